r"""Methods of a fit, which are configurations of one loop (:mod:`.solve`).

Notes
-----
``auto`` fits polynomials with physical priors, whose widths maximise the evidence. It returns the start with
the largest evidence, unless its scales have collapsed. Cross-validation over runs would need hundreds of fits
to choose the widths, and is not better. Held-out parts test the fit: all sigmas grow until they agree with
the errors (:mod:`.left_out`). If one ellipsoid predicts these parts better, ``auto`` returns the ellipsoid.

``nominal`` (section 2.1 of the paper, see :mod:`magbridge.calibration.model`) fits one ellipsoid, with nine
coefficients and a fixed prior. Its model error is correlated in time. On a glider's narrow range of attitudes
a free ellipsoid can collapse: ``A -> 0`` with ``T -> infinity`` makes every residual zero. Therefore scale
and soft iron have a prior of physical width, and the method rejects a fit that has collapsed.

``cubic`` (section 2.2 of the paper) fits free polynomials, starting at the nominal ellipsoid. Outside its
data it is wrong where the runs do not determine the coefficients: these keep :data:`FREE_SIGMA_NT`.

``runs`` (the first stage of section 2.2) fits an ellipsoid to each run, with a prior about the nominal
ellipsoid of all runs. It then fits polynomials to these ellipsoids, each weighted by its precision::

    c = argmin sum_r (Phi_r c - c_r)^T Lambda_r (Phi_r c - c_r),   Lambda_r = H_r / sigma_r^2 + P

``horizontal`` (Isezaki 1986, Korenaga 1995) adds the vertical component to ``nominal``, which roll and pitch
give at any heading (:mod:`.direction`).
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.direction import with_direction
from magbridge.calibration.fitting.left_out import LeftOut, error_between, error_forward, leave_out
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.pose import Known, Posed, Vehicle, pose
from magbridge.calibration.fitting.result import Fit, assemble
from magbridge.calibration.fitting.solve import (
    Climbed,
    CoefficientPosterior,
    best_climb,
    check_scales,
    flown,
    lasting_noise,
    noise_of_residuals,
    settle,
    starts,
    with_slow_noise,
)
from magbridge.constants import MAIN_FIELD_SIGMA_NT
from magbridge.errors import CalibrationError, NoSolutionError
from magbridge.estimation.noise import OUTLIER_SIGMA, NoiseModel, estimate_noise
from magbridge.estimation.priors import GAIN_SIGMA, SOFT_IRON_SIGMA, WIDE_HARD_IRON_SIGMA, Prior
from magbridge.estimation.residual import ResidualSamples, residuals_of

# ---- Polynomials with physical priors ----

CRUST_SIGMA = 3.0
"""Largest error of a main-field model over its 1-sigma before the ends of a log contradict the rest."""
SHRUNK = 0.15
"""Departure of the middle scale factor from 1 above which a fit is implausible."""


def fit_auto(
    data: Observations, order: int = 3, *, vehicle: Vehicle | None = None, known: Known | None = None
) -> Fit:
    """Fit polynomials up to a total degree with physical priors (method ``auto`` of the module's notes).

    `order`: highest total degree. `vehicle`: measured position of masses, by parameter; the prior of their
    coefficients is then that of dipoles. `known`: expected coefficients, instead of the physical prior.

    CalibrationError: no start converged, or the best fit collapsed.
    """
    # 1. coefficients, widths and noise that maximise the evidence, from several starts
    # 2. a crash or a launch at an end of the log is not flight: fit again without it
    flight = np.ones(len(data), bool)
    while True:
        posed = pose(data, order, vehicle, known)
        best = best_climb(posed.samples, posed.family)
        crust = CRUST_SIGMA * MAIN_FIELD_SIGMA_NT if data.lacks_rock else 0.0
        if (kept := flown(best.residual, crust)).all():
            break
        flight[flight], data = kept, data.part(kept)
    # 3. noise as a slow and a white part, if the residuals show both
    best = with_slow_noise(best)
    check_scales(posed.samples, best.coefficients)
    # 4. errors of the posterior on held-out parts
    left = leave_out(best, data.runs, attitudes=True)
    details = {
        "log_evidence": best.log_evidence,
        "determined": best.widths.determined,
        "outliers": best.noise.rejected,
        "widths_nT": dict(zip(best.family.names, np.exp(best.widths.eta).tolist(), strict=True)),
        "flown": flight,
    }
    if known is None:
        # always: the choice of parameters compares this error of fits with and without a parameter
        details["forward_nT"] = error_forward(best)
    found = assemble(data, posed, best, "auto", left, details, informative=True)
    if known is not None or (left.ratio <= 1.0 and data.names):
        return found
    return _simpler(data, found, best) or found


def _simpler(data: Observations, found: Fit, best: Climbed) -> Fit | None:
    """Return the fit of one ellipsoid if it predicts held-out parts better than `found`, else None."""
    try:
        posed, one, left = ellipsoid(data)
    except CalibrationError:
        return None
    simpler = _nominal(data, posed, one, left)
    simpler.details.update(forward_nT=error_forward(one), flown=found.details["flown"])
    # geometric mean of two error ratios: of later parts predicted from the earlier ones, and of parts
    # predicted from all others; for the latter, errors to first order suffice if the parameters differ
    forward = simpler.details["forward_nT"] / found.details["forward_nT"]
    if data.names:
        among = left.rms / found.details["left_out_nT"]
        return simpler if among * forward < 1.0 else None
    among = error_between(one, data.runs) / error_between(best, data.runs)
    # with a nearly constant reference such errors favour a collapsed fit, so compare the middle scales too
    shrinks, before = (abs(0.5 * sum(one.scales) - 1.0) for one in (simpler, found))
    return simpler if among * forward < 1.0 and shrinks <= max(before, SHRUNK) else None


# ---- One ellipsoid ----

WEIGHT_ITERATIONS = 5
"""Largest number of fits, each with the noise and the number of independent samples of the previous fit."""
SAME_WEIGHT = 0.02
"""Relative change of the weighting noise below which the fits have converged."""
CHOOSING_SAMPLES, MAX_ELLIPSOID_SAMPLES = 3_000, 50_000
"""Largest numbers of samples that choose the prior and the start, and of the final fit."""
WIDTH_FACTORS = (1.0, 2.0, 4.0, 8.0)
"""Factors of the prior widths of gain and soft iron, of which held-out errors choose one. Fluxgates have
scale factors within a few per cent of 1, some compasses of 0.8 to 1.5."""
WORTHWHILE_ERROR_RATIO = 0.7
"""Ratio of held-out errors with a wider and a narrower prior below which the wider prior is used."""
CONVERGED_LOG_LIKELIHOOD_GAIN = 0.02
"""Gain in log likelihood of one more step below which a fit has converged."""


def fit_nominal(
    data: Observations,
    order: int = 0,  # noqa: ARG001  (one ellipsoid has none)
    *,
    constrained: bool = False,
) -> Fit:
    """Fit one ellipsoid by :func:`ellipsoid`; return the fit, whose calibration has no parameters."""
    return _nominal(data, *ellipsoid(data, constrained=constrained))


def _nominal(data: Observations, posed: Posed, found: CoefficientPosterior, left: LeftOut) -> Fit:
    # a prior that the fit contradicts matters only where the samples do not overrule it
    before = found.prior.E @ np.linalg.inv(found.prior.precision) @ found.prior.E.T
    known = np.diag(found.covariance)[:6] / np.maximum(np.diag(before)[:6], 1e-300)
    details = {
        "prior_chi_squared": float(found.z @ found.prior.precision @ found.z),
        "scale_sigma_ratio": float(np.sqrt(known.max())),
    }
    return assemble(data, posed, found, "nominal", left, details)


def ellipsoid(
    data: Observations, *, constrained: bool = False
) -> tuple[Posed, CoefficientPosterior, LeftOut]:
    """Fit one ellipsoid; return its problem, its posterior, and its errors on held-out parts.

    `constrained`: set ``M = I`` (no rotation) and ``S_x = S_z``, as the paper does.

    NoSolutionError: the fit collapsed or did not converge.
    """
    bare = data.without_parameters()
    posed = pose(bare, 0)
    # Constraints of the paper as c = E z: S_x = S_z shares a column, M = I leaves the rotations out
    E = np.eye(9)
    if constrained:
        E[2, 0] = 1.0
        E = E[:, [0, 1, 6, 7, 8]]
    # a part of the samples chooses the prior and the start
    few = bare.thinned(CHOOSING_SAMPLES)
    best: tuple[CoefficientPosterior, LeftOut] | None = None
    failure: NoSolutionError | None = None
    F_0 = posed.samples.F_0
    for factor in WIDTH_FACTORS[:1] if constrained else WIDTH_FACTORS:
        prior = Prior(_precision(E, factor) / F_0**2, E)
        try:
            one = _settled(replace(pose(few, 0).samples, F_0=F_0), prior)
        except NoSolutionError as error:
            failure = failure or error
            continue
        left = leave_out(one, few.runs)
        if best is None or left.carried < WORTHWHILE_ERROR_RATIO * best[1].carried:
            best = one, left
    if best is None:
        assert failure is not None
        raise failure
    one, left = best
    if len(few) == len(data):
        return posed, one, left
    # the fit of more samples starts at the fit of a few; its residuals include all samples
    one = _settled(replace(pose(bare.thinned(MAX_ELLIPSOID_SAMPLES), 0).samples, F_0=F_0), one.prior, one.z)
    one = replace(one, samples=posed.samples)
    weight = (np.abs(one.residual) <= OUTLIER_SIGMA * one.noise.sigma).astype(float)
    noise, weighted = (replace(each, weight=weight) for each in (one.noise, one.weighted))
    return posed, replace(one, noise=noise, weighted=weighted), left


def _settled(
    samples: ResidualSamples, prior: Prior, start_z: FloatArray | None = None
) -> CoefficientPosterior:
    """Return the posterior of one ellipsoid, from `start_z` (q,), else the better of two starts."""
    begun = [np.asarray(np.linalg.lstsq(prior.E, start, rcond=None)[0], float) for start in starts(samples)]
    wide = NoiseModel(1e-3 * samples.F_0)  # residuals are not noise yet
    best: CoefficientPosterior | None = None
    for start in begun if start_z is None else [start_z]:
        found = settle(
            samples, prior, start, partial(lasting_noise, samples), wide,
            rounds=WEIGHT_ITERATIONS, change=SAME_WEIGHT, tolerance=CONVERGED_LOG_LIKELIHOOD_GAIN,
        )  # fmt: skip
        if found.settled and (best is None or found.objective < 0.999 * best.objective):
            best = found
    check_scales(samples, (found if best is None else best).coefficients)
    if best is None:
        raise NoSolutionError("nominal: no start converged; are the samples those of one sensor?")
    return best


def _precision(E: FloatArray, factor: float) -> FloatArray:
    """Return the prior precision (q, q) of z in ``c = E z``, for coefficients c as fractions of the field."""
    # soft iron and hard iron, plus a gain common to the axes; `factor` widens soft iron and gain
    covariance = np.diag(np.array([factor * SOFT_IRON_SIGMA] * 6 + [WIDE_HARD_IRON_SIGMA] * 3) ** 2)
    covariance[:3, :3] += (factor * GAIN_SIGMA) ** 2
    return np.asarray(E.T @ np.linalg.inv(covariance) @ E)


# ---- The paper's cubic polynomials ----

REFERENCE_NOISE_RATIO = 1e4
"""Kappa that assigns all noise to the reference: the residual is the paper's ``|A(H_r - T)| - H_e``."""
FREE_SIGMA_NT = 1e4
"""Prior 1-sigma of a free coefficient, nT, which is wide enough not to affect determined coefficients."""


def fit_cubic(data: Observations, order: int = 3) -> Fit:
    """Fit free polynomials as the paper does, by damped least squares; the paper's order is 3."""
    # eq. 8: each of the nine coefficients is a polynomial in the positions; start with the nominal ones
    posed = pose(data, order)
    samples = replace(posed.samples, kappa=REFERENCE_NOISE_RATIO)
    size = 9 * len(posed.exponents)
    start = np.zeros(size)
    with suppress(CalibrationError):  # without a nominal fit the start is a sensor without error
        start[:9] = ellipsoid(data, constrained=True)[1].coefficients
    # white noise: infinite steps; the coefficients take at most half of the degrees of freedom
    alone = replace(samples, steps=np.full(len(data), np.inf))
    noise_of = partial(noise_of_residuals, alone, min(float(size), len(data) / 2))
    wide = NoiseModel(float(np.std(residuals_of(samples, start))) or 1e-9)
    prior = Prior(np.eye(size) / FREE_SIGMA_NT**2, np.eye(size))
    found = settle(samples, prior, start, noise_of, wide, rounds=2, steps=200)
    check_scales(samples, found.z)
    # report residuals in the sensor's units; A is near I, so the sensor's noise is the magnitude's
    as_magnitude = NoiseModel(found.noise.sigma * REFERENCE_NOISE_RATIO)
    return assemble(data, posed, replace(found, samples=posed.samples, noise=as_magnitude), "cubic")


# ---- An ellipsoid for each run, then polynomials through them ----

MIN_RUN_SAMPLES = 20
"""Smallest number of samples of a run for which an ellipsoid is fitted."""
MAX_MONOMIAL_DIFFERENCE = 0.05
"""Largest difference of a monomial from the run's median at which the masses count as at rest."""
RUN_SIGMA_FRACTIONS = np.array([0.005] * 6 + [0.02] * 3)
"""1-sigma of a run's nine coefficients about the nominal ellipsoid, as fractions of the field."""


def fit_per_run(data: Observations, order: int = 3) -> Fit:
    """Fit an ellipsoid to each run, then polynomials of the positions to the ellipsoids (method ``runs``).

    CalibrationError: the number of usable runs is smaller than the order plus one.
    """
    posed = pose(data, order)
    samples = posed.samples
    single, one, _ = ellipsoid(data)
    prior = Prior(np.diag((RUN_SIGMA_FRACTIONS * samples.F_0) ** -2.0), np.eye(9), one.coefficients)
    size = 9 * len(posed.exponents)
    # A run at monomials m says C m = c_run. In units of its errors, with Lambda = L L^T, these are the rows
    # (m x L)^T c = L^T c_run. The first rows are the prior of the coefficients.
    rows_of_runs, values = [np.eye(size) / FREE_SIGMA_NT], [np.zeros(size)]
    for label in np.unique(data.runs):
        rows = data.runs == label
        typical = np.median(samples.phi[rows], axis=0)
        # use samples with the masses at rest only, because a run represents one position
        rows &= np.abs(samples.phi - typical).max(axis=1) < MAX_MONOMIAL_DIFFERENCE
        if rows.sum() < MIN_RUN_SAMPLES:
            continue
        part = single.samples.part(rows)
        noise_of = partial(noise_of_residuals, part, 5.0)
        found = settle(part, prior, np.zeros(9), noise_of, NoiseModel(one.noise.sigma), rounds=3)
        L = np.linalg.cholesky(np.linalg.inv(found.spread))
        rows_of_runs.append(np.kron(typical, L.T))
        values.append(L.T @ found.coefficients)
    if (runs := len(values) - 1) <= order:
        raise CalibrationError(
            f"method runs: {runs} runs with {MIN_RUN_SAMPLES} samples or more at one position of the masses; "
            f"order {order} needs {order + 1}: fly runs with the masses at rest"
        )
    # least squares by singular values: the normal equations would lose the directions that no run determines
    U, singular, Vt = np.linalg.svd(np.vstack(rows_of_runs), full_matrices=False)
    coefficients = (Vt.T / singular) @ (U.T @ np.concatenate(values))
    covariance = (Vt.T / singular**2) @ Vt
    check_scales(samples, coefficients)
    noise = estimate_noise(residuals_of(samples, coefficients), samples.steps, 0.0)
    none = Prior(np.zeros((size, size)), np.eye(size))
    joint = CoefficientPosterior(
        samples, none, coefficients, covariance, noise, noise, settled=True, objective=0.0
    )
    return assemble(data, posed, joint, "runs")


# ---- The vertical component ----


def fit_horizontal(data: Observations, order: int = 0) -> Fit:  # noqa: ARG001  (one ellipsoid has none)
    """Fit one ellipsoid to the magnitude and to the vertical component of the field (method ``horizontal``).

    CalibrationError: roll, pitch or the reference's direction are missing.
    """
    if data.attitude is None or data.reference_ned is None:
        raise CalibrationError("horizontal: needs roll, pitch and a position (for the field's inclination)")
    # the vertical component is the same at any heading
    headed = np.column_stack([data.attitude[:, :2], np.zeros(len(data))])
    data = replace(data, attitude=headed)
    found = with_direction(fit_nominal(data), data, headings=False)
    return replace(found, calibration=replace(found.calibration, method="horizontal"))
