"""Interpolate telemetry to the rows of a deployment; read the degrees of gliders."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from magbridge.arrays import FloatArray

__all__ = ["CIRCLES", "MAX_AGE", "degrees", "latest", "linear"]

MAX_AGE = 30.0
"""s; a value that was received longer ago is not carried to a row."""
CIRCLES = {
    "heading": (360.0, 0.0),
    "roll": (360.0, -180.0),
    "longitude": (360.0, -180.0),
    "dr_longitude": (360.0, -180.0),
}
"""Columns on a circle: its circumference and its lowest value, in deg."""


def latest(target: FloatArray, time: FloatArray, values: FloatArray, max_age: float = MAX_AGE) -> FloatArray:
    """Return the last value at or before each time, as known live.

    Parameters
    ----------
    target : (n,) array
        s, the rows.
    time, values : (m,) array
        s, not decreasing, and the values received then; NaN is a missing value.
    max_age : float
        s, of the oldest value that is still used.

    Returns
    -------
    (n,) array
        NaN before the first value, and once the last is older than `max_age`.
    """
    known = np.isfinite(values)
    time, values = time[known], values[known]
    if not len(time):
        return np.full(len(target), np.nan)
    k = np.searchsorted(time, target, side="right") - 1
    fresh = (k >= 0) & (target - time[k] <= max_age)
    return np.where(fresh, values[k], np.nan)


def linear(
    target: FloatArray,
    time: FloatArray,
    values: FloatArray,
    max_gap: float,
    column: str,
) -> FloatArray:
    """Return the values of a column interpolated linearly in time, along the shorter arc of a circle.

    Parameters
    ----------
    target : (n,) array
        s, the rows.
    time, values : (m,) array
        s, increasing, and the values measured then; NaN is a missing value.
    max_gap : float
        s; the result is NaN between neighbours with a longer interval, except at the neighbours' own times,
        and farther beyond an end. Nearer to an end, the value there is held.
    column : str
        Its name; the values of :data:`CIRCLES` lie on a circle.

    Returns
    -------
    (n,) array
    """
    known = np.isfinite(values) & np.isfinite(time)
    time, values = time[known], values[known]
    if not len(time):
        return np.full(len(target), np.nan)
    circle = CIRCLES.get(column)
    if circle is not None:
        values = np.unwrap(values, period=circle[0])
    result = np.interp(target, time, values)
    right = np.searchsorted(time, target)
    before, after = time[np.maximum(right - 1, 0)], time[np.minimum(right, len(time) - 1)]
    in_gap = (after - before > max_gap) & (target != after) & (target != before)
    result[in_gap | (target - time[-1] > max_gap) | (time[0] - target > max_gap)] = np.nan
    if circle is None:
        return result
    period, start = circle
    return result - period * np.floor((result - start) / period)


def degrees(written: ArrayLike) -> FloatArray:
    """Return degrees (n,) from numbers of degrees and minutes (n,), as ``-13036.442``."""
    values = np.asarray(written, np.float64)
    whole = np.trunc(values / 100.0)
    return np.asarray(whole + (values - 100.0 * whole) / 60.0)
