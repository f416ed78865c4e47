"""Regressors of effects along a whole survey at once: the same numbers as the steppers of a live correction give."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TypeVar
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from magbridge.diagnose.compare.problem import Problem

__all__ = ["lagged", "once", "play", "powers"]

FloatArray = NDArray[np.float64]
T = TypeVar("T")


def once(made: Callable[[Problem], T]) -> Callable[[Problem], T]:
    """Make something once for a problem: of a month a regressor is 50 MB, and causes share it."""
    known: WeakKeyDictionary[Problem, T] = WeakKeyDictionary()

    @wraps(made)
    def of(problem: Problem) -> T:
        if problem not in known:
            known[problem] = made(problem)
        return known[problem]

    return of


def lagged(time: FloatArray, values: FloatArray, lag: float, stages: int = 1) -> FloatArray:
    """(n,) y that follows x through equal lags in series, stepped as :class:`~magbridge.calibration.effects.ChannelEffect` does.

    Parameters
    ----------
    time, values : (n,) array
        s, and x.
    lag : float
        s, of all stages; 0: x itself.
    stages : int
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
    odd = np.flatnonzero(np.abs(share - usual) > 1e-6 * usual) + 1  # gaps, and clocks that tremble
    if odd.size > 0.05 * len(time):
        return _one_by_one(values, share)
    out = np.empty_like(values)
    out[0] = values[0]
    for first, end in zip(np.append(1, odd + 1), np.append(odd, len(time)), strict=True):
        if end > first:
            piece, _ = lfilter(
                [usual], [1.0, usual - 1.0], values[first:end], zi=[(1.0 - usual) * out[first - 1]]
            )
            out[first:end] = piece
        if end < len(time):
            out[end] = out[end - 1] + (values[end] - out[end - 1]) * share[end - 1]
    return out


def _one_by_one(values: FloatArray, share: FloatArray) -> FloatArray:
    level = float(values[0])
    out = [level]
    for x, s in zip(values[1:].tolist(), share.tolist(), strict=True):
        level += (x - level) * s
        out.append(level)
    return np.array(out)


def play(values: FloatArray, width: float) -> FloatArray:
    """(n,) play operator of `values` (:class:`~magbridge.calibration.followers.PlayEffect`); only changes are stepped through."""
    half, y = 0.5 * width, float(values[0])
    changed = np.append(0, np.flatnonzero(np.diff(values)) + 1)
    out = []
    for p in values[changed].tolist():
        y = min(max(y, p - half), p + half)
        out.append(y)
    return np.repeat(np.array(out), np.diff(np.append(changed, len(values))))


def powers(x: FloatArray, order: int) -> FloatArray:
    """(order, n) x, x^2, ... by multiplication: beyond a square numpy asks ``pow()``, a hundred times as slow."""
    return np.multiply.accumulate(np.broadcast_to(x, (order, *np.shape(x))))
