"""What mending gains: on dives that were left out, dive by dive against the calibration as it was."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magbridge.diagnose.joint import RIDGE, Joint
from magbridge.diagnose.problem import Columns, Problem

__all__ = ["Gain", "held_out", "paired"]

FloatArray = NDArray[np.float64]
FOLDS = 8
DRAWS = 2000


@dataclass(frozen=True)
class Gain:
    """RMS before and after (nT, held out), their ratio and its 95 % interval over dives."""

    before: float
    after: float
    ratio: float
    interval: tuple[float, float]


def held_out(problem: Problem, columns: Sequence[Columns], fit: Joint) -> FloatArray:
    """(n,) residual, nT, of every sample under a fit that never saw its dive.

    Nonlinear parameters and noise are those of the whole; every coefficient is fitted anew without the fold.
    """
    X = np.hstack([problem.free, *(column(slice(0, len(problem))) for column in columns)])
    q = len(problem.centre)
    prior = np.append(np.ones(q), np.full(X.shape[1] - q, RIDGE))
    centre = np.append(problem.centre, np.zeros(X.shape[1] - q))
    c = np.append(fit.z, fit.coefficients)
    A, y = fit.noise.filter(X), fit.noise.response(problem.residual - X @ c)
    y += A @ c
    P, b = A.T @ A + np.diag(prior), A.T @ y + prior * centre
    left = np.empty(len(problem))
    dives = np.unique(problem.survey.dive)
    for fold in np.array_split(dives, min(FOLDS, dives.size)):
        rows = np.isin(problem.survey.dive, fold)
        own = np.linalg.solve(P - A[rows].T @ A[rows], b - A[rows].T @ y[rows])
        left[rows] = problem.residual[rows] - X[rows] @ own
    return left


def paired(before: FloatArray, after: FloatArray, dive: NDArray[np.int64], counts: NDArray[np.bool_]) -> Gain:
    """Compare two residuals on the same samples; whole dives are drawn, so memory within a dive does no harm.

    Parameters
    ----------
    before, after : (n,) array
        nT.
    dive : (n,) int array
    counts : (n,) bool array
        Samples that count.
    """
    number = np.unique(dive[counts], return_inverse=True)[1]
    b, a = np.bincount(number, before[counts] ** 2), np.bincount(number, after[counts] ** 2)
    rng = np.random.default_rng(20131213)
    drawn = rng.integers(0, b.size, (DRAWS, b.size))
    ratios = np.sqrt(a[drawn].sum(axis=1) / (b[drawn].sum(axis=1) + 1e-300))
    low, high = np.quantile(ratios, [0.025, 0.975])
    n = int(counts.sum())
    return Gain(
        float(np.sqrt(b.sum() / n)),
        float(np.sqrt(a.sum() / n)),
        float(np.sqrt(a.sum() / (b.sum() + 1e-300))),
        (float(low), float(high)),
    )
