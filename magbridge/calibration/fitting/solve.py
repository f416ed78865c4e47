"""Loop of every fit: it alternates coefficients, prior widths and noise, from several starts.

Notes
-----
:func:`settle` alternates coefficients (Gauss-Newton with a fixed prior) and noise. :func:`climb` also
estimates the prior widths, which maximise the evidence of a quadratic approximation. After convergence the
residuals consist of outliers, white noise and an AR(1) process. Before, they are mainly the model's error,
which has a long correlation time.

If a model cannot describe the vehicle, its error remains correlated. :func:`lasting_noise` does not whiten
such an error, but counts several successive residuals as one (Newey & West 1987, Econometrica 55:703).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from magbridge.arrays import BoolArray, FloatArray, IndexArray
from magbridge.errors import NoSolutionError
from magbridge.estimation.hyperparameters import Hyperparameters, maximise_evidence
from magbridge.estimation.information import GaussianInformation, covariance_of
from magbridge.estimation.noise import (
    CLIP_SIGMA,
    OUTLIER_SIGMA,
    NoiseModel,
    Whitening,
    estimate_noise,
    fit_slow_and_white,
    samples_per_independent,
)
from magbridge.estimation.optimise import Solution, gauss_newton
from magbridge.estimation.priors import Prior, PriorFamily
from magbridge.estimation.residual import (
    ResidualSamples,
    residuals,
    residuals_of,
    robust_scale,
    scales_and_offsets,
)


@dataclass(frozen=True, eq=False)
class CoefficientPosterior:
    """Gaussian posterior of the coefficients ``c = E z + offset``, with samples, prior and noise."""

    samples: ResidualSamples
    prior: Prior
    z: FloatArray
    """(q,): Unknowns z of the fit at the maximum of the posterior."""
    spread: FloatArray
    """(q, q): Covariance of z."""
    noise: NoiseModel
    """Noise of a single sample."""
    weighted: NoiseModel
    """Noise with which the fit weights the samples; its sigma is larger if several residuals count as one."""
    settled: bool
    """True if the last Gauss-Newton solution converged to a minimum."""
    objective: float
    """Negative log posterior at z (without its constant), with the weights of the last step."""

    @property
    def coefficients(self) -> FloatArray:
        """Coefficients c, (9 m,), nT."""
        return self.prior.coefficients(self.z)

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the coefficients, (9 m, 9 m), nT²."""
        return np.asarray(self.prior.E @ self.spread @ self.prior.E.T)

    @property
    def residual(self) -> FloatArray:
        """Residual of each sample, (n,), nT as the sensor measures."""
        return residuals_of(self.samples, self.coefficients)


@dataclass(frozen=True, eq=False)
class Climbed(CoefficientPosterior):
    """Posterior of the coefficients with the prior widths that maximise the evidence."""

    family: PriorFamily
    widths: Hyperparameters
    """Prior widths (their logarithms eta) and noise that maximise the evidence."""
    log_evidence: float
    """Natural logarithm of the evidence of all samples."""


# ---- Coefficients and noise at fixed widths ----

MAX_START_ITERATIONS = 16
"""Largest number of iterations of coefficients, widths and noise; five or six are usual."""
MIN_APPROACH = 0.2
"""Relative decrease of the residuals by a step below which the solution is near."""
Estimate = Callable[[Prior, Solution, NoiseModel], tuple[NoiseModel, NoiseModel]]
"""Function that takes the prior, the solution and the present weighting noise. It returns the noise of a
sample, and the noise that weights the samples in the next iteration."""


def settle(
    samples: ResidualSamples,
    prior: Prior,
    z: FloatArray,
    estimate: Estimate,
    noise: NoiseModel,
    *,
    rounds: int = MAX_START_ITERATIONS,
    change: float = 0.0,
    steps: int = 50,
    tolerance: float = 1e-3,
) -> CoefficientPosterior:
    """Alternate coefficients and noise, starting at z (q,), and return the posterior.

    `estimate`: function that estimates the noise. `noise`: initial noise. `rounds`: largest number of
    iterations. `change`: relative change of the noise's sigma at which they stop. `steps`, `tolerance`:
    limits of each Gauss-Newton solution.
    """
    weighted = noise
    for _ in range(rounds):
        found = gauss_newton(samples, prior, weighted, z, steps=steps, tolerance=tolerance)
        z = found.z
        last, (noise, weighted) = weighted, estimate(prior, found, weighted)
        if abs(weighted.sigma - last.sigma) < change * last.sigma:
            break
    spread = covariance_of(found.normal.hessian / weighted.sigma**2 + prior.precision)
    objective = 0.5 * found.normal.cost / weighted.sigma**2 + 0.5 * float(z @ prior.precision @ z)
    return CoefficientPosterior(samples, prior, z, spread, noise, weighted, found.settled, objective)


def approach(samples: ResidualSamples, prior: Prior, z: FloatArray) -> CoefficientPosterior:
    """Return an approximate posterior after steps from z (q,); the bulk of the residuals sets the noise."""
    # far from the solution a small noise would make steps that overshoot
    white = replace(samples, steps=np.full(len(samples.field), np.inf))
    bulk = estimate_noise(residuals_of(samples, prior.coefficients(z)), white.steps, 0.0)
    estimate = partial(noise_of_residuals, white, 0.0)
    return settle(samples, prior, z, estimate, bulk, change=MIN_APPROACH, steps=1, tolerance=0.1)


def noise_of_residuals(
    samples: ResidualSamples, free: float, prior: Prior, found: Solution, _: NoiseModel
) -> tuple[NoiseModel, NoiseModel]:
    """Return the noise of a fit's residuals twice: of a sample, and for weighting.

    `free`: number of parameters that the fit determines.
    """
    noise = estimate_noise(residuals_of(samples, prior.coefficients(found.z)), samples.steps, free)
    return noise, noise


def lasting_noise(
    samples: ResidualSamples, prior: Prior, found: Solution, weighted: NoiseModel
) -> tuple[NoiseModel, NoiseModel]:
    """Return the noise of a sample, and the noise that weights it if model errors are correlated.

    The noise of a sample is white noise plus an AR(1) process. It has the residuals' autocorrelation at one
    sample, and their number of independent samples.
    """
    e, g = residuals(samples, prior.coefficients(found.z))
    noise = estimate_noise(e, samples.steps, len(found.z), shape=(0.0, 0.0))
    limit = CLIP_SIGMA * noise.sigma
    # scale the gradient by the posterior's root, so that all coefficients have equal weight
    root = np.linalg.cholesky(covariance_of(found.normal.hessian / weighted.sigma**2 + prior.precision))
    pulls = np.clip(e, -limit, limit)[:, None] * (g @ (prior.E @ root))
    repeats = samples_per_independent(pulls, samples.steps)
    # with a white fraction w: sum of the autocorrelations at all lags (1 - w) rho / (1 - rho), and that of
    # successive samples (1 - w) rho
    lasting = 0.5 * (repeats - 1.0)
    neighbours = estimate_noise(e, samples.steps, len(found.z)).autocorrelation
    rho, white = max(lasting / (1.0 + lasting), 0.0), 0.0
    if 0.0 < neighbours < lasting and neighbours < 1.0 - neighbours / lasting:
        rho = 1.0 - neighbours / lasting  # a slow part that lasts beyond the next sample
        white = 1.0 - neighbours / rho
    one = replace(noise, autocorrelation=rho, white=white)
    return one, replace(noise, sigma=noise.sigma * np.sqrt(repeats))


# ---- Widths by the evidence ----


def climb(
    samples: ResidualSamples,
    family: PriorFamily,
    z: FloatArray,
    eta: FloatArray,
    noise: NoiseModel | None = None,
    *,
    shaped: bool = False,
) -> Climbed:
    """Alternate coefficients, prior widths and noise until the evidence converges; return the posterior.

    `z` (q,), `eta` (h,): initial unknowns and log widths. `noise`: initial noise if z is near the solution.
    `shaped`: keep the autocorrelation and white fraction of `noise`.
    """
    score, white = -np.inf, noise is None
    shape = noise.shape if noise is not None and shaped else None
    if noise is None:
        near = approach(samples, family.prior(eta), z)
        z, noise = near.z, near.noise
    for step in range(MAX_START_ITERATIONS):
        if family.renew is not None and step:
            family = family.renew(z)
        # the first widths are a guess, so a few steps suffice
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
        # in the last iterations keep the noise's autocorrelation and outliers, so that the rest converges
        if step < MAX_START_ITERATIONS - 4:
            prior = family.prior(eta)
            e = residuals_of(samples, prior.coefficients(z))
            steps = np.where(white, np.inf, samples.steps)
            found = estimate_noise(e, steps, widths.determined, shape, samples.moving)
            noise = replace(found, sigma=widths.sigma)
    prior = family.prior(eta)
    spread = covariance_of(solution.normal.hessian / noise.sigma**2 + prior.precision)
    objective = 0.5 * solution.normal.cost / noise.sigma**2 + 0.5 * float(z @ prior.precision @ z)
    return Climbed(
        samples, prior, z, spread, noise, noise, solution.settled, objective, family, widths, score
    )


def _score(widths: Hyperparameters, noise: NoiseModel, samples: ResidualSamples) -> float:
    """Return the log evidence of all samples, with the Jacobians of the whitening and of the weights."""
    # an outlier counts as a sample at the outlier limit
    outlier = np.log(widths.sigma) + 0.5 * OUTLIER_SIGMA**2
    variance = Whitening(samples.steps, noise.autocorrelation, noise.white).variance
    whitening = 0.5 * np.log(variance).sum()
    weights = 0.0 if noise.weight is None else 0.5 * np.log(noise.weight[noise.weight > 0.0]).sum()
    return float(widths.log_evidence - noise.rejected * outlier - whitening + weights)


def best_climb(samples: ResidualSamples, family: PriorFamily) -> Climbed:
    """Return the converged posterior with the largest evidence among several starts.

    NoSolutionError: no start converged.
    """
    # climb from each start with a part of the samples, at narrow and at wide priors; then the best with all
    n = len(samples.field)
    few = successive(samples, thinned_rows(n)) if n > ENOUGH else samples
    answers = []
    for start in starts(few):
        z = family.nearest_latent(start)
        answers += [climb(few, family, z, family.centre + shift * family.spread) for shift in (0.0, 1.5)]
    for answer in sorted(answers, key=lambda answer: -answer.log_evidence):
        last = answer
        if few is not samples:
            noise = NoiseModel(answer.noise.sigma, answer.noise.autocorrelation, answer.noise.white)
            last = climb(samples, answer.family, answer.z, answer.widths.eta, noise)
        if last.settled:
            return last
    raise NoSolutionError("auto: no start converged; the data contradict themselves")


def with_slow_noise(answer: Climbed) -> Climbed:
    """Return the posterior, fitted again with slow and white noise if the residuals have both.

    Slow noise can also describe an error of the coefficients, such as a step at each move of a mass. The fit
    then leaves this error in its residuals, where a second estimate of the noise would find more of it.
    Therefore the noise is estimated once, and a fit with less evidence is discarded.
    """
    samples = answer.samples
    noise = fit_slow_and_white(
        answer.residual, samples.steps, answer.noise, answer.widths.determined, samples.moving
    )
    if noise is answer.noise:
        return answer
    again = climb(samples, answer.family, answer.z, answer.widths.eta, noise, shaped=True)
    return again if again.log_evidence > answer.log_evidence else answer


# ---- Where a fit begins, and with which samples ----

ENOUGH, BLOCK = 6000, 50
"""Largest number of samples that choose the start, and number of samples in each of their blocks."""
MIN_END_SAMPLES = 20
"""Smallest number of samples that :func:`flown` removes from an end of the log."""
MIN_OUTLIER_FRACTION = 0.7
"""Smallest fraction of outliers among the samples that :func:`flown` removes."""


def starts(samples: ResidualSamples) -> list[FloatArray]:
    """Return two initial sets of coefficients (9,), nT: zeros, and the offset of the best sphere.

    The sphere follows from linear least squares: ``|h|^2 = 2 h^T T + constant`` is linear in T.
    """
    h = samples.field
    design = np.column_stack([2.0 * h, np.full(len(h), samples.F_0)])
    scale = np.abs(design).max(axis=0) + 1e-300
    right = (h * h).sum(axis=1) - samples.reference**2
    # a weak ridge holds the directions that the samples do not determine
    damp = np.diag(np.full(4, 1e-2 * np.sqrt(len(h))))
    solved = np.linalg.lstsq(np.vstack([design / scale, damp]), np.append(right, np.zeros(4)), rcond=None)[0]
    sphere = np.concatenate([np.zeros(6), (solved / scale)[:3]])
    return [np.zeros(9), sphere]


def thinned_rows(n: int) -> IndexArray:
    """Return the rows (k,) of blocks of successive samples, spread evenly over n samples.

    Returns all rows if n is at most :data:`ENOUGH`.
    """
    if n <= ENOUGH:
        return np.arange(n)
    first = np.linspace(0, n // BLOCK - 1, ENOUGH // BLOCK).astype(int) * BLOCK
    return (first[:, None] + np.arange(BLOCK)).ravel()


def successive(samples: ResidualSamples, rows: IndexArray) -> ResidualSamples:
    """Return the samples of `rows` (k,), ascending; across a gap in the rows they count as independent."""
    part = samples.part(rows)
    part.steps[0] = np.inf
    part.steps[1:][np.diff(rows) > 1] = np.inf
    return part


def flown(residual: FloatArray, crust: float = 0.0) -> BoolArray:
    """Return a mask (n,) that is False for samples at the ends of the log that contradict the others.

    Such samples are a crash or a launch. `residual` (n,): of a robust fit, in the order of the log, nT.
    `crust`: largest error of the reference by a crustal field that it lacks, nT.
    """
    # an end is cut where most of its samples are outliers, which no crustal field below the ends explains
    off = np.abs(residual) > max(OUTLIER_SIGMA * robust_scale(residual), crust)
    kept = np.ones(len(off), bool)
    kept[: _end(off)] = False
    kept[len(off) - _end(off[::-1]) :] = False
    return kept if kept.sum() > len(kept) / 2 else np.ones(len(off), bool)


def _end(outlier: BoolArray) -> int:
    """Return the number of samples at the start of `outlier` (n,) that are mostly outliers; 0 if few."""
    share = np.cumsum(outlier) / np.arange(1, len(outlier) + 1)
    until = np.flatnonzero((share > MIN_OUTLIER_FRACTION) & outlier)
    return int(until[-1]) + 1 if until.size and until[-1] + 1 >= MIN_END_SAMPLES else 0


# ---- A fit that collapsed ----

ALL_AROUND = 0.05
"""Variance of the field along its least varied axis, over the field's square, below which the attitudes are
narrow. It is 1/3 if all attitudes occur, and 0.01 on a glider that never rolls."""


def check_scales(samples: ResidualSamples, coefficients: FloatArray) -> None:
    """Raise NoSolutionError if a fit collapsed, as its scales and offset at the samples show.

    NoSolutionError: a scale of A is outside 0.5 to 2; or T exceeds twice the field and the attitudes are too
    narrow to separate T from a scale. `coefficients` (9 m,): nT.
    """
    seen = samples.part(slice(None, None, max(len(samples.phi) // 1000, 1)))
    scales, T = scales_and_offsets(seen, coefficients)
    # the sample with the most unlikely scale or offset
    departure = np.abs(np.log2(np.maximum(scales, 1e-3))).max(axis=1)
    worst = int(np.argmax(np.maximum(departure, T / (2.0 * samples.F_0))))
    narrow = float(np.linalg.eigvalsh(np.cov(seen.field.T))[0]) < ALL_AROUND * samples.F_0**2
    if scales[worst, 0] < 0.5 or scales[worst, 2] > 2.0 or (narrow and T[worst] / samples.F_0 > 2.0):
        listed = ", ".join(f"{value:.3g}" for value in scales[worst])
        alike = scales[worst, 2] < 1.2 * scales[worst, 0]
        counts = f"a reading counts {scales[worst].mean():.3g} nT, or " if alike else ""
        raise NoSolutionError(
            f"the fit collapsed: scales {listed} (expected near 1), offset {T[worst]:.0f} nT in a field of "
            f"{samples.F_0:.0f} nT; {counts}there are too few attitudes to separate scale and offset"
        )
