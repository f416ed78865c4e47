"""Whether the total field leaves its own trend.

The total field does not change with the attitude, and changes slowly with the place. The innovation
``e = F - L`` from a level L that follows it has the variance ``S = s^2 + (5/7 slope dt)^2 + sigma^2 +
sigma_L^2``: s (:mod:`magbridge.health.scatter`) and the slope are learned, and the sigmas are those of
the correction, only where a mass may have moved. Where ``e^2 > GATE^2 S``, a Kalman filter's gate (Bar-Shalom
et al. 2001, *Estimation with Applications to Tracking and Navigation*, section 5.4), the sample is an
outlier. Outliers that agree with each other are another level, which nothing explains: what follows is
doubtful by their sum, until it is nothing, and then for a while (:mod:`magbridge.health.moves`).
"""

from __future__ import annotations

from math import isnan, nan
from typing import Final

from magbridge.health.moves import Moves
from magbridge.health.scatter import Scatter

__all__ = ["GATE", "SLOPE_US", "Jump"]

GATE: Final = 7.0
"""Sigmas of an innovation; 5.5 would be one false alarm a month, were the noise Gaussian."""
ROCK: Final = (5.0 / GATE) ** 2
"""Of the slope's share in S: over a pause or a motion it is five sigmas of a slope that are acceptable."""
SLOPE: Final = 0.7
LEAST_SLOPE: Final = 0.05
"""nT/s, 1-sigma, by which the field changes as a vehicle passes rock: at first, and at least."""
SLOPE_US: Final = 20_000_000
"""µs over which it is measured."""
MEMORY: Final = 64
"""Slopes over which the usual one is learned."""
AGREE: Final = 3
"""Outliers that agree with each other are a new level."""
CLIP: Final = 16.0
"""Squares beyond this many times the usual (of slopes) or the gate (of outliers) count as this much."""
UNREST: Final = 0.3
BURST: Final = 8
BURST_UNREST: Final = 0.8
"""Share of an outlier's square that is added to the variance of the next sample, and so on: a spike passes.
One that comes within so many samples of another is rather noise, whose next sample is as bad."""


class Jump:
    """The level that the total field follows.

    Attributes
    ----------
    outlier : bool
        The last sample is one.
    moved : bool
        A mass may have moved since the last sample.
    """

    def __init__(self, scatter: Scatter, moves: Moves) -> None:
        self._scatter, self._moves = scatter, moves
        self.outlier = self.moved = False
        self._level = nan
        self._level_variance = 0.0
        self._level_us = 0
        self._before = nan  # the level before a sample that only the time or a mass's move made acceptable
        self._accepted = 0
        self._slope = SLOPE * SLOPE
        self._mark, self._mark_us = nan, 0
        self._unrest = 0.0
        self._decay, self._quiet = UNREST, BURST
        self._candidate, self._agreed = nan, 0

    def check(self, time_us: int, total: float, sigma: float, *, learn: bool) -> float:
        """Follow the level; return the variance (nT²) to add to that of a sample which is an outlier."""
        scatter = self._scatter
        if isnan(self._level):
            if learn:
                self._begin(time_us, total, sigma)
                scatter.begin(9.0 * max(sigma * sigma, scatter.floor))
            return 0.0
        variance = scatter.variance
        seconds = 1e-6 * (time_us - self._level_us)
        spread = variance + ROCK * self._slope * seconds * seconds
        if self.moved:
            spread += sigma * sigma + self._level_variance
        e = total - self._level
        scatter.follow(time_us, total)
        if e * e <= GATE * GATE * spread:
            return self._accept(time_us, e, sigma, variance, spread)
        if self._accepted < AGREE:
            if self.moved and learn:
                self._move(time_us, e)
            self._begin(time_us, total, sigma)  # which of the first is the outlier is not known
            self._accepted = 0
            return 0.0
        self._unrest = min(e * e, CLIP * GATE * GATE * spread)
        self._decay = BURST_UNREST if self._quiet < BURST else UNREST
        self._quiet = 0
        self.outlier = True
        if learn:
            self._agree(time_us, total, sigma, spread)
        return e * e

    def explain(self, by: float) -> None:
        """Take note that another calibration moves the total field `by` nT."""
        self._level += by
        self._candidate += by

    def forget(self) -> None:
        """Take note that another calibration explains past jumps: no slope is measured across them."""
        self._mark = nan

    def _accept(self, time_us: int, e: float, sigma: float, variance: float, spread: float) -> float:
        """Let the level follow; return what past outliers add, nT²."""
        self._accepted += 1
        self._agreed = 0
        self._before = self._level if e * e > GATE * GATE * variance else nan
        # where the slope is known, the sample knows better after a pause or a motion
        known = self._slope < 0.5 * SLOPE * SLOPE
        gain = 1.0 - 0.5 * (variance / spread if known else 1.0)
        self._begin(time_us, self._level + gain * e, sigma)
        if time_us - self._mark_us >= SLOPE_US:
            self._learn_slope(time_us)
        self._unrest = self._unrest * self._decay if self._unrest > variance else 0.0
        self._quiet += 1
        return self._unrest

    def _agree(self, time_us: int, total: float, sigma: float, spread: float) -> None:
        """Take an outlier, which may be of another level."""
        off = total - self._candidate
        if self._agreed and off * off <= GATE * GATE * spread:
            self._agreed += 1
            self._candidate += 0.5 * off
        else:
            self._candidate, self._agreed = total, 1
        if self._agreed == AGREE:
            back = self._candidate - self._before
            if not back * back <= GATE * GATE * spread:  # else the last that was accepted was the outlier
                self._move(time_us, self._candidate - self._level)
            self._begin(time_us, self._candidate, sigma)
            self._agreed = 0

    def _begin(self, time_us: int, level: float, sigma: float) -> None:
        self._level, self._level_us, self.moved = level, time_us, False
        self._level_variance = sigma * sigma

    def _move(self, time_us: int, by: float) -> None:
        self._mark = nan
        self._moves.take(time_us, by, GATE * GATE * self._scatter.variance, by_mass=self.moved)

    def _learn_slope(self, time_us: int) -> None:
        """Follow the mean square of the rate at which the level changes."""
        seconds = 1e-6 * (time_us - self._mark_us)
        rate = (self._level - self._mark) / seconds
        if rate == rate and seconds < 10e-6 * SLOPE_US:  # noqa: PLR0124 - NaN
            self._slope += (min(rate * rate, CLIP * self._slope) - self._slope) / MEMORY
            self._slope = max(self._slope, LEAST_SLOPE * LEAST_SLOPE)
        self._mark, self._mark_us = self._level, time_us
