"""What an extended calibration says of its own uncertainty."""

from __future__ import annotations

import numpy as np

from magbridge.diagnose.causes.candidates import Candidate
from magbridge.diagnose.compare.past import Past
from magbridge.diagnose.extend import MODES, widened
from magbridge.diagnose.inference.fit_noise import fit_noise
from magbridge.diagnose.inference.joint import Joint
from magbridge.diagnose.inference.weigh import IDEAL


def candidate(size: int) -> Candidate:
    return Candidate(
        "current_field",
        "amps",
        lambda rows: np.zeros((len(range(*rows.indices(9))), size)),
        np.ones(size),
        ("x", "y", "z")[:size],
        ("nT",) * size,
    )


def fit(coefficients: np.ndarray, calibration: int = 4) -> Joint:
    rng = np.random.default_rng(3)
    size = calibration + len(coefficients)
    X = rng.standard_normal((200, size)) @ (np.eye(size) + 0.3 * rng.standard_normal((size, size)))
    noise = fit_noise(rng.standard_normal(50), Past(np.ones(50, int), 1))
    return Joint(
        0.0, np.zeros(calibration), coefficients, np.linalg.inv(X.T @ X), noise, noise.scale, np.ones(size)
    )


def test_a_misfit_grows_with_the_effect_and_points_anywhere() -> None:
    before = fit(np.array([3.0, 0.0, 0.0]))
    after = widened([candidate(3)], before)
    own = slice(4, 7)
    wald = before.coefficients @ np.linalg.solve(before.covariance[own, own], before.coefficients)
    np.testing.assert_allclose(
        after.covariance[own, own], (1.0 + IDEAL**2 * wald / MODES) * before.covariance[own, own]
    )
    np.linalg.cholesky(after.covariance)
    assert np.all(np.diag(after.covariance) >= np.diag(before.covariance))
    # the calibration's part that has nothing to do with the cause is as well known as it was
    np.testing.assert_allclose(
        np.linalg.inv(after.covariance)[:4, :4], np.linalg.inv(before.covariance)[:4, :4], rtol=1e-6
    )


def test_what_is_hardly_seen_is_hardly_widened() -> None:
    before = fit(np.array([1e-3, 0.0]))
    np.testing.assert_allclose(widened([candidate(2)], before).covariance, before.covariance, rtol=1e-4)


def test_two_causes_are_widened_each_by_its_own() -> None:
    before = fit(np.array([2.0, 0.0, 0.0, 0.0]))
    after = widened([candidate(1), candidate(3)], before)
    np.testing.assert_allclose(
        after.covariance[5:, 5:] @ np.ones(3), widened([candidate(1)], before).covariance[5:, 5:] @ np.ones(3)
    )
