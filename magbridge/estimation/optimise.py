r"""Damped Gauss-Newton on the scalar residual with a Gaussian prior.

The solver varies z, with coefficients ``c = E z + offset``, to minimise the objective

.. math:: \frac{1}{2\sigma^2} \sum_i w_i e_i(c)^2 + \tfrac12 z^T P z,

where e are the whitened residuals (:mod:`.residual`, :mod:`.noise`), w their weights and P is the prior's
precision. Each step solves ``(J^T J / sigma^2 + P) dz = -gradient`` and is shortened until the objective
decreases (Nocedal & Wright 2006, Numerical optimization, sections 3.5 and 10.3). Each trial sums the normal
equations over all samples once, so the linear algebra is small.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve
from scipy.linalg.lapack import dpotrf

from magbridge.arrays import FloatArray
from magbridge.estimation.noise import NoiseModel, Whitening
from magbridge.estimation.priors import Prior
from magbridge.estimation.residual import CHUNK_ROWS, ResidualSamples, jacobian, residuals

__all__ = ["NormalEquations", "Solution", "gauss_newton", "normal_equations"]

MIN_STEP_FRACTION = 1e-6
"""Fraction of a Gauss-Newton step below which it is not shortened further."""
MIN_SHORTENING = 0.1
"""Smallest factor by which one trial shortens a step that fails."""
MIN_EIGENVALUE_RATIO = 1e-11
"""Fraction of the largest eigenvalue of the scaled precision below which a direction is not determined."""


class NormalEquations(NamedTuple):
    """Normal equations at a point: ``cost = sum w e^2``, half its gradient, half its Gauss-Newton Hessian."""

    hessian: FloatArray
    gradient: FloatArray
    cost: float

    def reduced(self, E: FloatArray) -> NormalEquations:
        """Return the normal equations in z (q,), where ``c = E z + offset``, E (K, q)."""
        return NormalEquations(E.T @ self.hessian @ E, E.T @ self.gradient, self.cost)


@dataclass(frozen=True, eq=False)
class Solution:
    """Result of the solver: z (q,), normal equations in z, `settled` (True if converged), number of steps."""

    z: FloatArray
    normal: NormalEquations
    settled: bool
    steps: int


def normal_equations(
    samples: ResidualSamples,
    coefficients: FloatArray,
    weight: FloatArray | None = None,
    rho: float = 0.0,
    white: float = 0.0,
) -> NormalEquations:
    """Return the normal equations of the whitened residual, computed in bounded memory.

    `samples`: n samples with m monomials. `coefficients` (9 m,): point of linearisation, nT, monomial by
    monomial. `weight` (n,): weight of each whitened residual; 1 if not given. `rho`, `white`:
    autocorrelation of the noise, as for :func:`.noise.whiten`.
    """
    size = coefficients.size
    hessian, gradient, cost = np.zeros((size, size)), np.zeros(size), 0.0
    # Sum over chunks: J^T W J, J^T W e and e^T W e, with residual and Jacobian whitened in order of time.
    whitening = Whitening(samples.steps, rho, white) if rho else None
    for start in range(0, len(samples.field), CHUNK_ROWS):
        part = samples.part(slice(start, start + CHUNK_ROWS))
        e, g = residuals(part, coefficients)
        J = jacobian(part.phi, g)
        if whitening is not None:
            both = whitening.apply(np.column_stack([e, J]))
            e, J = both[:, 0], both[:, 1:]
        if weight is not None:
            root = np.sqrt(weight[start : start + CHUNK_ROWS])
            e, J = e * root, J * root[:, None]
        hessian += J.T @ J
        gradient += J.T @ e
        cost += float(e @ e)
    return NormalEquations(hessian, gradient, cost)


def gauss_newton(
    samples: ResidualSamples,
    prior: Prior,
    noise: NoiseModel,
    start: FloatArray,
    *,
    steps: int = 50,
    tolerance: float = 1e-3,
) -> Solution:
    """Minimise the objective in the module's docstring, starting from `start`.

    Parameters
    ----------
    samples, prior, noise
        The data, the prior of z and the noise.
    start : (q,) array
        z at the first step.
    steps : int
        Maximum number of steps.
    tolerance : float
        Gain in log likelihood of the next step, below which the solver has converged.
    """
    z = np.array(start, float)

    def normal_at(z: FloatArray) -> NormalEquations:
        coefficients = prior.coefficients(z)
        return normal_equations(samples, coefficients, noise.weight, *noise.shape).reduced(prior.E)

    normal = normal_at(z)
    value = _objective(normal, prior, noise, z)
    for step in range(steps):
        # Gauss-Newton: (J^T J / sigma^2 + P) dz = -(J^T e / sigma^2 + P z).
        precision = normal.hessian / noise.sigma**2 + prior.precision
        gradient = normal.gradient / noise.sigma**2 + prior.precision @ z
        move = -_solve(precision, gradient)
        # Twice the decrease that the quadratic model predicts; converged where it is below the tolerance.
        promised = -float(gradient @ move)
        if promised < tolerance:
            return Solution(z, normal, settled=True, steps=step)
        # Shorten the step until the objective decreases.
        fraction = 1.0
        while True:
            tried = normal_at(z + fraction * move)
            new = _objective(tried, prior, noise, z + fraction * move)
            if new < value:
                break
            # go to the minimum of the parabola through the value, the slope and the new value
            parabola = 0.5 * fraction * promised / (new - value + fraction * promised)
            fraction *= max(parabola, MIN_SHORTENING)
            if fraction < MIN_STEP_FRACTION:
                return Solution(z, normal, settled=False, steps=step)
        z, normal, value = z + fraction * move, tried, new
    return Solution(z, normal, settled=False, steps=steps)


def _objective(normal: NormalEquations, prior: Prior, noise: NoiseModel, z: FloatArray) -> float:
    return 0.5 * normal.cost / noise.sigma**2 + 0.5 * float(z @ prior.precision @ z)


def _solve(precision: FloatArray, gradient: FloatArray) -> FloatArray:
    """Return the Newton step (q,), computed in units of the diagonal's square roots."""
    scale = np.sqrt(np.maximum(np.diag(precision), 1e-300))
    scaled = precision / np.outer(scale, scale)
    factor, info = dpotrf(scaled)
    if info:
        # not positive definite: do not move along directions that neither data nor prior determine
        values, vectors = np.linalg.eigh(scaled)
        kept = values > MIN_EIGENVALUE_RATIO * values[-1]
        inner = vectors[:, kept] @ ((vectors[:, kept].T @ (gradient / scale)) / values[kept])
        return np.asarray(inner / scale)
    return np.asarray(cho_solve((factor, False), gradient / scale) / scale)
