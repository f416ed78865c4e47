"""The default fit: errors in variables, physical priors whose widths the evidence chooses.

Notes
-----
Each start is first brought near the answer, with a noise as large as its residuals. Then three steps
alternate: coefficients by Gauss-Newton at fixed prior widths; widths and noise by the evidence of the
quadratic found there; outliers and, once the model has converged, the noise's autocorrelation from the
residuals. The start with the largest evidence wins. It must be a maximum of the evidence, and its scales
must not have collapsed.

Choosing the widths by leaving out one run at a time is not better (survey error 1.045 times the noise floor,
against 1.036; median of 8 gliders) and takes hundreds of fits where the evidence needs a few. Leaving out is
used to check: sigmas grow to what the parts left out show (:mod:`.left_out`), and where one ellipsoid
predicts those better, it is taken.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from magbridge.arrays import BoolArray, FloatArray
from magbridge.calibration.fitting.left_out import error_between, error_forward, leave_out, thinned
from magbridge.calibration.fitting.nominal import check_scales, fit_nominal, nominal, nominal_samples, starts
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.pose import Known, Vehicle, pose
from magbridge.calibration.fitting.result import Fit, assemble
from magbridge.errors import CalibrationError, NoSolutionError
from magbridge.estimation.hyperparameters import Hyperparameters, is_maximum, maximise_evidence
from magbridge.estimation.information import GaussianInformation, covariance_of
from magbridge.estimation.noise import (
    OUTLIER_SIGMA,
    NoiseModel,
    Whitening,
    estimate_noise,
    fit_slow_and_white,
)  # fmt: skip
from magbridge.estimation.optimise import Solution, gauss_newton
from magbridge.estimation.priors import Prior, PriorFamily
from magbridge.estimation.residual import ResidualSamples, jacobian, residuals, residuals_of, robust_scale

__all__ = ["Climbed", "climb", "fit_auto", "flown"]

# ---- One start ----

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
    """Return variance of the model at a sample, and its covariance with the next one's, nT² (mean of all)."""
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


# ---- The ends of a log that are not its flight ----

MIN_END_SAMPLES = 20
"""Number of samples: fewer outliers at an end are outliers as any others."""
MIN_OUTLIER_FRACTION = 0.7
"""Share of an end's samples that are outliers."""


def flown(residual: FloatArray) -> BoolArray:
    """Return a mask (n,) without samples at an end of the log that contradict the others.

    `residual` (n,): of a robust fit, in the order of the log, nT.
    """
    # an end is cut where most of its samples are outliers
    off = np.abs(residual) > OUTLIER_SIGMA * robust_scale(residual)
    kept = np.ones(len(off), bool)
    kept[: _end(off)] = False
    kept[len(off) - _end(off[::-1]) :] = False
    return kept if kept.sum() > len(kept) / 2 else np.ones(len(off), bool)


def _end(outlier: BoolArray) -> int:
    """Return the number of samples at the start that are mostly outliers; 0 if they are few."""
    share = np.cumsum(outlier) / np.arange(1, len(outlier) + 1)
    until = np.flatnonzero((share > MIN_OUTLIER_FRACTION) & outlier)
    return int(until[-1]) + 1 if until.size and until[-1] + 1 >= MIN_END_SAMPLES else 0


# ---- The fit ----

SHRUNK = 0.15
"""Departure of the middle scale from 1 that no magnetometer has."""
USUAL = 3
"""The order that is usually enough: below it, the evidence is asked for one more."""


def fit_auto(
    data: Observations, order: int = 3, *, vehicle: Vehicle | None = None, known: Known | None = None
) -> Fit:
    """Fit polynomials of all orders up to `order` with physical priors; see the module's notes.

    `data`: the calibration runs. `order`: highest total degree. `vehicle`: where the masses sit, by
    parameter: their coefficients' prior is then that of dipoles there. `known`: what the coefficients are
    expected to be, instead of physical widths.

    CalibrationError: no start reached a maximum, or the best one collapsed.
    """
    # 1. coefficients, widths and noise that maximise the evidence, from several starts
    posed = pose(data, order, vehicle, known)
    samples, family = posed.samples, posed.family
    best = _best(samples, family)
    # 2. a crash or a launch at an end of the log is not flight: fit again without it
    kept = flown(residuals_of(samples, best.family.prior(best.widths.eta).coefficients(best.solution.z)))
    if not kept.all():
        found = fit_auto(data.part(kept), order, vehicle=vehicle, known=known)
        inner = found.details.pop("flown", None)
        if inner is not None:
            kept[kept] = inner
        return replace(found, details={**found.details, "flown": kept})
    # 3. noise as a slow and a white part, where the residuals show both
    best = _remembering(samples, best)
    prior = best.family.prior(best.widths.eta)
    precision = best.solution.normal.hessian / best.noise.sigma**2 + prior.precision
    coefficients = prior.coefficients(best.solution.z)
    check_scales(samples, coefficients)
    # 4. the posterior covariance, and what held-out parts say of it
    left = leave_out(samples, prior, best.solution.z, best.noise, data.runs, attitudes=True)
    covariance = prior.E @ covariance_of(precision) @ prior.E.T
    found = assemble(
        data, samples, posed.ranges, posed.exponents, coefficients, covariance, best.noise, "auto", left,
        prior=prior, details={
            "log_evidence": best.score,
            "next_order": _gained(data, order, vehicle) if _may_gain(data, order, known) else 0.0,
            "determined": best.widths.determined,
            "outliers": best.noise.rejected,
            "widths_nT": dict(zip(family.names, np.exp(best.widths.eta).tolist(), strict=True)),
        },
    )  # fmt: skip
    if known is not None:
        return found
    # always: the choice of parameters compares this error of fits with and without one
    found.details["forward_nT"] = error_forward(samples, prior, best.solution.z, best.noise)
    if left.ratio <= 1.0 and data.names:
        return found
    return _simpler(data, found, best) or found


def _simpler(data: Observations, found: Fit, best: Climbed) -> Fit | None:
    """Return the fit of one ellipsoid, if it predicts held-out parts better than `found`.

    Both are fitted again without each part: parts among the others, and the later parts of the log from the
    earlier ones. What counts is the geometric mean of the two errors' ratios. If the reference is nearly
    constant, such errors reward a collapse: the ellipsoid is not taken if its scales are implausible, and
    further from 1 than those of `found`.
    """
    try:
        one, simpler = nominal(data), fit_nominal(data)
    except CalibrationError:
        return None
    samples, white = nominal_samples(data), one.weighted
    prior, z, noise = best.family.prior(best.widths.eta), best.solution.z, best.noise
    forward = error_forward(samples, one.prior, one.z, white) / found.details["forward_nT"]
    simpler.details["forward_nT"] = forward * found.details["forward_nT"]
    if data.names:  # to first order is enough to compare fits that differ by their parameters
        among = simpler.details["left_out_nT"] / found.details["left_out_nT"]
        return simpler if among * forward < 1.0 else None
    among = error_between(samples, one.prior, one.z, white, data.runs) / error_between(
        found.samples, prior, z, noise, data.runs
    )
    return simpler if among * forward < 1.0 and _shrinks(simpler) <= max(_shrinks(found), SHRUNK) else None


def _shrinks(found: Fit) -> float:
    """Return departure of the middle scale from 1."""
    return abs(0.5 * sum(found.scales) - 1.0)


def _may_gain(data: Observations, order: int, known: Known | None) -> bool:
    return known is None and bool(data.names) and order < USUAL


def _gained(data: Observations, order: int, vehicle: Vehicle | None) -> float:
    """Return the gain in log evidence of one more order; none if it has no fit."""
    scores = []
    for n in (order, order + 1):
        posed = pose(data, n, vehicle)
        try:
            scores.append(_best(thinned(posed.samples), posed.family).score)
        except CalibrationError:
            return 0.0
    return scores[1] - scores[0]


def _best(samples: ResidualSamples, family: PriorFamily) -> Climbed:
    """Return the answer with the largest evidence among several starts."""
    # climb from each start with a part of the samples, at narrow and at wide priors; then the best with all
    few = thinned(samples)
    answers = []
    for start in starts(few):
        z = family.nearest_latent(start)
        answers += [climb(few, family, z, family.centre + shift * family.spread) for shift in (0.0, 1.5)]
    for answer in sorted(answers, key=lambda answer: -answer.score):
        last = answer
        if few is not samples:
            noise = NoiseModel(answer.noise.sigma, answer.noise.autocorrelation, answer.noise.white)
            last = climb(samples, answer.family, answer.solution.z, answer.widths.eta, noise)
        if last.solution.settled and is_maximum(last.quadratic, last.family, last.widths):
            return last
    raise NoSolutionError("auto: no start reached a maximum of the evidence; the data contradict themselves")


def _remembering(samples: ResidualSamples, answer: Climbed) -> Climbed:
    """Return the answer with slow and white noise if the residuals have both."""
    for _ in range(2):
        e = residuals_of(samples, answer.family.prior(answer.widths.eta).coefficients(answer.solution.z))
        noise = fit_slow_and_white(e, samples.steps, answer.noise)
        if noise is answer.noise:
            break
        answer = climb(samples, answer.family, answer.solution.z, answer.widths.eta, noise, shaped=True)
    return answer
