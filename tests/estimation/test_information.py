"""Test Gaussian information against dense integrals by scipy and least squares by numpy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from magbridge.arrays import FloatArray
from magbridge.errors import CalibrationError
from magbridge.estimation.information import GaussianInformation, covariance_of

RNG = np.random.default_rng(3)
J = RNG.normal(size=(12, 4))
Y = RNG.normal(size=12)
PRIOR = np.diag([1.0, 4.0, 0.25, 9.0])


def information_of(J: FloatArray, y: FloatArray) -> GaussianInformation:
    """Return the information of ``y = J z + v``, v white of unit variance."""
    return GaussianInformation(J.T @ J, J.T @ y, float(y @ y), len(y))


def test_the_evidence_is_the_density_of_the_data() -> None:
    exact = multivariate_normal(np.zeros(12), np.eye(12) + J @ np.linalg.inv(PRIOR) @ J.T).logpdf(Y)
    assert information_of(J, Y).log_evidence(PRIOR) == pytest.approx(exact)


def test_information_of_independent_data_adds() -> None:
    both = information_of(J[:5], Y[:5]) + information_of(J[5:], Y[5:])
    assert both.log_evidence(PRIOR) == pytest.approx(information_of(J, Y).log_evidence(PRIOR))


def test_unknowns_that_are_integrated_out_leave_evidence_and_posterior_as_they_are() -> None:
    rows, keep = np.array([1, 3]), np.array([0, 2])
    reduced = information_of(J, Y).marginalise(rows, PRIOR[np.ix_(rows, rows)])
    inner = PRIOR[np.ix_(keep, keep)]
    assert reduced.log_evidence(inner) == pytest.approx(information_of(J, Y).log_evidence(PRIOR))
    mean, covariance = information_of(J, Y).posterior(PRIOR)
    own_mean, own = reduced.posterior(inner)
    np.testing.assert_allclose(own_mean, mean[keep])
    np.testing.assert_allclose(own, covariance[np.ix_(keep, keep)])


def test_unknowns_that_are_given_leave_the_regression_on_the_others() -> None:
    rows, keep, values = np.array([2]), np.array([0, 1, 3]), np.array([0.7])
    given = information_of(J, Y).condition(rows, values)
    expected = information_of(J[:, keep], Y - J[:, 2] * 0.7)
    np.testing.assert_allclose(given.precision, expected.precision)
    np.testing.assert_allclose(given.vector, expected.vector)
    assert given.constant == pytest.approx(expected.constant)


def test_noise_of_another_size_scales_the_information() -> None:
    expected = information_of(J / 3.0, Y / 3.0)
    scaled = information_of(J, Y).divided(3.0)
    np.testing.assert_allclose(scaled.precision, expected.precision)
    np.testing.assert_allclose(scaled.vector, expected.vector)
    assert scaled.constant == pytest.approx(expected.constant)


def test_a_combination_that_is_free_is_refused() -> None:
    with pytest.raises(CalibrationError, match="leave a combination of coefficients free"):
        covariance_of(np.ones((2, 2)))


def test_the_quadratic_at_a_point_is_that_of_the_data() -> None:
    """Cost, half gradient and half Hessian of ``|J z - y|^2`` at any z give the information at z = 0."""
    z = np.array([0.3, -1.2, 2.0, 0.1])
    e = J @ z - Y
    quadratic = GaussianInformation.from_derivatives(z, J.T @ J, J.T @ e, float(e @ e), 12.0)
    exact = information_of(J, Y)
    np.testing.assert_allclose(quadratic.vector, exact.vector)
    assert (quadratic.constant, quadratic.n) == pytest.approx((exact.constant, exact.n))


def test_the_information_is_recovered_from_prior_and_posterior() -> None:
    """The unknowns have different units, and the prior has a mean."""
    units = np.array([1.0, 1e-4, 1e3, 10.0])
    before, prior = np.array([0.4, -0.2, 1.0, 0.3]) * units, np.linalg.inv(PRIOR) * np.outer(units, units)
    exact = information_of(J / units, Y)
    after = covariance_of(exact.precision + np.linalg.inv(prior))
    mean = after @ (exact.vector + np.linalg.solve(prior, before))
    found = GaussianInformation.from_posterior(mean, after, before, prior)
    np.testing.assert_allclose(found.precision, exact.precision, rtol=1e-8)
    np.testing.assert_allclose(found.vector, exact.vector, rtol=1e-8)


def test_a_common_error_widens_the_posterior_along_its_direction() -> None:
    direction, sigma = np.array([1.0, -0.5, 0.2, 2.0]), 1.7
    exact = information_of(J, Y)
    blurred = exact.blurred(direction, sigma)
    covariance = np.linalg.inv(exact.precision)
    np.testing.assert_allclose(
        np.linalg.inv(blurred.precision), covariance + sigma**2 * np.outer(direction, direction), rtol=1e-8
    )
    np.testing.assert_allclose(
        np.linalg.solve(blurred.precision, blurred.vector), covariance @ exact.vector, rtol=1e-8
    )
