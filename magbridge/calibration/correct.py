"""Correct raw samples: one after the other as the bridge does, or many at once.

If a channel of the field or a position is NaN, or so large that the total field exceeds
:data:`~magbridge.records.MAX_MEASURED_NT`, total and vector are NaN and the sigmas infinite. The sample is
flagged ``gap`` if the field's channels are the reason, else ``stale_telemetry``. :mod:`.kernel` gives the
equations, and :class:`Corrector` and :func:`correct` share its functions. The inverse :func:`forward`
computes the readings from the true field: ``H_r = A^-1 R^T H + T``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from math import inf, isnan, nan, sqrt
from typing import Final, NamedTuple

import numpy as np

from magbridge.arrays import FloatArray, IntArray
from magbridge.calibration.kernel import Kernel, Numbers, Prepared, apply, prepare, variances
from magbridge.calibration.model import Calibration, coefficient_tensor
from magbridge.calibration.terms import LogSeries, Step
from magbridge.errors import CalibrationError
from magbridge.estimation.residual import PAIRS, symmetric
from magbridge.records import MAX_MEASURED_NT, Corrected, Quality

Span = tuple[int, float, float]
"""Index of a channel, and two values of it between which it lies, in its unit."""
GAP: Final = int(Quality.GAP)
STALE_TELEMETRY: Final = int(Quality.STALE_TELEMETRY)
EXTRAPOLATED: Final = int(Quality.EXTRAPOLATED)
RANGE_MARGIN_FRACTION = 0.02
"""Fraction of a parameter's half range by which it may leave the range before a sample counts as
extrapolated, because telemetry jitters at the end of its range."""
CACHED_POSITIONS = 16
"""Number of sets of positions whose coefficients :meth:`Corrector.changes` keeps."""


class Corrector:
    """Corrector of single samples in order of time, with the state of the calibration's effects.

    Notes
    -----
    While positions and the regressors of effects do not change, each sample only needs :func:`.kernel.apply`.
    """

    def __init__(self, calibration: Calibration) -> None:
        self.calibration = calibration
        self._kernel = calibration.kernel
        self._omega = _omega_of(calibration)
        self._steps = [one.begin(calibration.channels, self._kernel) for one in calibration.effects]
        self._base = _base_flags(calibration)
        self._ranges = valid_ranges(calibration)
        self._wanted = len(calibration.channels)
        self._values: tuple[float, ...] | None = None
        self._flags = self._base
        self._last: list[float] = []
        self._prepared: Prepared = [], []
        self._linear_at = lru_cache(CACHED_POSITIONS)(self._kernel.linear_at)
        self._field = (nan, nan, nan)
        self._time_us = 0
        self._error_effects: FloatArray | None = None

    @property
    def regressors(self) -> list[float]:
        """Regressors at the last sample: the monomials, then the regressors of effects."""
        return self._last

    def vector_covariance(self) -> tuple[float, ...]:
        """Return the 9 entries of the last vector's covariance, nT^2, without the boresight's error."""
        numbers, V = self._prepared
        (hx, hy, hz), (tx, ty, tz) = self._field, numbers[9:]
        xx, yy, zz, xy, xz, yz = variances(hx - tx, hy - ty, hz - tz, V)
        return xx, xy, xz, xy, yy, yz, xz, yz, zz

    def replace(self, calibration: Calibration, values: Sequence[float] = ()) -> float:
        """Continue with another calibration; return the change of the last sample's total field, nT.

        `calibration`: the same terms with other coefficients, or with effects added or removed at the end.
        Effects that both calibrations have keep their state. `values`: its channels at the last sample,
        needed if effects are added. The change is NaN if no sample has been corrected.
        """
        # Total field of the last sample by the old coefficients, for the change that is returned.
        before = apply(*self._field, self._prepared, self._omega)[0] if self._last else nan
        self.calibration, self._kernel, self._omega = calibration, calibration.kernel, _omega_of(calibration)
        self._linear_at = lru_cache(CACHED_POSITIONS)(self._kernel.linear_at)
        self._error_effects, self._values = None, None
        self._wanted, self._base = len(calibration.channels), _base_flags(calibration)
        # Common effects keep their steppers, hence their state; new effects begin with the last sample.
        del self._steps[len(calibration.effects) :]
        regressors = self._last[: len(self._kernel.weights)]
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
        """Correct one sample; arguments and errors as for :meth:`numbers`."""
        (F, sigma, x, y, z, sx, sy, sz), quality = self.numbers(time_us, field, values, quality)
        return Corrected(F, sigma, (x, y, z), (sx, sy, sz), quality)

    def numbers(
        self, time_us: int, field: tuple[float, float, float], values: Sequence[float], quality: int
    ) -> tuple[Numbers, int]:
        """Correct one sample; return total field, its sigma, the vector, its sigmas, and the flags.

        Parameters
        ----------
        time_us : int
            Time of the sample, µs since 1970 UTC.
        field : tuple of 3 float
            Raw reading in sensor axes, nT.
        values : sequence of float
            Value of each of ``calibration.channels``, in their order; NaN where unknown.
        quality : int
            Flags that the sample already has.

        Raises
        ------
        CalibrationError
            The number of values is not that of the calibration's channels.
        """
        if len(values) != self._wanted:
            raise CalibrationError(
                f"expected {self._wanted} values ({', '.join(self.calibration.channels)}), "
                f"found {len(values)}"
            )
        # Compute the table's sums only if a position or a regressor changed.
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
        """Return by how much (nT) the total field changes from the first to the second value of each span.

        `field`: raw reading in sensor axes, nT. `values`: value of each of ``calibration.channels``, in their
        order. `spans`: index of a channel, and the two values between which it lies. The result omits spans
        of channels that are not positions, and does not include effects.
        """
        k = len(self._kernel.centre)
        found = []
        for index, low, high in spans:
            if index < k:
                before, after = values[:index], values[index + 1 : k]
                start = _total(field, self._linear_at((*before, low, *after)))
                end = _total(field, self._linear_at((*before, high, *after)))
                found.append(end - start)
        return found

    def error_effects(self) -> FloatArray:
        """Return the derivative (r,) of the last total field, nT, by the calibration's independent errors.

        An error of 1 is one standard deviation, and the sum of squares is the variance of the total field
        that the covariance of the coefficients causes.
        """
        if self._error_effects is None:
            # C = R R^T; the effect of each column of R on the nine coefficients of each regressor
            calibration = self.calibration
            tensor = coefficient_tensor(calibration)[0]
            eigenvalues, vectors = np.linalg.eigh(calibration.covariance)
            known = eigenvalues > 0.0
            root = vectors[:, known] * np.sqrt(eigenvalues[known])
            self._error_effects = root.T @ tensor.reshape(len(tensor), -1)
        phi = np.array(self._last)
        theta = phi @ self._kernel.weights
        # b = A d with d = H_r - T; dF/dA_ij = u_i d_j, and dF/dT = -A^T u
        A, d = symmetric(theta[None])[0], np.array(self._field) - theta[6:]
        b = A @ d
        u = b / np.sqrt(b @ b)
        by_A = np.outer(u, d)
        by_A += by_A.T
        by_six = [by_A[i, j] * (0.5 if i == j else 1.0) for i, j in PAIRS]
        by_nine = np.concatenate([np.array(by_six) / self._kernel.field, -(A @ u)])
        return np.asarray(self._error_effects @ np.outer(phi, by_nine).ravel())


def _total(field: tuple[float, float, float], linear: list[float]) -> float:
    """Return the total field ``|A (H_r - T)|``, nT, of a raw reading `field`, nT; `linear`: A and T."""
    xx, yy, zz, xy, xz, yz, tx, ty, tz = linear
    hx, hy, hz = field
    dx, dy, dz = hx - tx, hy - ty, hz - tz
    bx = xx * dx + xy * dy + xz * dz
    by = xy * dx + yy * dy + yz * dz
    bz = xz * dx + yz * dy + zz * dz
    return sqrt(bx * bx + by * by + bz * bz)


def _omega_of(calibration: Calibration) -> tuple[float, ...] | None:
    """Return xx, yy, zz, xy, xz, yz of the boresight's covariance, rad^2; None without a boresight."""
    if calibration.boresight is None:
        return None
    O = calibration.boresight.covariance  # noqa: E741 - Omega, as in the equation
    return O[0][0], O[1][1], O[2][2], O[0][1], O[0][2], O[1][2]


def _base_flags(calibration: Calibration) -> int:
    """Return the flags that every sample gets because of the calibration itself."""
    flags = Quality(0) if calibration.boresight else Quality.NO_BORESIGHT
    return int(flags | Quality.UNCALIBRATED) if calibration.method == "none" else int(flags)


def valid_ranges(calibration: Calibration) -> list[tuple[float, float]]:
    """Return the lowest and highest value of each parameter for which samples are not ``extrapolated``."""
    margins = ((one, RANGE_MARGIN_FRACTION * one.scale) for one in calibration.parameters)
    return [(one.low - margin, one.high + margin) for one, margin in margins]


# ---- Many samples at once ----

CORRECTED_AT_ONCE = 4096
"""Number of samples in a block: it outweighs the overhead of a call and fits the cache of a core."""


class CorrectedArrays(NamedTuple):
    """Corrected samples as arrays."""

    total: FloatArray
    sigma: FloatArray
    """`total`, `sigma`: (n,): Total field and its standard deviation, nT."""
    vector: FloatArray
    vector_sigma: FloatArray
    """`vector`, `vector_sigma`: (n, 3): Field vector and its standard deviations, nT, in body axes; in sensor
    axes if the flag ``no_boresight`` is set."""
    quality: IntArray
    """(n,): Flags of each sample, bits of :class:`~magbridge.records.Quality`."""


def correct(
    calibration: Calibration, field: FloatArray, channels: FloatArray, time: FloatArray
) -> CorrectedArrays:
    """Correct many samples; the result equals that of :class:`Corrector` to within 1e-12 of the field.

    Parameters
    ----------
    calibration : Calibration
        Calibration of the sensor that took the samples.
    field : (n, 3) array
        Raw readings in sensor axes, nT.
    channels : (n, k) array
        Values of ``calibration.channels``, in their order; NaN where unknown.
    time : (n,) array
        Time of the samples, s since 1970 UTC, ascending because effects may have a state.

    Returns
    -------
    CorrectedArrays

    Raises
    ------
    CalibrationError
        `channels` has another shape.
    """
    field, channels = np.asarray(field, float), np.asarray(channels, float)
    n, names = len(field), calibration.channels
    if channels.size != n * len(names) or (channels.ndim > 1 and len(channels) != n):
        wanted = f"shape {(n, len(names))} for {', '.join(names)}" if names else "none"
        raise CalibrationError(f"channels: expected {wanted}, got shape {channels.shape}")
    channels = channels.reshape(n, len(names))
    out, turn = np.empty((8, n)), _omega_of(calibration)
    with np.errstate(all="ignore"):  # NaN inputs give NaN results, which are flagged below
        for part, prepared in _prepared_blocks(calibration, field, channels, time):
            hx, hy, hz = field[part].T
            out[:, part] = apply(hx, hy, hz, prepared, turn, np.sqrt)
        # The flags of :class:`Corrector`, for arrays.
        quality = np.full(n, _base_flags(calibration))
        for value, (low, high) in zip(channels.T, valid_ranges(calibration), strict=False):
            quality |= np.where((value < low) | (value > high), EXTRAPOLATED, 0)
            quality |= np.where(np.isnan(value), STALE_TELEMETRY, 0)
        lost = ~(out[0] < MAX_MEASURED_NT)
        measured = np.abs(field).sum(axis=1) < MAX_MEASURED_NT
        quality |= np.where(lost, np.where(measured, STALE_TELEMETRY, GAP), 0)
    out[np.ix_([0, 2, 3, 4], lost)] = np.nan
    out[np.ix_([1, 5, 6, 7], lost)] = inf
    return CorrectedArrays(out[0], out[1], out[2:5].T, out[5:8].T, quality)


def vector_covariance(
    calibration: Calibration, field: FloatArray, channels: FloatArray, time: FloatArray
) -> FloatArray:
    """Return the covariance (n, 3, 3), nT^2, of corrected vectors without the error of the boresight.

    Arguments as for :func:`correct`.

    Notes
    -----
    ``V_ij = Q_ij . (d d^T) + L_ij . d + O_ij`` with ``d = H_r - T`` (:mod:`.kernel`).
    """
    out = np.empty((len(field), 3, 3))
    with np.errstate(all="ignore"):
        for part, (linear, V) in _prepared_blocks(calibration, field, channels, time):
            # d = H_r - T, then the six entries of V.
            d = field[part].T - np.stack(linear[9:12])
            for (i, j), value in zip(PAIRS, variances(d[0], d[1], d[2], V), strict=True):
                out[part, i, j] = out[part, j, i] = value
    return out


def _prepared_blocks(
    calibration: Calibration, field: FloatArray, channels: FloatArray, time: FloatArray
) -> Iterator[tuple[slice, Prepared]]:
    """Yield the rows of each block, in order of time, and the input of :func:`.kernel.apply` for them."""
    kernel = calibration.kernel
    steps = [effect.begin(calibration.channels, kernel) for effect in calibration.effects]
    for start in range(0, len(field), CORRECTED_AT_ONCE):
        part = slice(start, start + CORRECTED_AT_ONCE)
        yield part, _prepare_many(kernel, _regressors(kernel, steps, field[part], channels[part], time[part]))


def _regressors(
    kernel: Kernel, steps: list[Step], field: FloatArray, channels: FloatArray, time: FloatArray
) -> FloatArray:
    """Return the regressors (m, n) of n samples, those of effects computed by their steppers `steps`."""
    phi = kernel.monomials(list(channels.T), np.ones(len(field)))
    if steps:
        times = np.rint(np.asarray(time) * 1e6).astype(np.int64).tolist()
        samples = list(zip(times, *field.T.tolist(), channels.tolist(), strict=True))
        for step in steps:
            phi += list(np.array([step(*sample) for sample in samples]).T)
    return np.stack(phi)


def regressors(
    calibration: Calibration, field: FloatArray, channels: FloatArray, time: FloatArray
) -> FloatArray:
    """Return the regressors (m, n) of n samples, those of effects computed by their method ``batch``.

    Arguments as for :func:`correct`. Unlike it, :func:`correct` uses the steppers, as the bridge does.
    """
    kernel, channels = calibration.kernel, channels.reshape(len(field), -1)
    series = LogSeries(time, field, dict(zip(calibration.channels, channels.T, strict=True)), kernel)
    positions = list(channels.T)[: len(kernel.centre)]
    phi = [*kernel.monomials(positions, np.ones(len(field)))]
    for effect in calibration.effects:
        phi += list(effect.batch(series))
    return np.stack(phi)


def _prepare_many(kernel: Kernel, phi: FloatArray) -> Prepared:
    """Return the input of :func:`.kernel.apply` for n samples' regressors (m, n)."""
    # At rest the regressors of successive samples are equal: prepare each stretch once, and repeat it.
    new = np.ones(phi.shape[1], bool)
    new[1:] = (phi[:, 1:] != phi[:, :-1]).any(axis=0)
    if 2 * np.count_nonzero(new) > len(new):
        return prepare(list(kernel.sums(phi)))
    phi = phi[:, new]
    linear, V = prepare(list(kernel.sums(phi)))
    back = np.cumsum(new) - 1
    return [row[back] for row in linear], [[row[back] for row in entry] for entry in V]


def forward(
    calibration: Calibration, field_body: FloatArray, channels: FloatArray, time: FloatArray
) -> FloatArray:
    """Return the noiseless readings of a sensor in a true field; the inverse of :func:`correct`.

    Parameters
    ----------
    calibration : Calibration
        Calibration of the simulated sensor.
    field_body : (n, 3) array
        True field in body axes, nT; in sensor axes if the calibration has no boresight.
    channels : (n, k) array
        Values of ``calibration.channels``, in their order.
    time : (n,) array
        Time of the samples, s since 1970 UTC.

    Returns
    -------
    (n, 3) array
        Raw readings in sensor axes, nT.
    """
    truth = np.asarray(field_body, float)
    if calibration.boresight is not None:
        truth = truth @ calibration.boresight.matrix()
    reading = truth
    # the first pass is exact unless effects depend on the reading; then each further pass gains two digits
    for _ in range(6 if calibration.effects else 1):
        # the nine coefficients at every sample, with effects
        phi = regressors(calibration, reading, np.asarray(channels, float), time)
        theta = phi.T @ calibration.kernel.weights
        reading = np.linalg.solve(symmetric(theta), truth[:, :, None])[:, :, 0] + theta[:, 6:]
    return reading
