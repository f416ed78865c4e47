"""The paper's first stage (section 2.2): an ellipsoid for each run, then polynomials through them.

Notes
-----
A single run covers few attitudes and leaves its own ellipsoid undetermined in most directions. So each run
is fitted with a prior about the nominal ellipsoid of all runs, and weighted by its precision in the
polynomials::

    c = argmin sum_r (Phi_r c - c_r)^T Lambda_r (Phi_r c - c_r),   Lambda_r = H_r / sigma_r^2 + P
"""

from __future__ import annotations

import numpy as np

from magbridge.calibration.fitting.cubic import ANYTHING
from magbridge.calibration.fitting.nominal import check_scales, nominal, nominal_samples
from magbridge.calibration.fitting.observations import Observations, polynomial_samples
from magbridge.calibration.fitting.result import Fit, assemble
from magbridge.calibration.terms import full_order
from magbridge.errors import CalibrationError
from magbridge.estimation.information import covariance_of
from magbridge.estimation.noise import NoiseModel, estimate_noise
from magbridge.estimation.optimise import gauss_newton
from magbridge.estimation.priors import Prior
from magbridge.estimation.residual import residuals_of

__all__ = ["fit_per_run"]

FEWEST = 20
"""Samples of a run that is fitted."""
AT_REST = 0.05
"""Largest difference of a monomial from the run's median in a sample with the masses at rest."""
WIDTHS = np.array([0.005] * 6 + [0.02] * 3)
"""Share of the field: 1-sigma of a run's nine coefficients about the nominal ellipsoid."""


def fit_per_run(data: Observations, order: int = 3) -> Fit:
    """Fit every run on its own, then polynomials through the runs.

    CalibrationError: fewer runs than the order plus one.
    """
    ranges = data.ranges()
    exponents = full_order(len(ranges), order)
    samples = polynomial_samples(data, exponents)
    single = nominal_samples(data)
    one = nominal(data)
    middle, noise = one.coefficients, one.noise
    prior = Prior(np.diag((WIDTHS * samples.F_0) ** -2.0), np.eye(9), middle)
    size = 9 * len(exponents)
    precision, right, runs = np.eye(size) / ANYTHING**2, np.zeros(size), 0
    for label in np.unique(data.runs):
        rows = data.runs == label
        typical = np.median(samples.phi[rows], axis=0)
        rows &= np.abs(samples.phi - typical).max(axis=1) < AT_REST
        if rows.sum() < FEWEST:
            continue
        runs += 1
        part, z, scatter = single.part(rows), np.zeros(9), NoiseModel(noise.sigma)
        for _ in range(3):
            found = gauss_newton(part, prior, scatter, z)
            z = found.z
            scatter = estimate_noise(residuals_of(part, prior.coefficients(z)), part.steps, 5.0)
        Lambda = found.normal.hessian / scatter.sigma**2 + prior.precision
        precision += np.kron(np.outer(typical, typical), Lambda)
        right += np.kron(typical, Lambda @ prior.coefficients(z))
    if runs <= order:
        raise CalibrationError(
            f"method runs: {runs} runs with {FEWEST} samples or more at one position of the masses; order "
            f"{order} needs {order + 1}: fly runs with the masses at rest"
        )
    covariance = covariance_of(precision)
    coefficients = covariance @ right
    check_scales(samples, coefficients)
    left = estimate_noise(residuals_of(samples, coefficients), samples.steps, 0.0)
    return assemble(data, samples, ranges, exponents, coefficients, covariance, left, "runs")
