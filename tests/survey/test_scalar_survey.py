"""Test a scalar magnetometer on lines and ties: lag, lever arm and heading error from the survey only."""

import csv
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import xarray as xr
from commands import Command
from pages import blocks, commands
from rock import Rock
from scipy.spatial.transform import Rotation

import magbridge as mb
from magbridge import logs
from magbridge.arrays import FloatArray, IndexArray
from magbridge.field.geodesy import offset
from magbridge.field.igrf import igrf, magnitude
from magbridge.field.read import read_grid
from magbridge.field.reference import main_field
from magbridge.logs.deployment import deployment
from magbridge.survey.run import Result

ORIGIN = 49.5, -57.9
SPEED_M_S, RATE_HZ, SIDE_M = 15.0, 2.0, 1_000.0
LAG_S, LEVER_M, NOISE_NT = 0.3, np.array([1.5, -0.8]), 0.05
SENSOR = "mag_tail"
TRUE_NORTH = {"heading_reference": "true"}


class Grid(NamedTuple):
    """Simulated survey of a scalar magnetometer."""

    log: xr.Dataset
    truth: FloatArray
    """Anomaly at the sensor's place, nT."""
    line: IndexArray


def grid(
    seed: int = 1, side: float = SIDE_M, *, level: float = 3.0, error: float = 2.0, rise: float = 0.0
) -> Grid:
    """Return lines 100 m and ties 500 m from each other, flown to and fro, with a level for each line.

    `level` is the standard deviation of the lines' levels, and `error` the heading error's amplitude, nT. The
    height is within `rise` m of 80 m.
    """
    random = np.random.default_rng(seed)
    # sources at random depths, 150 m below the sensor
    rock = Rock.of_waves(50.0, random.gamma(2.0, 0.5 / 150.0, 400), *random.uniform(0.0, 2 * np.pi, (2, 400)))
    along = np.arange(0.0, side, SPEED_M_S / RATE_HZ)
    place, heading, line, time = [], [], [], []
    starts = [(across, 0.0) for across in np.arange(0.0, side + 1, 100.0)]
    starts += [(across, 90.0) for across in np.arange(0.0, side + 1, 500.0)]
    clock = 1.6e9
    for number, (across, course) in enumerate(starts):
        back = number % 2 == 1
        way = (side - along) if back else along
        aside = across + 3.0 * np.sin(along / 200.0 + number)
        place.append(np.stack([way, aside] if course == 0.0 else [aside, way], axis=1))
        crab = 4.0 * np.sin(1.7 * number)
        heading.append(np.full(len(along), course + 180.0 * back + crab))
        line.append(np.full(len(along), number))
        time.append(clock + along / SPEED_M_S)
        clock += side / SPEED_M_S + 30.0
    psi = np.radians(np.concatenate(heading))
    velocity = np.concatenate([np.gradient(part, axis=0) * RATE_HZ for part in place])
    position, label = np.concatenate(place), np.concatenate(line)
    forward, starboard = LEVER_M
    arm = [forward * np.cos(psi) - starboard * np.sin(psi), forward * np.sin(psi) + starboard * np.cos(psi)]
    sensor = position - LAG_S * velocity + np.stack(arm, axis=1)
    deeper = rise * np.sin(np.arange(len(psi)) / 6.0)
    truth = rock.at(sensor, deeper)
    latitude, longitude = offset(*ORIGIN, position[:, 0], position[:, 1])
    clocks = np.concatenate(time)
    reading = magnitude(igrf(longitude, latitude, deeper - 80.0, clocks)) + truth
    reading += error * np.cos(psi - 0.7) + random.normal(0, level, len(starts))[label]
    reading += random.normal(0, NOISE_NT, len(clocks))
    columns = {"latitude": latitude, "longitude": longitude, "depth": deeper - 80.0, SENSOR: reading}
    columns |= {"heading": np.degrees(psi) % 360.0, "line": label.astype(float)}
    return Grid(deployment("grid", clocks, columns, {SENSOR: "nT"}, TRUE_NORTH), truth, label)


def left_over(found: Result, truth: FloatArray) -> float:
    """Return the standard deviation, nT, of the levelled samples about the truth."""
    assert len(found.samples.value) == len(truth)
    return float(np.std(found.samples.value - found.gridded.levels - truth))


@pytest.fixture(scope="module")
def flown() -> Grid:
    return grid(side=800.0)


def test_shift_and_heading_error_are_found(flown: Grid) -> None:
    """The asked 0.1 nT include the noise of 0.05 nT; as read, crossings differ by 5 nT."""
    found = mb.survey([flown.log], scalar=SENSOR)
    assert found.scalar is not None
    assert found.scalar.along_m == pytest.approx(LEVER_M[0] - SPEED_M_S * LAG_S, abs=0.1)
    assert found.scalar.shift[2] == pytest.approx(LEVER_M[1], abs=0.1)
    assert abs(found.scalar.along_m - (LEVER_M[0] - SPEED_M_S * LAG_S)) < 4.0 * found.scalar.along_sigma_m
    assert left_over(found, flown.truth) < 0.1
    assert np.std(found.after) < 0.15 < 2.0 < found.scalar.misties_raw
    assert "lever - v * lag = -3.0" in found.scalar.summary()
    assert "cannot be separated at one speed" in found.scalar.summary()
    assert found.scalar.shift_sigma[0] > 0.4  # any lag with the lever arm that cancels it
    assert found.scalar.shift_sigma[1] > 0.4 * SPEED_M_S
    assert set(found.scalar.contribution) == {"heading error", "lag and lever arm"}
    # Levels of 3 nT on 14 lines hide a heading error of 2 nT.
    assert {finding.code for finding in found.scalar.findings} == {"scalar.shift"}


def test_shift_has_its_sigma_where_the_height_varies() -> None:
    """By 4.8 m, which changes the field by 15 times the noise."""
    found = mb.survey([grid(side=500.0, rise=2.4).log], scalar=SENSOR)
    assert found.scalar is not None
    assert abs(found.scalar.along_m - (LEVER_M[0] - SPEED_M_S * LAG_S)) < 3.0 * found.scalar.along_sigma_m
    assert abs(found.scalar.shift[2] - LEVER_M[1]) < 3.0 * found.scalar.shift_sigma[2]
    assert found.gridded.sigma == pytest.approx(NOISE_NT, rel=0.2)


def test_a_shift_that_no_sensor_has_is_a_warning_with_a_wide_sigma(flown: Grid) -> None:
    """With 13 nT of the vehicle's field and no calibration, a lag of 0.35 s was 4.85 s."""
    reading = flown.log[SENSOR].to_numpy().copy()
    for number in np.unique(flown.line):
        rows = flown.line == number
        reading[rows] = np.roll(reading[rows], 6)
    found = mb.survey([flown.log.assign({SENSOR: ("time", reading, {"units": "nT"})})], scalar=SENSOR)
    assert found.scalar is not None
    assert "scalar.implausible_shift" in [warning.code for warning in found.warnings]
    assert found.scalar.shift_sigma[0] >= abs(found.scalar.shift[0])


@pytest.mark.parametrize("error", [2.0, 0.0])
def test_a_heading_error_is_named_where_the_levels_of_lines_do_not_hide_it(error: float) -> None:
    found = mb.survey([grid(level=1.0, error=error).log], scalar=SENSOR)
    assert found.scalar is not None
    named = {finding.code for finding in found.scalar.findings}
    assert named == {"scalar.shift"} | ({"scalar.heading_error"} if error else set())
    assert found.scalar.heading_error[:2] == pytest.approx(error * np.array([0.76, 0.64]), abs=0.7)


def in_microtesla(log: xr.Dataset) -> xr.DataArray:
    """Return the scalar's reading in a declared unit other than nT."""
    return (1e-3 * log[SENSOR]).assign_attrs(units="uT")


def test_command_with_a_known_shift(flown: Grid, tmp_path: Path, command: Command) -> None:
    log, out = tmp_path / "grid.nc", tmp_path / "map.nc"
    lines = 10.0 * flown.log["line"] + 100.0
    logs.write(flown.log.assign({"line": lines, SENSOR: in_microtesla(flown.log)}), log)
    given = "survey", log, "--scalar", SENSOR, "-o", out, "--lever", "1.5,-0.8,0", "--lag", "0.3"
    crossings, tracks = tmp_path / "crossings.csv", tmp_path / "tracks.geojson"
    facts = json.loads(command(*given, "--crossovers", crossings, "--tracks", tracks, "--json").out)
    numbers = {f"{number:g}" for number in np.unique(lines).tolist()}
    rows = list(csv.DictReader(crossings.read_text().splitlines()))
    assert {row[name] for row in rows for name in ("line", "crossed")} == numbers
    features = json.loads(tracks.read_text())["features"]
    assert {feature["properties"]["line"] for feature in features} == numbers
    assert out.exists()
    assert facts["scalar"]["lag_s"] == {"value": 0.3, "sigma": 0.0}
    assert facts["misties_after_nT"] < 0.15
    assert "no_such" in command.refuses("survey", log, "--scalar", "no_such", "-o", out)
    assert "--save" in command.refuses(*given, "--save", tmp_path / "cal.json", code=2)
    assert "--scalar COLUMN" in command.refuses("survey", log, "--lag", "0.3", "-o", out, code=2)


def with_fluxgate(log: xr.Dataset, seed: int) -> xr.Dataset:
    """Return a log with roll, pitch, fluxgate and motor current, whose iron the scalar reads."""
    random = np.random.default_rng(seed)
    n, time = log.sizes["time"], log["time"].to_numpy()
    if "roll" not in log:
        log = log.assign(roll=("time", 3.0 * np.sin(time / 3.1)), pitch=("time", 2.0 * np.sin(time / 4.3)))
    angles = np.stack([log[name].to_numpy() for name in ("heading", "pitch", "roll")], axis=1)
    north_east_down = main_field(log)
    turned = Rotation.from_euler("ZYX", angles, degrees=True).inv().apply(north_east_down)
    total = magnitude(north_east_down)
    u = turned / total[:, None]
    current = 5.0 + 3.0 * np.sin(time / 11.0) + random.normal(0.0, 0.3, n)
    iron = u @ np.array([20.0, -12.0, 30.0]) + (current - 5.0) * (u @ np.array([2.0, -1.0, 1.5]))
    vector = turned + random.normal(0.0, 1.0, (n, 3))
    columns = {f"mag_{axis}": ("time", vector[:, k], {"units": "nT"}) for k, axis in enumerate("xyz")}
    columns["motor_current"] = ("time", current, {"units": "A"})
    return log.assign(columns | {SENSOR: log[SENSOR] + iron})


def box(start: float, minutes: float = 16.0) -> xr.Dataset:
    """Return rolls, pitches and yaws on four headings, high above the rock: the main field alone."""
    time = start + np.arange(0.0, 60.0 * minutes, 1.0 / RATE_HZ)
    leg, swing = (time - start) % 60.0, np.sin(2.0 * np.pi * (time - start) / 5.0)
    heading = 90.0 * ((time - start) // 60.0)
    heading += np.where((leg > 40) & (leg < 55), 5.0 * swing, 0.0)
    zero = np.zeros(len(time))
    columns = {"latitude": zero + ORIGIN[0] - 0.003, "longitude": zero + ORIGIN[1], "depth": zero - 500.0}
    columns |= {"heading": heading % 360.0, "line": zero + 900.0}
    columns["roll"] = np.where((leg > 5) & (leg < 20), 10.0 * swing, 0.3 * swing)
    columns["pitch"] = np.where((leg > 22) & (leg < 37), 5.0 * swing, 0.0)
    log = deployment("box", time, columns, attrs=TRUE_NORTH)
    noise = np.random.default_rng(int(start) % 1000).normal(0.0, NOISE_NT, len(time))
    return log.assign({SENSOR: ("time", magnitude(main_field(log)) + noise, {"units": "nT"})})


def test_the_page_runs_from_the_files_to_the_map(
    tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The survey has a box, a fluxgate, telemetry, and a calibration with this sensor."""
    flown = grid(seed=4, side=500.0)
    monkeypatch.chdir(tmp_path)
    logs.write(with_fluxgate(box(1.6e9 - 5_000.0), 1), Path("box.csv"))
    second = with_fluxgate(box(1.6e9 - 2_000.0, 8.0), 2)
    lines = with_fluxgate(flown.log, 3)
    logs.write(xr.concat([second, lines], "time", join="outer"), Path("survey.csv"))
    for block in blocks("sh"):
        for words in commands(block) if block.page == "docs/scalar.md" else ():
            command(*words[1:])
    assert len(Path("crossings.csv").read_text().splitlines()) > 6
    page = [block for block in blocks("python") if block.page == "docs/scalar.md"]
    scope: dict[str, Any] = {"__name__": "example"}
    for block in page:
        exec(compile(block.text, str(block), "exec"), scope)
    found: Result = scope["found"]
    assert found.scalar is not None
    assert {"permanent", "motor_current"} <= set(found.scalar.facts()["contribution_nT"])
    merit = found.scalar.facts()["figure_of_merit"]
    assert merit["after_nT"] < 0.5 * merit["before_nT"]
    assert any(warning.code == "box_samples" for warning in found.warnings)
    lines_only = found.samples.time >= flown.log["time"].to_numpy()[0]
    error = (found.samples.value - found.gridded.levels)[lines_only] - flown.truth
    assert np.std(error) < 0.3
    assert np.isfinite(read_grid(Path("map.nc")).anomaly).any()
