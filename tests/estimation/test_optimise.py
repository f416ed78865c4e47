"""Test that the solver finds the minimum of an independent optimiser, or reports its failure."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import least_squares

from magbridge.arrays import FloatArray
from magbridge.errors import CalibrationError
from magbridge.estimation.information import covariance_of
from magbridge.estimation.noise import NoiseModel
from magbridge.estimation.optimise import gauss_newton
from magbridge.estimation.priors import Prior
from magbridge.estimation.residual import ResidualSamples, residuals

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
