"""Times in the order in which they were written: which rows to leave out, and where a clock started again."""

from __future__ import annotations

from bisect import bisect_left, bisect_right

import numpy as np
from numpy.typing import NDArray

from magbridge.arrays import FloatArray, IndexArray

__all__ = ["MEDIAN_ROWS", "boots", "in_order"]

MIN_SET_BACK_S = 1.0
"""s by which times are set back where a vehicle was switched on again: records of one moment, which tasks of
their own write, differ by less."""
MEDIAN_ROWS = 5
"""Times before and after, whose median is compared: fewer than half of them may be damaged."""


def in_order(time: FloatArray, *, strictly: bool = True) -> NDArray[np.bool_]:
    """Return which rows to keep so that time increases and the fewest are left out.

    A single time that is ahead costs its own row, and not all that follow; so does one set back.

    Parameters
    ----------
    time : (n,) array of float
        s, in the order of the file; NaN is never kept.
    strictly : bool
        Of several rows with one time, only the first is kept.

    Returns
    -------
    (n,) array of bool

    Notes
    -----
    The longest increasing subsequence, by patience sorting from the end, so that of equals the first is kept:
    C. Schensted (1961), Canad. J. Math. 13, 179.
    """
    known = np.isfinite(time)
    steps = np.diff(time[known])
    if (steps > 0 if strictly else steps >= 0).all():
        return known
    rows, place = np.flatnonzero(known)[::-1], bisect_left if strictly else bisect_right
    starts: list[float] = []  # starts[k]: minus the greatest first time of an increasing sequence of k + 1,
    first: list[int] = []  # and its row
    after: list[int] = [-1] * len(time)
    for row, one in zip(rows.tolist(), (-time[rows]).tolist(), strict=True):
        k = place(starts, one)
        if k == len(starts):
            starts.append(one)
            first.append(row)
        else:
            starts[k], first[k] = one, row
        after[row] = first[k - 1] if k else -1
    keep = np.zeros(len(time), dtype=bool)
    row = first[-1] if first else -1
    while row >= 0:
        keep[row] = True
        row = after[row]
    return keep


def boots(time: FloatArray) -> IndexArray:
    """Return the rows at which the clock started again, the first row included.

    Parameters
    ----------
    time : (n,) array of float
        s since the boot, in the order of the file.
    """
    found = [0]
    for k in (1 + np.flatnonzero(np.diff(time) < -MIN_SET_BACK_S)).tolist():
        before, after = time[max(found[-1], k - MEDIAN_ROWS) : k], time[k : k + MEDIAN_ROWS]
        if np.median(after) < np.median(before) - MIN_SET_BACK_S:
            found.append(k)
    return np.array(found, dtype=np.intp)
