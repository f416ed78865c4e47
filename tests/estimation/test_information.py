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
    assert scaled.constant == pytest.approx(expected.constant)


def test_a_combination_that_is_free_is_refused() -> None:
    with pytest.raises(CalibrationError, match="leave a combination of coefficients free"):
        covariance_of(np.ones((2, 2)))
