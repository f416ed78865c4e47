"""The paper's own fit (section 2.2): nominal start, every coefficient a free polynomial.

It is here for comparison. On its calibration runs it looks as good as any. Out of sample it errs wherever the
runs say nothing, and its covariance says so: combinations of coefficients that the runs do not determine keep
the width :data:`ANYTHING`.
"""

from __future__ import annotations

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.nominal import check_scales, nominal
from magbridge.calibration.fitting.observations import Observations, polynomial_samples
from magbridge.calibration.fitting.result import Fit, assemble
from magbridge.calibration.terms import full_order
from magbridge.errors import CalibrationError
from magbridge.estimation.information import covariance_of
from magbridge.estimation.noise import NoiseModel, estimate_noise
from magbridge.estimation.optimise import gauss_newton
from magbridge.estimation.priors import Prior
from magbridge.estimation.residual import residuals_of

__all__ = ["ANYTHING", "fit_cubic"]

PLAIN = 1e4
"""kappa at which all noise counts as the reference's: the residual is the paper's ``|A(H_r - T)| - H_e``."""
ANYTHING = 1e4
"""nT, prior 1-sigma of every coefficient: so wide that it only keeps steps finite."""


def fit_cubic(data: Observations, order: int = 3) -> Fit:
    """Fit all coefficients by damped least squares on the scalar residual.

    Parameters
    ----------
    data : Observations
        The calibration runs.
    order : int
        Highest total degree; the paper's is 3.
    """
    ranges = data.ranges()
    exponents = full_order(len(ranges), order)
    samples = polynomial_samples(data, exponents, PLAIN)
    start = np.zeros(9 * len(exponents))
    start[:9] = _start(data)
    prior = Prior(np.eye(len(start)) / ANYTHING**2, np.eye(len(start)))
    noise = NoiseModel(float(np.std(residuals_of(samples, start))) or 1e-9)
    for _ in range(2):  # once far from the answer, once with the noise found there
        found = gauss_newton(samples, prior, noise, start, steps=200)
        start = found.z
        free = min(float(len(start)), len(data) / 2)
        noise = NoiseModel(estimate_noise(residuals_of(samples, start), samples.steps, free).sigma)
    check_scales(samples, start)
    covariance = covariance_of(found.normal.hessian / noise.sigma**2 + prior.precision)
    plain = polynomial_samples(data, exponents)
    as_magnitude = NoiseModel(noise.sigma * PLAIN)  # A is near I, so the sensor's noise is the magnitude's
    return assemble(data, plain, ranges, exponents, start, covariance, as_magnitude, "cubic")


def _start(data: Observations) -> FloatArray:
    """Return the nominal fit with the paper's constraints, or zeros if that fails."""
    try:
        return nominal(data, axes_fixed=True, equal_xz=True).coefficients
    except CalibrationError:
        return np.zeros(9)
