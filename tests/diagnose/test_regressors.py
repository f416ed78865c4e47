"""Test that the columns of the search equal the regressors of the live correction."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import xarray as xr
from posed import FIELD, T0, calibrated, missed, right, surveyed, thinned, walk

from magbridge.calibration.model import Parameter
from magbridge.calibration.terms import Polynomial
from magbridge.diagnose.assessment import delays
from magbridge.diagnose.causes import CAUSES
from magbridge.diagnose.causes.instrument import OffsetStep
from magbridge.diagnose.causes.masses import ActuatorOrder
from magbridge.diagnose.causes.timing import ChannelSkew, field_rates, mass_rates
from magbridge.diagnose.evidence import information
from magbridge.diagnose.joint import fit_joint
from magbridge.diagnose.problem import AXIS_DELAY_SIGMA_S, DELAYS, Problem, interpolation_error, pose
from magbridge.diagnose.report.findings import findings
from magbridge.diagnose.run import diagnose
from magbridge.diagnose.survey import MAX_LAG, Survey, TelemetryChannel


@pytest.fixture(scope="module")
def problem() -> Problem:
    """Return half an hour of turns with a gap, jitter, a moving mass, a temperature and a current."""
    rng = np.random.default_rng(1)
    n = 450
    t = 1.7e9 + 4.0 * np.arange(float(n)) + np.where(np.arange(n) > 300, 500.0, 0.0)
    t[200:204] += rng.uniform(-0.5, 0.5, 4)
    directions = walk(n, rng)
    p = np.interp(
        np.arange(n), [0, 60, 70, 150, 160, 300, 310, 449], [-0.5, -0.5, 0.8, 0.8, -1.0, -1.0, 0.6, 0.6]
    )
    warm = 3.0 + rng.normal(size=n).cumsum() * 0.1
    amps = np.where(rng.uniform(size=n) > 0.7, 1.3, 0.0)
    channels = {
        "p": TelemetryChannel(p, "in", ("position",)),
        "fin": TelemetryChannel(p[::-1].copy(), "deg", ("position",)),
        "warm": TelemetryChannel(warm, "degC", ("temperature",)),
        "amps": TelemetryChannel(amps, "A", ("current",)),
    }
    steps = np.append(MAX_LAG, np.rint(np.diff(t) / 4.0).astype(int))
    survey = surveyed(directions, p, time=t, steps=steps, channels=channels)
    return pose(survey, calibrated(rng.normal(0, 50.0, 27), centre=0.1, scale=0.9))


@pytest.mark.parametrize("share", [0.05, 0.125])
def test_a_rate_of_change_is_the_whole_logs_where_samples_are_lost(share: float) -> None:
    """The rate has no more noise than a central difference, unlike a one-sided difference."""
    whole, rng = right(3000), np.random.default_rng(2)
    survey = whole.survey
    turning = 2e4 * np.sin(2.0 * np.pi * survey.time[:, None] / np.array([150.0, 230.0, 700.0]))
    here = np.append(True, rng.random(len(whole) - 1) > share)

    def rated(field: np.ndarray, rows: np.ndarray) -> np.ndarray:
        log = thinned(replace(survey, field=field), rows)
        return field_rates(replace(whole, survey=log)).T

    expected, found = rated(turning, here | True)[here], rated(turning, here)
    seen = found.any(axis=1)
    assert seen.mean() > 0.995
    assert np.sum((found - expected)[seen] ** 2) < 0.01 * np.sum(expected[seen] ** 2)
    noise = rng.normal(size=turning.shape)
    own = np.sum(rated(noise, here) * noise[here]) / 3.0
    assert abs(own) < 0.05 * len(found) / whole.survey.interval


def test_a_rate_of_change_holds_a_turn_of_a_few_samples() -> None:
    """The turn has six samples: a central difference would lose a sixth of the rate."""
    whole = right(300)
    phase = 2.0 * np.pi * np.arange(len(whole))[:, None] / 6.0 + np.arange(3.0)
    survey = replace(whole.survey, field=2e4 * np.sin(phase))
    expected = 2e4 * 2.0 * np.pi / 6.0 / survey.interval * np.cos(phase)
    found = field_rates(replace(whole, survey=survey)).T
    np.testing.assert_allclose(found[10:-10], 0.992 * expected[10:-10], rtol=0.002, atol=1.0)
    assert not found[[0, -1]].any()


def test_a_filter_shortens_a_field_that_turns() -> None:
    """The loss is an RC filter's in steady turns; without calibration runs this cause is not proposed."""
    whole, tau, period = right(300), 1.5, 240.0
    phase, steepness = 2.0 * np.pi * whole.survey.time / period, np.arctan(2.0 * np.pi * tau / period)

    def seen(shorter: float, later: float) -> Problem:
        turning = 4e4 * shorter * np.stack([np.cos(phase - later), np.sin(phase - later)], axis=1)
        field = np.column_stack([turning, np.full(len(phase), 3e4)])
        learned = phase > 0.0
        return pose(replace(whole.survey, field=field, fitted=learned, learned=learned), whole.calibration)

    full, short = seen(1.0, 0.0), seen(float(np.cos(steepness)), float(steepness))
    *_, attenuated = CAUSES["filter_lag"].candidates(short)
    assert (attenuated.names, attenuated.units, attenuated.effects) == (("variance",), ("s^2",), ())
    expected = (short.residual - full.residual)[20:-20]
    assert expected.mean() < -20.0 or expected.mean() > 20.0
    np.testing.assert_allclose(tau**2 * attenuated.columns(slice(20, -20))[:, 0], expected, rtol=0.01)
    new = replace(short, survey=replace(short.survey, fitted=phase < 0.0, learned=phase < 0.0))
    assert {c.names for c in CAUSES["filter_lag"].candidates(new)} == {("delay",)}


def test_a_mass_rate_is_the_drives_speed_while_it_moves(problem: Problem) -> None:
    """A clock that is off is seen where the mass has moved before and after, and nowhere else."""
    clock, *_ = CAUSES["clock_offset"].candidates(problem)
    lag, *_ = CAUSES["filter_lag"].candidates(problem)
    rows = np.flatnonzero(clock.columns(slice(0, len(problem)))[:, 0])
    assert set(rows) == {*range(61, 70), *range(151, 160), *range(302, 310)}
    share = lag.columns(slice(0, len(problem)))[rows] / clock.columns(slice(0, len(problem)))[rows]
    np.testing.assert_allclose(share, -lag.width[0] / clock.width[0])


def test_a_mass_that_moves_within_one_interval_is_seen_by_a_shift(problem: Problem) -> None:
    """The mass has no rate at any sample, but its telemetry has changed after a shift in time."""
    name = problem.calibration.parameters[0].name
    channel = problem.survey.channels[name]
    low, high = channel.extent
    jump = channel._replace(values=np.where(np.arange(len(problem)) < 100, low, high))
    channels = {
        k: c if k == name else c._replace(values=np.full(len(problem), c.values[0]))
        for k, c in problem.survey.channels.items()
    }
    moved = pose(replace(problem.survey, channels=channels | {name: jump}), problem.calibration)
    rates, *shifts = CAUSES["clock_offset"].candidates(moved)
    whole = slice(0, len(moved))
    assert not rates.columns(whole).any()
    seen = {float(c.point.shape["shift"][0]): set(np.flatnonzero(c.columns(whole)[:, 0])) for c in shifts}
    assert any(rows and max(rows) < 100 for shift, rows in seen.items() if shift > 0.0)
    assert any(rows and min(rows) >= 100 for shift, rows in seen.items() if shift < 0.0)


def test_a_step_is_as_likely_at_a_power_cycle_as_at_all_other_times(problem: Problem) -> None:
    """A power cycle has also occurred between the calibration's logs and these logs."""
    t = problem.survey.time
    learned = replace(problem.survey, learned=np.arange(len(t)) < 100, cycles=t[[300]])
    grid = OffsetStep().candidates(replace(problem, survey=learned))
    odds = {candidate.point.shape["onset"][0]: np.exp(candidate.point.likelier) for candidate in grid}
    assert odds[t[100] - 1.0] + odds[t[300]] == pytest.approx(0.5 * len(grid))
    assert sum(odds.values()) == pytest.approx(len(grid))
    assert grid[0].point.rebuild is not None
    assert [grid[0].point.rebuild(t[at]).point.likelier > 0.0 for at in (99, 101, 300)] == [True, False, True]
    assert {candidate.point.likelier for candidate in OffsetStep().candidates(problem)} == {0.0}


def test_a_mass_that_stops_while_another_goes_on_has_no_rate(problem: Problem) -> None:
    """At 4 s a row: a stops between two samples, and b goes on."""
    rows = np.arange(len(problem))
    a = np.interp(rows, [10.0, 13.6], [-0.5, 0.5])
    b = np.interp(rows, [10.0, 20.0], [0.8, -0.8])
    parameters = (Parameter("a", "in", -1.0, 1.0, 0.0, 1.0), Parameter("b", "in", -1.0, 1.0, 0.0, 1.0))
    calibration = replace(
        problem.calibration,
        parameters=parameters,
        terms=(Polynomial(exponents=((0, 0), (1, 0), (0, 1))),),
        coefficients=np.concatenate([np.zeros(9), np.arange(9.0), 10.0 + np.arange(9.0)]),
    )
    channels = {name: TelemetryChannel(values, "in", ("position",)) for name, values in (("a", a), ("b", b))}
    survey = replace(problem.survey, channels=channels)
    rates = mass_rates(replace(problem, survey=survey, calibration=calibration))
    only_b, both = rates[:, 15], rates[:, 12]
    np.testing.assert_allclose(rates[:, 14], only_b, rtol=1e-6)
    np.testing.assert_allclose(only_b[6:], -0.04 * (10.0 + np.arange(6.0, 9.0)), rtol=1e-6)
    np.testing.assert_allclose(both[6:] - only_b[6:], np.arange(6.0, 9.0) / 3.6 / 4.0, rtol=1e-6)
    assert not rates[:, 30:].any()


def test_sources_along_its_way_hold_the_field_of_iron_that_a_mass_passes(problem: Problem) -> None:
    """A dipole near the track, anywhere, any direction: the next power leaves far more than sources."""
    rng, t = np.random.default_rng(8), np.linspace(0.0, 1.0, len(problem))
    channels = problem.survey.channels | {"p": problem.survey.channels["p"]._replace(values=np.sin(12.0 * t))}
    problem = replace(problem, survey=replace(problem.survey, channels=channels))
    p, jacobian = channels["p"].values, problem.jacobian[:, 6:]
    powers = (p[:, None, None] ** np.arange(4)[:, None] * jacobian[:, None, :]).reshape(len(p), -1)
    listed = [
        c.columns(slice(0, len(p))) for c in ActuatorOrder().candidates(problem) if c.spectra is not None
    ]

    def beyond(columns: np.ndarray, field: np.ndarray) -> float:
        return missed(field, np.hstack([powers, columns])) / missed(field, powers)

    for _ in range(5):
        r = np.column_stack(
            [p - rng.uniform(-1.0, 1.0), np.full_like(p, rng.uniform(0.3, 0.8)), np.zeros_like(p)]
        )
        far, m = np.linalg.norm(r, axis=1)[:, None], rng.normal(size=3)
        field = np.sum(jacobian * (3.0 * r * (r @ m)[:, None] / far**2 - m) / far**3, axis=1)
        next_power = beyond(p[:, None] ** 4 * jacobian, field)
        assert min(beyond(columns, field) for columns in listed) < min(0.2, 0.4 * next_power)


def test_a_core_that_shows_through_changes_the_sensitivity_too(problem: Problem) -> None:
    """A feedback of finite gain leaves the core the field that its output takes: not flat at zero."""
    shown = np.einsum("ni,ni->n", problem.jacobian[:, 6:], np.arctanh(0.8 * problem.reading / 5e4))
    every = CAUSES["nonlinearity"].candidates(problem)[-1].columns(slice(0, len(problem)))
    assert missed(shown, every) < 0.04 * missed(shown, every[:, 3:])


# ---- Channels that a log has interpolated linearly to its rows, of a vehicle that sways quickly ------------


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
