r"""Compare the first calibration with learned coefficients, on samples that were taken after the learning.

Time is divided into blocks. A block contains a turn, and lasts until the crustal field along the track has
decorrelated (or 10 minutes). The coefficients learned before a block are its *candidate*. They stay fixed in
the block, so all of its samples test them, most samples at another attitude and position. The predictions of
both calibrations use one model of the reference's error (:class:`.Nuisance`), with the standard deviation of
the crustal field under which the better calibration predicts best. The innovations are v (first calibration)
and v + d (candidate), of variance S. The samples confirm this share of the candidate's change:

.. math:: \beta = -\frac{\sum v d / S}{\sum d^2 / S}

This is the generalised least-squares coefficient of the first calibration's error on the change: 1 if the
change is right, 0 if the first calibration is right. If :math:`\beta > 1/2`, the candidate has the smaller
error; the log-likelihood ratio of both is :math:`(\beta - 1/2) \sum d^2 / S`. The standard error of the share
is the larger of two: the model's, and one from the differences between the blocks. The latter includes errors
that neither calibration explains (Liang & Zeger 1986, Biometrika 73:13).

A change that is right at the tested attitudes may still be wrong at other attitudes. :class:`Coverage`
compares the change with its uncertainty at all attitudes so far.
"""

from __future__ import annotations

from collections import deque
from math import sqrt
from typing import Final

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.estimation.track_process import CORRELATION_LENGTH_M, TRACK_STATES
from magbridge.learning.estimator import Nuisance

FIRST, PUBLISHED, CANDIDATE = range(3)
MAX_JUDGE_SQUARE: Final = 25.0
"""Normalised square of the smaller innovation above which a sample has a larger variance: an outlier of both
calibrations does not distinguish them."""
JUDGE_MEMORY_SAMPLES: Final = 500
"""Averaging time of the mean squares, in samples."""
MIN_BLOCK_S: Final = 60.0
MAX_BLOCK_S: Final = 600.0
"""Shortest duration of a block, and duration from which it may end at any distance, s. In between, it may end
once the vehicle has travelled the crustal field's correlation length."""
STEADY_TIME_S: Final = 60.0
"""Time after a turn in which a block does not end, s, so that the block contains the whole turn. If the
vehicle turns all the time, the block ends after twice MAX_BLOCK_S."""
TURN: Final = 0.4
"""Change of the field's direction in sensor axes that counts as another attitude, rad."""
MIN_BLOCKS: Final = 3
MAX_BLOCKS: Final = 12
"""Smallest and largest number of recent blocks that a comparison uses."""
SIGNIFICANCE_SIGMA: Final = 2.0
"""Normal quantile (2.3 %) at which a share differs significantly from 1/2. Few blocks need
Student's larger quantile."""
MIN_DIRECTIONS: Final = 4
"""Number of field directions, :data:`TURN` from each other, from which on a change can be significant at all
attitudes."""
MIN_CHANGE_RATIO: Final = 3.0
"""Least ratio of a change's mean square to its variance, at all attitudes so far."""
CRUST_FACTORS: Final = np.array([1.0, 0.3, 0.1, 0.03])
"""Standard deviations of the crustal field that are compared, as fractions of the nuisance's."""
CRUST_MEMORY_SAMPLES: Final = 2000.0
"""Averaging time of the likelihoods of these standard deviations, in samples."""


def student_quantile(dof: int) -> float:
    """Return Student's t at the probability of SIGNIFICANCE_SIGMA (Abramowitz & Stegun 1964, eq. 26.7.5)."""
    z = SIGNIFICANCE_SIGMA
    return z + (z**3 + z) / (4.0 * dof) + (5.0 * z**5 + 16.0 * z**3 + 3.0 * z) / (96.0 * dof**2)


class Blocks:
    """Comparison of the candidates of recent blocks with one calibration."""

    def __init__(self) -> None:
        self._ended: deque[FloatArray] = deque(maxlen=MAX_BLOCKS)
        self._sums = np.zeros((len(CRUST_FACTORS), 2))

    def add(self, v: FloatArray, d: FloatArray, S: FloatArray) -> None:
        """Add a sample with the innovations v (calibration) and v + d (candidate), of variance S.

        Each array (4,) has one element for each of :data:`CRUST_FACTORS`.
        """
        self._sums += np.stack([d * d / S, -v * d / S], axis=1)

    def end(self) -> None:
        """End the present block and begin the next."""
        self._ended.append(self._sums)
        self._sums = np.zeros_like(self._sums)

    @property
    def count(self) -> int:
        """Number of blocks that have ended."""
        return len(self._ended)

    def log_ratio(self, crust: int) -> float:
        """Return the candidates' log-likelihood ratio over the calibration, for an index of CRUST_FACTORS."""
        information, confirmed = sum(self._ended, self._sums)[crust].tolist()
        return float(confirmed - 0.5 * information)

    def significance(self, crust: int, *, expected: bool = False) -> float:
        """Return the difference of the confirmed share from 1/2, in units of its significance bound.

        Above 1 the candidates are significantly better, below -1 worse. `crust` is an index of
        :data:`CRUST_FACTORS`. If the change was `expected`, one block and the normal quantile suffice.
        """
        largest = 0.0
        for count in range(1 if expected else MIN_BLOCKS, len(self._ended) + 1):
            information, confirmed = np.array(list(self._ended)[-count:])[:, crust].T
            # beta of the module, over the last `count` blocks together
            total = float(information.sum())
            if total <= 0.0:
                continue
            share = float(confirmed.sum()) / total
            # deviation of each block from the common share
            excess = confirmed - share * information
            by_blocks = float(excess @ excess) / total**2 * count / max(count - 1, 1)
            # the larger of the model's standard error and the sandwich estimate over the blocks
            sigma = sqrt(max(1.0 / total, by_blocks))
            quantile = SIGNIFICANCE_SIGMA if expected else student_quantile(count - 1)
            significance = (share - 0.5) / (quantile * sigma)
            if abs(significance) > abs(largest):
                largest = significance
        return largest


class Judge:
    """Comparison of the predictions of the first calibration, the published one and the candidates.

    `mean_square` (3,) are the recent mean squares of their prediction errors, nT²; `last` is the error of the
    published calibration's last prediction (nT), with its predicted variance (nT²).
    """

    def __init__(self, nuisance: Nuisance) -> None:
        self._nuisance = nuisance
        self.mean_square = np.zeros(3)
        self._noisier, self._judged = 1.0, 0
        self.last = 0.0, 1.0
        self.restart()

    def restart(self, nuisance: Nuisance | None = None) -> None:
        """Reset the filters and discard all blocks, after a change of a calibration or of the nuisance."""
        self._nuisance = nuisance or self._nuisance
        # one filter for each standard deviation of the crustal field: its value and slope are scaled
        scale = np.ones((len(CRUST_FACTORS), TRACK_STATES))
        scale[:, :2] = CRUST_FACTORS[:, None]
        self._initial = scale[:, :, None] * self._nuisance.initial * scale[:, None, :]
        self._P = self._initial.copy()
        self._states = np.zeros((len(CRUST_FACTORS), TRACK_STATES, 3))
        self._likelihoods = np.zeros((len(CRUST_FACTORS), 3))
        self._fresh = True
        self.discard()

    def discard(self) -> None:
        """Discard all blocks, because their candidates are no longer considered."""
        self._to_first, self._to_published = Blocks(), Blocks()
        self._begin_block()

    def _begin_block(self) -> None:
        self._seconds = self._metres = self._steady = 0.0
        self._turned = False
        self._direction: FloatArray | None = None

    def is_due(self, metres: float, seconds: float, direction: FloatArray) -> bool:
        """Return True if a sample begins a new block, which needs a new candidate.

        `metres` and `seconds` are distance and time since the previous sample; `direction` (3,) is the
        field's direction in sensor axes.
        """
        if self._direction is None:
            self._direction = direction
            return True
        # a block may end once the crustal field has decorrelated, a minute after a turn
        self._seconds += seconds
        self._metres += metres
        self._steady += seconds
        # another attitude, since the block began or since the last turn
        change = direction - self._direction
        if float(change @ change) > TURN * TURN:
            self._turned, self._direction, self._steady = True, direction, 0.0
        long = self._seconds >= MAX_BLOCK_S or (
            self._seconds >= MIN_BLOCK_S and self._metres >= CORRELATION_LENGTH_M
        )
        over = self._steady >= STEADY_TIME_S or self._seconds >= 2.0 * MAX_BLOCK_S
        if not (long and over and self._turned):
            return False
        self._to_first.end()
        self._to_published.end()
        self._begin_block()
        self._direction = direction
        return True

    def replace(self, index: int, change: float, scale: float) -> None:
        """Correct the level of a replaced calibration, whose present residual changes by `change` (nT)."""
        self._states[:, 3, index] += scale * change

    def judge(self, F: FloatArray, residuals: tuple[float, float, float], scale: float) -> None:
        """Update the comparison with one sample; `F` (4, 4) is the transition of the reference's error.

        `residuals` (nT) belong to the first calibration, the published calibration and the candidate;
        `scale` is s of the first calibration's residual.
        """
        # the three calibrations share the covariance, because only their residuals differ
        h = self._nuisance.row(scale)
        self._P = self._initial + F @ (self._P - self._initial) @ F.T
        Ph = self._P @ h
        S = Ph @ h + self._nuisance.white_variance
        states = F @ self._states
        v = np.array(residuals) + np.tensordot(h, states, axes=(0, 1))
        gain = Ph / S[:, None]
        self._states = states - gain[:, :, None] * v[:, None, :]
        self._P -= gain[:, :, None] * Ph[:, None, :]
        # innovations of the published calibration under the widest crustal field
        self.last = float(v[0, PUBLISHED]), float(S[0])
        if self._fresh:  # the first sample only determines the level of the crustal field
            self._fresh = False
            return
        self._judged += 1
        share = 1.0 / min(self._judged, JUDGE_MEMORY_SAMPLES)
        self.mean_square += share * (v[0] * v[0] - self.mean_square)
        # likelihood of each standard deviation, without outliers
        squares = v * v / S[:, None]
        self._likelihoods *= 1.0 - 1.0 / CRUST_MEMORY_SAMPLES
        self._likelihoods -= 0.5 * (np.minimum(squares, MAX_JUDGE_SQUARE) + np.log(S)[:, None])
        smaller = squares.min(axis=1)
        self._noisier += share * (min(float(smaller[0]), MAX_JUDGE_SQUARE) - self._noisier)
        # reduce the weight of excess noise, and of outliers of both calibrations
        S = S * np.maximum(max(1.0, self._noisier), smaller / MAX_JUDGE_SQUARE)
        for blocks, which in ((self._to_first, FIRST), (self._to_published, PUBLISHED)):
            blocks.add(v[:, which], v[:, CANDIDATE] - v[:, which], S)

    @property
    def _crust(self) -> int:
        """Index of the crustal field's standard deviation with which the best calibration predicts best."""
        return int(self._likelihoods.max(axis=1).argmax())

    @property
    def better(self) -> float:
        """Log-likelihood ratio of the candidates over the first calibration, in the last blocks."""
        return self._to_first.log_ratio(self._crust)

    @property
    def improves(self) -> float:
        """Log-likelihood ratio of the candidates over the published calibration, in the last blocks."""
        return self._to_published.log_ratio(self._crust)

    def adopt(self, *, expected: bool = False) -> bool:
        """Return True if the candidates have significantly smaller errors than the published calibration.

        Their change is `expected` if an alarm has shown a cause that explains the samples.
        """
        return self._to_published.significance(self._crust, expected=expected) > 1.0

    @property
    def is_complete(self) -> bool:
        """Return True if :data:`MAX_BLOCKS` blocks have ended."""
        return self._to_published.count == MAX_BLOCKS

    @property
    def roll_back(self) -> bool:
        """Return True if the first calibration has significantly smaller errors than the candidates."""
        return self._to_first.significance(self._crust) < -1.0


class Coverage:
    """Statistics of all samples so far, which test a change of the `size` coefficients at every attitude."""

    def __init__(self, size: int) -> None:
        # moments of the samples' derivatives: number, mean, and sum of squares about the mean
        self._samples, self._mean, self._scatter = 0, np.zeros(size), np.zeros((size, size))
        self._directions: list[FloatArray] = []

    def add(self, row: FloatArray, direction: FloatArray) -> None:
        """Add a sample's derivatives of the total field (K,), and the field's direction in sensor axes."""
        # directions closer than TURN to a known one are the same attitude
        nearest = min((float(np.sum((direction - one) ** 2)) for one in self._directions), default=np.inf)
        if nearest > TURN * TURN:
            self._directions.append(direction)
        # the mean is subtracted, because the reference hides the level
        self._samples += 1
        change = row - self._mean
        self._mean += change / self._samples
        self._scatter += np.outer(change, row - self._mean)

    def is_significant(self, change: FloatArray, covariance: FloatArray) -> bool:
        """Return True if a change of the coefficients (K,) exceeds its uncertainty (K, K) at all attitudes.

        The mean of the change over all samples does not count, because the reference hides it.
        """
        if len(self._directions) < MIN_DIRECTIONS:
            return False
        # mean square of the change and its variance, both as a sum over the samples
        square, variance = float(change @ self._scatter @ change), float(np.sum(self._scatter * covariance))
        return square > MIN_CHANGE_RATIO * variance
