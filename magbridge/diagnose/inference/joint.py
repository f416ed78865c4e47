r"""The joint likelihood: calibration and effects free, the noise refitted under each hypothesis.

Notes
-----
Noise that is fitted without an effect absorbs it if it is large and slow, so two hypotheses are compared only
after the noise has been fitted under each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from magbridge.arrays import FloatArray, IndexArray
from magbridge.diagnose.compare.design_columns import Columns
from magbridge.diagnose.compare.problem import DELAYS, Problem
from magbridge.diagnose.inference.design import Design, in_threads, normal, precomputed
from magbridge.diagnose.inference.fit_noise import fit_noise
from magbridge.diagnose.inference.noise import Noise
from magbridge.diagnose.inference.statistic import Statistic
from magbridge.estimation.residual import robust_scale

__all__ = ["FLAT_PRECISION", "RIDGE", "Joint", "fit_joint", "volume_of"]

RIDGE = 0.1
"""Prior precision of an effect, in units of a plausible size's: ten times that size is hardly believed, a
hundred times not at all. Without it a nonlinearity and the calibration's scales can cancel each other and
grow until they fit the noise."""
FLAT_PRECISION = 1e-6
"""Prior precision of coefficients that are free, or of no known size."""


@dataclass(frozen=True, eq=False)
class Joint:
    """A hypothesis at its maximum."""

    log_likelihood: float
    """Log-likelihood of the noise model, with the prior of the calibration and the effects; coefficients of
    one common size, as the axes' delays and slow noise are, are integrated out (Laplace's approximation)."""
    z: FloatArray
    """(q,)."""
    coefficients: FloatArray
    """(k,) of the effects, in units of their prior width."""
    covariance: FloatArray
    """(q + k, q + k)."""
    noise: Noise
    residual: FloatArray
    """(n,) nT, residual of the fit."""
    prior: FloatArray
    """(q + k,) prior precision of every coefficient, effects in units of their widths."""

    @property
    def effects_covariance(self) -> FloatArray:
        """(k, k) of the effects' coefficients."""
        return self.covariance[len(self.z) :, len(self.z) :]

    def wald(self, at: slice | IndexArray) -> float:
        """Wald's statistic ``b^T C_bb^-1 b`` of the effects' coefficients b (k,) `at` these places."""
        b = self.coefficients[at]
        return float(b @ np.linalg.solve(self.effects_covariance[at][:, at], b))


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
) -> Joint:
    """Maximise the joint likelihood of calibration, effects and noise.

    Parameters
    ----------
    problem : Problem
        The survey, with the prior of its q calibration coefficients.
    columns : sequence of Columns
        The effects'.
    order : int
        Of the noise's autoregression.
    *starts : (q + k,) array
        Starting points, of which the best is taken; without any, the prior mean.
    plain : bool
        Try the result of plain least squares as a starting point, too.
    spectra : sequence of (l, k) array or None
        For each of `columns` whose coefficients have one common size (:mod:`.statistic`): l alternatives
        for their prior variances.
    like : Joint, optional
        A fit of similar noise, from which this one's begins: saves time.
    blocks, brief : bool, optional
        See :func:`~magbridge.diagnose.inference.fit_noise.fit_noise`.
    ridge : float or (k,) array
        Prior precision of the effects, in units of their widths.
    rounds : int
        At most.
    """
    X = Design(problem, precomputed(len(problem), columns))
    q, k = X.calibration_jacobian.shape[1], X.effects
    prior = np.append(np.ones(q), np.broadcast_to(ridge, k))
    common = [(slice(q + DELAYS.start, q), np.ones((1, 3)))]
    if problem.waves.size:
        common.append((problem.slow, 1.0 / problem.waves[None]))
    common += [(own, spectrum) for own, spectrum in zip(X.at, spectra, strict=False) if spectrum is not None]
    centre = np.append(problem.centre, np.zeros(k))
    past = problem.survey.past(order)

    def at(c: FloatArray) -> tuple[FloatArray, Noise]:
        residual = problem.residual - X.times(c)
        known = None if like is None else like.noise
        return residual, fit_noise(residual, past, blocks=blocks, like=known, brief=brief)

    def value(c: FloatArray, noise: Noise) -> float:
        return noise.log_likelihood - 0.5 * float(prior @ (c - centre) ** 2)

    # noise of a long correlation absorbs a slow effect, and no later step finds it again: so one start is
    # fitted as if the noise were white
    first = [*(starts or [centre])]
    if plain:
        first.append(_plain(X, problem.residual, prior, centre))
    for own, _ in common:
        prior[own] = FLAT_PRECISION  # no size is known yet
    tries = in_threads(len(problem), lambda c: (c, *at(c)), first)
    c, residual, noise = max(tries, key=lambda entry: value(entry[0], entry[2]))
    del tries  # of a month each is 15 MB
    for step in range(rounds + 1):
        P, b = normal(X.rows, noise.response(residual), noise)
        for own, spectrum in common:
            prior[own] = _sized(P, b + P @ c + prior * centre, prior, own, spectrum)
        P += np.diag(prior)
        if step == rounds:
            break
        moved = c + np.linalg.solve(P, b - prior * (c - centre))
        tried = at(moved)
        gained = value(moved, tried[1]) - value(c, noise)
        if gained > 0.0:
            c, (residual, noise) = moved, tried
        if gained < 0.02:  # converged: P need not be computed again
            break
    covariance: FloatArray = np.asarray(np.linalg.inv(P), float)
    volume = sum(volume_of(covariance[own, own], prior[own]) for own, _ in common)
    return Joint(value(c, noise) - volume, c[:q], c[q:], covariance, noise, residual, prior)


def volume_of(covariance: FloatArray, prior: FloatArray) -> float:
    """Return ``1/2 ln det(1 + g S)``, the log of how much the data narrow coefficients.

    Their posterior covariance is (k, k), their prior's precision (k,).
    """
    return -0.5 * float(np.linalg.slogdet(covariance)[1] + np.log(prior).sum())


def _sized(P: FloatArray, h: FloatArray, prior: FloatArray, own: slice, spectra: FloatArray) -> FloatArray:
    """Prior precision of the coefficients at `own`, by their likeliest common size and spectrum."""
    others = np.delete(np.arange(len(h)), own)
    K = np.linalg.solve(P[np.ix_(others, others)] + np.diag(prior[others]), P[others, own])
    S, b = P[own, own] - P[own, others] @ K, h[own] - K.T @ h[others]
    return np.asarray(1.0 / Statistic(S, spectra).best(b).variance)


def _plain(X: Design, residual: FloatArray, prior: FloatArray, centre: FloatArray) -> FloatArray:
    """Least squares as if the noise were white, outliers cut off."""
    level = robust_scale(residual - np.median(residual)) + 1e-12
    P, b = normal(X.rows, residual)
    c = centre + np.linalg.solve(P / level**2 + np.diag(prior), (b - P @ centre) / level**2)
    residual = residual - X.times(c)
    level = robust_scale(residual) + 1e-12
    cut = np.clip(residual, *(np.median(residual) + np.array([-8.0, 8.0]) * level))
    b = normal(X.rows, cut, asked=())[1]
    return np.asarray(c + np.linalg.solve(P / level**2 + np.diag(prior), b / level**2 - prior * (c - centre)))
