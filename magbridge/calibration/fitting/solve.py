"""Damped Gauss-Newton on the scalar residual with a Gaussian prior.

Notes
-----
Minimises over z, with coefficients ``c = E z + offset``::

    sum_i w_i e_i(c)^2 / (2 sigma^2) + z^T P z / 2

Each step is Gauss-Newton's, shortened until the sum decreases. The linear algebra is small, because the
normal equations of all samples are summed up once for each trial.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.linalg.lapack import dpotrf

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.noise import NoiseModel
from magbridge.calibration.fitting.prior import Prior
from magbridge.calibration.residual import NormalEquations, Samples, normal_equations
from magbridge.errors import CalibrationError

__all__ = ["Solution", "covariance_of", "gauss_newton"]


@dataclass(frozen=True, eq=False)
class Solution:
    """Where the solver ended: z, normal equations there (in z), and whether it settled."""

    z: FloatArray
    normal: NormalEquations
    settled: bool
    steps: int


def gauss_newton(
    samples: Samples,
    prior: Prior,
    noise: NoiseModel,
    start: FloatArray,
    *,
    steps: int = 50,
    tolerance: float = 1e-3,
) -> Solution:
    """Minimise from `start`.

    Parameters
    ----------
    samples, prior, noise
        See the module's notes.
    start : (q,) array
        z at the first step.
    steps : int
        How many at most.
    tolerance : float
        Settled when the next step would gain less than this (in units of log likelihood).
    """
    z = np.array(start, float)

    def normal_at(z: FloatArray) -> NormalEquations:
        return prior.reduce(
            normal_equations(samples, prior.coefficients(z), noise.weight, noise.autocorrelation, noise.white)
        )

    normal = normal_at(z)
    value = _objective(normal, prior, noise, z)
    for step in range(steps):
        precision = normal.hessian / noise.sigma**2 + prior.precision
        gradient = normal.gradient / noise.sigma**2 + prior.precision @ z
        move = -_solve(precision, gradient)
        promise = -float(gradient @ move)
        if promise < tolerance:
            return Solution(z, normal, settled=True, steps=step)
        part = 1.0
        while True:
            tried = normal_at(z + part * move)
            new = _objective(tried, prior, noise, z + part * move)
            if new < value:
                break
            # go to the minimum of the parabola through value, slope and new
            part *= max(0.5 * part * promise / (new - value + part * promise), 0.1)
            if part < 1e-6:
                return Solution(z, normal, settled=False, steps=step)
        z, normal, value = z + part * move, tried, new
    return Solution(z, normal, settled=False, steps=steps)


def _objective(normal: NormalEquations, prior: Prior, noise: NoiseModel, z: FloatArray) -> float:
    return 0.5 * normal.cost / noise.sigma**2 + 0.5 * float(z @ prior.precision @ z)


def _solve(precision: FloatArray, gradient: FloatArray) -> FloatArray:
    """Newton's step, scaled by the diagonal."""
    scale = np.sqrt(np.maximum(np.diag(precision), 1e-300))
    scaled = precision / np.outer(scale, scale)
    factor, info = dpotrf(scaled)
    if info:  # do not move along directions that neither data nor prior determine
        values, vectors = np.linalg.eigh(scaled)
        kept = values > 1e-11 * values[-1]
        inner = vectors[:, kept] @ ((vectors[:, kept].T @ (gradient / scale)) / values[kept])
        return np.asarray(inner / scale)
    return np.asarray(cho_solve((factor, False), gradient / scale) / scale)


def covariance_of(precision: FloatArray) -> FloatArray:
    """Inverse of a positive definite precision (q, q), symmetric to the last bit.

    CalibrationError: the precision leaves a combination free.
    """
    scale = np.sqrt(np.diag(precision))
    try:
        factor, lower = cho_factor(precision / np.outer(scale, scale), lower=True)
    except np.linalg.LinAlgError as problem:
        raise CalibrationError("the data and the prior leave a combination of coefficients free") from problem
    root = solve_triangular(factor, np.eye(len(scale)), lower=lower) / scale
    return np.asarray(root.T @ root)
