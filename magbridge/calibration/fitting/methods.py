r"""The methods of a fit: configurations of one loop (:mod:`.solve`).

Notes
-----
``auto`` has physical priors whose widths the evidence chooses. The start with the largest evidence wins; its
scales must not have collapsed. Choosing the widths by leaving out
one run at a time is not better (survey error 1.045 times the noise floor, against 1.036; median of 8 gliders)
and takes hundreds of fits. Held-out parts check the fit: sigmas grow to what they show (:mod:`.left_out`),
and where one ellipsoid predicts them better, it is taken.

``nominal`` (section 2.1 of the paper, see :mod:`magbridge.calibration.model`) is one block of nine numbers
whose prior is given, and the error of its model lasts. On a glider's narrow range of attitudes a free
ellipsoid can collapse: ``A -> 0`` with ``T -> infinity`` makes every residual zero. So scale and soft iron
have a prior of physical width, and a fit that collapsed all the same is refused.

``cubic`` (section 2.2): every coefficient is a free polynomial, from a nominal start. Out of sample it is
wrong in every direction that the runs do not determine; such combinations of coefficients keep the width
:data:`FREE_SIGMA_NT`.

``runs`` (the first stage of section 2.2): an ellipsoid for each run, with a prior about the nominal ellipsoid
of all runs, then polynomials through them, each run weighted by its precision::

    c = argmin sum_r (Phi_r c - c_r)^T Lambda_r (Phi_r c - c_r),   Lambda_r = H_r / sigma_r^2 + P

``horizontal`` (Isezaki 1986, Korenaga 1995) uses the sizes of the horizontal and the vertical part of the
field, which roll and pitch separate at any heading::

    l = R_y(pitch) R_x(roll) B (H_r - T),   |l_xy| = H_h,   l_z = Z

with a full matrix ``B = R A``, A symmetric (polar decomposition). A tilt of half a degree puts 0.9 % of Z
into H_h, 400 nT of 46,000 nT.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.linalg import polar
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from magbridge.arrays import FloatArray
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
    settle,
    starts,
    thinned,
    with_slow_noise,
)
from magbridge.errors import CalibrationError, NoSolutionError
from magbridge.estimation.noise import OUTLIER_SIGMA, NoiseModel, estimate_noise
from magbridge.estimation.optimise import Solution
from magbridge.estimation.priors import GAIN_SIGMA, SOFT_IRON_SIGMA, WIDE_HARD_IRON_SIGMA, Prior
from magbridge.estimation.residual import ResidualSamples, residuals_of
from magbridge.wording import counted

# ---- Polynomials with physical priors ----

SHRUNK = 0.15
"""Departure of the middle scale from 1 that no magnetometer has."""
USUAL = 3
"""The order that is usually enough: below it, the evidence is asked for one more."""


def fit_auto(
    data: Observations, order: int = 3, *, vehicle: Vehicle | None = None, known: Known | None = None
) -> Fit:
    """Fit polynomials of all orders up to `order` with physical priors; see the module's notes.

    `order`: highest total degree. `vehicle`: where the masses sit, by parameter: their coefficients' prior is
    then that of dipoles there. `known`: what the coefficients are expected to be, instead of physical widths.

    CalibrationError: no start converged, or the best one collapsed.
    """
    # 1. coefficients, widths and noise that maximise the evidence, from several starts
    posed = pose(data, order, vehicle, known)
    best = best_climb(posed.samples, posed.family)
    # 2. a crash or a launch at an end of the log is not flight: fit again without it
    kept = flown(best.residual)
    if not kept.all():
        found = fit_auto(data.part(kept), order, vehicle=vehicle, known=known)
        inner = found.details.pop("flown", None)
        if inner is not None:
            kept[kept] = inner
        return replace(found, details={**found.details, "flown": kept})
    # 3. noise as a slow and a white part, where the residuals show both
    best = with_slow_noise(best)
    check_scales(posed.samples, best.coefficients)
    # 4. the posterior, and what held-out parts say of it
    left = leave_out(best, data.runs, attitudes=True)
    details = {
        "log_evidence": best.log_evidence,
        "next_order": _gained(data, order, vehicle) if known is None else 0.0,
        "determined": best.widths.determined,
        "outliers": best.noise.rejected,
        "widths_nT": dict(zip(best.family.names, np.exp(best.widths.eta).tolist(), strict=True)),
    }
    if known is None:
        # always: the choice of parameters compares this error of fits with and without one
        details["forward_nT"] = error_forward(best)
    found = assemble(data, posed, best, "auto", left, details, informative=True)
    if known is not None or (left.ratio <= 1.0 and data.names):
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
        posed, one, left = ellipsoid(data)
    except CalibrationError:
        return None
    forward = error_forward(one) / found.details["forward_nT"]
    simpler = _nominal(data, posed, one, left)
    simpler.details["forward_nT"] = forward * found.details["forward_nT"]
    if data.names:  # to first order is enough to compare fits that differ by their parameters
        among = left.rms / found.details["left_out_nT"]
        return simpler if among * forward < 1.0 else None
    among = error_between(one, data.runs) / error_between(best, data.runs)
    return simpler if among * forward < 1.0 and _shrinks(simpler) <= max(_shrinks(found), SHRUNK) else None


def _shrinks(found: Fit) -> float:
    """Return departure of the middle scale from 1."""
    return abs(0.5 * sum(found.scales) - 1.0)


def _gained(data: Observations, order: int, vehicle: Vehicle | None) -> float:
    """Return the gain in log evidence of one more order; 0 if it has no fit, or the order is usual."""
    if not data.names or order >= USUAL:
        return 0.0
    scores = []
    for n in (order, order + 1):
        posed = pose(data, n, vehicle)
        try:
            scores.append(best_climb(thinned(posed.samples), posed.family).log_evidence)
        except CalibrationError:
            return 0.0
    return scores[1] - scores[0]


# ---- One ellipsoid ----

WEIGHT_ITERATIONS = 5
"""Fits, each with the noise and the number of independent samples that the last one left."""
SAME_WEIGHT = 0.02
"""Relative change of the weights below which they have converged."""
CHOOSING_SAMPLES, MAX_ELLIPSOID_SAMPLES = 3_000, 50_000
"""Samples at most that choose the prior and the start, and that are fitted in the end."""
WIDTH_FACTORS = (1.0, 2.0, 4.0, 8.0)
"""Factors of the prior widths of gain and soft iron. Fluxgates have scales within a few per cent of 1, some
compasses of 0.8 to 1.5; parts left out, later ones predicted from earlier ones among them, choose one."""
WORTHWHILE_ERROR_RATIO = 0.7
"""Share of the error on parts left out, below which a wider prior is taken."""
CONVERGED_LOG_LIKELIHOOD_GAIN = 0.02
"""Gain in log likelihood of one more step, below which a fit has converged."""


def fit_nominal(
    data: Observations,
    order: int = 0,  # noqa: ARG001  (one ellipsoid has none)
    *,
    axes_fixed: bool = False,
    equal_xz: bool = False,
    gain_sigma: float = GAIN_SIGMA,
) -> Fit:
    """Return the fit of :func:`ellipsoid` as a calibration without parameters."""
    return _nominal(data, *ellipsoid(data, axes_fixed=axes_fixed, equal_xz=equal_xz, gain_sigma=gain_sigma))


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
    data: Observations,
    *,
    axes_fixed: bool = False,
    equal_xz: bool = False,
    scale_sigma: float = SOFT_IRON_SIGMA,
    gain_sigma: float = GAIN_SIGMA,
) -> tuple[Posed, CoefficientPosterior, LeftOut]:
    """Fit one ellipsoid; return it with its problem, and its errors on parts left out.

    `axes_fixed`: ``M = I``: no rotation, as the paper does. `equal_xz`: ``S_x = S_z``, as the paper does.
    `scale_sigma`, `gain_sigma`: prior 1-sigma of soft iron, and of the gain common to all axes.

    NoSolutionError: the fit collapsed or did not converge.
    """
    bare = data.without_parameters()
    posed = pose(bare, 0)
    # Constraints of the paper as c = E z: S_x = S_z shares a column, M = I leaves the rotations out
    E = np.eye(9)
    if equal_xz:
        E[2, 0] = 1.0
    keep = [s for s in range(9) if not (axes_fixed and s in {3, 4, 5}) and not (equal_xz and s == 2)]
    E = E[:, keep]
    # a part of the samples chooses the prior and the start
    few = bare.thinned(CHOOSING_SAMPLES)
    best: tuple[CoefficientPosterior, LeftOut] | None = None
    failure: NoSolutionError | None = None
    F_0 = posed.samples.F_0
    for factor in WIDTH_FACTORS[:1] if axes_fixed or equal_xz else WIDTH_FACTORS:
        prior = Prior(_precision(E, factor * scale_sigma, factor * gain_sigma) / F_0**2, E)
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
    # the fit of more samples begins at that of a few, and is judged on all
    one = _settled(replace(pose(bare.thinned(MAX_ELLIPSOID_SAMPLES), 0).samples, F_0=F_0), one.prior, one.z)
    one = replace(one, samples=posed.samples)
    weight = (np.abs(one.residual) <= OUTLIER_SIGMA * one.noise.sigma).astype(float)
    noise, weighted = (replace(each, weight=weight) for each in (one.noise, one.weighted))
    return posed, replace(one, noise=noise, weighted=weighted), left


def _settled(
    samples: ResidualSamples, prior: Prior, start_z: FloatArray | None = None
) -> CoefficientPosterior:
    """Return the fit with a prior, from the better one of two starts or from `start_z` (q,) its minimum.

    NoSolutionError: the fit collapsed or did not converge.
    """
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


def _precision(E: FloatArray, scale_sigma: float, gain_sigma: float) -> FloatArray:
    """Return the prior precision, in units of the field, of the numbers that E leaves free."""
    # independent soft iron and hard iron, plus a gain that is common to the three axes
    covariance = np.diag(np.array([scale_sigma] * 6 + [WIDE_HARD_IRON_SIGMA] * 3) ** 2)
    covariance[:3, :3] += gain_sigma**2
    return np.asarray(E.T @ np.linalg.inv(covariance) @ E)


# ---- The paper's cubic polynomials ----

REFERENCE_NOISE_RATIO = 1e4
"""kappa at which all noise counts as the reference's: the residual is the paper's ``|A(H_r - T)| - H_e``."""
FREE_SIGMA_NT = 1e4
"""Prior 1-sigma of a free coefficient, nT: so wide that it only keeps steps finite."""


def fit_cubic(data: Observations, order: int = 3) -> Fit:
    """Fit all coefficients by damped least squares on the scalar residual; the paper's order is 3."""
    # eq. 8: each of the nine coefficients is a polynomial in the positions; start with the nominal ones
    posed = pose(data, order)
    samples = replace(posed.samples, kappa=REFERENCE_NOISE_RATIO)
    size = 9 * len(posed.exponents)
    start = np.zeros(size)
    with suppress(CalibrationError):  # without a nominal fit the start is a sensor without error
        start[:9] = ellipsoid(data, axes_fixed=True, equal_xz=True)[1].coefficients
    # white noise: its samples have no steps; they cannot have determined more numbers than half of them
    alone = replace(samples, steps=np.full(len(data), np.inf))
    noise_of = partial(_noise_of, alone, min(float(size), len(data) / 2))
    wide = NoiseModel(float(np.std(residuals_of(samples, start))) or 1e-9)
    prior = Prior(np.eye(size) / FREE_SIGMA_NT**2, np.eye(size))
    found = settle(samples, prior, start, noise_of, wide, rounds=2, steps=200)
    check_scales(samples, found.z)
    # report residuals in the sensor's units; A is near I, so the sensor's noise is the magnitude's
    as_magnitude = NoiseModel(found.noise.sigma * REFERENCE_NOISE_RATIO)
    return assemble(data, posed, replace(found, samples=posed.samples, noise=as_magnitude), "cubic")


def _noise_of(
    samples: ResidualSamples, free: float, prior: Prior, found: Solution, _: NoiseModel
) -> tuple[NoiseModel, NoiseModel]:
    """Return the noise of the residuals of a fit with `free` parameters, to state and to weigh with."""
    noise = estimate_noise(residuals_of(samples, prior.coefficients(found.z)), samples.steps, free)
    return noise, noise


# ---- An ellipsoid for each run, then polynomials through them ----

MIN_RUN_SAMPLES = 20
"""Samples of a run that is fitted."""
MAX_MONOMIAL_DIFFERENCE = 0.05
"""Largest difference of a monomial from the run's median in a sample with the masses at rest."""
RUN_SIGMA_FRACTIONS = np.array([0.005] * 6 + [0.02] * 3)
"""1-sigma of a run's nine coefficients about the nominal ellipsoid, as fractions of the field."""


def fit_per_run(data: Observations, order: int = 3) -> Fit:
    """Fit every run on its own, then polynomials through the runs.

    CalibrationError: fewer runs than the order plus one.
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
        # only samples with the masses at rest: one run is one position
        rows &= np.abs(samples.phi - typical).max(axis=1) < MAX_MONOMIAL_DIFFERENCE
        if rows.sum() < MIN_RUN_SAMPLES:
            continue
        part = single.samples.part(rows)
        found = settle(
            part, prior, np.zeros(9), partial(_noise_of, part, 5.0), NoiseModel(one.noise.sigma), rounds=3
        )
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
    return _assembled(data, posed, coefficients, (Vt.T / singular**2) @ Vt, "runs")


def _assembled(
    data: Observations, posed: Posed, coefficients: FloatArray, covariance: FloatArray, method: str
) -> Fit:
    """Return a fit whose coefficients were found without a common posterior."""
    samples, free = posed.samples, 0.0 if method == "runs" else 9.0
    check_scales(samples, coefficients)
    noise = estimate_noise(residuals_of(samples, coefficients), samples.steps, free)
    none = Prior(np.zeros_like(covariance), np.eye(len(coefficients)))
    found = CoefficientPosterior(
        samples, none, coefficients, covariance, noise, noise, settled=True, objective=0.0
    )
    return assemble(data, posed, found, method)


# ---- The horizontal fit ----

MIN_LEVELLED_SAMPLES = 30
"""Samples that an ellipsoid's twelve unknowns need."""
DIFFERENCE_STEP = 1e-6
"""Step of B, and of T over the field: the symmetric difference over it is good to 1e-9."""
FIRST_NOISE_FRACTION = 1e-3
"""Noise that attitude errors make, before it is estimated, as a fraction of the field."""


def fit_horizontal(data: Observations, order: int = 0) -> Fit:  # noqa: ARG001  (one ellipsoid has none)
    """Fit one ellipsoid by levelled components.

    CalibrationError: roll and pitch, or the reference's direction, are lacking.
    """
    if data.attitude is None or data.reference_ned is None:
        raise CalibrationError("horizontal: needs roll, pitch and a position (for the field's inclination)")
    known = np.isfinite(data.attitude[:, :2]).all(axis=1) & np.isfinite(data.reference_ned).all(axis=1)
    if known.sum() < MIN_LEVELLED_SAMPLES:
        raise CalibrationError(
            f"horizontal: only {counted(int(known.sum()), 'sample')} with roll, pitch and position"
        )
    data = data.part(np.asarray(known))
    assert data.attitude is not None
    assert data.reference_ned is not None
    posed = pose(data.without_parameters(), 0)
    F_0 = posed.samples.F_0
    # Turn the reading by pitch and roll alone: its horizontal and vertical parts are then those of the Earth.
    level = Rotation.from_euler("YX", data.attitude[:, 1::-1])
    horizontal, vertical = np.hypot(*data.reference_ned[:, :2].T), data.reference_ned[:, 2]
    widths = np.array([SOFT_IRON_SIGMA] * 9 + [WIDE_HARD_IRON_SIGMA] * 3)

    def misfit(x: FloatArray, sigma: float) -> FloatArray:
        B, T = np.eye(3) + x[:9].reshape(3, 3), F_0 * x[9:]
        l = level.apply((data.field - T) @ B.T)  # noqa: E741  (the notes' letter)
        parts = np.concatenate([np.hypot(l[:, 0], l[:, 1]) - horizontal, l[:, 2] - vertical])
        return np.concatenate([parts / sigma, x / widths])

    # robust least squares, each time with the noise that the last one left
    sigma, x = FIRST_NOISE_FRACTION * F_0, np.zeros(12)
    for _ in range(3):
        found = least_squares(misfit, x, args=(sigma,), loss="soft_l1", f_scale=3.0)
        x = found.x
        sigma = float(np.sqrt(np.mean((misfit(x, sigma)[:-12] * sigma) ** 2)))
    # covariance of (A, T) from that of (B, T), by symmetric differences
    steps = DIFFERENCE_STEP * np.eye(12)
    J = np.array([_ellipsoid_of(x + h, F_0) - _ellipsoid_of(x - h, F_0) for h in steps]).T
    J /= 2.0 * DIFFERENCE_STEP
    covariance = J @ np.linalg.inv(found.jac.T @ found.jac) @ J.T
    return _assembled(data, posed, _ellipsoid_of(x, F_0), covariance, "horizontal")


def _ellipsoid_of(x: FloatArray, F_0: float) -> FloatArray:
    """Return the nine coefficients (nT) for B and T: A of ``B = R A``, and T."""
    _, A = polar(np.eye(3) + x[:9].reshape(3, 3))
    a = F_0 * (A - np.eye(3))
    return np.concatenate([a[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]], F_0 * x[9:]])
