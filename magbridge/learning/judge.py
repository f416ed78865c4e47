r"""Compare the first and the learned calibration by their predictions of each sample before the update.

Both predict the residual of the next sample and its variance. The first calibration has a filter of its own
for the nuisance (:mod:`.nuisance`); the learned calibration has its estimator's
(:mod:`.estimator`). With errors v and variances S of these predictions,

.. math:: 2 L = \sum \left( \frac{v_a^2}{c^2 S_a} - \frac{v_b^2}{c^2 S_b} + \log \frac{S_a}{S_b} \right)

is the log-likelihood ratio of b over a (Dawid 1984, J. R. Statist. Soc. A 147:278). Where a holds,
:math:`e^L` has the mean 1, and by Ville's inequality it exceeds :math:`e^h` at any time with probability
:math:`e^{-h}` at most. L is kept from falling below 0 (Page 1954): a mistaken change then comes once in
:math:`e^h` samples at most. c is how much noisier the better of them is than its sigma.
"""

from __future__ import annotations

from math import log
from typing import Final

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.learning.nuisance import STATES, Nuisance

__all__ = ["BEYOND_CHANCE", "FIRST", "LEARNED", "Judge"]

FIRST, LEARNED = range(2)
BEYOND_CHANCE: Final = 13.5
"""h: once in 30 days of 0.25 Hz."""
MAX_JUDGE_SQUARE: Final = 4.0
"""Largest contribution of one sample: an outlier does not distinguish the calibrations."""
MIN_ADVANTAGE: Final = 0.01
"""Least advantage of the learned calibration for each sample: an error of 0.14 sigma that only the first
calibration makes. No calibration is exact. A smaller advantage becomes significant over thousands of similar
samples, but does not hold for different ones, and quantities that predictions do not show, as the level, may
get worse."""
JUDGE_MEMORY_SAMPLES: Final = 500
"""Samples over which mean squares are followed."""


class Judge:
    """Follows the predictions of the first and of the learned calibration.

    Attributes
    ----------
    better, worse : float
        Log-likelihood ratio of the learned calibration over the first one, less the margin; and of the first
        over the learned one.
    mean_square : (2,) array
        Recent mean square of the prediction errors of the first and the learned calibration, nT².
    last : tuple of 2 float
        Error of the first calibration's last prediction (nT), and its predicted variance (nT²).
    """

    def __init__(self, nuisance: Nuisance) -> None:
        self._nuisance = nuisance
        self.mean_square = np.zeros(2)
        self._noisier = np.ones(2)
        self._judged = 0
        self.last = 0.0, 1.0
        self.restart()

    def restart(self, nuisance: Nuisance | None = None) -> None:
        """Restart the comparison, for another first calibration or another nuisance."""
        self._nuisance = nuisance or self._nuisance
        self._P = self._nuisance.initial.copy()
        self._m = np.zeros(STATES)
        self.better = self.worse = 0.0
        self._fresh = True

    def judge(
        self, F: FloatArray, Q: FloatArray, e: float, s: float, innovation: float, variance: float
    ) -> None:
        """Compare one sample, after the states moved by F and Q.

        Parameters
        ----------
        F, Q : (4, 4) arrays
            Transition and process noise of :meth:`.Nuisance.transition`.
        e, s : float
            Residual of the first calibration (nT), and its scale.
        innovation, variance : float
            Innovation of the learned calibration (nT), and its variance (nT²).
        """
        h = self._nuisance.row(s)
        self._P = F @ self._P @ F.T + Q
        self._m = F @ self._m
        Ph = self._P @ h
        S = float(h @ Ph) + self._nuisance.white_variance
        v = e + float(h @ self._m)
        self.last = v, S
        self._m -= Ph * (v / S)
        self._P -= np.outer(Ph / S, Ph)
        if self._fresh:  # the first sample only determines the level of the crustal field
            self._fresh = False
            return
        self._judged += 1
        share = 1.0 / min(self._judged, JUDGE_MEMORY_SAMPLES)
        square = np.array([v * v, innovation * innovation])
        self.mean_square += share * (square - self.mean_square)
        square /= (S, variance)
        self._noisier += share * (np.minimum(square, 25.0) - self._noisier)
        first, learned = (square / max(1.0, float(self._noisier.min()))).tolist()
        won = min(max(0.5 * (first - learned + log(S / variance)), -MAX_JUDGE_SQUARE), MAX_JUDGE_SQUARE)
        self.better = max(0.0, self.better + won - MIN_ADVANTAGE)
        self.worse = max(0.0, self.worse - won)

    @property
    def adopt(self) -> bool:
        """Return True if the learned calibration predicts significantly better, by its log ratio."""
        return self.better > BEYOND_CHANCE

    @property
    def roll_back(self) -> bool:
        """Return True if the first calibration predicts significantly better (log ratio above the bound)."""
        return self.worse > BEYOND_CHANCE
