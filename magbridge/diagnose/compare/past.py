"""What came before each sample, and how long before: logs have gaps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["FAR", "Past"]

IntArray = NDArray[np.int64]

FAR = 1000
"""Intervals after which nothing is known any more."""


class Past:
    """The p samples before each.

    Parameters
    ----------
    steps : (n,) int array
        Intervals since the sample before, at least 1; :data:`FAR` where there is none.
    order : int
        p.

    Attributes
    ----------
    order : int
    whole : (n,) bool array
        They are the last p intervals' own.
    rows : (m,) int array
        Where they are not.
    lags : (l, p) int array
        Patterns of how many intervals ago they were, :data:`FAR` where that is nobody's concern.
    pattern : (m,) int array
        Which of them each of `rows` has.
    """

    def __init__(self, steps: IntArray, order: int) -> None:
        n, self.order = len(steps), order
        index = np.arange(n)
        broken = np.where(steps == 1, 0, index)
        broken[:1] = 0
        self.whole = index - np.maximum.accumulate(broken) >= order
        self.rows = np.flatnonzero(~self.whole)
        place = np.append(np.cumsum(np.minimum(steps, FAR)), -FAR)
        before = np.maximum(self.rows[:, None] - np.arange(1, order + 1), -1)
        lags = np.minimum(place[self.rows, None] - place[before], FAR)
        self.lags, inverse = np.unique(lags, axis=0, return_inverse=True)
        self.pattern: IntArray = inverse.ravel()
