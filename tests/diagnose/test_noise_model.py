"""Test the autoregressive noise model, its filter and its standard deviation."""

from dataclasses import replace

import numpy as np
import pytest
from posed import candidate, right

from magbridge.diagnose.columns import Candidate, GridPoint
from magbridge.diagnose.extend import loosened
from magbridge.diagnose.joint import Joint, fit_joint, normal
from magbridge.diagnose.noise import ResidualNoise, autoregressive_order, fit_noise
from magbridge.diagnose.problem import Problem
from magbridge.diagnose.survey import MAX_LAG, Past


def made(kind: str, n: int = 6000, rho: float = 0.0, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return noise, and steps that show two gaps in it."""
    rng = np.random.default_rng(seed)
    v = rng.standard_t(3.0, n) if kind == "heavy" else rng.normal(size=n)
    if kind == "uneven":
        v *= np.repeat(np.exp(rng.normal(0, 0.7, n // 300)), 300)
    r = v.copy()
    for i in range(1, n):
        r[i] += rho * r[i - 1]
    steps = np.ones(n, int)
    steps[[0, n // 6, n // 2]] = MAX_LAG
    return r, steps


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.95])
def test_autoregression_and_level_are_found(rho: float) -> None:
    r, steps = made("white", rho=rho)
    noise = fit_noise(r, Past(steps, 1))
    assert noise.ar[0] == pytest.approx(rho, abs=0.04)
    assert float(np.median(noise.scale)) == pytest.approx(1.0, abs=0.04)
    assert noise.nu > 10
    assert autoregressive_order(r, np.cumsum(steps)) == 1


def test_heavy_tails_are_found_and_the_score_is_of_unit_variance() -> None:
    r, steps = made("heavy", rho=0.6)
    noise = fit_noise(r, Past(steps, 1))
    assert noise.nu in (2.5, 3.0, 4.0)
    assert float(np.std(noise.response(r))) == pytest.approx(1.0, abs=0.05)


def test_a_level_that_changes_is_followed() -> None:
    r, steps = made("uneven")
    noise = fit_noise(r, Past(steps, 1))
    assert np.ptp(np.log(noise.scale)) > 1.0
    even, steps = made("white")
    assert np.ptp(fit_noise(even, Past(steps, 1)).scale) == 0.0


def test_filtering_in_pieces_is_filtering_the_whole() -> None:
    r, steps = made("heavy", n=900, rho=0.6)
    noise = fit_noise(r, Past(steps, 3))
    X = np.random.default_rng(2).normal(size=(900, 2))
    whole = noise.filter(X)
    np.testing.assert_allclose(noise.filter(X[397:600], 397, 3), whole[400:600])
    np.testing.assert_allclose(noise.filter(X[:2]), whole[:2])


def covariance(ar: np.ndarray, reach: int) -> np.ndarray:
    """Return the covariance (reach,) of an autoregression, from its response to an impulse."""
    impulse = np.append(1.0, np.zeros(4000))
    for k in range(1, len(impulse)):
        before = impulse[max(k - len(ar), 0) : k][::-1]
        impulse[k] = ar[: len(before)] @ before
    return np.array([impulse[: len(impulse) - lag] @ impulse[lag:] for lag in range(reach)])


@pytest.mark.parametrize(
    ("ar", "breaks", "lost"),
    [
        ((0.9, -0.5, 0.3), (0, 2, 70, 71, 150), ()),
        ((0.97,), (0, 90), (4, 5, 6, 30, 31, 77, 100, 150, 152, 154)),
    ],
)
def test_least_squares_of_the_filtered_is_generalised_least_squares(
    ar: tuple[float, ...], breaks: tuple[int, ...], lost: tuple[int, ...]
) -> None:
    """Compare with the inverse of the full covariance, for separate stretches and next to gaps."""
    a, p = np.array(ar), len(ar)
    place = np.setdiff1d(np.arange(200), lost)
    n, stretch = len(place), np.searchsorted(breaks, place, "right")
    steps = np.where(np.diff(stretch, prepend=-1) > 0, MAX_LAG, np.diff(place, prepend=0))
    rng = np.random.default_rng(3)
    X = rng.normal(size=(n, 2)).cumsum(axis=0)
    noise = ResidualNoise(a, np.ones(n), 1e6, Past(steps, p), 0.0, np.zeros(n))
    apart = np.abs(np.subtract.outer(place, place))
    C = covariance(a, 200)[apart] * np.equal.outer(stretch, stretch)
    A = noise.filter(X)
    np.testing.assert_allclose(A.T @ A, X.T @ np.linalg.solve(C, X), rtol=1e-5)
    y = rng.normal(size=n)
    np.testing.assert_allclose(X.T @ noise.filter_back(y), A.T @ y)


@pytest.mark.parametrize("lost", ["every 24th", "one in twelve", "76 of 100"])
def test_the_information_about_a_constant_is_right_next_to_gaps(lost: str) -> None:
    """Under white noise upon one that remembers 40 samples, fitted with 8 coefficients."""
    pulls = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        whole = made("white", 4000, rho=0.975, seed=seed)[0] + 2.0 * rng.normal(size=4000)
        place = np.arange(4000)
        keep = {
            "every 24th": place % 24 > 0,
            "one in twelve": rng.random(4000) > 1 / 12,
            "76 of 100": place % 100 > 75,
        }
        place = np.flatnonzero(keep[lost])
        past = Past(np.append(MAX_LAG, np.diff(place)), 8)
        noise = fit_noise(whole[place], past, blocks=False)
        one = noise.filter(np.ones((len(place), 1)))[:, 0]
        pulls.append(float(one @ noise.response(whole[place]) / np.sqrt(one @ one)))
    assert float(np.std(pulls)) == pytest.approx(1.0, abs=0.3)


# ---- nonlinear parameters are estimates, too ---------------------------------------------------------------


ROWS, LAG, CELL = 300, 60.0, 40.0


def decay(lag: float) -> Candidate:
    """Return a decay of unknown amplitude and lag."""
    x = np.exp(-np.arange(ROWS) / lag)
    return candidate("made", x, point=GridPoint({"lag": (lag, "s")}, decay, cells=(CELL,)))


@pytest.fixture(scope="module")
def problem() -> Problem:
    noise = np.random.default_rng(6).normal(size=ROWS)
    return replace(right(ROWS), residual=9.0 * np.exp(-np.arange(ROWS) / LAG) + noise)


def fitted(problem: Problem, *model: Candidate) -> Joint:
    return fit_joint(problem, [one.columns for one in model], 1)


def test_the_covariance_is_that_of_a_fit_in_which_the_lag_is_free(problem: Problem) -> None:
    """Compare with the inverse of the full information, with the derivative by the lag as a column."""
    one = decay(LAG)
    fit = fitted(problem, one)
    t = np.arange(ROWS)
    slope = CELL * fit.coefficients[0] * t / LAG**2 * np.exp(-t / LAG)

    def every(rows: slice) -> np.ndarray:
        return np.column_stack([problem.calibration_rows(rows), one.columns(rows), slope[rows]])

    P = normal(every, fit.noise.response(fit.residual), fit.noise)[0] + np.diag(np.append(fit.prior, 1.0))
    expected = np.linalg.inv(P)[:-1, :-1]
    found = loosened(problem, [one], [one.columns], fit).covariance
    np.testing.assert_allclose(np.sqrt(np.diag(found)), np.sqrt(np.diag(expected)), rtol=0.03)
    assert found[-1, -1] > 1.1 * fit.covariance[-1, -1]
