"""Test channels that a log has interpolated linearly to its rows, of a vehicle that sways quickly."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import xarray as xr
from posed import FIELD, T0, calibrated, right, walk

from magbridge.diagnose.assessment import delays
from magbridge.diagnose.causes import CAUSES
from magbridge.diagnose.causes.timing import ChannelSkew
from magbridge.diagnose.evidence import information
from magbridge.diagnose.joint import fit_joint
from magbridge.diagnose.problem import AXIS_DELAY_SIGMA_S, DELAYS, Problem, interpolation_error, pose
from magbridge.diagnose.report.findings import findings
from magbridge.diagnose.run import diagnose
from magbridge.diagnose.survey import Survey

TAKEN = np.array([0.0, 0.16, 0.32])
"""Delays of a converter that samples the channels in turn, s."""


def swaying(time: np.ndarray) -> np.ndarray:
    """Return a field (n, 3) of 50,000 nT that turns slowly, with sways of 6 and 17 samples."""
    t = time - 1.7e9
    heading = 1e-3 * t + 0.02 * np.sin(2.0 * np.pi * t / 24.7)
    pitch = 0.3 + 0.015 * np.sin(2.0 * np.pi * t / 23.1 + 1.0) + 0.05 * np.sin(2.0 * np.pi * t / 68.0)
    return 5e4 * np.stack(
        [np.cos(pitch) * np.cos(heading), np.cos(pitch) * np.sin(heading), np.sin(pitch)], axis=1
    )


def interpolated(time: np.ndarray) -> np.ndarray:
    """Return the field as a logger records it that interpolates each channel linearly between its samples."""
    taken = time[:, None] + TAKEN
    field = np.stack([swaying(taken[:, k])[:, k] for k in range(3)], axis=1)
    return np.stack([np.interp(time, taken[:, k], field[:, k]) for k in range(3)], axis=1)


def made(whole: Problem, field: np.ndarray, seed: int) -> Survey:
    noise = np.random.default_rng(seed).normal(size=field.shape)
    return replace(whole.survey, field=field + noise, reference=np.full(len(field), 5e4))


def test_a_line_leaves_its_delay_times_what_it_is_bent_by() -> None:
    survey = right(400).survey
    error = interpolated(survey.time) - swaying(survey.time)
    expected = TAKEN * interpolation_error(survey, swaying(survey.time).T).T
    inside = slice(10, -10)
    for k in (1, 2):
        assert np.sum((error - expected)[inside, k] ** 2) < 0.02 * np.sum(error[inside, k] ** 2)


def test_the_delays_are_found() -> None:
    """All delays except their common part are found: a constant total field does not show a late vector."""
    whole = right(3000)
    time = whole.survey.time
    problem = pose(made(whole, interpolated(time), 1), whole.calibration)
    fit = fit_joint(problem, [], 1)
    found = AXIS_DELAY_SIGMA_S * (fit.z[DELAYS] - fit.z[DELAYS][0])
    np.testing.assert_allclose(found, TAKEN, atol=0.03)
    late = delays(problem, fit)
    assert late is not None
    np.testing.assert_allclose(late.later, found[1:], atol=1e-9)


def test_channels_taken_at_once_have_none() -> None:
    whole = right(3000)
    problem = pose(made(whole, swaying(whole.survey.time), 2), whole.calibration)
    fit = fit_joint(problem, [], 1)
    spread = fit.z[DELAYS] - np.mean(fit.z[DELAYS])
    assert np.all(np.abs(AXIS_DELAY_SIGMA_S * spread) < 0.03)
    assert np.std(problem.delay_jacobian @ fit.z[DELAYS]) < 0.2
    assert delays(problem, fit) is None


def test_delays_that_are_not_there_leave_a_skew_its_power() -> None:
    """A skew keeps its power if there are no delays, except if noise resembles them."""
    whole = right(3000)

    def power(of: Problem) -> float:
        fit, (skew,) = fit_joint(of, [], 1), ChannelSkew().candidates(of)
        return float(np.trace(information(of, fit.noise, fit, [skew.columns]).matrix))

    shares = []
    for seed in range(3, 8):
        problem = pose(made(whole, swaying(whole.survey.time), seed), whole.calibration)
        shares.append(
            power(problem) / power(replace(problem, delay_jacobian=np.zeros_like(problem.delay_jacobian)))
        )
    assert np.median(shares) > 0.95
    assert max(shares) > 0.99


# ---- telemetry that is late against the sensor -------------------------------------------------------------


INTERVAL_S, IRON_NT = 4.0, np.array([300.0, -200.0, 500.0])
MASS_CAUSES = ("clock_offset", "filter_lag", "actuator_order", "hysteresis", "temperature_offset")


def flight(delay: float, cubic: float, seed: int) -> xr.Dataset:
    """Return a log with a mass that moves rarely: late telemetry, and an iron effect with its cube."""
    rng, n = np.random.default_rng(seed), 1500
    time = INTERVAL_S * np.arange(n)
    stops = np.cumsum(rng.uniform(120.0, 300.0, 60))
    knots = np.sort(np.concatenate([stops, stops + 40.0]))
    position = np.repeat(rng.uniform(-1.0, 1.0, 61), 2)[1:-1]

    def mass(t: np.ndarray) -> np.ndarray:
        return np.interp(t, knots, position)

    direction = walk(n, rng)
    field = FIELD * direction / np.linalg.norm(direction, axis=1)[:, None]
    acts = mass(time)[:, None] * IRON_NT + cubic * mass(time)[:, None] ** 3
    raw = field + acts + rng.normal(0.0, 1.0, (n, 3))
    columns = {
        f"mag_{axis}": ("time", values, {"units": "nT"}) for axis, values in zip("xyz", raw.T, strict=True)
    }
    columns |= {
        "p": ("time", mass(time - delay), {"units": "in"}),
        "reference_field": ("time", np.full(n, FIELD), {"units": "nT"}),
        "sensor_temperature": ("time", 10.0 + rng.normal(0.0, 0.01, n).cumsum(), {"units": "degC"}),
    }
    return xr.Dataset(columns, {"time": T0 + time}, {"source": "made"})


def named(log: xr.Dataset) -> list[dict[str, Any]]:
    coefficients = np.concatenate([np.zeros(15), IRON_NT])
    table = {name: CAUSES[name] for name in MASS_CAUSES}
    return findings(diagnose([log], calibrated(coefficients, 0.01), causes=table))["findings"]


@pytest.mark.parametrize("delay", [0.6, 7.0])
def test_late_telemetry_is_offered_as_a_delay(delay: float) -> None:
    (finding,) = named(flight(delay, 0.0, 3))
    assert finding["cause"] == "clock_offset"
    assert "actuator_order" not in {other["cause"] for other in finding["alternatives"]}
    assert finding["configuration"]["telemetry"]["p"]["delay"] == pytest.approx(delay, rel=0.15)


def test_a_finer_action_of_the_mass_is_not_taken_for_a_delay() -> None:
    (finding,) = named(flight(0.0, 20.0, 4))
    assert (finding["cause"], finding["configuration"]) == ("actuator_order", None)
