"""Which of three calibrations predicts better: the first, the published, or a candidate of what was learned.

All three are fixed while they are judged, so that one learns nothing from what it is judged by. Each is
given the same filter for what is not the calibration's (:mod:`.nuisance`), and judged by its errors of
prediction v. All three have the same variance S, so

    L = sum (v_a^2 - v_b^2) / (2 c^2 S)

is the log-likelihood ratio of b over a. Where a holds, ``exp L`` has the mean 1, and by Ville's inequality
it exceeds ``exp h`` at any time with probability ``exp -h`` at most. L is kept from falling below 0 (Page
1954): a mistaken change then comes once in ``exp h`` samples at most. c is how much noisier the best of
them is than its sigma.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.learning.nuisance import STATES, Nuisance

__all__ = ["CANDIDATE", "FIXED", "PUBLISHED", "Judge"]

FIXED, PUBLISHED, CANDIDATE = range(3)
BEYOND_CHANCE: Final = 13.5
"""h: once in 30 days of 0.25 Hz."""
MOST: Final = 4.0
"""That one sample counts at most: an outlier says nothing of which is better."""
MEMORY: Final = 500
"""Samples over which mean squares are followed."""
SHORTEST: Final = 32
LONGEST: Final = 1024
"""Samples after which a candidate is replaced: the first ones, and later ones."""
PROMISING: Final = 3.0
"""The log-likelihood ratio from which on a candidate is given more time."""


class Judge:
    """Follows the predictions of three calibrations.

    Parameters
    ----------
    nuisance : Nuisance

    Attributes
    ----------
    better, back : float
        Log-likelihood ratio of the candidate over the published calibration, and of the first over it.
    mean_square : (3,) array
        nT², of the errors of prediction lately.
    """

    def __init__(self, nuisance: Nuisance) -> None:
        self._nuisance = nuisance
        self._P = nuisance.initial.copy()
        self._m = np.zeros((STATES, 3))
        self.better = self.back = 0.0
        self.mean_square = np.zeros(3)
        self._noisier = np.ones(3)
        self._judged, self._age, self._period = 0, 0, SHORTEST

    def judge(self, F: FloatArray, Q: FloatArray, e: FloatArray, s: float) -> None:
        """Compare residuals e (3,) of one sample, nT, after the states moved by F and Q."""
        h = np.array([-1.0 / s, 0.0, -1.0])
        self._P = F @ self._P @ F.T + Q
        self._m = F @ self._m
        Ph = self._P @ h
        S = float(h @ Ph) + self._nuisance.white
        v = e + h @ self._m
        gain = Ph / S
        self._m -= np.outer(gain, v)
        self._P -= np.outer(gain, Ph)
        self._judged += 1
        self._age += 1
        share = 1.0 / min(self._judged, MEMORY)
        square = v * v
        if self._judged > 1:  # the first says only what the rock's level is
            self.mean_square += share * (square - self.mean_square)
            self._noisier += share * (np.minimum(square / S, 25.0) - self._noisier)
        square /= 2.0 * S * max(1.0, float(self._noisier.min()))
        fixed, published, candidate = square.tolist()
        self.better = max(0.0, self.better + min(max(published - candidate, -MOST), MOST))
        self.back = max(0.0, self.back + min(max(published - fixed, -MOST), MOST))

    @property
    def adopt(self) -> bool:
        """Whether the candidate predicts better than the published calibration, beyond chance."""
        return self.better > BEYOND_CHANCE

    @property
    def roll_back(self) -> bool:
        """Whether the first calibration predicts better than the published one, beyond chance."""
        return self.back > BEYOND_CHANCE

    @property
    def stale(self) -> bool:
        """Whether the candidate has had its time, and another one should be judged."""
        return self._age >= self._period and (self.better < PROMISING or self._age >= 4 * self._period)

    def challenge(self, states: FloatArray, *, soon: bool) -> None:
        """Begin with a new candidate, which takes what is not the calibration's to be `states` (3,).

        The next one comes `soon` where the calibration changes.
        """
        self._m[:, CANDIDATE] = states
        longest = 4 * SHORTEST if soon else LONGEST
        self.better, self._age, self._period = 0.0, 0, min(2 * self._period, longest)

    def hurry(self) -> None:
        """Take the next candidates soon: something has changed."""
        self._age, self._period = 0, SHORTEST

    def publish(self, which: int) -> None:
        """Let the published calibration be another one: :data:`CANDIDATE` or :data:`FIXED`."""
        for known in (self._m, self.mean_square, self._noisier):
            known[..., PUBLISHED] = known[..., which]
        self.better = self.back = 0.0
        self.hurry()

    def settle(self) -> None:
        """Let the published calibration be the first from now on."""
        self._m[:, FIXED] = self._m[:, PUBLISHED]
        self.back = 0.0
