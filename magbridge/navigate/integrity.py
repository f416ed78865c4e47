"""Integrity: tests of the filter against other explanations of the field.

A filter at the wrong place has small innovations, because it has moved to where they are small. The error
shows only when another explanation predicts the same measurements better. Two are kept in addition to the
filter:
*elsewhere*, a bank of hypotheses spread around it; and *nowhere*, a random field as rough as the map but
unrelated to it.

The odds of each against the filter, ratios of the products of predictive likelihoods, are a martingale as
long as the filter is right, so they ever exceed c with a probability of at most 1/c (Ville 1939): a
threshold of c limits false alarms to 1/c.
"""

from __future__ import annotations

from enum import Enum
from math import exp, expm1, log, pi, sqrt

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.field.grid import AnomalyGrid
from magbridge.navigate.bank import Bank, widest
from magbridge.navigate.deadreckoning import Step
from magbridge.navigate.model import Block, average, block_length, transition
from magbridge.navigate.options import NavigationOptions

__all__ = ["IntegrityMonitor", "Unmapped", "Verdict", "squared_mahalanobis"]

MAX_AGREEING_DISTANCE = 9.0
"""Squared distance in sigmas within which two estimates are the same place."""
ELSEWHERE = 16.0
"""Squared distance in sigmas beyond which they are not."""
MAX_AVERAGING_US = 45_000_000
"""µs over which blocks are averaged to one measurement of the competing filters."""
MAX_AVERAGING_BLOCKS = 3.0
"""Distance over that which a block covers: they are averaged after it, if that comes sooner."""


class Verdict(Enum):
    """Result of comparing the filter with competing ones."""

    OPEN = "not yet decided"
    HOLDS = "the filter holds"
    ELSEWHERE = "another place explains the field better"
    NOWHERE = "the map does not explain the field"


class Unmapped:
    """The field as a smooth random function of the distance, with the map's scatter and correlation length.

    It predicts measurements as if the map were unrelated to the field: a Matérn process of smoothness 3/2
    with two states (value nT, slope nT/m). Bias and map error enter by the variance that they add in each
    step.

    Notes
    -----
    ``F = exp(-λd) [[1 + λd, d], [-λ²d, 1 - λd]]``, ``λ = √3/L``, stationary covariance ``diag(σ², λ²σ²)``
    (Hartikainen & Särkkä 2010, sec. 4).
    """

    def __init__(self, grid: AnomalyGrid, options: NavigationOptions) -> None:
        self._options = options
        self._rate = sqrt(3.0) / grid.correlation_length
        self._mean = float(np.nanmean(grid.anomaly))
        self._value = float(np.nanvar(grid.anomaly)) + options.bias_sigma**2 + options.map_sigma**2
        self._slope = self._rate**2 * float(np.nanvar(grid.anomaly))
        self._x = 0.0, 0.0
        self._p = self._value, 0.0, self._slope

    def update(self, block: Block, step: Step, curvature_variance: float) -> float:
        """Update with a measurement, one `step` after the previous one; return its log-likelihood.

        `curvature_variance` (nT²) is what the filter adds to the measurement's variance for the map's
        curvature. It is added here too; else a filter that is still searching would lose by its larger
        variance alone.
        """
        o, rate = self._options, self._rate
        seconds, metres, _ = step
        # Prediction over the distance d: F = [[a, b], [c, d]] of the Matern process (see Notes).
        kept = exp(-rate * metres)
        a, b = kept * (1.0 + rate * metres), kept * metres
        c, d = -kept * rate * rate * metres, kept * (1.0 - rate * metres)
        value, slope = a * self._x[0] + b * self._x[1], c * self._x[0] + d * self._x[1]
        p, q, r = self._p
        v, w = self._value, self._slope
        # What bias and map error may have changed since the previous measurement.
        wander = o.map_sigma**2 * -expm1(-2.0 * metres / o.map_length)
        wander += o.bias_sigma**2 * -expm1(-2.0 * seconds / o.bias_time)
        p, q, r = (
            a * a * (p - v) + 2.0 * a * b * q + b * b * (r - w) + v + wander,
            a * c * (p - v) + (a * d + b * c) * q + b * d * (r - w),
            c * c * (p - v) + 2.0 * c * d * q + d * d * (r - w) + w,
        )
        # Kalman update of the two states with H = [1, 0], and the log-likelihood of the innovation.
        y, s = block.anomaly - self._mean - value, p + block.variance + curvature_variance
        self._x = value + p / s * y, slope + q / s * y
        self._p = p - p * p / s, q - p * q / s, r - q * q / s
        return -0.5 * (y * y / s + log(2.0 * pi * s))


class IntegrityMonitor:
    """Two banks compared on equal terms: *here* begins at the filter, *elsewhere* is spread around it.

    Both use the same measurements, several blocks averaged to one, because a bank costs more than a filter
    and the comparison can wait a minute. The filter starts a new monitor once it is confirmed or starts
    again. `x` (6,) and `P` (6, 6) are the filter's estimate at `time_us`, `reach` (m) the 1-sigma by which
    *elsewhere* is spread around it, and `resolution` (m) that of the banks. `levels` (nT) are the 1-sigma of
    the bias elsewhere, and that of half of the places there; 0: of none.
    """

    def __init__(
        self,
        grid: AnomalyGrid,
        options: NavigationOptions,
        x: FloatArray,
        P: FloatArray,
        time_us: int,
        reach: float,
        resolution: float,
        levels: tuple[float, float],
    ) -> None:
        level, doubted = levels
        # *elsewhere* begins with the filter's covariance, widened in position, current and bias.
        wide = P.copy()
        wide[:2, :2] += reach**2 * np.eye(2)
        for state, sigma in ((2, options.current_sigma), (3, options.current_sigma), (4, level)):
            wide[state, state] = max(wide[state, state], sigma**2)
        self._options, self._time_us = options, time_us
        self._threshold = log(options.alarm_odds)
        self._waiting: list[Block] = []
        self._since, self._step = Step(), MAX_AVERAGING_BLOCKS * block_length(grid)
        self.here = Bank(grid, x, P, resolution, options.gate)
        self.elsewhere = Bank(grid, x, wide, resolution, options.gate, doubted)
        self.odds = 0.0
        """Natural logarithm of the odds of *elsewhere* against *here*."""

    def step(self, block: Block, step: Step, x: FloatArray, P: FloatArray) -> Verdict:
        """Update both banks with a block, one `step` after the previous one, and compare them.

        They are compared with the filter's estimate after that block: `x` (6,) and its covariance `P`
        (6, 6).
        """
        # Collect blocks until the competing filters are worth an update.
        self._waiting.append(block)
        self._since = self._since.joined(step)
        first = self._waiting[0]
        if block.time_us - first.time_us < MAX_AVERAGING_US and self._since.metres < self._step:
            return Verdict.OPEN
        together = average(self._waiting)
        seconds = (together.time_us - self._time_us) * 1e-6
        F, Q = transition(self._options, seconds, self._since.metres, self._since.noise)
        self._time_us, self._since = together.time_us, Step()
        self._waiting.clear()
        self.here.predict(F, Q)
        self.elsewhere.predict(F, Q)
        # Both predict the same measurement: the difference of log-likelihoods is the change of the log odds.
        self.odds += self.elsewhere.update(together)[2] - self.here.update(together)[2]
        return self._compare(x, P)

    def surrender(self, time_us: int) -> Bank:
        """Return *elsewhere*, propagated to `time_us`, to replace the filter."""
        self.elsewhere.predict(*transition(self._options, (time_us - self._time_us) * 1e-6, 0.0))
        return self.elsewhere

    def _compare(self, x: FloatArray, P: FloatArray) -> Verdict:
        there, spread = self.elsewhere.moments()
        # Another place has won if its odds pass the threshold and it is another place indeed.
        if self.odds > self._threshold and squared_mahalanobis(there - x, P) > ELSEWHERE:
            return Verdict.ELSEWHERE
        # As long as *elsewhere* covers several places, nothing is decided.
        if widest(spread) > 1.5 * max(self.elsewhere.resolution, widest(P)):
            return Verdict.OPEN
        # Spread out and started wide, it came back to the filter's place: the filter holds.
        if squared_mahalanobis(there - x, spread + P) < MAX_AGREEING_DISTANCE:
            return Verdict.HOLDS
        here, narrow = self.here.moments()  # where the filter would be without its single linearisation
        return (
            Verdict.ELSEWHERE
            if squared_mahalanobis(there - here, spread + narrow) < MAX_AGREEING_DISTANCE
            else Verdict.OPEN
        )


def squared_mahalanobis(difference: FloatArray, P: FloatArray) -> float:
    """Return the squared Mahalanobis distance of two positions by their difference, m, and its covariance.

    The first two elements of `difference` (2,) or (6,), and of `P`, are north and east.
    """
    return float(difference[:2] @ np.linalg.solve(P[:2, :2], difference[:2]))
