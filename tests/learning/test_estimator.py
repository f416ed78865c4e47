"""The unobservable level is kept, and the published sigma includes its possible change."""

from __future__ import annotations

import numpy as np

from magbridge.calibration.model import Noise
from magbridge.learning.estimator import Estimator, Nuisance


def estimator(sigma: float) -> Estimator:
    """Return one of three offsets, each known to `sigma`, that has seen the field along z."""
    nuisance = Nuisance(Noise(1.0), 145.0)
    one = Estimator(np.array([1.0, 2.0, 3.0]), np.eye(3) * sigma**2, np.arange(3), nuisance, 0.0)
    one.predict(0.0, 1.0, np.array([0.0, 0.0, -1.0]))
    one.follow(1.0)
    return one


def test_a_level_that_may_be_chance_is_kept_and_sigma_says_by_how_much() -> None:
    """The other offsets stay as learned; the filter itself is not let loose."""
    one = estimator(2.0)
    variance = one.variance
    one.keep_level(np.array([9.0, 9.0, 6.0]))
    np.testing.assert_allclose(one.coefficients, [1.0, 2.0, 6.0])
    np.testing.assert_allclose(np.diag(one.covariance), [4.0, 4.0, 4.0 + 9.0])
    one.predict(0.0, 1.0, np.array([0.0, 0.0, -1.0]))
    assert one.variance == variance


def test_a_level_that_has_changed_beyond_chance_is_not_kept() -> None:
    one = estimator(1.0)
    one.keep_level(np.array([9.0, 9.0, 9.0]))
    np.testing.assert_array_equal(one.coefficients, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(one.covariance, np.eye(3), atol=1e-12)
