"""The methods of the paper and of earlier work, for comparison with ``auto``.

``cubic`` (section 2.2): every coefficient is a free polynomial, from a nominal start. On its calibration runs
it looks as good as any method. Out of sample it is wrong in every direction that the runs do not determine,
and its covariance reports it: such combinations of coefficients keep the width :data:`ANYTHING`.

``runs`` (the first stage of section 2.2): an ellipsoid for each run, then polynomials through them. A single
run has few attitudes and leaves most directions of its own ellipsoid undetermined. So each run is fitted with
a prior about the nominal ellipsoid of all runs, and weighted by its precision in the polynomials::

    c = argmin sum_r (Phi_r c - c_r)^T Lambda_r (Phi_r c - c_r),   Lambda_r = H_r / sigma_r^2 + P

``horizontal`` (Isezaki 1986, Korenaga 1995): a vehicle with an attitude reference knows which part of its
corrected field is horizontal, and both parts have known sizes at any heading::

    l = R_y(pitch) R_x(roll) B (H_r - T),   |l_xy| = H_h,   l_z = Z

with a full matrix B: components show tilts, unlike a magnitude, so all of the boresight but one angle is
found, too. ``B = R A`` with A symmetric (polar decomposition); with J its derivative, a covariance C of B and
T becomes ``J C J^T`` of A and T. It is only as good as the attitude: a tilt of half a degree puts 0.9 % of Z
into H_h, 400 nT of 46,000 nT.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import polar
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.auto import ellipsoid
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.pose import Posed, pose
from magbridge.calibration.fitting.result import Fit, assemble
from magbridge.calibration.fitting.solve import CoefficientPosterior, check_scales, settle
from magbridge.errors import CalibrationError
from magbridge.estimation.information import covariance_of
from magbridge.estimation.noise import NoiseModel, estimate_noise
from magbridge.estimation.optimise import Solution
from magbridge.estimation.priors import SOFT_IRON_SIGMA, WIDE_HARD_IRON_SIGMA, Prior
from magbridge.estimation.residual import ResidualSamples, residuals_of
from magbridge.wording import counted

# ---- Cubic polynomials ----

PLAIN = 1e4
"""kappa at which all noise counts as the reference's: the residual is the paper's ``|A(H_r - T)| - H_e``."""
ANYTHING = 1e4
"""Prior 1-sigma of every coefficient, nT: so wide that it only keeps steps finite."""


def fit_cubic(data: Observations, order: int = 3) -> Fit:
    """Fit all coefficients by damped least squares on the scalar residual; the paper's order is 3."""
    # eq. 8: each of the nine coefficients is a polynomial in the positions; start with the nominal ones
    posed = pose(data, order)
    samples = replace(posed.samples, kappa=PLAIN)
    size = 9 * len(posed.exponents)
    start = np.zeros(size)
    start[:9] = _start(data)
    prior = Prior(np.eye(size) / ANYTHING**2, np.eye(size))

    def estimate(_: Prior, found: Solution, __: NoiseModel) -> tuple[NoiseModel, NoiseModel]:
        # the data cannot have determined more numbers than half the samples
        free = min(float(size), len(data) / 2)
        noise = NoiseModel(estimate_noise(residuals_of(samples, found.z), samples.steps, free).sigma)
        return noise, noise

    # once far from the answer, once with the noise found there
    wide = NoiseModel(float(np.std(residuals_of(samples, start))) or 1e-9)
    found = settle(samples, prior, start, estimate, wide, rounds=2, steps=200)
    check_scales(samples, found.z)
    # report residuals in the sensor's units; A is near I, so the sensor's noise is the magnitude's
    as_magnitude = NoiseModel(found.noise.sigma * PLAIN)
    return assemble(data, posed, replace(found, samples=posed.samples, noise=as_magnitude), "cubic")


def _start(data: Observations) -> FloatArray:
    """Return the nominal fit with the paper's constraints, or zeros if that fails."""
    try:
        return ellipsoid(data, axes_fixed=True, equal_xz=True)[1].coefficients
    except CalibrationError:
        return np.zeros(9)


# ---- An ellipsoid for each run, then polynomials through them ----

MIN_RUN_SAMPLES = 20
"""Samples of a run that is fitted."""
AT_REST = 0.05
"""Largest difference of a monomial from the run's median in a sample with the masses at rest."""
WIDTHS = np.array([0.005] * 6 + [0.02] * 3)
"""Share of the field: 1-sigma of a run's nine coefficients about the nominal ellipsoid."""


def fit_per_run(data: Observations, order: int = 3) -> Fit:
    """Fit every run on its own, then polynomials through the runs.

    CalibrationError: fewer runs than the order plus one.
    """
    posed = pose(data, order)
    samples = posed.samples
    single, one, _ = ellipsoid(data)
    prior = Prior(np.diag((WIDTHS * samples.F_0) ** -2.0), np.eye(9), one.coefficients)
    size = 9 * len(posed.exponents)
    # Information form: a run at monomials m says Lambda (C m) = Lambda c_run, so the polynomial's precision
    # is the sum of (m m^T) x Lambda, and its vector the sum of m x Lambda c_run.
    precision, right, runs = np.eye(size) / ANYTHING**2, np.zeros(size), 0
    for label in np.unique(data.runs):
        rows = data.runs == label
        typical = np.median(samples.phi[rows], axis=0)
        # only samples with the masses at rest: one run is one position
        rows &= np.abs(samples.phi - typical).max(axis=1) < AT_REST
        if rows.sum() < MIN_RUN_SAMPLES:
            continue
        runs += 1
        found = _one_run(single.samples.part(rows), prior, one.noise.sigma)
        Lambda = np.linalg.inv(found.spread)
        precision += np.kron(np.outer(typical, typical), Lambda)
        right += np.kron(typical, Lambda @ found.coefficients)
    if runs <= order:
        raise CalibrationError(
            f"method runs: {runs} runs with {MIN_RUN_SAMPLES} samples or more at one position of the masses; "
            f"order {order} needs {order + 1}: fly runs with the masses at rest"
        )
    covariance = covariance_of(precision)
    return _assembled(data, posed, covariance @ right, covariance, "runs")


def _one_run(part: ResidualSamples, prior: Prior, sigma: float) -> CoefficientPosterior:
    """Return the ellipsoid of one run: alternate it and the noise of its residuals."""

    def estimate(prior: Prior, found: Solution, _: NoiseModel) -> tuple[NoiseModel, NoiseModel]:
        noise = estimate_noise(residuals_of(part, prior.coefficients(found.z)), part.steps, 5.0)
        return noise, noise

    return settle(part, prior, np.zeros(9), estimate, NoiseModel(sigma), rounds=3)


def _assembled(
    data: Observations,
    posed: Posed,
    coefficients: FloatArray,
    covariance: FloatArray,
    method: str,
    details: dict[str, float] | None = None,
) -> Fit:
    """Return a fit whose coefficients were found without a common posterior."""
    samples, free = posed.samples, 0.0 if method == "runs" else 9.0
    check_scales(samples, coefficients)
    noise = estimate_noise(residuals_of(samples, coefficients), samples.steps, free)
    none = Prior(np.zeros_like(covariance), np.eye(len(coefficients)))
    found = CoefficientPosterior(
        samples, none, coefficients, covariance, noise, noise, settled=True, objective=0.0
    )
    return assemble(data, posed, found, method, details=details)


# ---- The horizontal fit ----

MIN_LEVELLED_SAMPLES = 30
"""Samples that an ellipsoid's twelve unknowns need."""
DIFFERENCE_STEP = 1e-6
"""Of B, and of T over the field: the symmetric difference over it is good to 1e-9."""
FIRST_NOISE = 1e-3
"""Share of the field: the noise that attitude errors make, before it is estimated."""


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
    # Turn the reading by pitch and roll alone: its horizontal and vertical parts are then those of the Earth,
    # whatever the heading. B = R A takes in the mounting; the polar decomposition separates it from A.
    level = Rotation.from_euler("YX", data.attitude[:, 1::-1])
    ned = data.reference_ned
    horizontal, vertical = np.hypot(ned[:, 0], ned[:, 1]), ned[:, 2]
    widths = np.array([SOFT_IRON_SIGMA] * 9 + [WIDE_HARD_IRON_SIGMA] * 3)

    def misfit(x: FloatArray, sigma: float) -> FloatArray:
        B, T = np.eye(3) + x[:9].reshape(3, 3), F_0 * x[9:]
        l = level.apply((data.field - T) @ B.T)  # noqa: E741  (the notes' letter)
        parts = np.concatenate([np.hypot(l[:, 0], l[:, 1]) - horizontal, l[:, 2] - vertical])
        return np.concatenate([parts / sigma, x / widths])

    # robust least squares, each time with the noise that the last one left
    sigma, x = FIRST_NOISE * F_0, np.zeros(12)
    for _ in range(3):
        found = least_squares(misfit, x, args=(sigma,), loss="soft_l1", f_scale=3.0)
        x = found.x
        sigma = float(np.sqrt(np.mean((misfit(x, sigma)[:-12] * sigma) ** 2)))
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    steps = DIFFERENCE_STEP * np.eye(12)
    # covariance of (A, T) from that of (B, T), by symmetric differences
    J = np.array([_coefficients(x + h, F_0) - _coefficients(x - h, F_0) for h in steps]).T / (
        2.0 * DIFFERENCE_STEP
    )
    return _assembled(
        data, posed, _coefficients(x, F_0), J @ covariance @ J.T, "horizontal", {"attitude_noise_nT": sigma}
    )


def _coefficients(x: FloatArray, F_0: float) -> FloatArray:
    """Return the nine coefficients (nT) for B and T: A of ``B = R A``, and T."""
    _, A = polar(np.eye(3) + x[:9].reshape(3, 3))
    a = F_0 * (A - np.eye(3))
    return np.concatenate([a[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]], F_0 * x[9:]])
