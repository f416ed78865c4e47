"""Test the kinds of telemetry series, and that no named cause contradicts a kind."""

import ast
from dataclasses import replace
from inspect import getsource
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from numpy.typing import NDArray
from posed import FIELD, T0, calibrated, right, surveyed, walk

import magbridge
from magbridge.calibration.effects import lagged
from magbridge.calibration.terms import Polynomial
from magbridge.diagnose import causes
from magbridge.diagnose.causes import CAUSES
from magbridge.diagnose.causes.instrument import OffsetDrift, OffsetStep
from magbridge.diagnose.causes.reference import DiurnalVariation, MapError, ReferenceBias
from magbridge.diagnose.columns import Candidate
from magbridge.diagnose.joint import Joint, fit_joint
from magbridge.diagnose.problem import Problem, pose
from magbridge.diagnose.report.findings import findings
from magbridge.diagnose.run import diagnose
from magbridge.diagnose.search import beside_slow_noise, search
from magbridge.diagnose.survey import ANY, TelemetryChannel, kinds_of
from magbridge.learning import alarms


@pytest.mark.parametrize(
    ("name", "unit", "kinds"),
    [
        ("throttle", "", ("current", "position")),
        ("throttle", "%", ("current", "position")),
        ("servo3", "us", ("current", "position")),
        ("esc1_rpm", "rpm", ("current", "position")),
        ("battery_voltage", "V", ("current", "position")),
        ("motor_temperature", "", ("temperature",)),
        ("m_veh_temp", "degC", ("temperature",)),
        ("m_coulomb_current", "A", ("current",)),
        ("esc2_current", "", ("current",)),
        ("depth", "m", ("pressure",)),
        ("height", "m", ("pressure",)),
        ("battpos", "in", ("position",)),
        ("battpos", "m", ("position",)),
        ("vbdCC", "", ("position",)),
        ("descent", "", ANY),
        ("attempts", "1", ANY),
        ("q7", "", ANY),
    ],
)
def test_unit_and_name_give_a_series_its_kind(name: str, unit: str, kinds: tuple[str, ...]) -> None:
    assert kinds_of(name, unit) == kinds


def test_no_cause_is_put_forward_for_a_series_whose_kind_contradicts_it() -> None:
    """Several motors are one candidate with a common size, in addition to each motor."""
    rng = np.random.default_rng(4)
    n = 400
    motors = {name: rng.uniform(size=n) for name in ("throttle", "esc1_current")}
    survey = surveyed(walk(n, rng), np.sin(np.arange(n) / 30.0))
    channels = survey.channels | {
        name: TelemetryChannel(values, "", kinds_of(name, "")) for name, values in motors.items()
    }
    problem = pose(replace(survey, channels=channels), calibrated(np.zeros(18)))
    made = {cause: {one.channel for one in row.candidates(problem)} for cause, row in CAUSES.items()}
    assert made["temperature_offset"] == made["temperature_scale"] == made["pressure_offset"] == set()
    assert made["unmodelled_actuator"] == {"throttle"}
    assert made["current_field"] == {"throttle", "esc1_current", None}
    (together,) = (one for one in CAUSES["current_field"].candidates(problem) if one.channel is None)
    assert together.size == 6
    assert together.freedom == 1
    assert {name for effect in together.effects for name in effect.channels()} == set(motors)


def rotor(hidden: str) -> xr.Dataset:
    """A multirotor's log at 2 Hz with a throttle without a unit, four motors' outputs and a current.

    Its field follows the throttle 2 s late, along z; or each motor, along an axis of its own.
    """
    rng, n = np.random.default_rng(2), 1600
    time, u = T0 + 0.5 * np.arange(float(n)), walk(n, rng)
    throttle = np.clip(
        0.45 + 0.25 * rng.normal(size=n // 20).repeat(20) + 0.02 * rng.normal(size=n), 0.0, 1.0
    )
    apart = 0.1 * rng.normal(size=(4, n // 10)).repeat(10, axis=1)
    motors = {f"esc{k}": 1000.0 + 800.0 * np.clip(throttle + one, 0.0, 1.0) for k, one in enumerate(apart, 1)}
    field = FIELD * u / np.linalg.norm(u, axis=1)[:, None] + rng.normal(size=(n, 3))
    if hidden == "late":
        field += np.outer(60.0 * lagged(time, throttle, 2.0), [0.1, 0.0, 1.0])
    else:
        field += sum(np.outer(0.05 * (one - 1000.0), rng.normal(size=3)) for one in motors.values())
    columns = dict(zip(("mag_x", "mag_y", "mag_z"), field.T, strict=True)) | motors
    columns |= {"throttle": throttle, "current": 5.0 + 30.0 * throttle**1.5 + 0.3 * rng.normal(size=n)}
    columns["reference_field"] = np.full(n, FIELD)
    ds = xr.Dataset({k: ("time", v) for k, v in columns.items()}, {"time": time}, {"source": "rotor"})
    units = dict.fromkeys(("mag_x", "mag_y", "mag_z", "reference_field"), "nT") | {"current": "A"}
    for name, unit in units.items():
        ds[name].attrs["units"] = unit
    return ds


@pytest.mark.parametrize("hidden", ["late", "several"])
def test_on_a_multirotors_log_what_is_seen_stands_apart_from_what_it_may_be(hidden: str) -> None:
    known = replace(calibrated(np.zeros(9)), parameters=(), terms=(Polynomial(exponents=((),)),))
    found = diagnose([rotor(hidden)], known)
    facts = findings(found)
    named = {(one["cause"], one["channel"]) for one in facts["findings"]}
    every = named | {(o["cause"], o["channel"]) for one in facts["findings"] for o in one["alternatives"]}
    assert not [one for one in every if one[0].startswith(("temperature", "pressure"))]
    if hidden == "several":
        assert named == {("current_field", None)}
    else:
        assert {one for one, _ in named} <= {"current_field", "unmodelled_actuator"}
        seen = facts["assessment"]["residual"]["follows"] if not named else facts["findings"][0]["follows"]
        assert (seen["channel"], seen["lag_s"], seen["axis"]) == ("throttle", 2.0, "z")


# ---- an error of the map, as the search describes it -------------------------------------------------------


N = 1500
NORTH = 2000.0 * (1.0 - np.abs(np.linspace(-1.0, 1.0, N)))
DOWN = 75.0 * (1.0 - np.cos(2.0 * np.pi * np.arange(N) / 170.0))
"""Depth of a line there and back, m."""


def drawn(whole: Problem, error: NDArray[np.float64], down: NDArray[np.float64]) -> Problem:
    """Return a problem whose reference has an `error` (n,), nT, along a track at depths `down`."""
    place = np.stack([NORTH, np.zeros(N), down], axis=1)
    return replace(whole, residual=whole.residual + error, survey=replace(whole.survey, place=place))


def fitted(problem: Problem, chart: Candidate) -> Joint:
    assert chart.nonparametric
    return fit_joint(problem, [chart.columns], 1, spectra=[chart.spectra])


def flown(altitude: float) -> NDArray[np.float64]:
    """Return the difference (n,), nT, of a map at altitude from the field, for two waves."""
    found = np.zeros(N)
    for length, phase in ((1600.0, 0.3), (5000.0, 1.0)):
        k = 2.0 * np.pi / length
        grown = np.exp(k * (DOWN - 150.0)) - np.exp(k * (-altitude - 150.0))
        found += 60.0 * grown * np.cos(k * NORTH + phase)
    return found


def test_what_a_map_as_flown_lacks_grows_with_depth() -> None:
    """Without the depths, the map would have two errors at one place."""
    missing, residual = flown(90.0), []
    for down in (DOWN, np.zeros(N)):
        problem = drawn(right(N), missing, down)
        residual.append(float(np.std(fitted(problem, MapError().candidates(problem)[0]).residual)))
    assert residual[0] < 0.1 * np.std(missing) < 0.2 * np.std(missing) < residual[1], residual


@pytest.mark.parametrize("altitude", [60.0, 100.0, 150.0])
def test_the_mean_of_what_a_map_lacks_is_known(altitude: float) -> None:
    """The growth with depth distinguishes it from a constant."""
    missing = flown(altitude)
    problem = drawn(right(N), missing + 40.0, DOWN)
    chart, _ = MapError().candidates(problem)
    [constant] = ReferenceBias().candidates(problem)
    fit = fit_joint(problem, [chart.columns, constant.columns], 1, spectra=[chart.spectra, None])
    error = chart.columns(slice(None)) @ fit.coefficients[: chart.size] / problem.reference_jacobian
    assert abs(error.mean() - missing.mean()) < 0.2 * np.sqrt(np.mean(missing**2))


def test_what_is_drawn_wrong_is_the_same_at_every_depth() -> None:
    wrong = 30.0 * np.exp(-0.5 * ((NORTH - 900.0) / 400.0) ** 2)
    problem = drawn(right(N), wrong, DOWN)
    _, chart = MapError().candidates(problem)
    fit = fitted(problem, chart)
    assert np.std(fit.residual) < 0.1 * np.std(wrong)
    error = chart.columns(slice(None)) @ fit.coefficients / problem.reference_jacobian
    np.testing.assert_allclose(error, error[::-1], atol=1e-6)  # there and back


def test_a_gradient_over_the_whole_region_is_the_maps_error_alone() -> None:
    """A line there and back separates place from time: no second, slow cause is named."""
    rng = np.random.default_rng(5)
    whole = right(N)
    survey = replace(whole.survey, time=whole.survey.time[0] + 16.0 * np.arange(N))
    wrong = 0.01 * (NORTH - 1000.0) + rng.normal(size=N)
    problem = drawn(replace(whole, survey=survey), wrong, DOWN)
    causes = MapError(), DiurnalVariation(), OffsetDrift(), OffsetStep()
    every = [candidate for cause in causes for candidate in cause.candidates(problem)]
    found = beside_slow_noise(search(problem, every, 4), every, 4)
    assert [h.candidate.cause for h in found.chosen] == ["map_error"]


# ---- The causes: each is one class, and nothing else in the package asks for one by its name -------------


ROOM = Path(causes.__file__).parent
ELSEWHERE = {"magbridge/learning"}
"""Packages that may contain the names of causes: in-flight calibration names its filter's states by them."""


def strings(path: Path) -> set[str]:
    tree = ast.parse(path.read_text("utf-8"))
    return {
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }


def test_a_cause_is_named_in_its_own_room_alone() -> None:
    package = Path(magbridge.__file__).parent
    unlike_words = set(CAUSES) - {
        "hysteresis",
        "map_error",
    }  # a shape's name; a column that navigation writes
    asked = {
        path.relative_to(package.parent).as_posix(): sorted(unlike_words & strings(path))
        for path in package.rglob("*.py")
        if ROOM not in path.parents and unlike_words & strings(path)
    }
    assert {path for path in asked if Path(path).parent.as_posix() not in ELSEWHERE} == set()


def test_a_cause_is_one_short_class() -> None:
    """The cause's name is in one module only, and its class has at most forty lines without docstring."""
    for name, cause in CAUSES.items():
        places = [path for path in ROOM.glob("*.py") if name in strings(path)]
        assert len(places) == 1, (name, places)
        assert all((cause.needs, cause.disambiguation, cause.meaning))
        (node,) = ast.parse(getsource(type(cause))).body
        assert isinstance(node, ast.ClassDef)
        first = node.body[1]  # after the docstring
        assert (node.end_lineno or 0) - first.lineno < 60, name


@pytest.mark.parametrize("name", CAUSES)
def test_columns_are_derivatives_of_the_nonlinear_model(name: str, problem: Problem) -> None:
    """For every candidate whose effect the corrector computes as the search does."""
    for candidate in CAUSES[name].candidates(problem)[::7]:
        assert CAUSES[name].jacobian_error(problem, candidate) < 1e-3, candidate.names


# ---- one vocabulary of causes ------------------------------------------------------------------------------


def test_a_cause_learned_in_flight_has_a_name_of_the_diagnosis() -> None:
    assert set(alarms.CAUSE_UNITS) <= set(CAUSES)
    assert set(alarms.FROM_ZERO) <= set(alarms.CAUSE_UNITS)
