"""A scalar magnetometer on lines and ties: lag, lever arm and heading error, from the survey alone."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import xarray as xr
from commands import Command

import magbridge as mb
from magbridge import logs
from magbridge.arrays import FloatArray, IndexArray
from magbridge.field.geodesy import offset
from magbridge.field.igrf import igrf, magnitude
from magbridge.survey.run import Result

ORIGIN = 49.5, -57.9
SPEED_M_S, RATE_HZ, SIDE_M = 15.0, 2.0, 1_000.0
LAG_S, LEVER_M, NOISE_NT = 0.3, np.array([1.5, -0.8]), 0.05
SENSOR = "mag_tail"


class Grid(NamedTuple):
    """A simulated survey."""

    log: xr.Dataset
    truth: FloatArray
    """Anomaly at the sensor's place, nT."""
    line: IndexArray


def rock(random: np.random.Generator, depth: float) -> tuple[FloatArray, FloatArray]:
    """Return wave numbers (m, 2) and phases of sources at random `depth` m below the sensor."""
    wave = random.gamma(2.0, 0.5 / depth, 400)
    angle = random.uniform(0.0, 2 * np.pi, 400)
    return np.stack([wave * np.cos(angle), wave * np.sin(angle)], axis=1), random.uniform(0, 2 * np.pi, 400)


def grid(seed: int = 1, depth: float = 150.0) -> Grid:
    """Return lines 100 m and ties 500 m from each other, flown to and fro, with a level for each line."""
    random = np.random.default_rng(seed)
    waves, phases = rock(random, depth)
    along = np.arange(0.0, SIDE_M, SPEED_M_S / RATE_HZ)
    place, heading, line, time = [], [], [], []
    starts = [(across, 0.0) for across in np.arange(0.0, SIDE_M + 1, 100.0)]
    starts += [(across, 90.0) for across in np.arange(0.0, SIDE_M + 1, 500.0)]
    clock = 1.6e9
    for number, (across, course) in enumerate(starts):
        back = number % 2 == 1
        way = (SIDE_M - along) if back else along
        aside = across + 3.0 * np.sin(along / 200.0 + number)
        place.append(np.stack([way, aside] if course == 0.0 else [aside, way], axis=1))
        crab = 4.0 * np.sin(1.7 * number)
        heading.append(np.full(len(along), course + 180.0 * back + crab))
        line.append(np.full(len(along), number))
        time.append(clock + along / SPEED_M_S)
        clock += SIDE_M / SPEED_M_S + 30.0
    psi = np.radians(np.concatenate(heading))
    velocity = np.concatenate([np.gradient(part, axis=0) * RATE_HZ for part in place])
    position, label = np.concatenate(place), np.concatenate(line)
    forward, starboard = LEVER_M
    arm = [forward * np.cos(psi) - starboard * np.sin(psi), forward * np.sin(psi) + starboard * np.cos(psi)]
    sensor = position - LAG_S * velocity + np.stack(arm, axis=1)
    truth = 50.0 * np.sqrt(2 / len(waves)) * np.cos(sensor @ waves.T + phases).sum(axis=1)
    latitude, longitude = offset(*ORIGIN, position[:, 0], position[:, 1])
    clocks = np.concatenate(time)
    reading = magnitude(igrf(longitude, latitude, np.full(len(clocks), -80.0), clocks)) + truth
    reading += 2.0 * np.cos(psi - 0.7) + random.normal(0, 3.0, len(starts))[label]
    reading += random.normal(0, NOISE_NT, len(clocks))
    columns = {
        "latitude": (latitude, "deg"),
        "longitude": (longitude, "deg"),
        "depth": (np.full(len(psi), -80.0), "m"),
        "heading": (np.degrees(psi) % 360.0, "deg"),
        "line": (label.astype(float), "1"),
        SENSOR: (reading, "nT"),
    }
    log = xr.Dataset(
        {name: ("time", values, {"units": units}) for name, (values, units) in columns.items()},
        coords={"time": clocks},
        attrs={"source": "grid", "heading_reference": "true"},
    )
    return Grid(log, truth, label)


def left_over(found: Result, truth: FloatArray) -> float:
    """Return the standard deviation, nT, of the levelled samples about the truth."""
    assert len(found.samples.value) == len(truth)
    return float(np.std(found.samples.value - found.gridded.levels - truth))


@pytest.fixture(scope="module")
def flown() -> Grid:
    return grid()


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
    assert set(found.scalar.contribution) == {"heading error", "lag and lever arm"}


def test_command_with_a_known_shift(flown: Grid, tmp_path: Path, command: Command) -> None:
    log, out = tmp_path / "grid.nc", tmp_path / "map.nc"
    logs.write(flown.log, log)
    given = "survey", log, "--scalar", SENSOR, "-o", out, "--lever", "1.5,-0.8,0", "--lag", "0.3"
    facts = json.loads(command(*given, "--json").out)
    assert out.exists()
    assert facts["scalar"]["lag_s"] == {"value": 0.3, "sigma": 0.0}
    assert facts["misties_after_nT"] < 0.15
    assert "no_such" in command.refuses("survey", log, "--scalar", "no_such", "-o", out)
    assert "--save" in command.refuses(*given, "--save", tmp_path / "cal.json", code=2)
    assert "--scalar COLUMN" in command.refuses("survey", log, "--lag", "0.3", "-o", out, code=2)
