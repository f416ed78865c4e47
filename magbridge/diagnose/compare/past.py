"""Which samples precede each one, and by how many intervals: logs have gaps."""

from __future__ import annotations

import numpy as np

from magbridge.arrays import IntArray

__all__ = ["MAX_LAG", "Past"]

MAX_LAG = 1000
"""Lag, in sampling intervals, from which on a sample says nothing about the noise; longer ones are cut
to it."""


class Past:
    """The p samples before each sample, and their lags.

    Parameters
    ----------
    steps : (n,) int array
        Intervals since the sample before, at least 1; :data:`MAX_LAG` where there is none.
    order : int
        p.

    Attributes
    ----------
    order : int
    whole : (n,) bool array
        True if no gap precedes: the p previous samples have the lags 1 to p.
    rows : (m,) int array
        Samples where there is one.
    lags : (l, p) int array
        Patterns of lags at `rows`, in intervals; :data:`MAX_LAG` where a sample is too long ago,
        or there is none.
    pattern : (m,) int array
        Pattern of each of `rows`.
    """

    def __init__(self, steps: IntArray, order: int) -> None:
        n, self.order = len(steps), order
        index = np.arange(n)
        broken = np.where(steps == 1, 0, index)
        broken[:1] = 0
        self.whole = index - np.maximum.accumulate(broken) >= order
        self.rows = np.flatnonzero(~self.whole)
        place = np.append(np.cumsum(np.minimum(steps, MAX_LAG)), -MAX_LAG)
        before = np.maximum(self.rows[:, None] - np.arange(1, order + 1), -1)
        lags = np.minimum(place[self.rows, None] - place[before], MAX_LAG)
        self.lags, inverse = np.unique(lags, axis=0, return_inverse=True)
        self.pattern: IntArray = inverse.ravel()
