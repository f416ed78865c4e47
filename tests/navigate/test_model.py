"""The motion of the states, and how fine a map must be cut."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from magbridge.calibration.model import Calibration, Noise, identity
from magbridge.field.grid import AnomalyGrid
from magbridge.navigate.model import block_length, prior, resolution, transition
from magbridge.navigate.options import NavigationOptions, informed


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


def test_no_time_is_not_motion() -> None:
    f, q = transition(NavigationOptions(), 0.0, 0.0)
    np.testing.assert_array_equal(f, np.eye(6))
    np.testing.assert_array_equal(q, np.zeros((6, 6)))


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
