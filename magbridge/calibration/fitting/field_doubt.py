r"""Posterior uncertainty of a field's amplitude and length.

A few anomalies hardly determine the crustal field's amplitude and length: a solution at the likeliest values
alone would be overconfident away from the track. The evidence is summed over points about its maximum,

.. math:: p(f) \approx \sum_k w_k\, p(f \mid \theta_k), \quad \theta_k = \hat\theta + V S g_k,

of a Gauss-Hermite rule (3 x 3) along the axes V of its curvature with the spreads S, each weighed with its
own evidence (Rue, Martino & Chopin 2009, section 6.5).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.field_search import Choice

__all__ = ["MAX_UNCERTAIN_NODES", "plausible"]

MAX_UNCERTAIN_NODES = 2_500
"""Nodes from which on size and length are known well enough."""
LOG_STEP = 0.3
"""Step in the logarithms of amplitude and length with which the evidence's curvature is computed."""
WIDEST = 0.7
"""Largest spread of these logarithms: beyond, the evidence is not a parabola."""
RULE = ((0.0, 2.0 / 3.0), (3.0**0.5, 1.0 / 6.0), (-(3.0**0.5), 1.0 / 6.0))
"""Nodes and weights for a standard normal distribution."""
MIN_WEIGHT = 0.01
"""Weight below which a point is not worth its cost."""


def plausible(score: Callable[[Choice], float], best: Choice) -> list[tuple[float, Choice]]:
    """Return choices about the best one with their weights, which add up to 1; the best one first.

    Parameters
    ----------
    score : callable
        The log evidence of a choice; may raise LinAlgError where there is none.
    best : Choice
        About where that is largest.
    """
    if best.field.nodes.size > MAX_UNCERTAIN_NODES:
        return [(1.0, best)]

    def choice_at(x: FloatArray) -> Choice:
        field = replace(best.field, length=best.field.length * float(np.exp(x[1])))
        return replace(best, field=field, ratio=best.ratio * float(np.exp(x[0])))

    def value(x: FloatArray) -> float:
        try:
            return score(choice_at(x))
        except np.linalg.LinAlgError:
            return -np.inf

    top = value(np.zeros(2))
    spreads, axes = _spread(value, top)
    points: list[tuple[float, Choice]] = []
    for (g, p), (h, q) in product(RULE, RULE):
        x = axes @ (spreads * np.array([g, h]))
        gained = (value(x) if x.any() else top) - top + 0.5 * (g * g + h * h)
        points.append((p * q * float(np.exp(min(gained, 5.0))), choice_at(x)))
    total = sum(weight for weight, _ in points)
    kept = [(weight, one) for weight, one in points if weight > MIN_WEIGHT * total]
    total = sum(weight for weight, _ in kept)
    return [(weight / total, one) for weight, one in kept]


def _spread(value: Callable[[FloatArray], float], top: float) -> tuple[FloatArray, FloatArray]:
    """Return the standard deviations (2,) along the axes, columns (2, 2), of the evidence's curvature."""
    a, b = LOG_STEP * np.eye(2)
    second = np.array([value(x) + value(-x) - 2.0 * top for x in (a, b, a + b)]) / LOG_STEP**2
    if not np.isfinite(second).all():
        return np.full(2, 0.1), np.eye(2)
    # second differences along both axes and their diagonal give the Hessian
    bend = np.diag(second[:2])
    bend[0, 1] = bend[1, 0] = 0.5 * (second[2] - second[:2].sum())
    values, axes = np.linalg.eigh(-bend)
    return np.maximum(values, WIDEST**-2.0) ** -0.5, axes
