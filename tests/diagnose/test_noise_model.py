from __future__ import annotations

import numpy as np
import pytest

from magbridge.diagnose.inference.fit_noise import certainty, fit_noise, memory_order


def made(kind: str, n: int = 6000, rho: float = 0.0, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    v = rng.standard_t(3.0, n) if kind == "heavy" else rng.normal(size=n)
    if kind == "uneven":
        v *= np.repeat(np.exp(rng.normal(0, 0.7, n // 300)), 300)
    r = v.copy()
    for i in range(1, n):
        r[i] += rho * r[i - 1]
    follows = np.ones(n, bool)
    follows[[0, n // 6, n // 2]] = False
    return r, follows


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.95])
def test_memory_and_level_are_found(rho: float) -> None:
    r, follows = made("white", rho=rho)
    noise = fit_noise(r, follows, 1)
    assert noise.memory[0] == pytest.approx(rho, abs=0.04)
    assert float(np.median(noise.scale)) == pytest.approx(1.0, abs=0.04)
    assert noise.nu > 10
    assert memory_order(r, follows) == 1


def test_heavy_tails_are_found_and_the_score_is_of_unit_variance() -> None:
    r, follows = made("heavy", rho=0.6)
    noise = fit_noise(r, follows, 1)
    assert noise.nu in (2.5, 3.0, 4.0)
    assert float(np.std(noise.response(r))) == pytest.approx(1.0, abs=0.05)


def test_a_level_that_changes_is_followed() -> None:
    r, follows = made("uneven")
    noise = fit_noise(r, follows, 1)
    assert np.ptp(np.log(noise.scale)) > 1.0
    even, follows = made("white")
    assert np.ptp(fit_noise(even, follows, 1).scale) == 0.0


def test_filtering_in_pieces_is_filtering_the_whole() -> None:
    r, follows = made("heavy", n=900, rho=0.6)
    noise = fit_noise(r, follows, 3)
    X = np.random.default_rng(2).normal(size=(900, 2))
    whole = noise.filter(X)
    np.testing.assert_allclose(noise.filter(X[397:600], 397, 3), whole[400:600])


def test_least_squares_of_the_filtered_is_generalised_least_squares() -> None:
    """Against the naive oracle: the full covariance of an AR(1), inverted."""
    n, rho = 200, 0.7
    rng = np.random.default_rng(3)
    X = rng.normal(size=(n, 2)).cumsum(axis=0)
    follows = np.append(False, np.ones(n - 1, bool))
    noise = fit_noise(rng.normal(size=n), follows, 1, blocks=False)
    noise = type(noise)(np.array([rho]), np.ones(n), 1e6, np.sqrt(1 - rho**2), noise.past, 0.0, np.zeros(n))
    C = rho ** np.abs(np.subtract.outer(np.arange(n), np.arange(n))) / (1 - rho**2)
    A = noise.filter(X)
    np.testing.assert_allclose(A.T @ A, X.T @ np.linalg.solve(C, X), rtol=1e-4)


@pytest.mark.parametrize(("period", "slow"), [(np.inf, True), (5.0, False)])
def test_the_level_is_known_as_well_as_refitted_noises_agree_on_it(period: float, slow: bool) -> None:
    """Against many noises fitted to as many residuals: the scatter of the column's information is 2 / f."""
    n = 1200
    t = np.arange(n)
    column = np.cos(2.0 * np.pi * t / period)[:, None]
    logs, freedoms = [], []
    for seed in range(60):
        r, follows = made("white", n, rho=0.9, seed=seed)
        noise = fit_noise(r, follows, 1)
        logs.append(float(np.log(np.sum(noise.filter(column) ** 2))))
        freedoms += certainty(r, noise, [lambda rows: column[rows]])
    assert 2.0 / np.var(logs) == pytest.approx(np.median(freedoms), rel=0.5)
    assert (np.median(freedoms) < 100) == slow
