"""Test the Kalman filter against least squares, and the sequential test against densities of scipy."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from magbridge.arrays import IndexArray
from magbridge.estimation.kalman import KalmanFilter
from magbridge.estimation.sequential import SequentialTest
from magbridge.estimation.track_process import Course, TrackProcess


def test_filter_agrees_with_batch_least_squares() -> None:
    rng = np.random.default_rng(1)
    n, m = 4, 60
    prior = np.diag(rng.uniform(1.0, 4.0, n))
    H, y, R = rng.normal(size=(m, n)), rng.normal(size=m), rng.uniform(0.5, 2.0, m)
    kalman = KalmanFilter(np.zeros(n), prior)
    for h, e, r in zip(H, y, R, strict=True):
        kalman.innovate(float(e), h, float(r))
        kalman.update()
    information = np.linalg.inv(prior) + H.T @ (H / R[:, None])
    np.testing.assert_allclose(kalman.covariance, np.linalg.inv(information), atol=1e-10)
    np.testing.assert_allclose(kalman.mean, np.linalg.solve(information, -H.T @ (y / R)), atol=1e-10)


def test_a_wide_prior_leaves_the_variance_of_the_measurements() -> None:
    """The factor 1e10 that the module states; the error stays below 1e-5 of the variance."""
    kalman = KalmanFilter(np.zeros(2), np.eye(2) * 1e8)
    for row in ([1.0, 1.0], [1.0, -1.0]):
        kalman.innovate(0.0, np.array(row), 0.01)
        kalman.update()
    np.testing.assert_allclose(np.diag(kalman.covariance), 0.005, rtol=1e-5)


def test_considered_state_keeps_its_mean_and_its_uncertainty() -> None:
    kalman = KalmanFilter(np.zeros(2), np.diag([4.0, 9.0]))
    for _ in range(50):
        kalman.innovate(5.0, np.array([1.0, 1.0]), 1.0)
        kalman.update(considered=slice(1, 2))
    assert kalman.mean[1] == 0.0
    assert kalman.covariance[1, 1] == 9.0
    assert kalman.covariance[0, 0] > 2.5, "the other state is known no better than the considered one"


@pytest.mark.parametrize("states", [np.array([1, 3]), slice(1, 3), None])
def test_prediction_of_some_states_is_that_of_the_whole_transition(states: IndexArray | slice | None) -> None:
    rng = np.random.default_rng(2)
    moved = np.arange(5)[slice(None) if states is None else states]
    A = rng.normal(size=(5, 5))
    part, root = rng.normal(size=(2, len(moved), len(moved)))
    whole, noise = np.eye(5), np.zeros((5, 5))
    whole[np.ix_(moved, moved)], noise[np.ix_(moved, moved)] = part, root @ root.T
    kalman = KalmanFilter(rng.normal(size=5), A @ A.T)
    mean, covariance = whole @ kalman.mean, whole @ kalman.covariance @ whole.T + noise
    kalman.predict(part, root @ root.T, states)
    np.testing.assert_allclose(kalman.mean, mean)
    np.testing.assert_allclose(kalman.covariance, covariance, atol=1e-12)


def test_log_ratio_is_the_log_likelihood_ratio_of_a_random_amplitude() -> None:
    rng = np.random.default_rng(3)
    m, R = 40, 0.7
    F = rng.normal(size=(m, 3))
    y = F @ np.array([0.4, -0.3, 0.8]) + rng.normal(0.0, R**0.5, m)
    kalman = KalmanFilter(np.zeros(1), np.eye(1) * 2.0)
    test = SequentialTest([False], 1)
    row = 5  # the longest onset, which begins with the first sample and is not replaced
    for f, e in zip(F, y, strict=True):
        kalman.innovate(float(e), np.array([1.0]), R)
        test._excess = 1.0
        test.test(kalman, 0.0, np.ones(1), f[None])
        test.update(kalman.update())
    null = 2.0 * np.ones((m, m)) + R * np.eye(m)
    ratio = multivariate_normal(np.zeros(m), null + F @ F.T).logpdf(y) - multivariate_normal(
        np.zeros(m), null
    ).logpdf(y)
    np.testing.assert_allclose(test.log_ratio[row], ratio, rtol=0.02)
    posterior = np.linalg.inv(np.eye(3) + F.T @ np.linalg.solve(null, F))
    np.testing.assert_allclose(test.amplitude[row], posterior @ F.T @ np.linalg.solve(null, y), atol=0.02)
    np.testing.assert_allclose(test.covariance(row), posterior, atol=0.01)


def test_log_ratio_of_unknown_noise_is_the_ratio_of_student_densities() -> None:
    rng = np.random.default_rng(4)
    m, dof = 30, 8.0
    F = rng.normal(size=(m, 3))
    y = 20.0 * rng.normal(size=m)
    test = SequentialTest([False], 1, noise_dof=dof)
    kalman = KalmanFilter(np.zeros(1), np.zeros((1, 1)))
    for f, e in zip(F, y, strict=True):
        kalman.innovate(float(e), np.array([1.0]), 1.0 + 1e4)  # none is clipped
        test.test(kalman, 0.0, np.ones(1), f[None])
        test.update(kalman.update())
    S = 1.0 + 1e4
    both = S * np.eye(m) + F @ F.T
    squares = (y @ y / S, y @ np.linalg.solve(both, y))
    ratio = 0.5 * (dof + m) * np.log((dof + squares[0]) / (dof + squares[1]))
    ratio -= 0.5 * np.linalg.slogdet(both / S)[1]
    np.testing.assert_allclose(test.log_ratio[5], ratio, atol=1e-8)
    factor = (dof + squares[1]) / (dof + m)
    posterior = np.linalg.inv(np.eye(3) + F.T @ F / S)
    np.testing.assert_allclose(test.covariance(5), factor * posterior, rtol=1e-6)


def test_track_process_is_matern() -> None:
    process = TrackProcess(1.0, 60.0, 30.0, length=800.0)
    F, Q = process.transition(500.0, 10.0)
    x = 3.0**0.5 * 500.0 / 800.0
    np.testing.assert_allclose((F @ process.initial)[0, 0], 60.0**2 * (1.0 + x) * np.exp(-x))
    np.testing.assert_allclose(F @ process.initial @ F.T + Q, process.initial, atol=1e-9)


def test_turn_of_the_track_leaves_the_crustal_field_and_forgets_its_slope() -> None:
    """A right angle makes the slope unknown; a turn back inverts it."""
    process = TrackProcess(1.0, 60.0)
    F, Q = process.transition(1e-3, 1e-3, np.pi / 2.0)
    np.testing.assert_allclose(F[:2, :2], [[1.0, 0.0], [0.0, 0.0]], atol=1e-5)
    np.testing.assert_allclose(Q[1, 1], process.initial[1, 1], rtol=1e-4)
    F, Q = process.transition(1e-3, 1e-3, np.pi)
    np.testing.assert_allclose(F[1, 1], -1.0, rtol=1e-4)
    np.testing.assert_allclose(Q[1, 1], 0.0, atol=1e-6)


def test_course_changes_once_it_is_measured() -> None:
    course = Course()
    assert np.isnan(course.angle)
    turns = [course.move(3.0, 0.0) for _ in range(8)] + [course.move(0.0, 6.0) for _ in range(4)]
    np.testing.assert_allclose(sum(turns), np.pi / 2.0)
    np.testing.assert_allclose(course.angle, np.pi / 2.0)
    assert course.move(np.nan, 0.0) == 0.0


def test_size_of_a_change_is_that_of_its_effect() -> None:
    """The change alternates by 2 about 5."""
    kalman, test = KalmanFilter(np.zeros(1), np.zeros((1, 1))), SequentialTest([False], 1)
    for k in range(200):
        kalman.innovate(5.0 + 2.0 * (-1.0) ** k, np.zeros(1), 0.01)
        test.test(kalman, float(k), np.ones(1), np.array([[5.0 + 2.0 * (-1.0) ** k, 0.0, 0.0]]))
        test.update(kalman.update())
    assert 5.0 < test.rms(5) < 5.8
    assert test.misfit(5) < 0.5


def test_pulses_are_a_misfit_of_every_constant_change() -> None:
    kalman, test = KalmanFilter(np.zeros(1), np.zeros((1, 1))), SequentialTest([False], 1)
    for k in range(400):
        kalman.innovate(20.0 * (k % 10 < 2), np.zeros(1), 1.0)
        test.test(kalman, float(k), np.ones(1), np.array([[20.0, 0.0, 0.0]]))
        test.update(kalman.update())
    assert test.misfit(5) > 5.0
