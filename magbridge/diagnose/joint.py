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
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magbridge.diagnose.noise import Noise, fit_noise
from magbridge.diagnose.problem import Columns, Problem
from magbridge.diagnose.statistic import Statistic

__all__ = ["RIDGE", "Design", "Information", "Joint", "fit_joint", "information"]

FloatArray = NDArray[np.float64]
CHUNK = 2048
"""Rows that are whitened at a time, to stay near the processor."""
KEPT = 25_000_000
"""Numbers of a hypothesis' own columns that are kept: 200 MB."""
THREADS, LONG = 2, 16
"""Threads that share the pieces of a log, and pieces from which on it is worth the while."""
RIDGE = 0.1
"""Prior precision of an effect, of a plausible size's: ten times that size is hardly believed, a hundred times not at
all. Without it a bend of the channels and the calibration's scales grow against each other until the noise is gone."""


@dataclass(frozen=True, eq=False)
class Joint:
    """A hypothesis at its maximum.

    Attributes
    ----------
    log_likelihood : float
        Of the noise model, with the prior of the calibration and of the effects; numbers of one common size are integrated
        out (Laplace's approximation).
    z : (q,) array
    coefficients : (k,) array
        Of the effects, in units of their prior width.
    covariance : (q + k, q + k) array
    noise : Noise
    left : (n,) array
        nT, what is left of the residual.
    prior : (q + k,) array
        Precision that every coefficient had before the data, effects in units of their widths.
    """

    log_likelihood: float
    z: FloatArray
    coefficients: FloatArray
    covariance: FloatArray
    noise: Noise
    left: FloatArray
    prior: FloatArray


def fit_joint(
    problem: Problem,
    columns: Sequence[Columns],
    order: int,
    *starts: FloatArray,
    plain: bool = True,
    spectra: Sequence[FloatArray | None] = (),
    like: Joint | None = None,
    blocks: bool | None = None,
    ridge: float | FloatArray = RIDGE,
    rounds: int = 5,
) -> Joint:
    """Maximise the joint likelihood of calibration, effects and noise.

    Parameters
    ----------
    problem : Problem
    columns : sequence of Columns
        The effects'.
    order : int
        Of the noise's memory.
    *starts : (q + k,) array
        Where to begin: the best of them; the calibration as it stands if there is none.
    plain : bool
        Begin where plain least squares ends, too.
    spectra : sequence of (l, k) array or None
        For each of `columns` whose numbers have one common free size (:mod:`.statistic`): their prior variances.
    like : Joint, optional
        A fit whose noise this one's will resemble: saves time.
    blocks : bool, optional
        See :func:`~magbridge.diagnose.noise.fit_noise`.
    ridge : float or (k,) array
        Prior precision of the effects, in units of their widths.
    rounds : int
        At most.
    """
    X = Design(problem, columns)
    q, k = X.free.shape[1], X.effects
    prior = np.append(np.ones(q), np.broadcast_to(ridge, k))
    common = [(own, spectrum) for own, spectrum in zip(X.at, spectra, strict=False) if spectrum is not None]
    centre = np.append(problem.centre, np.zeros(k))
    follows = problem.survey.follows

    def at(c: FloatArray) -> tuple[FloatArray, Noise]:
        left = problem.residual - X.times(c)
        return left, fit_noise(left, follows, order, blocks=blocks, like=None if like is None else like.noise)

    def value(c: FloatArray, noise: Noise) -> float:
        return noise.log_likelihood - 0.5 * float(prior @ (c - centre) ** 2)

    # noise with a long memory swallows what is slow, and least squares then never asks for it again: so it is
    # asked once as if the noise had none
    first = [*(starts or [centre])]
    if plain:
        first.append(_plain(X, problem.residual, prior, centre))
    found = [(c, *at(c)) for c in first]
    for own, _ in common:
        prior[own] = 0.0  # no size is known yet
    c, left, noise = max(found, key=lambda entry: value(entry[0], entry[2]))
    for step in range(rounds + 1):
        P, b = normal(X.rows, noise.response(left), noise)
        for own, spectrum in common:
            prior[own] = _sized(P, b + P @ c + prior * centre, prior, own, spectrum)
        P += np.diag(prior)
        if step == rounds:
            break
        moved = c + np.linalg.solve(P, b - prior * (c - centre))
        tried = at(moved)
        gained = value(moved, tried[1]) - value(c, noise)
        if gained > 0.0:
            c, (left, noise) = moved, tried
        if gained < 0.02:  # P is that of the last step: no other
            break
    covariance: FloatArray = np.asarray(np.linalg.inv(P), float)
    volume = sum(volume_of(covariance[own, own], prior[own]) for own, _ in common)
    return Joint(value(c, noise) - volume, c[:q], c[q:], covariance, noise, left, prior)


def volume_of(covariance: FloatArray, prior: FloatArray) -> float:
    """Return ``1/2 ln det(1 + g S)``: by how much the data have narrowed numbers of this prior precision."""
    return -0.5 * float(np.linalg.slogdet(covariance)[1] + np.log(prior).sum())


def _sized(P: FloatArray, h: FloatArray, prior: FloatArray, own: slice, spectra: FloatArray) -> FloatArray:
    """Prior precision of the numbers at `own`, of the common size and spectrum that data of information P and h like best."""
    others = np.delete(np.arange(len(h)), own)
    K = np.linalg.solve(P[np.ix_(others, others)] + np.diag(prior[others]), P[others, own])
    S, b = P[own, own] - P[own, others] @ K, h[own] - K.T @ h[others]
    return np.asarray(1.0 / Statistic(S, spectra).best(b).variance)


class Design:
    """The columns of a hypothesis, the calibration's and the effects'; what would fill the memory is made anew each time.

    Parameters
    ----------
    problem : Problem
    columns : sequence of Columns
        The effects'.
    """

    def __init__(self, problem: Problem, columns: Sequence[Columns]) -> None:
        self.free, self.columns = problem.free, columns
        n = len(problem)
        self.pieces = [slice(start, min(start + CHUNK, n)) for start in range(0, n, CHUNK)]
        sizes = [column(self.pieces[0]).shape[1] for column in columns]
        ends = self.free.shape[1] + np.cumsum([0, *sizes]).astype(int)
        self.at = [slice(*own) for own in zip(ends.tolist(), ends.tolist()[1:], strict=False)]
        self.effects = sum(sizes)
        self.kept: FloatArray | None = None
        if n * self.effects <= KEPT:
            self.kept = np.empty((n, self.effects))
            for rows in self.pieces:
                self.kept[rows] = self._made(rows)

    def _made(self, rows: slice) -> FloatArray:
        return np.hstack([column(rows) for column in self.columns]) if self.columns else self.free[rows, :0]

    def rows(self, rows: slice) -> FloatArray:
        """(m, q + k) rows of all columns."""
        return np.hstack([self.free[rows], self._made(rows) if self.kept is None else self.kept[rows]])

    def times(self, c: FloatArray) -> FloatArray:
        """(n,) what the coefficients c (q + k,) leave."""
        return np.concatenate([self.rows(rows) @ c for rows in self.pieces])

    def against(self, y: FloatArray) -> FloatArray:
        """(q + k,) ``X^T y``."""
        return np.asarray(sum(self.rows(rows).T @ y[rows] for rows in self.pieces))


def normal(X: Columns, y: FloatArray, noise: Noise | None = None) -> tuple[FloatArray, FloatArray]:
    """Return ``X^T X`` and ``X^T y``, X whitened if a noise is given; summed up in pieces that stay near the processor.

    Long logs are shared out among threads, always in the same way: the same numbers on any machine.
    """
    past = 0 if noise is None else len(noise.memory)

    def share(starts: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        P, b = np.zeros((0, 0)), np.zeros(0)
        for start in starts:
            first, end = max(start - past, 0), min(start + CHUNK, len(y))
            A = X(slice(first, end))
            if noise is not None:
                A = noise.filter(A, first, start - first)
            if not b.size:
                P, b = np.zeros((A.shape[1],) * 2), np.zeros(A.shape[1])
            P += A.T @ A
            b += A.T @ y[start:end]
        return P, b

    starts = range(0, len(y), CHUNK)
    if len(starts) < LONG:
        return share(starts)
    each = -(-len(starts) // THREADS)
    with ThreadPoolExecutor(THREADS) as pool:
        parts = list(pool.map(share, [starts[k : k + each] for k in range(0, len(starts), each)]))
    return sum((P for P, _ in parts), start=np.zeros(())), sum((b for _, b in parts), start=np.zeros(()))


def _plain(X: Design, residual: FloatArray, prior: FloatArray, centre: FloatArray) -> FloatArray:
    """Least squares as if the noise were white, outliers cut off."""
    level = 1.4826 * float(np.median(np.abs(residual - np.median(residual)))) + 1e-12
    c = centre
    P, _ = normal(X.rows, residual)
    left = residual - X.times(c)
    for step in range(2):
        cut = np.clip(left, *(np.median(left) + np.array([-8.0, 8.0]) * level)) if step else left
        c = c + np.linalg.solve(
            P / level**2 + np.diag(prior), X.against(cut) / level**2 - prior * (c - centre)
        )
        left = residual - X.times(c)
        level = 1.4826 * float(np.median(np.abs(left))) + 1e-12
    return c


@dataclass(frozen=True, eq=False)
class Information:
    """What the data say of every candidate's coefficients, calibration (and model so far) projected out.

    Attributes
    ----------
    matrix : (m, m) array
        Fisher information, in units of the prior widths.
    score : (m,) array
    shift : (q + k, m) array
        By how much calibration and model give way to one unit of each coefficient.
    """

    matrix: FloatArray
    score: FloatArray
    shift: FloatArray

    def moved(self, base: Joint, index: NDArray[np.intp], taken: FloatArray) -> FloatArray:
        """Return calibration and model (q + k,) where they are best when the coefficients at `index` are `taken`."""
        return np.append(base.z, base.coefficients) - self.shift[:, index] @ taken

    def without(self, index: NDArray[np.intp], prior: FloatArray) -> Information:
        """Project out the coefficients at `index`, of this prior precision, too."""
        S = self.matrix[np.ix_(index, index)] + np.diag(prior)
        K = np.linalg.solve(S, self.matrix[index])
        return Information(
            self.matrix - self.matrix[:, index] @ K, self.score - K.T @ self.score[index], self.shift
        )


def information(
    problem: Problem, noise: Noise, base: Joint, model: Sequence[Columns], candidates: Sequence[Columns]
) -> Information:
    """Sum up the candidates' information at the hypothesis `base`, whose effects are `model`, under `noise`."""
    q = problem.free.shape[1]
    nuisance = q + base.coefficients.size
    G, b = normal(
        lambda rows: np.hstack([problem.free[rows], *(column(rows) for column in (*model, *candidates))]),
        noise.response(base.left),
        noise,
    )
    pull = base.prior * np.append(problem.centre - base.z, -base.coefficients)
    K: FloatArray = np.asarray(
        np.linalg.solve(G[:nuisance, :nuisance] + np.diag(base.prior), G[:nuisance, nuisance:]), float
    )
    return Information(
        G[nuisance:, nuisance:] - G[nuisance:, :nuisance] @ K, b[nuisance:] - K.T @ (b[:nuisance] + pull), K
    )
