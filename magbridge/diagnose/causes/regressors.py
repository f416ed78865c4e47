"""Regressors of effects for a whole survey at once; the values are those that the live effects compute."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from itertools import pairwise
from typing import TypeVar
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from magbridge.arrays import FloatArray
from magbridge.diagnose.compare.problem import Problem

__all__ = ["lagged", "once", "play", "powers"]

T = TypeVar("T")
Number = TypeVar("Number", np.float64, np.complex128)


def once(made: Callable[[Problem], T]) -> Callable[[Problem], T]:
    """Cache a function's result for each problem: causes share regressors, of 50 MB for a month."""
    known: WeakKeyDictionary[Problem, T] = WeakKeyDictionary()

    @wraps(made)
    def of(problem: Problem) -> T:
        if problem not in known:
            known[problem] = made(problem)
        return known[problem]

    return of


def lagged(time: FloatArray, values: FloatArray, lag: float, stages: int = 1) -> FloatArray:
    """(n,) y that follows x through equal lags in series, as in a live ``ChannelEffect``.

    Parameters
    ----------
    time, values : (n,) array
        s, and x.
    lag : float
        s, the sum of all stages; at 0, y is x.
    stages : int
        Number of lags in series.
    """
    if lag <= 0.0 or len(time) < 2:
        return values
    for _ in range(stages):
        values = _followed(time, values, lag / stages)
    return values


def _followed(time: FloatArray, values: FloatArray, lag: float) -> FloatArray:
    """(n,) y with ``dy/dt = (x - y) / lag``."""
    share = -np.expm1(-np.diff(time) / lag)
    usual = float(np.median(share))
    if np.abs(share - usual).max() > 1e-6 * usual:  # gaps, or a clock that jitters
        return _stepped(values, share)
    return np.asarray(lfilter([usual], [1.0, usual - 1.0], values, zi=[(1.0 - usual) * values[0]])[0])


def _stepped(values: FloatArray, share: FloatArray) -> FloatArray:
    """(n,) ``y_t = y_(t-1) + s_t (x_t - y_(t-1))``, by doubling: the steps of 2, 4, 8 ... rows are one."""
    y, kept = np.append(values[0], share * values[1:]), np.append(0.0, 1.0 - share)
    step = 1
    while step < len(y):
        y[step:] = y[step:] + kept[step:] * y[:-step]
        kept[step:] = kept[step:] * kept[:-step]
        step *= 2
    return y


def play(values: FloatArray, width: float) -> FloatArray:
    """(n,) play operator of `values` (:class:`~magbridge.calibration.mass_effects.PlayEffect`).

    Each row clips the output of the row before. Two such clips in series are one clip, so they are combined
    by doubling: over 2, 4, 8 ... rows.
    """
    low, high = values - 0.5 * width, values + 0.5 * width
    low[0] = high[0] = values[0]
    step = 1
    while step < len(values):
        bounds = low[step:].copy(), high[step:].copy()
        low[step:], high[step:] = (np.clip(x[:-step], *bounds) for x in (low, high))
        step *= 2
    return low


def powers(x: NDArray[Number], order: int) -> NDArray[Number]:
    """(order, n) x, x^2, ... by multiplication: above a square ``pow()`` is a hundred times as slow."""
    out = np.empty((order, *np.shape(x)), x.dtype)
    out[0] = x
    for lower, higher in pairwise(out):
        np.multiply(lower, x, out=higher)
    return out
