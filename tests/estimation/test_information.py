"""Test Gaussian information and the solver against dense integrals and an independent optimiser."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import least_squares

from magbridge.arrays import FloatArray
from magbridge.errors import CalibrationError
from magbridge.estimation.information import GaussianInformation, covariance_of
from magbridge.estimation.noise import NoiseModel
from magbridge.estimation.optimise import gauss_newton
from magbridge.estimation.priors import Prior
from magbridge.estimation.residual import ResidualSamples, residuals

RNG = np.random.default_rng(3)
J = RNG.normal(size=(12, 4))
Y = RNG.normal(size=12)
PRIOR = np.diag([1.0, 4.0, 0.25, 9.0])


def information_of(J: FloatArray, y: FloatArray) -> GaussianInformation:
    """Return the information of ``y = J z + v``, v white of unit variance."""
    return GaussianInformation(J.T @ J, J.T @ y, float(y @ y), len(y))


def test_information_of_independent_data_adds() -> None:
    both, exact = information_of(J[:5], Y[:5]) + information_of(J[5:], Y[5:]), information_of(J, Y)
    np.testing.assert_allclose(both.precision, exact.precision)
    np.testing.assert_allclose(both.vector, exact.vector)
    assert (both.constant, both.n) == pytest.approx((exact.constant, exact.n))


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
    spread = sigma * J @ direction
    assert blurred.constant == pytest.approx(Y @ np.linalg.solve(np.eye(12) + np.outer(spread, spread), Y))


# ---- The solver finds the minimum of an independent optimiser, or reports its failure ----------------------


FIELD = 5e4
NOISE = NoiseModel(5.0)
FREE = Prior(np.diag(np.full(9, 1e-8)), np.eye(9))


@pytest.fixture
def samples() -> ResidualSamples:
    """Return readings of a sensor with soft and hard iron at random attitudes, with 5 nT of noise."""
    rng = np.random.default_rng(1)
    b = rng.normal(size=(300, 3))
    b *= FIELD / np.linalg.norm(b, axis=1)[:, None]
    A = np.eye(3) + 0.03 * np.array([[1.0, 0.4, -0.2], [0.4, -0.6, 0.3], [-0.2, 0.3, 0.8]])
    field = b @ np.linalg.inv(A).T + [3000.0, -2000.0, 1000.0] + rng.normal(0.0, 5.0, b.shape)
    steps = np.r_[np.inf, np.ones(299)]
    return ResidualSamples(field, np.full(300, FIELD), np.ones((300, 1)), steps, FIELD)


def slope(samples: ResidualSamples, z: FloatArray, prior: Prior) -> FloatArray:
    """Return the objective's slope along each coefficient over the width that the data allow."""

    def value(c: FloatArray) -> float:
        e = residuals(samples, c)[0]
        return 0.5 * float(e @ e) / NOISE.sigma**2 + 0.5 * float(c @ prior.precision @ c)

    return np.array([(value(z + h) - value(z - h)) / 2.0 for h in np.eye(9)])


@pytest.mark.parametrize("width", [1e4, 20.0], ids=["free", "a prior that matters"])
def test_it_ends_where_an_independent_optimiser_ends(samples: ResidualSamples, width: float) -> None:
    prior = Prior(np.diag(np.full(9, width**-2)), np.eye(9))
    found = gauss_newton(samples, prior, NOISE, np.zeros(9))
    independent = least_squares(
        lambda c: np.append(residuals(samples, c)[0] / NOISE.sigma, c / width), np.zeros(9), x_scale=1000.0
    )
    assert found.settled
    assert 2 <= found.steps < 20
    np.testing.assert_allclose(found.z, independent.x, atol=0.05)
    np.testing.assert_allclose(slope(samples, found.z, prior), 0.0, atol=0.05)
    assert found.normal.cost == pytest.approx(np.sum(residuals(samples, found.z)[0] ** 2))
    assert width < 1e4 or np.sqrt(found.normal.cost / 300.0) == pytest.approx(5.0, rel=0.1)


def test_a_fit_that_is_cut_short_has_not_settled(samples: ResidualSamples) -> None:
    short = gauss_newton(samples, FREE, NOISE, np.zeros(9), steps=1)
    assert (short.settled, short.steps) == (False, 1)
    begun = np.sum(residuals(samples, np.zeros(9))[0] ** 2)
    assert short.normal.cost < 0.5 * begun
    done = gauss_newton(samples, FREE, NOISE, gauss_newton(samples, FREE, NOISE, np.zeros(9)).z)
    assert (done.settled, done.steps) == (True, 0)


def test_from_far_away_steps_are_shortened_and_never_lead_uphill(samples: ResidualSamples) -> None:
    far = np.r_[np.full(6, 3e4), np.full(3, -6e4)]
    best = gauss_newton(samples, FREE, NOISE, np.zeros(9)).normal.cost
    costs = [gauss_newton(samples, FREE, NOISE, far, steps=k).normal.cost for k in range(12)]
    assert all(later <= earlier for earlier, later in pairwise(costs))
    assert gauss_newton(samples, FREE, NOISE, far, steps=200).normal.cost == pytest.approx(best, rel=1e-3)


def test_along_what_nothing_determines_it_does_not_move(samples: ResidualSamples) -> None:
    """Two numbers that do the same, and one that does nothing: without any prior."""
    E = np.hstack([np.eye(9), np.eye(9)[:, :1], np.zeros((9, 1))])
    found = gauss_newton(samples, Prior(np.zeros((11, 11)), E), NOISE, np.r_[np.zeros(10), 7.0])
    alone = gauss_newton(samples, Prior(np.zeros((9, 9)), np.eye(9)), NOISE, np.zeros(9))
    assert found.settled
    assert found.z[10] == 7.0
    assert found.z[0] == pytest.approx(found.z[9])
    np.testing.assert_allclose(E @ found.z, alone.z, atol=0.1)


def test_a_covariance_is_the_inverse_and_symmetric_or_there_is_none() -> None:
    rng = np.random.default_rng(2)
    root = rng.normal(size=(6, 6)) * 10.0 ** np.arange(-3.0, 3.0)
    precision = root.T @ root
    covariance = covariance_of(precision)
    np.testing.assert_allclose(covariance @ precision, np.eye(6), atol=1e-6)
    np.testing.assert_array_equal(covariance, covariance.T)
    with pytest.raises(CalibrationError, match="leave a combination of coefficients free"):
        covariance_of(np.ones((2, 2)) - 1e-9 * np.eye(2))
    with pytest.raises(CalibrationError, match="leave a combination of coefficients free"):
        covariance_of(np.diag([1.0, 0.0]))
