"""Correct one sample after the other, as the bridge does.

Where a channel of the field or a position is NaN, or so large that the total field exceeds
:data:`~magbridge.records.MAX_MEASURED_NT`, total and vector are NaN and the sigmas infinite. The flag is
``gap`` if the field's channels are the reason, else ``stale_telemetry``. The total is never a guess. The
equations stand in :mod:`.kernel`.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, isnan, nan, sqrt
from typing import Final

from magbridge.calibration.kernel import Linear, Numbers, Prepared, apply, linear, prepare, variances
from magbridge.calibration.model import Calibration
from magbridge.calibration.terms import Step
from magbridge.errors import CalibrationError
from magbridge.records import MAX_MEASURED_NT, Corrected, Quality

Span = tuple[int, float, float]
GAP: Final = int(Quality.GAP)
STALE_TELEMETRY: Final = int(Quality.STALE_TELEMETRY)
EXTRAPOLATED: Final = int(Quality.EXTRAPOLATED)
RANGE_MARGIN_FRACTION = 0.02
"""Share of the half range: telemetry that jitters at the end of its range is not extrapolated."""


class Corrector:
    """Correct one sample after the other, as the bridge does.

    Notes
    -----
    While positions and the regressors of effects stay the same, only :func:`.kernel.apply` is computed again.
    """

    def __init__(self, calibration: Calibration) -> None:
        self.calibration = calibration
        self._kernel = calibration.kernel
        self._omega = omega(calibration)
        self._steps = begun(calibration)
        self._base = base_flags(calibration)
        self._ranges = ranges(calibration)
        self._wanted = len(calibration.channels)
        self._values: tuple[float, ...] | None = None
        self._flags = self._base
        self._last: list[float] = []
        self._prepared: Prepared = [], []
        self._weights: list[Linear] = [tuple(row) for row in self._kernel.weights.tolist()]
        self._positions = len(calibration.parameters)
        self._asked: tuple[tuple[float, ...], Sequence[Span]] = (), ()
        self._ends: list[tuple[int, int]] = []
        self._places: dict[tuple[float, ...], int] = {}
        self._there: list[Linear] = []
        self._field = (nan, nan, nan)
        self._time_us = 0

    @property
    def regressors(self) -> list[float]:
        """The regressors at the last sample: the monomials, then those of effects."""
        return self._last

    def vector_covariance(self) -> tuple[float, ...]:
        """Return the covariance of the last sample's vector without the boresight's part, 9 numbers, nT^2."""
        numbers, V = self._prepared
        (hx, hy, hz), (tx, ty, tz) = self._field, numbers[9:]
        xx, yy, zz, xy, xz, yz = variances(hx - tx, hy - ty, hz - tz, V)
        return xx, xy, xz, xy, yy, yz, xz, yz, zz

    def replace(self, calibration: Calibration, values: Sequence[float] = ()) -> float:
        """Continue with other coefficients of the same terms, or with effects added or removed at the end.

        `calibration`: effects that it has in common with the one before keep their state. `values`: its
        channels at the last sample; needed where it has effects more. Returns: nT, by which the total field
        of the last sample changes; NaN if there was none.
        """
        # Total field of the last sample by the old coefficients, for the change that is returned.
        before = apply(*self._field, self._prepared, self._omega)[0] if self._last else nan
        self.calibration, self._kernel, self._omega = calibration, calibration.kernel, omega(calibration)
        self._weights = [tuple(row) for row in self._kernel.weights.tolist()]
        self._values, self._asked, self._places, self._ends, self._there = None, ((), ()), {}, [], []
        self._wanted, self._base = len(calibration.channels), base_flags(calibration)
        # Effects in common keep their steppers, hence their state; new ones begin with the last sample.
        del self._steps[len(calibration.effects) :]
        regressors = self._last[: len(self._weights)]
        for effect in calibration.effects[len(self._steps) :]:
            step = effect.begin(calibration.channels, self._kernel)
            self._steps.append(step)
            if self._last:
                regressors += step(self._time_us, *self._field, values)
        self._last = regressors
        if not self._last:
            return nan
        self._prepared = prepare(self._kernel.sums_of_one(self._last))
        return apply(*self._field, self._prepared, self._omega)[0] - before

    def step(
        self, time_us: int, field: tuple[float, float, float], values: Sequence[float], quality: int = 0
    ) -> Corrected:
        """Correct one sample; see :meth:`numbers`."""
        (F, sigma, x, y, z, sx, sy, sz), quality = self.numbers(time_us, field, values, quality)
        return Corrected(F, sigma, (x, y, z), (sx, sy, sz), quality)

    def numbers(
        self, time_us: int, field: tuple[float, float, float], values: Sequence[float], quality: int
    ) -> tuple[Numbers, int]:
        """Correct one sample; return total field, its sigma, the vector, its sigmas, and the flags.

        Parameters
        ----------
        time_us : int
            µs since 1970 UTC.
        field : tuple of 3 float
            nT, raw, sensor axes.
        values : sequence of float
            ``calibration.channels``, in that order; NaN where unknown.
        quality : int
            Flags that the sample already carries.

        Raises
        ------
        CalibrationError
            Another number of values than the calibration's channels.
        """
        if len(values) != self._wanted:
            raise CalibrationError(
                f"expected {self._wanted} values ({', '.join(self.calibration.channels)}), "
                f"found {len(values)}"
            )
        # The table's sums are computed only where a position or a regressor changed.
        hx, hy, hz = self._field = field
        self._time_us = time_us
        values = tuple(values)
        if values != self._values or self._steps:
            self._values, self._flags = values, self._flags_of(values)
            regressors = self._kernel.monomials(values, 1.0)
            for effect in self._steps:
                regressors += effect(time_us, hx, hy, hz, values)
            if regressors != self._last:
                self._last = regressors
                self._prepared = prepare(self._kernel.sums_of_one(regressors))
        F, sigma, x, y, z, sx, sy, sz = apply(hx, hy, hz, self._prepared, self._omega)
        quality |= self._flags
        # The total is never a guess: without a finite, plausible field it is NaN, and sigma is infinite.
        if not F < MAX_MEASURED_NT:  # also NaN
            quality |= STALE_TELEMETRY if abs(hx) + abs(hy) + abs(hz) < MAX_MEASURED_NT else GAP
            F = x = y = z = nan
            sigma = sx = sy = sz = inf
        return (F, sigma, x, y, z, sx, sy, sz), quality

    def _flags_of(self, values: tuple[float, ...]) -> int:
        flags = self._base
        for value, (low, high) in zip(values, self._ranges, strict=False):
            if not low <= value <= high:
                flags |= STALE_TELEMETRY if isnan(value) else EXTRAPOLATED
        return flags

    def changes(
        self, field: tuple[float, float, float], values: tuple[float, ...], spans: Sequence[Span]
    ) -> list[float]:
        """Return the change (nT) of the total field over each span of a position, without effects.

        `field`: nT, raw, sensor axes. `values`: ``calibration.channels``, in that order. `spans` (int,
        float, float): index of a channel, and the two values between which it lies. Spans of channels that
        are not positions are left out of the result.
        """
        positions = values[: self._positions]
        asked = positions, spans
        if asked != self._asked:
            self._asked = asked
            # Coefficients at the ends of all spans; those of the previous call are kept.
            known = {place: self._there[n] for place, n in self._places.items()}
            places: dict[tuple[float, ...], int] = {}  # each once: most spans share an end
            self._ends = []
            for index, low, high in spans:
                if index < self._positions:
                    before, after = positions[:index], positions[index + 1 :]
                    start = places.setdefault((*before, low, *after), len(places))
                    self._ends.append((start, places.setdefault((*before, high, *after), len(places))))
            self._places = places
            self._there = [known.get(place) or self._linear_at(place) for place in places]
        # |A (H_r - T)| at both ends of each span.
        totals = [_total(field, there) for there in self._there]
        return [totals[high] - totals[low] for low, high in self._ends]

    def _linear_at(self, positions: tuple[float, ...]) -> Linear:
        """Return A's six entries and T."""
        return linear(self._kernel.monomials(positions, 1.0), self._weights)


def _total(field: tuple[float, float, float], linear: Linear) -> float:
    """Return ``|A (H_r - T)|``."""
    xx, yy, zz, xy, xz, yz, tx, ty, tz = linear
    hx, hy, hz = field
    dx, dy, dz = hx - tx, hy - ty, hz - tz
    bx = xx * dx + xy * dy + xz * dz
    by = xy * dx + yy * dy + yz * dz
    bz = xz * dx + yz * dy + zz * dz
    return sqrt(bx * bx + by * by + bz * bz)


def omega(calibration: Calibration) -> tuple[float, ...] | None:
    """Return six entries of the boresight's covariance, as :func:`.kernel.apply` takes them."""
    if calibration.boresight is None:
        return None
    O = calibration.boresight.covariance  # noqa: E741 - Omega, as in the equation
    return O[0][0], O[1][1], O[2][2], O[0][1], O[0][2], O[1][2]


def begun(calibration: Calibration) -> list[Step]:
    """Return a stepper for each effect, in a fresh state."""
    return [effect.begin(calibration.channels, calibration.kernel) for effect in calibration.effects]


def base_flags(calibration: Calibration) -> int:
    """Return the flags that every sample has."""
    flags = Quality(0) if calibration.boresight else Quality.NO_BORESIGHT
    return int(flags | Quality.UNCALIBRATED) if calibration.method == "none" else int(flags)


def ranges(calibration: Calibration) -> list[tuple[float, float]]:
    """Return the lowest and the highest value of each parameter that is not extrapolated."""
    return [
        (
            parameter.low - RANGE_MARGIN_FRACTION * parameter.scale,
            parameter.high + RANGE_MARGIN_FRACTION * parameter.scale,
        )
        for parameter in calibration.parameters
    ]
