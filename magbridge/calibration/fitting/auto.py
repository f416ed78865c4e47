"""The default fit, and the fit of one ellipsoid: two configurations of one loop (:mod:`.solve`).

Notes
-----
``auto`` has physical priors whose widths the evidence chooses. The start with the largest evidence wins. It
must be a maximum of the evidence, and its scales must not have collapsed. Choosing the widths by leaving out
one run at a time is not better (survey error 1.045 times the noise floor, against 1.036; median of 8 gliders)
and takes hundreds of fits where the evidence needs a few. Leaving out is used to check: sigmas grow to what
the parts left out show (:mod:`.left_out`), and where one ellipsoid predicts those better, it is taken.

``nominal`` (paper, section 2.1) is one block of nine numbers whose prior is given, and the error of its model
lasts. On a glider's narrow range of attitudes a free ellipsoid can collapse: ``A -> 0`` with ``T ->
infinity`` makes every residual zero. So scale and soft iron have a prior of physical width, residuals are in
the sensor's own nT, and a fit that collapsed all the same is refused.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

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
from magbridge.estimation.noise import OUTLIER_SIGMA, NoiseModel
from magbridge.estimation.priors import GAIN_SIGMA, SOFT_IRON_SIGMA, WIDE_HARD_IRON_SIGMA, Prior
from magbridge.estimation.residual import ResidualSamples

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

    CalibrationError: no start reached a maximum, or the best one collapsed.
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
