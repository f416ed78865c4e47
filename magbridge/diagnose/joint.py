r"""The joint fit of calibration, effects and noise, and its prediction of held-out dives.

Notes
-----
*Likelihood ratio of one candidate.* With projected information S and score b of k columns in units of their
widths, free coefficients have the likelihood ratio ``R = b^T S^-1 b``. Its degrees of freedom are the
directions that the data determine. A smooth function of the place, or a slow curve, has more coefficients
than these. Its coefficients have a Gaussian prior of variance g w, with the likeliest common size g and
spectrum w. With ``w^1/2 S w^1/2 = V diag(lambda) V^T``, ``y = V^T w^1/2 b`` the log evidence is

.. math:: E = \max_{g, w} \tfrac12 \sum_i \left(\frac{g y_i^2}{1 + g \lambda_i} - \ln(1 + g \lambda_i)\right)

Under no effect ``R = 2 E`` is at most a chi-square of one degree of freedom (Self & Liang 1987).

*Joint likelihood.* Noise that is fitted without a large and slow effect absorbs it, so two hypotheses are
compared only after the noise has been fitted under each.

*Score of a model*: the log predictive density of every fold of dives, given the other folds. l is the log
likelihood of the noise at the fit c to all dives, c_-f the fit without fold f, ``A_f^T A_f`` the information
of fold f, and P the information of all folds and the prior. Laplace's approximation is

.. math:: S = l - \tfrac12 |z|^2 - \tfrac12 \sum_f \left[ (c - c_{-f})^T (P - A_f^T A_f) (c - c_{-f})
              + \log\det P - \log\det (P - A_f^T A_f) \right]

The logs that the calibration was fitted to enter by ``|z|``. The difference of two models' scores is the log
of the pseudo-Bayes factor (Geisser & Eddy 1979, JASA 74:153).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from threading import current_thread
from typing import NamedTuple, TypeVar

import numpy as np

from magbridge.arrays import BoolArray, FloatArray, IndexArray, IntArray
from magbridge.diagnose.columns import Columns, places, size_of
from magbridge.diagnose.noise import ResidualNoise, fit_noise
from magbridge.diagnose.problem import DELAYS, Problem, row_blocks, side_by_side
from magbridge.estimation.residual import robust_scale

S = TypeVar("S")
T = TypeVar("T")
MAX_STORED_NUMBERS = 12_500_000
"""Largest number of matrix elements of columns that are kept in memory: 100 MB."""
ALL_PRODUCTS = ((slice(None), slice(None)),)
"""Blocks of ``X^T X`` to compute: all."""
THREADS, LONG, POOL = 2, 32768, "diagnose"
"""Number of threads, rows of a log above which they are used, and the prefix of their names."""
PRIOR_SIZES = np.logspace(-7, 2, 64)
"""Common sizes g that are tried, in units of the squared widths."""
VISIBLE = 1e-3
"""Information, as a fraction of the prior's own, below which a direction is ignored."""
RIDGE = 0.1
"""Prior precision of an effect's coefficients, in units of their widths. Without it, a nonlinearity and the
calibration's scales could cancel each other and fit the noise."""
FLAT_PRECISION = 1e-6
"""Prior precision of coefficients whose common size is not yet known."""
FOLDS = 8
"""Largest number of folds: each costs one solution of the normal equations."""
DRAWS = 2000
"""Number of bootstrap samples: an end of the interval then scatters by 1.5 % of the interval's width."""
QUANTILES = (0.025, 0.975)
"""Quantiles of the bootstrap samples at the ends of the interval."""
CONFIDENCE_LEVEL = QUANTILES[1] - QUANTILES[0]
"""Confidence level of the interval."""


def precomputed(n: int, columns: Sequence[Columns]) -> list[Columns]:
    """Return the columns of n rows, precomputed unless they would need too much memory."""
    # the fits of a long log are made by two threads, each with columns of its own
    if n * sum(map(size_of, columns)) > MAX_STORED_NUMBERS / (THREADS if n > LONG else 1):
        return list(columns)

    def stored(column: Columns) -> FloatArray:
        return np.concatenate([column(rows).T for rows in row_blocks(n)], axis=1).T

    return [made.__getitem__ for made in in_threads(n, stored, columns)]


class JointDesign:
    """Design matrix X of a hypothesis: q columns of the calibration, then k of the effects."""

    def __init__(self, problem: Problem, columns: Sequence[Columns]) -> None:
        self.problem, self.columns, self.pieces = problem, columns, row_blocks(len(problem))
        sizes, self.q = [size_of(column) for column in columns], len(problem.centre)
        self.at, self.effects = places(sizes, self.q), sum(sizes)

    def rows(self, rows: slice) -> FloatArray:
        """Return m rows of X, (m, q + k)."""
        return side_by_side([self.problem.calibration_rows(rows), *(column(rows) for column in self.columns)])

    def times(self, c: FloatArray) -> FloatArray:
        """Return ``X c`` (n,) for coefficients c (q + k,)."""

        def piece(rows: slice) -> FloatArray:
            out = np.asarray(self.problem.calibration_rows(rows) @ c[: self.q])
            for own, column in zip(self.at, self.columns, strict=True):
                if c[own].any():
                    out += column(rows) @ c[own]
            return out

        return np.concatenate(in_threads(len(self.problem), piece, self.pieces))


def normal(
    X: Columns,
    y: FloatArray,
    noise: ResidualNoise | None = None,
    asked: Sequence[tuple[slice, slice]] = ALL_PRODUCTS,
    stride: int = 1,
) -> tuple[FloatArray, FloatArray]:
    """Return ``X^T X`` (k, k) and ``X^T y`` (k,), X whitened if a noise is given.

    Only the blocks `asked` of ``X^T X``, pairs of row and column slices, and their transposes are computed.
    With a `stride` k, only every k-th piece of the log counts. The order of the sums does not depend on the
    machine.
    """
    k = size_of(X)

    # Sums over a share of the pieces; the shares are added in their order
    def share(part: Sequence[slice]) -> tuple[FloatArray, FloatArray]:
        P, b = np.zeros((k, k)), np.zeros(k)
        for rows in part:
            A = X(rows) if noise is None else noise.whitened(X, rows)
            for own, others in asked:
                P[own, others] += A[:, own].T @ A[:, others]
            b += A.T @ y[rows]
        return P, b

    every = row_blocks(len(y))[::stride]
    each = -(-len(every) // THREADS) if len(y) > LONG else len(every)
    shares = in_threads(len(y), share, [every[n : n + each] for n in range(0, len(every), each)])
    P = np.asarray(sum(P for P, _ in shares))
    for own, others in asked:
        P[others, own] = P[own, others].T
    return P, np.asarray(sum(b for _, b in shares))


def in_threads(n: int, function: Callable[[S], T], given: Iterable[S]) -> list[T]:
    """Return the results of `function` for each argument in `given`.

    For a log of more than :data:`LONG` rows n, threads share the calls, except for a call from such a thread.
    """
    if n <= LONG or current_thread().name.startswith(POOL):
        return [function(one) for one in given]
    return list(_pool().map(function, given))


@cache
def _pool() -> ThreadPoolExecutor:
    # the same threads all the time: the memory that new ones allocate would not be released
    return ThreadPoolExecutor(THREADS, POOL)


@dataclass(frozen=True, eq=False)
class Ridge:
    """Estimate of coefficients of one common size, at the likeliest size and spectrum."""

    ratio: float
    estimate: FloatArray
    """(k,) posterior mean of the coefficients."""
    variance: FloatArray
    """(k,) prior variance of each coefficient."""
    price: float
    """Cost of the prior in log evidence: density at the estimate, and volume (Occam's factor)."""
    signal_to_noise: float
    """Whitened norm of the estimate."""


class Statistic:
    """The likelihood ratio of one candidate's coefficients, of information S (k, k).

    `spectra` (l, k) are alternative prior variances, up to a common factor. Without them each coefficient is
    free.
    """

    def __init__(self, S: FloatArray, spectra: FloatArray | None = None) -> None:
        self.spectra = spectra
        if spectra is None:
            values, self.vectors = np.linalg.eigh(S)
            self.values = np.where(values > VISIBLE, values, np.inf)  # ignore directions without a signal
            self.freedom = int(np.isfinite(self.values).sum())
            return
        root = np.sqrt(spectra)
        # w^1/2 S w^1/2 = V diag(lambda) V^T, one decomposition for each spectrum
        values, vectors = np.linalg.eigh(S * root[:, :, None] * root[:, None, :])
        self.values, self.vectors = np.maximum(values, 0.0), root[:, :, None] * vectors
        self.freedom = 1

    def ratio(self, b: FloatArray) -> FloatArray:
        """Return the likelihood ratios (m,) of m scores b (k, m)."""
        if self.spectra is None:
            return np.asarray(np.sum((self.vectors.T @ b) ** 2 / self.values[:, None], axis=0))
        return np.asarray(
            2.0 * np.max([self._evidences(k, b).max(axis=0) for k in range(len(self.spectra))], axis=0)
        )

    def _evidences(self, k: int, b: FloatArray) -> FloatArray:
        """Return the log evidence (sizes, m) of m scores at each prior size, with the k-th spectrum."""
        y2, grown = (self.vectors[k].T @ b) ** 2, PRIOR_SIZES[:, None] * self.values[k]
        return np.asarray(
            0.5 * ((PRIOR_SIZES[:, None] / (1.0 + grown)) @ y2 - np.log1p(grown).sum(axis=1)[:, None])
        )

    def best(self, b: FloatArray) -> Ridge:
        """Return the estimate at the likeliest size and spectrum for a score b (k,)."""
        assert self.spectra is not None
        # E(g, w) on the grid of sizes and spectra: its maximum gives both
        tables = [self._evidences(k, b[:, None])[:, 0] for k in range(len(self.spectra))]
        k = int(np.argmax([table.max() for table in tables]))
        at = int(np.argmax(tables[k]))
        values, g = self.values[k], PRIOR_SIZES[at]
        # Posterior mean in the eigenbasis: g y / (1 + g lambda)
        c = g * (self.vectors[k].T @ b) / (1.0 + g * values)
        price = 0.5 * float(c @ c / g + np.log1p(g * values).sum())
        ratio, norm = 2.0 * float(tables[k][at]), float(np.sqrt(c**2 @ values))
        return Ridge(ratio, self.vectors[k] @ c, g * self.spectra[k], price, norm)


@dataclass(frozen=True, eq=False)
class Joint:
    """Joint fit of calibration, effects and noise at the maximum of the likelihood."""

    log_likelihood: float
    """Penalised log-likelihood; coefficients of one common size are integrated out (Laplace)."""
    z: FloatArray
    """(q,) unknowns of the calibration, as in :mod:`.problem`."""
    coefficients: FloatArray
    """(k,) coefficients of the effects, in units of their prior widths."""
    covariance: FloatArray
    """(q + k, q + k) covariance of z and the coefficients."""
    noise: ResidualNoise
    residual: FloatArray
    """(n,) residual of the fit, in the sensor's nT."""
    prior: FloatArray
    """(q + k,) prior precision of z and of the coefficients, in their units."""

    @property
    def effects_covariance(self) -> FloatArray:
        """(k, k) covariance of the effects' coefficients."""
        return self.covariance[len(self.z) :, len(self.z) :]

    def wald(self, places: slice | IndexArray) -> float:
        """Return Wald's statistic ``b^T C_bb^-1 b`` of the effects' coefficients b (k,) at `places`."""
        # Quadratic form of the estimates with their inverse covariance
        b = self.coefficients[places]
        return float(b @ np.linalg.solve(self.effects_covariance[places][:, places], b))


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
    brief: bool = False,
    stride: int = 1,
) -> Joint:
    """Maximise the joint likelihood of calibration, effects and noise by at most `rounds` steps.

    The fit starts from the best of the `starts` (q + k,) and, if `plain`, of least squares under white noise.
    The k coefficients of the effects have the prior precision `ridge`, in units of their widths. Columns with
    `spectra` (l, k) have one common size instead, and l alternative variances. The autoregression has this
    `order`, and its fit starts from the noise of the fit `like`. `blocks` and `brief` are arguments of
    :func:`.fit_noise`. With a `stride` k, every k-th piece of the log counts in the normal equations.
    """
    # Coefficients c = (z, b): the calibration's, then the effects'. Prior precision 1 for z, `ridge` for b
    X = JointDesign(problem, precomputed(len(problem), columns))
    q, k = X.q, X.effects
    prior = np.append(np.ones(q), np.broadcast_to(ridge, k))
    # Blocks of one common prior size, which is chosen in each step: delays, slow noise, Gaussian processes
    common = [(slice(q + DELAYS.start, q), np.ones((1, 3)))]
    if problem.waves.size:
        common.append((problem.slow, 1.0 / problem.waves[None]))
    common += [(own, spectrum) for own, spectrum in zip(X.at, spectra, strict=False) if spectrum is not None]
    centre = np.append(problem.centre, np.zeros(k))
    past = problem.survey.history(order)

    def evaluated(c: FloatArray) -> tuple[FloatArray, ResidualNoise]:
        residual = problem.residual - X.times(c)
        # The noise is fitted again at every trial, beginning with that of a similar fit
        known = None if like is None else like.noise
        return residual, fit_noise(residual, past, blocks=blocks, like=known, brief=brief)

    def value(c: FloatArray, noise: ResidualNoise) -> float:
        return noise.log_likelihood - 0.5 * float(prior @ (c - centre) ** 2)

    # noise of a long correlation absorbs a slow effect, and no later step finds it again: so one start is
    # fitted as if the noise were white
    first = [*(starts or [centre])]
    if plain:
        first.append(_plain(X, problem.residual, prior, centre, stride))
    for own, _ in common:
        prior[own] = FLAT_PRECISION  # no size is known yet
    # The best start by the penalised likelihood, each under its own noise
    tries = in_threads(len(problem), lambda c: (c, *evaluated(c)), first)
    c, residual, noise = max(tries, key=lambda entry: value(entry[0], entry[2]))
    del tries  # of a month each is 15 MB
    for step in range(rounds + 1):
        # Fisher scoring: whitened normal equations (P + prior) dc = b - prior (c - centre)
        P, b = normal(X.rows, noise.response(residual), noise, stride=stride)
        for own, spectrum in common:
            prior[own] = _sized(P, b + P @ c + prior * centre, prior, own, spectrum)
        P += np.diag(prior)
        if step == rounds:
            break
        # A step is kept only if the likelihood grows with the noise fitted again
        moved = c + np.linalg.solve(P, b - prior * (c - centre))
        tried = evaluated(moved)
        gained = value(moved, tried[1]) - value(c, noise)
        if gained > 0.0:
            c, (residual, noise) = moved, tried
        if gained < 0.02:  # converged: P need not be computed again
            break
    covariance: FloatArray = np.asarray(np.linalg.inv(P), float)
    # Laplace's approximation: coefficients of one common size are integrated out
    volume = sum(volume_of(covariance[own, own], prior[own]) for own, _ in common)
    return Joint(value(c, noise) - volume, c[:q], c[q:], covariance, noise, residual, prior)


def volume_of(covariance: FloatArray, prior: FloatArray) -> float:
    """Return ``1/2 ln det(1 + g S)`` by posterior `covariance` (k, k) and `prior` precision (k,)."""
    return -0.5 * float(np.linalg.slogdet(covariance)[1] + np.log(prior).sum())


def _sized(P: FloatArray, h: FloatArray, prior: FloatArray, place: slice, spectra: FloatArray) -> FloatArray:
    """Return the prior precision of the coefficients at `place` for their likeliest size and spectrum."""
    # Schur complement: information and score of the block, all other coefficients projected out
    others = np.delete(np.arange(len(h)), place)
    K = np.linalg.solve(P[np.ix_(others, others)] + np.diag(prior[others]), P[others, place])
    S, b = P[place, place] - P[place, others] @ K, h[place] - K.T @ h[others]
    return np.asarray(1.0 / Statistic(S, spectra).best(b).variance)


def _plain(
    X: JointDesign, residual: FloatArray, prior: FloatArray, centre: FloatArray, stride: int
) -> FloatArray:
    """Return the coefficients (q + k,) of least squares under white noise, with outliers clipped."""
    level = robust_scale(residual - np.median(residual)) + 1e-12
    # First all samples, then again with those beyond 8 sigma cut off
    P, b = normal(X.rows, residual, stride=stride)
    c = centre + np.linalg.solve(P / level**2 + np.diag(prior), (b - P @ centre) / level**2)
    residual = residual - X.times(c)
    level = robust_scale(residual) + 1e-12
    cut = np.clip(residual, *(np.median(residual) + np.array([-8.0, 8.0]) * level))
    b = normal(X.rows, cut, asked=(), stride=stride)[1]
    return np.asarray(c + np.linalg.solve(P / level**2 + np.diag(prior), b / level**2 - prior * (c - centre)))


class HeldOut(NamedTuple):
    """Result of cross-validation over folds of dives."""

    residual: FloatArray
    """(n,) residual of each sample by the linear fit without its fold, in the sensor's nT."""
    score: float
    """Log predictive density, summed over the folds."""
    fold: IntArray
    """(n,) number of each sample's fold."""
    coefficients: FloatArray
    """(f, q + k) coefficients of calibration and effects, fitted without each of f folds."""


def held_out(
    problem: Problem,
    columns: Sequence[Columns],
    fit: Joint,
    *,
    interleaved: bool = False,
    groups: IntArray | None = None,
) -> HeldOut:
    """Refit all coefficients without each fold of dives; noise and nonlinear parameters stay as in `fit`.

    A fold is a stretch of consecutive dives, so the fit extrapolates a slow change. If `interleaved`, a fold
    is every eighth dive, so the fit interpolates. `groups` (n,) replaces the numbers of the dives.
    """
    X, noise, prior = JointDesign(problem, precomputed(len(problem), columns)), fit.noise, fit.prior
    centre = np.append(problem.centre, np.zeros(X.effects))
    c = np.append(fit.z, fit.coefficients)
    y = noise.response(problem.residual - X.times(c))
    # Folds: every count-th dive, or stretches of dives of equal number
    dive = np.unique(problem.survey.dive if groups is None else groups, return_inverse=True)[1]
    count, dives = min(FOLDS, int(dive.max()) + 1), int(dive.max()) + 1
    ends = np.cumsum([len(some) for some in np.array_split(np.arange(dives), count)])
    of = dive % count if interleaved else np.searchsorted(ends, dive, side="right")
    # Information and score of each fold, about the fit c to all dives
    P, b = np.zeros((count, c.size, c.size)), np.zeros((count, c.size))
    for rows in X.pieces:
        A = noise.whitened(X.rows, rows)
        for k in np.unique(of[rows]):
            fold_rows = A[of[rows] == k]
            P[k] += fold_rows.T @ fold_rows
            b[k] += fold_rows.T @ (y[rows][of[rows] == k] + fold_rows @ c)
    # Without fold f: (P - P_f)^-1 (b - b_f), one solution of the normal equations for each fold
    whole_P, whole_b = P.sum(axis=0) + np.diag(prior), b.sum(axis=0) + prior * centre
    others = whole_P - P
    without = np.linalg.solve(others, (whole_b - b)[:, :, None])[:, :, 0]
    corrected, residual = without.copy(), np.empty(len(problem))
    corrected[:, problem.slow] = 0.0  # the corrected field keeps its slow noise
    for rows in X.pieces:
        residual[rows] = problem.residual[rows] - np.einsum("ij,ij->i", X.rows(rows), corrected[of[rows]])
    # The score S of this module's notes: likelihood less the price of predicting each fold
    away = c - without
    price = np.einsum("fi,fij,fj->", away, others, away)
    price += np.sum(np.linalg.slogdet(whole_P)[1] - np.linalg.slogdet(others)[1])
    price += prior[: len(fit.z)] @ (fit.z - problem.centre) ** 2
    return HeldOut(residual, noise.log_likelihood - 0.5 * float(price), of, without)


class Improvement(NamedTuple):
    """Held-out RMS before and after, nT, their ratio, and its bootstrap interval over dives."""

    before: float
    after: float
    ratio: float
    interval: tuple[float, float]

    @property
    def shown(self) -> bool:
        """Return True if the held-out dives show an improvement: the whole interval is below 1."""
        return self.interval[1] < 1.0


def paired(
    error_before: FloatArray, error_after: FloatArray, dive: IntArray, counts: BoolArray
) -> Improvement:
    """Return the improvement between two errors (n,), nT, where `counts` (n,), by a bootstrap of dives."""
    # Sums of squares of each dive: the bootstrap then draws dives, not samples
    number = np.unique(dive[counts], return_inverse=True)[1]
    b, a = np.bincount(number, error_before[counts] ** 2), np.bincount(number, error_after[counts] ** 2)
    rng = np.random.default_rng(20131213)  # the same answer every time
    drawn = rng.integers(0, b.size, (DRAWS, b.size))
    ratios = np.sqrt(a[drawn].sum(axis=1) / (b[drawn].sum(axis=1) + 1e-300))
    low, high = np.quantile(ratios, QUANTILES)
    before, after = np.sqrt(np.array([b.sum(), a.sum()]) / counts.sum()).tolist()
    return Improvement(before, after, after / (before + 1e-150), (float(low), float(high)))
