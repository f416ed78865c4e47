"""Test one filter and a bank against the written-out equations, each other, and brute force."""

import dataclasses

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray
from scipy.stats import multivariate_normal
from voyages import PLACE

from magbridge.calibration.model import Calibration, Noise, identity
from magbridge.field.geodesy import metres_per_degree, offset
from magbridge.field.grid import AnomalyGrid, Local
from magbridge.navigate.bank import Bank, widest
from magbridge.navigate.model import Block, block_length, prior, resolution, transition
from magbridge.navigate.options import NavigationOptions, informed

Moments = tuple[np.ndarray, np.ndarray]


def block(anomaly: float, variance: float = 1.0) -> Block:
    return Block(0, *PLACE, anomaly, variance, 0.0, 0.0)


def around(
    grid: AnomalyGrid, north: np.ndarray | float, east: np.ndarray | float
) -> Local[NDArray[np.float64]]:
    per_lat, per_lon = metres_per_degree(PLACE[0])
    return grid.evaluate(PLACE[1] + np.asarray(east) / per_lon, PLACE[0] + np.asarray(north) / per_lat)


@pytest.fixture
def correlated() -> Moments:
    rng = np.random.default_rng(0)
    x, P = prior(NavigationOptions(start_sigma=60.0))
    root = np.linalg.cholesky(P) @ (np.eye(6) + 0.2 * rng.normal(size=(6, 6)))
    return x + 0.3 * np.sqrt(np.diag(P)) * rng.normal(size=6), root @ root.T


def test_a_map_s_variance_counts_with_the_measurement_s(grid: AnomalyGrid, correlated: Moments) -> None:
    x, P = correlated
    unsure = AnomalyGrid(grid.longitude, grid.latitude, grid.anomaly, 3.0)
    for scale, finest in ((1.0, np.inf), (1e-6, 500.0)):
        banks = (Bank(one, x, scale * P, finest, gate=25.0) for one in (grid, unsure))
        sure, not_sure = (bank.update(block(0.0)).variance for bank in banks)
        assert not_sure - sure == pytest.approx(9.0, rel=1e-3)


def test_the_tracker_is_the_second_order_filter(grid: AnomalyGrid, correlated: Moments) -> None:
    """The textbook equations, with the whole covariance, in the plainest code."""
    x, P = correlated
    tracker = Bank(grid, x, P, np.inf, gate=25.0)
    local = around(grid, x[0], x[1])
    hessian = np.array(
        [[local.north_north[0], local.north_east[0]], [local.north_east[0], local.east_east[0]]]
    )
    h = np.array([local.north[0], local.east[0], 0, 0, 1, 1])
    curve = hessian @ P[:2, :2]
    expected = local.anomaly[0] + 0.5 * np.trace(curve) + x[4] + x[5]
    s = h @ P @ h + 1.0 + 0.5 * np.trace(curve @ curve)
    z = expected + 2.0
    gain = P @ h / s
    seen = tracker.update(block(z))
    np.testing.assert_allclose(tracker.x[:, 0], x + gain * 2.0, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(tracker.P[:, :, 0], P - np.outer(gain, gain) * s, rtol=1e-6, atol=1e-6)
    assert seen.value == pytest.approx(2.0, abs=1e-9)
    assert seen.variance == pytest.approx(s)
    assert seen.accepted


def test_the_gate_keeps_an_outlier_out(grid: AnomalyGrid, correlated: Moments) -> None:
    tracker = Bank(grid, *correlated, np.inf, gate=16.0)
    before = tracker.x.copy()
    seen = tracker.update(block(5_000.0))
    assert not seen.accepted
    np.testing.assert_array_equal(tracker.x, before)


def test_off_the_map_nothing_is_compared(grid: AnomalyGrid, correlated: Moments) -> None:
    x, P = correlated
    seen = Bank(grid, x + 1e6 * np.eye(6)[0], P, np.inf, 16.0).update(block(0.0))
    assert np.isnan(seen.value)
    assert not seen.accepted


def test_a_cut_gaussian_is_still_that_gaussian(grid: AnomalyGrid, correlated: Moments) -> None:
    """1 %: what a lattice of 1.2 sigma spacing loses; 3 % for the tails beyond 3.5 sigma."""
    x, P = correlated
    bank = Bank(grid, x, P, resolution=15.0, gate=16.0)
    assert 20 < len(bank) < 800
    mean, covariance = bank.moments()
    scale = np.sqrt(np.diag(P))
    np.testing.assert_allclose(mean / scale, x / scale, atol=0.01)
    np.testing.assert_allclose(covariance / np.outer(scale, scale), P / np.outer(scale, scale), atol=0.03)
    assert widest(bank.P[:, :, 0]) == pytest.approx(15.0, rel=1e-6)
    assert np.linalg.eigvalsh(np.moveaxis(bank.P, 2, 0)).min() > 0


def test_the_bank_is_bayes_on_a_wide_start(grid: AnomalyGrid) -> None:
    """Places of the prior, weighted by the likelihood, against the bank: mean, spread and evidence.

    Places need no line through the map: the remainder is the bank's own. Bias and map error, which both
    measurements share, are integrated out. Two measurements 900 m apart; tolerance 3 % of the posterior's
    spread, and 3 % of the evidence.
    """
    options = NavigationOptions(start_sigma=600.0, bias_sigma=2.0, map_sigma=0.5)
    bank = Bank(grid, *prior(options), resolution=40.0, gate=1e9)
    places = options.start_sigma * np.random.default_rng(3).normal(size=(200_000, 2))
    truth = np.array([250.0, -420.0])
    left, evidence = [], 0.0
    for shift in ((0.0, 0.0), (900.0, 0.0)):
        z = float(around(grid, *(truth + shift)).anomaly[0])
        latitude, longitude = offset(*PLACE, *shift)
        evidence += bank.update(Block(0, latitude, longitude, z, 4.0, 0.0, 0.0))[2]
        left.append(z - around(grid, *(places + shift).T).anomaly)
    shared = options.bias_sigma**2 + options.map_sigma**2
    log_w = multivariate_normal(cov=4.0 * np.eye(2) + shared).logpdf(np.stack(left, axis=1))
    w = np.exp(log_w - log_w.max())
    mean, covariance = np.average(places, 0, w), np.cov(places.T, aweights=w)
    found, spread = bank.moments()
    scale = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(found[:2] / scale, mean / scale, atol=0.03)
    np.testing.assert_allclose(
        spread[:2, :2] / np.outer(scale, scale), covariance / np.outer(scale, scale), atol=0.05
    )
    assert evidence == pytest.approx(np.log(w.mean()) + log_w.max(), abs=0.03)


def test_hypotheses_off_the_map_stay_in_the_running(grid: AnomalyGrid) -> None:
    """A vehicle at the edge: those outside expect anything, so they neither win nor vanish at once."""
    x, P = prior(NavigationOptions(start_sigma=800.0))
    bank = Bank(grid, x + 16_000.0 * np.eye(6)[0], P, resolution=200.0, gate=16.0)
    bank.update(block(float(np.nanmean(grid.anomaly))))
    off = np.isnan(around(grid, bank.x[0], bank.x[1]).anomaly)
    assert 0.02 < bank.w[off].sum() < 0.98
    assert np.isfinite(bank.moments()[1]).all()


# ---- The motion of the states, and how fine a map must be cut --------------------------------------------


def test_many_short_steps_are_one_long_step() -> None:
    options = NavigationOptions()
    f, q = np.eye(6), np.zeros((6, 6))
    for _ in range(100):
        step_f, step_q = transition(options, 3.0, 1.0)
        f, q = step_f @ f, step_f @ q @ step_f.T + step_q
    long_f, long_q = transition(options, 300.0, 100.0)
    np.testing.assert_allclose(f, long_f, rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(q, long_q, rtol=0.01, atol=1e-9)


def test_gauss_markov_states_keep_their_variance() -> None:
    options = NavigationOptions()
    _, P = prior(options)
    f, q = transition(options, 600.0, 200.0)
    np.testing.assert_allclose((f @ P @ f.T + q)[2:, 2:], P[2:, 2:], rtol=1e-12)


def test_resolution_follows_the_map(grid: AnomalyGrid) -> None:
    fine, coarse = resolution(grid, NavigationOptions(), 0.1), resolution(grid, NavigationOptions(), 10.0)
    assert 0 < fine < coarse <= 0.25 * grid.correlation_length
    flat = AnomalyGrid(grid.longitude, grid.latitude, np.zeros_like(grid.anomaly))
    assert resolution(flat, NavigationOptions(), 1.0) == np.inf
    assert block_length(flat) == np.inf


def test_options_refuse_what_they_do_not_know() -> None:
    with pytest.raises(msgspec.ValidationError, match="unknown field `gait`"):
        msgspec.convert({"gait": 1.0}, NavigationOptions)
    assert msgspec.convert({"gate": 9.0}, NavigationOptions).gate == 9.0


def test_a_calibration_separates_white_and_slow_noise() -> None:
    known = NavigationOptions(bias_sigma=1.0)
    white = with_noise(Noise(2.0))
    assert informed(known, white, 2.0) == replace(known, noise=2.0)
    slow = informed(known, white, 10.0)
    assert slow.bias_sigma == pytest.approx(np.sqrt(1.0 + 100.0 - 4.0))
    assert slow.bias_time < known.bias_time
    lasting = informed(known, with_noise(Noise(10.0, autocorrelation=0.99, interval=4.0)), 10.0)
    assert lasting.noise == pytest.approx(10.0 * np.sqrt(1.0 - 0.99**2))
    assert lasting.bias_sigma == pytest.approx(np.hypot(1.0, 10.0 * 0.99))
    assert informed(
        known, with_noise(Noise(5.0, autocorrelation=0.9, interval=4.0)), 5.0
    ).noise_time == pytest.approx(38, 0.01)


def with_noise(noise: Noise) -> Calibration:
    return dataclasses.replace(identity(), noise=noise)
