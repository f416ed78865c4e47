r"""Compare the total fields of two sensors of one vehicle, and find which of them is wrong.

Both sensors measure the same field, so their difference d has the variance :math:`s_1^2 + s_2^2` of their
sigmas. If d is much larger for long, one sensor is wrong: the sensor whose samples are flagged, or else the
sensor that the main field contradicts. The Earth's field F is normal about the main field R, with the
standard deviation :math:`\sigma_R`. If sensor 1 is wrong, sensor 2 measures F, and vice versa. The log ratio
of 'sensor 1 is wrong' over 'sensor 2 is wrong' is

.. math:: \frac{(F_1 - R)^2}{2 (\sigma_R^2 + s_1^2)} - \frac{(F_2 - R)^2}{2 (\sigma_R^2 + s_2^2)}

The variance that neither sigma explains, :math:`d^2 - s_1^2 - s_2^2`, is added to that of the wrong sensor,
or to both sensors' if the evidence does not show which is wrong.
"""

from __future__ import annotations

from math import isfinite
from typing import Final, NamedTuple

from magbridge.calibration.scalar import DISAGREEMENT_SIGMA
from magbridge.records import Quality

MIN_COMPARED: Final = 5
MIN_DISAGREEMENT_US: Final = 1_000_000
"""Number of consecutive comparisons, and time (µs), that begin or end a disagreement."""
BLAME_LOG_RATIO: Final = 3.0
"""Log ratio above which the main field decides which sensor is wrong: odds of 20 to 1."""
MAX_INTERVAL_US: Final = 10_000_000
"""Longest interval between two samples of a sensor over which its field is interpolated, µs."""
DOUBTFUL: Final = int(
    Quality.IMPLAUSIBLE | Quality.SATURATED | Quality.OFFSET_SUSPECT | Quality.STALE_TELEMETRY
)
"""Flags that mark a sample as faulty without the other sensor."""
IMPLAUSIBLE: Final = int(Quality.IMPLAUSIBLE)


class ComparedSample(NamedTuple):
    """Sample of one of the two sensors, as the comparison uses it."""

    time_us: int
    total: float
    """Total field, nT."""
    sigma: float
    """1-sigma of the total field, nT."""
    reference: float
    """Total field of the main-field model at the sample, nT; NaN if unknown."""
    is_doubtful: bool
    """True if the sample's own flags show a fault."""


class SensorComparison:
    """Comparison of the total fields of two sensors, sample by sample; messages use the sensors' `names`.

    `message` tells the operator the last change of the state; the caller empties it. `is_wrong` is True while
    the sensors disagree. `blamed` (0 or 1) is the index of the wrong sensor, or None if unknown.
    """

    def __init__(self, names: tuple[str, str]) -> None:
        self._names = names
        self.message = ""
        self.is_wrong = False
        self.blamed: int | None = None
        self._previous: list[ComparedSample | None] = [None, None]
        self._last: list[ComparedSample | None] = [None, None]
        self._excess = 0.0
        self._run, self._since_us = 0, 0

    def update(
        self,
        side: int,
        time_us: int,
        total_field: tuple[float, float],
        main_field: tuple[float, float],
        quality: int,
    ) -> tuple[float, int]:
        """Compare a sample with the other sensor; return the variance (nT²) and flags to add to the sample.

        `side` (0 or 1) is the sensor's index, `total_field` the total field with its 1-sigma (nT).
        `main_field` is the main field (NaN if unknown) with the 1-sigma of the Earth's field about it (nT).
        `quality` has the sample's :class:`~magbridge.records.Quality` bits.
        """
        total, sigma = total_field
        if isfinite(total + sigma):
            sample = ComparedSample(time_us, total, sigma, main_field[0], bool(quality & DOUBTFUL))
            self._previous[side], self._last[side] = self._last[side], sample
            self._compare(side, main_field[1])
        if self.blamed not in (None, side):
            return 0.0, 0
        return self._excess, IMPLAUSIBLE if self.is_wrong and self.blamed == side else 0

    def _compare(self, side: int, reference_sigma: float) -> None:
        """Compare the other sensor's last sample with the field of sensor `side` at the same time."""
        before, after, other = self._previous[side], self._last[side], self._last[1 - side]
        if before is None or after is None or other is None:
            return
        step_us = after.time_us - before.time_us
        if not (before.time_us < other.time_us <= after.time_us and step_us <= MAX_INTERVAL_US):
            return
        # linear interpolation of this sensor at the time of the other one
        fraction = (other.time_us - before.time_us) / step_us
        total = before.total + fraction * (after.total - before.total)
        difference = total - other.total
        # variance of the difference if both sigmas are right
        expected = after.sigma**2 + other.sigma**2
        # beyond the sigmas, or during a disagreement: the variance that neither sigma explains
        disagrees = difference * difference > DISAGREEMENT_SIGMA**2 * expected
        self._excess = difference * difference - expected if disagrees or self.is_wrong else 0.0
        self._excess = max(self._excess, 0.0)
        self._count(disagrees, other.time_us)
        if self.is_wrong:
            pair = (after, other) if side == 0 else (other, after)
            self._blame(pair, reference_sigma)
            self._report(abs(difference))

    def _count(self, disagrees: bool, time_us: int) -> None:
        """Begin or end the disagreement, once enough consecutive comparisons support the change."""
        # a state changes only after several comparisons in a row
        if disagrees == self.is_wrong:
            self._run = 0
            return
        if self._run == 0:
            self._since_us = time_us
        self._run += 1
        if self._run < MIN_COMPARED or time_us - self._since_us < MIN_DISAGREEMENT_US:
            return
        self.is_wrong, self._run, self.blamed = disagrees, 0, None
        if not disagrees:
            self._excess = 0.0
            self.message = f"{self._names[0]} and {self._names[1]} agree again"
        else:
            self._reported: int | None = -1

    def _blame(self, pair: tuple[ComparedSample, ComparedSample], reference_sigma: float) -> None:
        """Decide which sensor is wrong; keep the last decision unless the evidence contradicts it."""
        first, second = pair
        if first.is_doubtful != second.is_doubtful:
            self.blamed = 0 if first.is_doubtful else 1
            return
        squares = [(one.total - one.reference) ** 2 / (reference_sigma**2 + one.sigma**2) for one in pair]
        # log ratio of the module, up to the logarithm of the variances
        log_ratio = 0.5 * (squares[0] - squares[1])  # NaN without a position: no decision
        if log_ratio > BLAME_LOG_RATIO:
            self.blamed = 0
        elif log_ratio < -BLAME_LOG_RATIO:
            self.blamed = 1

    def _report(self, difference: float) -> None:
        if self._reported == self.blamed:
            return
        self._reported = self.blamed
        a, b = self._names
        if self.blamed is None:
            self.message = f"{a} and {b} differ by {difference:.0f} nT: one is wrong"
        else:
            wrong, right = (a, b) if self.blamed == 0 else (b, a)
            self.message = f"{wrong} is wrong: {difference:.0f} nT off {right}"
