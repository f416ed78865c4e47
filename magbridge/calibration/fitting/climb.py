"""The default fit from one start: coefficients, widths and noise in turn, until the evidence converges."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from magbridge.arrays import FloatArray, IndexArray
from magbridge.estimation.hyperparameters import Hyperparameters, maximise_evidence
from magbridge.estimation.information import GaussianInformation, covariance_of
from magbridge.estimation.noise import OUTLIER_SIGMA, NoiseModel, Whitening, estimate_noise
from magbridge.estimation.optimise import Solution, gauss_newton
from magbridge.estimation.priors import Prior, PriorFamily
from magbridge.estimation.residual import ResidualSamples, jacobian, residuals, residuals_of

__all__ = ["Climbed", "climb", "thinned", "thinned_rows"]

ENOUGH, BLOCK = 6000, 50
"""Samples that choose the start, and the size of the blocks of neighbours in which they are taken."""
MAX_START_ITERATIONS = 16
"""Rounds of coefficients, widths, noise, at most; five or six are usually enough."""


@dataclass(frozen=True, eq=False)
class Climbed:
    """Result of a climb."""

    solution: Solution
    widths: Hyperparameters
    noise: NoiseModel
    family: PriorFamily
    quadratic: GaussianInformation
    score: float


def thinned_rows(n: int) -> IndexArray:
    """Return the rows (k,) of blocks of neighbours, spread evenly over n samples; all rows if n is small."""
    if n <= ENOUGH:
        return np.arange(n)
    first = np.linspace(0, n // BLOCK - 1, ENOUGH // BLOCK).astype(int) * BLOCK
    return (first[:, None] + np.arange(BLOCK)).ravel()


def thinned(samples: ResidualSamples) -> ResidualSamples:
    """Return blocks of neighbours, spread evenly over all samples, to choose a start."""
    n = len(samples.field)
    if n <= ENOUGH:
        return samples
    part = samples.part(thinned_rows(n))
    part.steps[::BLOCK] = np.inf
    return part


def climb(
    samples: ResidualSamples,
    family: PriorFamily,
    z: FloatArray,
    eta: FloatArray,
    noise: NoiseModel | None = None,
    *,
    shaped: bool = False,
) -> Climbed:
    """Alternate coefficients, widths and noise until the evidence converges; give `noise` if z is near that.

    `z` (q,) and `eta` (h,) are where it begins. `shaped`: the memory of `noise` is kept.
    """
    score, white = -np.inf, noise is None
    shape = noise.shape if noise is not None and shaped else None
    if noise is None:
        z, noise = _approach(samples, family.prior(eta), z)
    for step in range(MAX_START_ITERATIONS):
        if family.renew is not None and step:
            family = family.renew(z)
        # the first widths are a guess, and not worth settling at
        solution = gauss_newton(samples, family.prior(eta), noise, z, steps=50 if step else 3)
        kept = len(samples.field) - noise.rejected
        quadratic = GaussianInformation.from_derivatives(solution.z, *solution.normal, kept)
        widths = maximise_evidence(quadratic, family, eta, noise.sigma)
        eta, z = widths.eta, solution.z
        last, score = score, _score(widths, noise, samples)
        noise = replace(noise, sigma=widths.sigma)
        still = step > 0 and abs(score - last) < 1e-2 and solution.steps <= 1
        if still and not white:
            break
        # residuals of a wrong model look correlated for long, so the autocorrelation waits for convergence
        white = white and not still and step < MAX_START_ITERATIONS // 2
        # at last the noise's autocorrelation and outliers are kept, so that the rest converges
        if step < MAX_START_ITERATIONS - 4:
            prior = family.prior(eta)
            e = residuals_of(samples, prior.coefficients(z))
            doubt = (0.0, 0.0) if white or shape else _doubt(samples, prior, solution, noise)
            steps = np.where(white, np.inf, samples.steps)
            found = estimate_noise(e, steps, widths.determined, doubt, shape)
            noise = replace(found, sigma=widths.sigma)
    return Climbed(solution, widths, noise, family, quadratic, score)


def _doubt(
    samples: ResidualSamples, prior: Prior, solution: Solution, noise: NoiseModel
) -> tuple[float, float]:
    """Variance of the model at a sample, and its covariance with the next one's, nT² (mean of all)."""
    few = thinned(samples)
    _, g = residuals(few, prior.coefficients(solution.z))
    J = jacobian(few.phi, g)
    P = covariance_of(solution.normal.hessian / noise.sigma**2 + prior.precision)
    JP = J @ (prior.E @ P @ prior.E.T)
    next_one = few.steps[1:] == 1
    return float(np.mean((JP * J).sum(axis=1))), float(np.mean((JP[1:] * J[:-1]).sum(axis=1)[next_one]))


def _approach(samples: ResidualSamples, prior: Prior, z: FloatArray) -> tuple[FloatArray, NoiseModel]:
    """Approach the solution: after each Gauss-Newton step, set the noise to the bulk of the residuals."""
    apart = np.full(len(samples.field), np.inf)
    noise = estimate_noise(residuals_of(samples, prior.coefficients(z)), apart, 0.0)
    for _ in range(MAX_START_ITERATIONS):
        z = gauss_newton(samples, prior, noise, z, steps=1, tolerance=0.1).z
        last, noise = noise, estimate_noise(residuals_of(samples, prior.coefficients(z)), apart, 0.0)
        if noise.sigma > 0.8 * last.sigma:
            break
    return z, noise


def _score(widths: Hyperparameters, noise: NoiseModel, samples: ResidualSamples) -> float:
    """Log evidence of all samples: an outlier counts as one just at the limit, whitening by its Jacobian."""
    outlier = np.log(widths.sigma) + 0.5 * OUTLIER_SIGMA**2
    variance = Whitening(samples.steps, noise.autocorrelation, noise.white).variance
    whitening = 0.5 * np.log(variance).sum()
    return float(widths.log_evidence - noise.rejected * outlier - whitening)
