"""Integrity: tests of the filter against other explanations of the field.

A filter at a wrong place has small innovations, because it has moved to where they are small. The error
shows only if another explanation predicts the same measurements better. Two explanations compete with the
filter: *elsewhere*, a bank of hypotheses spread around it; and *nowhere*, a random field as rough as the map
but unrelated to it.

The odds of each against the filter are ratios of the products of predictive likelihoods. As long as the
filter is right, these odds are a martingale. They then ever exceed c with a probability of at most 1/c
(Ville 1939): a threshold of c limits false alarms to 1/c.
"""

from __future__ import annotations

from enum import Enum
from math import expm1, log, pi, sqrt

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.estimation.track_process import matern_transition
from magbridge.field.grid import AnomalyGrid
from magbridge.navigate.bank import Bank, widest
from magbridge.navigate.deadreckoning import Step
from magbridge.navigate.model import Block, average, block_length, transition
from magbridge.navigate.options import NavigationOptions
from magbridge.navigate.record import Rival

__all__ = ["ELSEWHERE", "Competitor", "IntegrityMonitor", "Unmapped", "Verdict", "squared_mahalanobis"]

MAX_AGREEING_DISTANCE = 9.0
"""Largest squared Mahalanobis distance of two estimates of the same place."""
ELSEWHERE = 16.0
"""Squared Mahalanobis distance beyond which two estimates are different places."""
MAX_AVERAGING_US = 45_000_000
"""Longest time over which blocks are averaged to one measurement of the competing filters, µs."""
MAX_AVERAGING_BLOCKS = 3.0
"""Longest distance over which blocks are averaged to such a measurement, in block lengths."""


class Verdict(Enum):
    """Result of comparing the filter with competing ones."""

    OPEN = "not yet decided"
    HOLDS = "the filter holds"
    ELSEWHERE = "another place explains the field better"
    NOWHERE = "the map does not explain the field"


class Unmapped:
    """Model of a field that is unrelated to the map, to compare with the filter by its likelihood.

    The field is a random function of the distance with the map's scatter and correlation length: a Matérn
    process of smoothness 3/2 with two states (value nT, slope nT/m). Bias and map error add their variance
    in each step.

    Notes
    -----
    F is that of :mod:`magbridge.estimation.track_process`, the stationary covariance ``diag(σ², λ²σ²)``.
    """

    def __init__(self, grid: AnomalyGrid, options: NavigationOptions) -> None:
        self._options = options
        self._rate = sqrt(3.0) / grid.correlation_length
        self._mean, variance = grid.mean_and_variance
        self._value = variance + options.bias_sigma**2 + options.map_sigma**2
        self._slope = self._rate**2 * variance
        self._x = 0.0, 0.0
        self._p = self._value, 0.0, self._slope

    def update(self, block: Block, step: Step, curvature_variance: float) -> float:
        """Update with a measurement and return its log-likelihood; `step` is the motion since the last one.

        `curvature_variance` (nT²) is the variance that the filter adds to the measurement for the map's
        curvature. This model adds it too; otherwise a searching filter would lose by its larger variance.
        """
        o = self._options
        seconds, metres, _ = step
        # Prediction over the distance d: F = [[a, b], [c, d]] of the Matern process (see Notes).
        a, b, c, d = matern_transition(self._rate, metres)
        value, slope = a * self._x[0] + b * self._x[1], c * self._x[0] + d * self._x[1]
        p, q, r = self._p
        v, w = self._value, self._slope
        # Variance of the change of bias and map error since the previous measurement.
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
    """Comparison of two banks: *here* begins at the filter's position, *elsewhere* is spread around it.

    Both use the same measurements. Several blocks are averaged to one measurement, because a bank costs more
    than a filter and the comparison can wait a minute. A new monitor follows once the filter is confirmed or
    starts again. `x` (6,) and `P` (6, 6) are the filter's estimate at `time_us`. `reach` (m) is the 1-sigma
    by which *elsewhere* is spread around it, and `resolution` (m) that of both banks. `levels` (nT) are two
    1-sigmas of the bias: of all hypotheses elsewhere, and a larger one of half of them (0: none).
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
        """Update both banks with a block and return the result of their comparison with the filter.

        `step` is the motion since the previous block. `x` (6,) and `P` (6, 6) are the filter's estimate after
        the block.
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
        # Another place has won if its odds pass the threshold and it is not the filter's place.
        if self.odds > self._threshold and squared_mahalanobis(there - x, P) > ELSEWHERE:
            return Verdict.ELSEWHERE
        # As long as *elsewhere* covers several places, the comparison stays open.
        if widest(spread) > 1.5 * max(self.elsewhere.resolution, widest(P)):
            return Verdict.OPEN
        # *elsewhere* started wide and converged to the filter's place: the filter holds.
        if squared_mahalanobis(there - x, spread + P) < MAX_AGREEING_DISTANCE:
            return Verdict.HOLDS
        here, narrow = self.here.moments()  # where the filter would be without its single linearisation
        return (
            Verdict.ELSEWHERE
            if squared_mahalanobis(there - here, spread + narrow) < MAX_AGREEING_DISTANCE
            else Verdict.OPEN
        )


class Competitor:
    """Filter with its log-likelihood ratio against the navigator's, `log_odds`, and its age, `seconds`."""

    def __init__(self, bank: Bank) -> None:
        self.filter, self.log_odds, self.seconds = bank, 0.0, 0.0

    def update(self, block: Block, likelihood: float) -> None:
        """Update with a measurement, whose log-likelihood in the navigator's filter is `likelihood`."""
        self.log_odds += self.filter.update(block).log_likelihood - likelihood

    def rival(self, prior_odds: float) -> Rival:
        """Return its position, with the odds against the navigator's before the field is compared."""
        x, P = self.filter.moments()
        return Rival(x[:2], P[:2, :2], self.log_odds + log(prior_odds))


def squared_mahalanobis(difference: FloatArray, P: FloatArray) -> float:
    """Return the squared Mahalanobis distance of two positions by their difference, m, and its covariance.

    The first two elements of `difference` (2,) or (6,), and of `P`, are north and east.
    """
    return float(difference[:2] @ np.linalg.solve(P[:2, :2], difference[:2]))
