r"""The joint likelihood: calibration free, effects free, the noise fitted anew under each hypothesis.

Notes
-----
Noise that is fitted without an effect swallows a large slow one, so two hypotheses are compared only after each
has had its own noise. Between them lies :func:`information`, the whole search's arithmetic in one matrix: the
whitened columns of *all* candidates against each other, summed up in chunks, linear in samples. From it come
scores, Occam factors, what is confounded with what, and the distribution of the largest score under no effect.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magbridge.diagnose.noise import Noise, fit_noise
from magbridge.diagnose.problem import Columns, Problem

__all__ = ["Information", "Joint", "fit_joint", "information"]

FloatArray = NDArray[np.float64]
CHUNK = 4096


@dataclass(frozen=True, eq=False)
class Joint:
    """A hypothesis at its maximum.

    Attributes
    ----------
    log_likelihood : float
        Of the noise model, with the calibration's prior.
    z : (q,) array
    coefficients : (k,) array
        Of the effects, in units of their prior width.
    covariance : (q + k, q + k) array
    noise : Noise
    left : (n,) array
        nT, what is left of the residual.
    """

    log_likelihood: float
    z: FloatArray
    coefficients: FloatArray
    covariance: FloatArray
    noise: Noise
    left: FloatArray


def fit_joint(
    problem: Problem,
    columns: Sequence[Columns],
    order: int,
    start: FloatArray | None = None,
    *,
    blocks: bool | None = None,
    ridge: float = 1e-6,
    rounds: int = 5,
    rows: NDArray[np.bool_] | None = None,
) -> Joint:
    """Maximise the joint likelihood of calibration, effects and noise.

    Parameters
    ----------
    problem : Problem
    columns : sequence of Columns
        The effects'.
    order : int
        Of the noise's memory.
    start : (q + k,) array, optional
    blocks : bool, optional
        See :func:`~magbridge.diagnose.noise.fit_noise`.
    ridge : float
        Prior precision of the effects; the default only keeps what is invisible from running away.
    rounds : int
        At most.
    rows : (n,) bool array, optional
        Which samples count; all if not given.
    """
    q, n = problem.free.shape[1], len(problem)
    whole = slice(0, n)
    X = np.hstack([problem.free, *(column(whole) for column in columns)])
    k = X.shape[1] - q
    prior = np.append(np.ones(q), np.full(k, ridge))
    centre = np.append(problem.centre, np.zeros(k))
    c = centre.copy() if start is None else start.copy()
    left, noise, P = problem.residual - X @ c, None, np.diag(prior)
    follows = problem.survey.follows
    before = -np.inf
    for _ in range(rounds):
        noise = fit_noise(left, follows, order, blocks=blocks)
        value = noise.log_likelihood - 0.5 * float(prior[:q] @ (c[:q] - centre[:q]) ** 2)
        if abs(value - before) < 0.02:
            break
        before = value
        A, y = noise.filter(X), noise.response(left)
        if rows is not None:
            A, y = A[rows], y[rows]
        P = A.T @ A + np.diag(prior)
        c = c + np.linalg.solve(P, A.T @ y - prior * (c - centre))
        left = problem.residual - X @ c
    assert noise is not None
    value = noise.log_likelihood - 0.5 * float(prior[:q] @ (c[:q] - centre[:q]) ** 2)
    return Joint(value, c[:q], c[q:], np.linalg.inv(P), noise, left)


@dataclass(frozen=True, eq=False)
class Information:
    """What the data say of every candidate's coefficients, calibration (and model so far) projected out.

    Attributes
    ----------
    matrix : (m, m) array
        Fisher information, in units of the prior widths.
    score : (m,) array
    """

    matrix: FloatArray
    score: FloatArray


def information(
    problem: Problem, noise: Noise, base: Joint, model: Sequence[Columns], candidates: Sequence[Columns]
) -> Information:
    """Sum up the candidates' information at the hypothesis `base`, whose effects are `model`, under `noise`."""
    n, p = len(problem), len(noise.memory)
    y = noise.response(base.left)
    q = problem.free.shape[1]
    nuisance = q + base.coefficients.size
    G: FloatArray = np.zeros((0, 0))
    b: FloatArray = np.zeros(0)
    for start in range(0, n, CHUNK):
        first = max(start - p, 0)
        rows = slice(first, min(start + CHUNK, n))
        X = np.hstack([problem.free[rows], *(column(rows) for column in (*model, *candidates))])
        A = noise.filter(X, first, start - first)
        if not G.size:
            G, b = np.zeros((A.shape[1],) * 2), np.zeros(A.shape[1])
        G += A.T @ A
        b += A.T @ y[start : start + CHUNK]
    prior = np.append(np.ones(q), np.full(nuisance - q, 1e-6))
    pull = np.append(problem.centre - base.z, np.zeros(nuisance - q))
    K = np.linalg.solve(G[:nuisance, :nuisance] + np.diag(prior), G[:nuisance, nuisance:])
    return Information(
        G[nuisance:, nuisance:] - G[nuisance:, :nuisance] @ K, b[nuisance:] - K.T @ (b[:nuisance] + pull)
    )
