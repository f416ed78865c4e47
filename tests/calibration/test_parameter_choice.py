"""Test that ``--parameter auto`` selects the columns that move the field, and no others."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from commands import Command
from demos import demo_log
from gliders import Gliders, codes
from measured import hold_runs_out
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from magbridge.calibration.correct import correct
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.fitting.parameter_choice import best_parameters, lines, undeclared
from magbridge.calibration.fitting.uncertainty import in_sensor_units
from magbridge.estimation.residual import rms
from magbridge.logs import read, write
from magbridge.logs.deployment import deployment
from magbridge.logs.info import movers

EARTH = np.array([21_000.0, 1_500.0, 43_000.0])
IRON = np.array([800.0, -300.0, 500.0])
PER_AMPERE = np.array([40.0, -25.0, 60.0])
UNITS = {"battery_current": "A", "throttle": "1", "servo1": "us", "baro_temperature": "degC"}


def flight(seed: int = 1, moved: float = 1.0) -> xr.Dataset:
    """Return a drone's turns, whose motors move its field by `moved` times 76 nT a A."""
    rng = np.random.default_rng(seed)
    n = 500
    heading = np.cumsum(rng.normal(3.0, 4.0, n)) % 360.0
    roll, pitch = (30.0 * np.sin(np.arange(n) / period) for period in (17.0, 23.0))
    turned = (
        Rotation.from_euler("ZYX", np.column_stack([heading, pitch, roll]), degrees=True).inv().apply(EARTH)
    )
    current = 10.0 + 8.0 * np.abs(np.sin(np.arange(n) / 11.0)) + rng.normal(0.0, 0.3, n)
    field = turned + IRON + moved * np.outer(current, PER_AMPERE) + rng.normal(0.0, 40.0, (n, 3))
    columns = {f"mag_{axis}": values for axis, values in zip("xyz", field.T, strict=True)}
    columns |= {"roll": roll, "pitch": pitch, "heading": heading, "battery_current": current}
    columns |= {"throttle": current / 30.0 + rng.normal(0.0, 0.05, n), "servo1": rng.uniform(1100, 1900, n)}
    columns |= {"baro_temperature": np.linspace(20.0, 30.0, n)}
    columns["reference_field"] = np.full(n, np.linalg.norm(EARTH))
    return deployment("flight.csv", 1.6e9 + 0.2 * np.arange(n), columns, UNITS)


def test_the_current_is_taken_and_what_says_the_same_is_not() -> None:
    log = flight()
    taken, offers = best_parameters(log, movers(log))
    assert taken == ("battery_current",)
    first = offers[0]
    assert first.name == "battery_current"
    assert first.left_out < 0.5 * first.without
    assert lines(offers)[0].endswith("with it: taken")
    # the promised error holds on a new flight
    found = fit(observations(log, taken))
    other = observations(flight(2), taken)
    off = correct(found.calibration, other.field, other.parameters, other.time).total - other.reference
    assert float(np.sqrt(np.mean(off**2))) == pytest.approx(first.left_out, rel=0.3)


def test_where_nothing_moves_the_field_nothing_is_taken() -> None:
    log = flight(moved=0.0)
    taken, _ = best_parameters(log, movers(log))
    assert taken == ()


def test_two_masses_that_move_together_with_the_attitude_are_taken() -> None:
    # one of them alone distorts the scales by more than 0.15
    log = demo_log().isel(time=slice(None, None, 2))
    taken, offers = best_parameters(log, movers(log))
    assert set(taken) == {"battpos", "ballast"}
    assert offers[-1].left_out < 0.02 * offers[0].without


def test_on_the_command_line(here: Path, command: Command) -> None:
    write(flight(), "flight.csv")
    asked = "calibrate", "flight.csv", "-o", "cal.json", "--parameter", "auto"
    output = command(*asked)
    assert "--parameter battery_current: " in output.err
    assert "is not declared" not in output.err
    command("correct", "flight.csv", "--calibration", "cal.json", "-o", "c.csv")
    assert (here / "c.csv").exists()
    for more in (("--parameter", "throttle"), ("--method", "nominal")):
        assert "--parameter auto" in command.refuses(*asked, *more, code=2)


# ---- a column that moves the field and was not declared is named; one that does not is not -----------------


@pytest.mark.parametrize("seed", [2, 5])
@pytest.mark.parametrize("declared", [("battpos",), ("battpos", "ballast")])
def test_a_mass_that_was_left_out_is_named(declared: tuple[str, ...], seed: int) -> None:
    """The message also names a mass that nearly always moves with the declared mass, as ballast does."""
    log = demo_log(seed)
    data = observations(log, declared)
    data = data.part(np.arange(len(data)) % 3 == 0)  # as much to see in a third of the time
    rows = np.searchsorted(log["time"].to_numpy(), data.time)
    noise = np.random.default_rng(2).normal(size=len(data))
    others = {name: log[name].to_numpy()[rows] for name in ("ballast", "sensor_temperature")}
    columns = {"noise": noise, "walk": np.cumsum(noise), "clock": data.time, **others}
    others = {name: column for name, column in columns.items() if name not in declared}
    output = undeclared(fit(data, "auto").calibration, data, others)
    if "ballast" in declared:
        assert not output
    else:
        (line,) = output
        assert line.startswith("column 'ballast' is not declared and moves the field, by about ")
        assert line.endswith("--parameter ballast")


# ---- Parts left out: which they are, what a fit without them predicts, and which fit they prefer ---------


FIELD = np.array([21_000.0, 2_000.0, 42_000.0])
BOOTS = np.repeat([0, 1, 2], [400, 100, 100])


def copter(seed: int, n: int = 1200, size: float = 800.0, memory: float = 0.97) -> Observations:
    """Return a copter's log: all headings, tilts of 12 deg, the first third disturbed three times as much."""
    rng = np.random.default_rng(seed)
    angles = np.column_stack([lfilter([0.2], [1.0, -0.98], rng.normal(size=n)) * 3.0 for _ in range(2)])
    heading = np.cumsum(rng.normal(0.0, 6.0, n)) + np.linspace(0.0, 1500.0, n)
    turned = Rotation.from_euler("ZYX", np.column_stack([heading, 12.0 * np.tanh(angles)]), degrees=True)
    field = turned.inv().apply(FIELD) @ (np.eye(3) + rng.normal(0.0, 0.005, (3, 3)))
    lasting = lfilter([np.sqrt(1.0 - memory**2)], [1.0, -memory], rng.normal(0.0, size, (n, 3)), axis=0)
    lasting[: n // 3] = 3.0 * lasting[: n // 3] + rng.normal(0.0, 3.0 * size, 3)
    field = field + rng.normal(0.0, 500.0, 3) + lasting
    return Observations(
        field, np.full(n, np.linalg.norm(FIELD)), np.empty((n, 0)), time=0.1 * np.arange(float(n))
    )


def test_auto_is_better_than_one_ellipsoid_where_the_first_part_differs() -> None:
    """Each method is fitted to the first half and tested on the second half of six logs."""
    squares = {"nominal": 0.0, "auto": 0.0}
    for seed in range(6):
        data = copter(seed)
        late, first = data.part(data.time >= 60.0), replace(data.part(data.time < 60.0), runs=BOOTS)
        for method in squares:
            error, _ = in_sensor_units(fit(first, method).calibration, late)
            squares[method] += float(np.mean(error**2))
    assert squares["auto"] < 0.87**2 * squares["nominal"]


def smoothed(window: int, roll: float = 0.0, pitch: float = 20.0, n: int = 7200) -> Observations:
    """Return circles of 150 s, ten minutes up and ten down; each reading is the mean of some seconds."""
    rng, second = np.random.default_rng(7), np.arange(n)
    dive = lfilter([0.08], [1.0, -0.92], np.where(second // 600 % 2, pitch, -pitch))
    roll_s, pitch_s = (lfilter([0.06], [1.0, -0.94], rng.normal(0.0, size, n)) for size in (8.0, 2.0))
    angles = np.column_stack([2.4 * second, dive + pitch_s, roll + roll_s])
    field = Rotation.from_euler("ZYX", angles, degrees=True).inv().apply(FIELD)
    field = field @ (np.eye(3) + 0.01 * np.diag([1.0, -0.5, 0.3])) + np.array([900.0, -400.0, 300.0])
    field = np.column_stack([np.convolve(axis, np.full(window, 1.0 / window), "same") for axis in field.T])
    rows = second[(second > 60) & (second < n - 60)][::4]
    field, reference = field[rows] + rng.normal(0.0, 1.0, (len(rows), 3)), np.linalg.norm(FIELD)
    return Observations(
        field, np.full(len(rows), reference), np.empty((len(rows), 0)), time=rows.astype(float)
    )


def test_a_smoothed_field_is_as_unsure_as_it_is_wrong_in_attitudes_not_seen() -> None:
    """Groups of similar attitude that are held out show a missing term; runs alone give too small a sigma."""
    found = fit(smoothed(12))
    assert found.details["left_out_ratio"] > 1.5
    for roll, pitch in ((0.0, 20.0), (25.0, 20.0), (0.0, 55.0)):
        other = smoothed(12, roll, pitch, 2400)
        _, standardised = in_sensor_units(found.calibration, other.part(other.time % 600.0 > 90.0))
        assert np.sqrt(np.mean(standardised**2)) < 1.15
    clean = fit(smoothed(1))
    assert clean.details["left_out_ratio"] == 1.0
    for roll, pitch in ((0.0, 20.0), (25.0, 20.0)):
        _, standardised = in_sensor_units(clean.calibration, smoothed(1, roll, pitch, 2400))
        assert 0.6 < np.sqrt(np.mean(standardised**2)) < 1.3


# ---- runs held out of a fit one at a time, simulated and of a Seaglider's own magnetometer -----------------


COUNT_NT = 100.0
"""Resolution of the Seaglider's magnetometer, nT."""


@pytest.mark.real
def test_seaglider_dives_held_out(real_data: Path) -> None:
    """The nominal fit is at the sensor's quantisation; moving masses take a few per cent of it."""
    dives = sorted((real_data / "seaglider_sg167").glob("*.nc"))[:3]
    deployment = read(dives).isel(time=slice(None, None, 2))
    nominal, _ = hold_runs_out(observations(deployment, []), "nominal")
    moving, normalised = hold_runs_out(observations(deployment, ["vbdCC"]), "auto", 2)
    nominal, moving = (error[np.isfinite(error)] for error in (nominal, moving))
    assert rms(nominal) / COUNT_NT == pytest.approx(1.0, abs=0.03)
    assert 0.85 < rms(moving) / rms(nominal) < 1.02
    # each sigma includes the bias of the IGRF: 145 nT, in addition to 88
    assert 0.4 < np.nanstd(normalised) < 1.0


# ---- The messages of the fit -------------------------------------------------------------------------------


def test_readings_that_a_fit_multiplies_are_reported(glider: Gliders) -> None:
    """Anomalies shrink with the readings: a reference that is wrong along the track can do that unnoticed."""
    runs = glider(0, 2).runs
    reported = [fit(replace(runs, field=gain * runs.field), "nominal").warnings for gain in (1.0, 1.3, 0.8)]
    plain, shrunk, grown = (
        [one.values["low"] for one in warnings if one.code == "unusual_scales"] for warnings in reported
    )
    assert not plain
    assert shrunk[0] < 0.85
    assert grown[0] > 1.03


def test_warnings_are_in_a_pilot_s_words(glider: Gliders) -> None:
    words = "\n".join(warning.text for warning in fit(glider(0, 2).runs).warnings)
    assert "ballast was nearly always at 2 positions (-200 and 200 cm3)" in words
    assert "battpos and ballast always moved together" in words
    assert "roll stayed within" in words
    assert "the vertical offset is known only to" in words
    dives = glider(0, 2).runs.part(np.degrees(glider(0, 2).runs.attitude[:, 1]) < 0.0)
    one = replace(dives, parameters=dives.parameters[:, :1], names=("battpos",), units=("in",))
    assert "one_pitch_sign" in codes(fit(one))


def test_a_fit_from_a_corner_of_the_compass_is_not_supported(glider: Gliders) -> None:
    """Any iron fits samples that all head one way: a real ArduSub was 300 nT off there, 1,700 beyond."""
    runs = glider(0, 2).runs
    turned = np.degrees(runs.attitude[:, 2]) % 360.0
    found = fit(runs.part((turned > 200.0) & (turned < 260.0)), "nominal")
    assert not found.supported
    assert any("all headings lie within 60 degrees" in doubt for doubt in found.calibration.warnings)
    assert found.calibration.warnings[-1] in found.warnings[0].text
    assert fit(runs, "nominal").supported


def test_a_fit_that_the_data_cannot_hold_reports_it(glider: Gliders) -> None:
    runs = glider(0, 2).runs
    few = runs.part((np.asarray(runs.runs) < 2) & (np.cos(runs.attitude[:, 2]) > 0.5))
    found = fit(few, "cubic")
    assert not found.supported
    assert found.warnings[0].code == "unsupported_fit"
    assert found.warnings[0].severity == "error"
    assert fit(runs).supported
