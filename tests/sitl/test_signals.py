"""First-order lags and autoregressive noise."""

from __future__ import annotations

import numpy as np
import pytest

from sitl.signals import autoregressive, first_order

TAU = 1 / (2 * np.pi * 0.33)


def test_a_step_rises_as_one_minus_e_to_the_t_over_tau() -> None:
    # a step between two points is a ramp; a steep one must do
    step = 1e-3
    u = np.ones(5000)
    y = first_order(u, step, TAU, start=0.0)
    t = step * np.arange(5000)
    np.testing.assert_allclose(y, 1 - np.exp(-t / TAU), atol=1e-12)


def test_a_ramp_is_followed_one_time_constant_late_at_any_step() -> None:
    for step in (0.01, 0.5, 4.0):
        t = np.arange(0.0, 40.0, step)
        y = first_order(t, step, TAU)
        np.testing.assert_allclose(y, t - TAU * (1 - np.exp(-t / TAU)), atol=1e-9)


@pytest.mark.parametrize("memory", [0.0, 3.0, 10.0])
def test_noise_has_the_spread_and_memory_asked_for(memory: float) -> None:
    noise = autoregressive(np.random.default_rng(2), (200_000, 2), 5.0, memory)
    assert np.std(noise) == pytest.approx(5.0, rel=0.02)
    expected = np.exp(-1 / memory) if memory else 0.0
    assert np.corrcoef(noise[:-1, 0], noise[1:, 0])[0, 1] == pytest.approx(expected, abs=0.02)
    assert np.std(autoregressive(np.random.default_rng(3), (2, 100_000), 5.0, memory)[0]) == pytest.approx(
        5.0, rel=0.02
    )
