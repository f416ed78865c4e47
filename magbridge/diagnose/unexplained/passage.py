"""The passage of a distant source."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from magbridge.arrays import FloatArray
from magbridge.diagnose.compare.design_columns import Columns
from magbridge.diagnose.compare.problem import Problem
from magbridge.diagnose.inference.joint import Joint

__all__ = ["passage"]

DURATIONS, SHORTEST, LONGEST = 12, 8.0, 0.125
"""Durations: how many are tried, the shortest in samples, the longest as a share of the log."""
QUARTERS = np.arange(-12, 13)
"""Quarters of its duration over which it is evaluated."""


def passage(problem: Problem, fit: Joint) -> tuple[Columns, float]:
    r"""Find the most likely passage of a distant source, over all durations T, in steps of half a duration.

    Returns
    -------
    Columns
        Of three numbers.
    look_elsewhere : float
        Moments that were tried at this duration, times the durations.

    Notes
    -----
    Along a straight course a dipole adds to the field :math:`(b_0 + b_1 s + b_2 s^2) / (1 + s^2)^{5/2}`, s
    the time from its nearest point in units of T, distance over speed (Anderson's functions: Ginzburg,
    Frumkis & Kaplan 2002, Sens. Actuators A 102:67).
    """
    t = problem.survey.time - problem.survey.time[0]
    improvement = fit.noise.whiten(problem.reference_jacobian)
    matched, power = improvement * fit.noise.response(fit.residual), improvement * improvement
    shape = _passing(QUARTERS / 4.0)
    pairs = np.einsum("ik,jk->ijk", shape, shape).reshape(9, -1)
    best, nearest, scale, look_elsewhere = -np.inf, 0.0, 1.0, 1.0
    for duration in np.geomspace(SHORTEST / len(t), LONGEST, DURATIONS) * float(t[-1]):
        quarters = (4.0 * t / duration).astype(int)
        b, S = (_around(np.bincount(quarters, x)) @ f.T for x, f in ((matched, shape), (power, pairs)))
        ratio = _ratio(S.reshape(-1, 3, 3), b)
        at, count = int(np.argmax(ratio)), float(ratio.size * DURATIONS)
        evidence = 0.5 * float(ratio[at]) - float(np.log(count))
        if evidence > best:
            best, nearest, scale, look_elsewhere = evidence, (2 * at + 0.5) * duration / 4.0, duration, count
    return (
        lambda rows: problem.reference_jacobian[rows, None] * _passing((t[rows] - nearest) / scale).T,
        look_elsewhere,
    )


def _passing(s: FloatArray) -> FloatArray:
    """(3, n) functions of Anderson."""
    return np.stack([np.ones_like(s), s, s * s]) / (1.0 + s * s) ** 2.5


def _around(values: NDArray[Any]) -> FloatArray:
    """Return, for every other quarter, the values in the window of :data:`QUARTERS` about it."""
    return sliding_window_view(np.pad(values, len(QUARTERS) // 2), len(QUARTERS))[::2]


def _ratio(S: FloatArray, b: FloatArray) -> FloatArray:
    """(m,) likelihood ratios of scores b (m, k), information S (m, k, k)."""
    size = np.trace(S, axis1=1, axis2=2)[:, None, None] + 1e-300
    S = S + 1e-6 * size * np.eye(b.shape[1])
    return np.asarray(np.einsum("mi,mi->m", b, np.linalg.solve(S, b[:, :, None])[:, :, 0]))
