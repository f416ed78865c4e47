r"""Held-out dives: the residual of a fit without them, and how well it predicts them.

Notes
-----
The *score* of a model is the log predictive density of every fold of dives, given the others. With l the log
likelihood of the noise at the fit c to all dives, c_-f the fit without fold f, ``A_f^T A_f`` the information
of that fold and P that of all folds and the prior, Laplace's approximation (exact for Gaussian noise, by
Woodbury's identity) is

.. math:: S = l - \tfrac12 |z|^2 - \tfrac12 \sum_f \left[ (c - c_{-f})^T (P - A_f^T A_f) (c - c_{-f})
              + \log\det P - \log\det (P - A_f^T A_f) \right]

the log likelihood less the price of predicting each fold with coefficients learned from the others. The logs
that the calibration was fitted to enter by ``|z|``, the distance in sigma between the coefficients and their
prior: without that, every other dive would predict a constant that the calibration absorbs. The
difference of two models' scores is the log of the odds that the left-out dives give one against the other:
the pseudo-Bayes factor (Geisser & Eddy 1979, JASA 74:153).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from magbridge.arrays import BoolArray, FloatArray, IntArray
from magbridge.diagnose.compare.design_columns import Columns
from magbridge.diagnose.compare.problem import Problem
from magbridge.diagnose.inference.design import Design, precomputed
from magbridge.diagnose.inference.joint import Joint

__all__ = ["CONFIDENCE_LEVEL", "HeldOut", "Improvement", "held_out", "paired"]

FOLDS = 8
"""Folds at most: each costs one solution of the normal equations."""
DRAWS = 2000
"""Bootstrap samples: an end of the interval then scatters by 1.5 % of its width."""
QUANTILES = (0.025, 0.975)
"""Quantiles of the bootstrap samples: the ends of the interval."""
CONFIDENCE_LEVEL = QUANTILES[1] - QUANTILES[0]
"""Confidence level of the interval."""


class HeldOut(NamedTuple):
    """Result of leaving out dives, fold by fold."""

    residual: FloatArray
    """Residual (n,) of every sample under the fit without its fold, by the linear model, nT of the sensor."""
    score: float
    """Log predictive density of all folds."""
    fold: IntArray
    """Number (n,) of the fold that each sample belongs to."""
    coefficients: FloatArray
    """Coefficients (f, q + k) of calibration and effects, fitted without each fold."""


def held_out(
    problem: Problem,
    columns: Sequence[Columns],
    fit: Joint,
    *,
    interleaved: bool = False,
    groups: IntArray | None = None,
) -> HeldOut:
    """Leave out dives, fold by fold.

    Nonlinear parameters and noise are those of the fit to all dives; every coefficient is refitted without
    the fold. Folds are stretches of dives, so that a slow change is extrapolated; or, `interleaved`, every
    eighth dive, so that it is only interpolated. `groups` (n,) takes the place of the dives' numbers.
    """
    X, noise, prior = Design(problem, precomputed(len(problem), columns)), fit.noise, fit.prior
    centre = np.append(problem.centre, np.zeros(X.effects))
    c = np.append(fit.z, fit.coefficients)
    y = noise.response(problem.residual - X.times(c))
    dive = np.unique(problem.survey.dive if groups is None else groups, return_inverse=True)[1]
    count, dives = min(FOLDS, int(dive.max()) + 1), int(dive.max()) + 1
    ends = np.cumsum([len(some) for some in np.array_split(np.arange(dives), count)])
    of = dive % count if interleaved else np.searchsorted(ends, dive, side="right")
    P, b = np.zeros((count, c.size, c.size)), np.zeros((count, c.size))
    for rows in X.pieces:
        A = noise.whitened(X.rows, rows)
        for k in np.unique(of[rows]):
            fold_rows = A[of[rows] == k]
            P[k] += fold_rows.T @ fold_rows
            b[k] += fold_rows.T @ (y[rows][of[rows] == k] + fold_rows @ c)
    whole_P, whole_b = P.sum(axis=0) + np.diag(prior), b.sum(axis=0) + prior * centre
    others = whole_P - P
    without = np.linalg.solve(others, (whole_b - b)[:, :, None])[:, :, 0]
    corrected, residual = without.copy(), np.empty(len(problem))
    corrected[:, problem.slow] = 0.0  # the corrected field keeps its slow noise
    for rows in X.pieces:
        residual[rows] = problem.residual[rows] - np.einsum("ij,ij->i", X.rows(rows), corrected[of[rows]])
    away = c - without
    price = np.einsum("fi,fij,fj->", away, others, away)
    price += np.sum(np.linalg.slogdet(whole_P)[1] - np.linalg.slogdet(others)[1])
    price += prior[: len(fit.z)] @ (fit.z - problem.centre) ** 2
    return HeldOut(residual, noise.log_likelihood - 0.5 * float(price), of, without)


@dataclass(frozen=True)
class Improvement:
    """Held-out RMS before and after, nT, their ratio, its interval over dives (:data:`CONFIDENCE_LEVEL`)."""

    before: float
    after: float
    ratio: float
    interval: tuple[float, float]

    @property
    def shown(self) -> bool:
        """Return True if the held-out dives show a gain: the interval lies below 1."""
        return self.interval[1] < 1.0


def paired(before: FloatArray, after: FloatArray, dive: IntArray, counts: BoolArray) -> Improvement:
    """Compare two residuals on the same samples.

    The interval comes from a bootstrap of whole dives, so correlation within a dive does no harm.

    Parameters
    ----------
    before, after : (n,) array
        nT.
    dive : (n,) int array
        Number of the dive that each sample belongs to.
    counts : (n,) bool array
        Samples that count.
    """
    number = np.unique(dive[counts], return_inverse=True)[1]
    b, a = np.bincount(number, before[counts] ** 2), np.bincount(number, after[counts] ** 2)
    rng = np.random.default_rng(20131213)  # the same answer every time
    drawn = rng.integers(0, b.size, (DRAWS, b.size))
    ratios = np.sqrt(a[drawn].sum(axis=1) / (b[drawn].sum(axis=1) + 1e-300))
    low, high = np.quantile(ratios, QUANTILES)
    n = int(counts.sum())
    return Improvement(
        float(np.sqrt(b.sum() / n)),
        float(np.sqrt(a.sum() / n)),
        float(np.sqrt(a.sum() / (b.sum() + 1e-300))),
        (float(low), float(high)),
    )
