"""Test that the estimated size and autocorrelation of noise equal the simulated ones, despite outliers."""

import tracemalloc

import numpy as np
import pytest
from scipy.signal import lfilter

from magbridge.arrays import FloatArray
from magbridge.estimation.noise import (
    NoiseModel,
    Whitening,
    effective_fraction,
    estimate_noise,
    fit_slow_and_white,
    samples_per_independent,
    whiten,
)  # fmt: skip

N = 4000
STEPS = np.r_[np.inf, np.ones(N - 1)]


def drawn(rho: float, sigma: float = 4.0, seed: int = 1) -> FloatArray:
    """Return an AR(1) process of the given 1-sigma."""
    rng = np.random.default_rng(seed)
    e = lfilter([np.sqrt(1.0 - rho**2)], [1.0, -rho], rng.normal(0.0, sigma, N + 500))
    return np.asarray(e[500:])


@pytest.mark.parametrize("rho", [0.0, 0.4, 0.9])
def test_size_and_memory_are_those_that_were_drawn(rho: float) -> None:
    noise = estimate_noise(drawn(rho), STEPS, 0.0)
    assert noise.autocorrelation == pytest.approx(rho, abs=0.03)
    assert noise.sigma == pytest.approx(4.0, rel=0.08)
    assert noise.white == 0.0
    assert noise.shape == (noise.autocorrelation, 0.0)


def test_white_noise_has_no_memory_and_few_samples_tell_of_none() -> None:
    assert NoiseModel(4.0).shape == (0.0, 0.0)
    assert estimate_noise(drawn(0.0), STEPS, 0.0).autocorrelation == 0.0
    short = slice(0, 30)
    assert estimate_noise(drawn(0.9)[short], STEPS[short], 0.0).autocorrelation == 0.0
    enough = slice(0, 60)
    assert estimate_noise(drawn(0.9)[enough], STEPS[enough], 0.0).autocorrelation > 0.4


def test_memory_is_believed_from_three_standard_errors_on() -> None:
    weak = drawn(0.07)
    rho = float(weak[1:] @ weak[:-1] / (weak @ weak))
    assert 3.0 < rho * np.sqrt(N) < 6.0
    assert estimate_noise(weak, STEPS, 0.0).autocorrelation == pytest.approx(rho, abs=0.01)


def test_samples_beside_a_motion_have_a_variance_of_their_own() -> None:
    moving = np.arange(N) % 20 < 2
    e = drawn(0.0) * np.where(moving, 10.0, 1.0)
    e[[0, 1]] = 400.0, -100.0  # in motion: beyond and within five of its own 1-sigmas of 40 nT
    e[5] = 30.0  # at rest, with 4 nT
    noise = estimate_noise(e, STEPS, 0.0, moving=moving)
    assert noise.weight is not None
    assert noise.sigma == pytest.approx(4.0, rel=0.05)
    assert np.flatnonzero(noise.weight == 0.0).tolist() == [0, 5]
    assert noise.weight[moving][1:] == pytest.approx(0.01, rel=0.2)
    # where motion adds no error, all samples count alike
    assert estimate_noise(drawn(0.0), STEPS, 0.0, moving=moving).root_weights(N).min() > 0.95


def test_a_few_pairs_of_wrong_samples_do_not_count_as_memory() -> None:
    e = drawn(0.0)
    for k in range(100, 100 + 200 * 10, 200):
        e[k : k + 2] += 400.0
    assert estimate_noise(e, STEPS, 0.0).autocorrelation == 0.0


def test_neighbours_across_a_gap_are_not_neighbours() -> None:
    """Two interleaved halves, each of which turns its sign at every gap."""
    e = drawn(0.95)
    steps = np.where(np.arange(N) % 2 == 0, np.inf, 1.0)
    e[2::4] *= -1.0
    e[3::4] *= -1.0
    assert estimate_noise(e, steps, 0.0).autocorrelation == pytest.approx(0.95, abs=0.03)


def test_a_walk_is_bounded_and_perfect_data_have_a_sigma_above_zero() -> None:
    walk = estimate_noise(np.cumsum(drawn(0.0)), STEPS, 0.0)
    assert walk.autocorrelation == 0.99
    perfect = estimate_noise(np.zeros(N), STEPS, 0.0)
    assert 0.0 < perfect.sigma < 1e-6
    assert perfect.rejected == 0


def test_outliers_are_left_out_and_counted() -> None:
    e = drawn(0.0)
    e[100::200] += 400.0
    noise = estimate_noise(e, STEPS, 0.0)
    assert noise.rejected == 20
    assert noise.weight is not None
    assert np.flatnonzero(noise.weight == 0.0).tolist() == list(range(100, N, 200))
    assert noise.sigma == pytest.approx(4.0, rel=0.05)
    assert noise.autocorrelation == 0.0
    assert estimate_noise(drawn(0.0), STEPS, 0.0).weight is None


def test_every_number_that_was_fitted_counts() -> None:
    few = slice(0, 100)
    plain, fitted = (estimate_noise(drawn(0.0)[few], STEPS[few], free).sigma for free in (0.0, 36.0))
    assert fitted / plain == pytest.approx(1.0 / 0.8)
    assert estimate_noise(drawn(0.0)[few], STEPS[few], 500.0).sigma > fitted, "more numbers than samples"


def test_a_slow_part_is_believed_only_where_it_is_likelier() -> None:
    alone = estimate_noise(drawn(0.5), STEPS, 0.0)
    assert fit_slow_and_white(drawn(0.5), STEPS, alone, 0.0) is alone
    short = NoiseModel(4.0, 0.19)
    assert fit_slow_and_white(drawn(0.19), STEPS, short, 0.0) is short
    both = drawn(0.98, 8.0) + drawn(0.0, 4.0, seed=2)
    found = fit_slow_and_white(both, STEPS, estimate_noise(both, STEPS, 0.0), 0.0)
    assert found.autocorrelation == pytest.approx(0.98, abs=0.01)
    assert found.white == pytest.approx(0.2, abs=0.05)
    assert found.sigma == pytest.approx(80.0**0.5, rel=0.15)


def test_the_sigma_of_slow_noise_is_that_of_its_own_autocorrelation() -> None:
    """The AR(1) process of the start has an autocorrelation of 0.99 at most, and a third of the sigma."""
    rng, n, rho = np.random.default_rng(1), 20_000, 0.999
    steps = np.r_[np.inf, np.ones(n - 1)]
    e = lfilter([np.sqrt(1.0 - rho**2)], [1.0, -rho], rng.normal(size=n))
    found = fit_slow_and_white(e, steps, estimate_noise(e, steps, 0.0), 0.0)
    driving = found.sigma * np.sqrt(1.0 - found.autocorrelation**2)
    assert driving == pytest.approx(np.sqrt(1.0 - rho**2), rel=0.05)


def test_a_small_slow_part_is_found_where_neighbours_hardly_show_it() -> None:
    """10 samples a second: 0.4 nT over 100 s in 1 nT of white noise."""
    n, rho = 10 * N, np.exp(-1e-3)
    rng, steps = np.random.default_rng(3), np.r_[np.inf, np.ones(n - 1)]
    slow = lfilter([np.sqrt(1.0 - rho**2)], [1.0, -rho], rng.normal(0.0, 0.4, n))
    e = slow + rng.normal(0.0, 1.0, n)
    neighbours = estimate_noise(e, steps, 0.0)
    assert neighbours.autocorrelation < 0.2
    found = fit_slow_and_white(e, steps, neighbours, 0.0)
    assert -0.1 / np.log(found.autocorrelation) == pytest.approx(100.0, rel=0.6)
    assert found.white == pytest.approx(1.0 / 1.16, abs=0.05)


def test_correlation_of_many_runs_needs_memory_that_is_linear_in_the_samples() -> None:
    runs = 40_000 // 100
    values = np.vstack([drawn(0.8, seed=k)[:100, None] for k in range(runs)])
    steps = np.tile(np.r_[np.inf, np.ones(99)], runs)
    tracemalloc.start()
    found = samples_per_independent(values, steps)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found == pytest.approx(1.8 / 0.2, rel=0.15)  # (1 + rho) / (1 - rho)
    assert peak < 60 * values.nbytes


@pytest.mark.parametrize(("rho", "white"), [(0.0, 0.0), (0.6, 0.0), (0.9, 0.3), (0.98, 0.9)])
def test_the_effective_fraction_is_that_of_the_variance_of_a_mean(rho: float, white: float) -> None:
    """The variance of a mean of n samples is the mean of their covariance matrix."""
    n = 4000
    lags = np.arange(n)
    covariance = (1.0 - white) * rho**lags
    covariance[0] += white
    mean = (covariance[0] + 2.0 * ((1.0 - lags[1:] / n) * covariance[1:]).sum()) / n
    assert 1.0 / (n * mean) == pytest.approx(effective_fraction(rho, white), rel=0.03)


@pytest.mark.parametrize(("rho", "white"), [(0.7, 0.0), (0.95, 0.4)])
def test_whitening_decorrelates_as_the_inverse_of_the_covariance_does(rho: float, white: float) -> None:
    """The squared length of whitened values is that of the dense inverse, across gaps and runs."""
    steps = np.array([np.inf, 1.0, 1.0, 3.0, 1.0, np.inf, 1.0, 2.0])
    time = np.cumsum(np.where(np.isfinite(steps), steps, 0.0))
    run = np.cumsum(~np.isfinite(steps))
    together = run[:, None] == run
    covariance = together * (1.0 - white) * rho ** np.abs(time[:, None] - time) + white * np.eye(len(steps))
    values = np.random.default_rng(2).normal(size=(len(steps), 3))
    found = whiten(values, steps, rho, white)
    np.testing.assert_allclose(found.T @ found, values.T @ np.linalg.solve(covariance, values), rtol=1e-9)
    whitening = Whitening(steps, rho, white)
    np.testing.assert_allclose(
        np.vstack([whitening.apply(part) for part in np.array_split(values, 3)]), found
    )
    assert np.log(whitening.variance).sum() == pytest.approx(np.linalg.slogdet(covariance)[1])
