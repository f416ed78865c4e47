"""Test one map from raw logs: several vehicles, a base station, and the message for a bad log."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from commands import Command
from rock import Rock
from scipy.spatial.transform import Rotation

from magbridge.arrays import FloatArray
from magbridge.calibration.file import save
from magbridge.calibration.model import Noise, identity
from magbridge.field.geodesy import offset
from magbridge.field.igrf import igrf
from magbridge.field.read import read_grid
from magbridge.logs import read_each, write
from magbridge.logs.deployment import deployment
from magbridge.records import Quality

ORIGIN, START, STEP = (49.5, -57.9), 1.4e9, 20.0
NOISE = 1.5
IRON = {
    "comet": (np.array([900.0, -600.0, 1200.0]), 40.0),
    "rocket": (np.array([-400.0, 300.0, 700.0]), -20.0),
}
"""nT: the hard iron of each vehicle, and by how much its calibration makes the field too large."""


rock = Rock(np.random.default_rng(5), 50.0, 900.0).at


def lanes(axis: int, count: int = 6) -> FloatArray:
    """Return places (n, 2), m, of parallel lines along an axis, back and forth, with the ways between."""
    along = np.linspace(-2600.0, 2600.0, 44)
    turned = [along[:: 1 if k % 2 else -1] for k in range(count)]
    across = np.linspace(-2400.0, 2400.0, count) if count > 1 else np.zeros(1)
    lines = [np.stack([one, np.full(44, y)], axis=1) for one, y in zip(turned, across, strict=True)]
    return np.roll(with_ways(lines), axis, axis=1)


def with_ways(legs: list[FloatArray]) -> FloatArray:
    """Return the places (n, 2), m, of legs (m, 2) and of the ways from one to the next."""
    parts = legs[:1]
    for last, leg in pairwise(legs):
        steps = int(np.linalg.norm(leg[0] - last[-1]) / 120.0) + 2
        parts += [np.linspace(last[-1], leg[0], steps)[1:-1], leg]
    return np.concatenate(parts)


def flown(
    vehicle: str, place: FloatArray, began: float = START, varied: FloatArray | float = 0.0
) -> xr.Dataset:
    """Return what a vehicle reads at places (n, 2), m, on a day on which the field `varied` (n,), nT."""
    rng = np.random.default_rng(len(vehicle))
    latitude, longitude = offset(*ORIGIN, place[:, 0], place[:, 1])
    n = len(place)
    main = igrf(longitude, latitude, np.zeros(n), np.full(n, began))
    total = np.linalg.norm(main, axis=1)
    ned = main * ((total + rock(place) + varied) / total)[:, None]
    way = np.gradient(place, axis=0)
    attitude = np.stack([np.degrees(np.arctan2(way[:, 1], way[:, 0])), *rng.normal(0, 8.0, (2, n))], axis=1)
    body = Rotation.from_euler("ZYX", attitude, degrees=True).inv().apply(ned)
    read = body + IRON[vehicle][0] + rng.normal(0, NOISE, (n, 3))
    names = "mag_x", "mag_y", "mag_z", "heading", "pitch", "roll", "latitude", "longitude"
    columns = dict(zip(names, (*read.T, *attitude.T, latitude, longitude), strict=True))
    return deployment(vehicle, began + STEP * np.arange(n), columns)


def calibrated(vehicle: str, path: Path, **slow: float) -> Path:
    """Write the vehicle's calibration: its hard iron, exactly, on a wrong level, with slow noise."""
    iron, level = IRON[vehicle]
    coefficients = np.array([level, level, level, 0.0, 0.0, 0.0, *iron])
    known = replace(
        identity(), coefficients=coefficients, covariance=1e-6 * np.eye(9), noise=Noise(NOISE, **slow),
        method="auto",
    )  # fmt: skip
    save(known, path)
    return path


def judged(command: Command, folder: Path, *words: object) -> tuple[FloatArray, FloatArray, dict[str, Any]]:
    """Return the error (n,) of a survey's map about its mean, at places inside, its sigma, and the facts."""
    facts = json.loads(command("survey", *words, "-o", folder / "map.nc", "--json").out)
    grid = read_grid(folder / "map.nc")
    at = np.random.default_rng(7).uniform(-2200.0, 2200.0, (300, 2))
    latitude, longitude = offset(*ORIGIN, at[:, 0], at[:, 1])
    there = grid.evaluate(longitude, latitude)
    error = there.anomaly - rock(at)
    return error - error.mean(), np.sqrt(there.variance), facts


def test_two_vehicles_with_a_calibration_each_make_one_map(command: Command, tmp_path: Path) -> None:
    """Their hard irons differ, and their levels by 64 nT: no seam remains, and the sigma is consistent."""
    words: list[object] = []
    for axis, vehicle in enumerate(IRON):
        write(flown(vehicle, lanes(axis), START + 1e5 * axis), tmp_path / f"{vehicle}.nc")
        words.append(tmp_path / f"{vehicle}.nc")
    for vehicle in IRON:
        words += ["--calibration", calibrated(vehicle, tmp_path / f"{vehicle}.json")]
    error, sigma, facts = judged(command, tmp_path, *words)
    assert facts["lines"] == 2
    assert facts["misties_before_nT"] == pytest.approx(64.0, abs=2.0)
    assert facts["misties_after_nT"] < 2.0 * NOISE
    assert np.std(error) < 3.0 * NOISE
    assert 0.4 < np.sqrt(np.mean((error / sigma) ** 2)) < 1.3


def test_a_small_slow_part_of_the_noise_is_not_all_of_it(command: Command, tmp_path: Path) -> None:
    write(flown("comet", lanes(0)), tmp_path / "log.nc")
    slow = {"autocorrelation": 0.998, "interval": STEP, "white": 0.99}
    words = tmp_path / "log.nc", "--calibration", calibrated("comet", tmp_path / "cal.json", **slow)
    error, sigma, facts = judged(command, tmp_path, *words)
    assert facts["noise_nT"] == pytest.approx(NOISE, rel=0.2)
    assert np.std(error) < 3.0 * NOISE
    assert 0.4 < np.sqrt(np.mean((error / sigma) ** 2)) < 1.3


def test_a_base_station_takes_a_daily_variation_off(command: Command, tmp_path: Path) -> None:
    """Forty minutes, 25 nT: left in the log, it is in the map."""
    place = with_ways([lanes(0), lanes(1)])
    time = STEP * np.arange(-10.0, len(place) + 10.0)
    varied = 25.0 * np.sin(2.0 * np.pi * time / 2400.0)
    write(flown("comet", place, varied=varied[10:-10]), tmp_path / "log.nc")
    write(deployment("base", START + time, {"total_field": 53_000.0 + varied}), tmp_path / "base.nc")
    words = tmp_path / "log.nc", "--calibration", calibrated("comet", tmp_path / "cal.json")
    error, sigma, _ = judged(command, tmp_path, *words, "--base", tmp_path / "base.nc")
    assert np.std(error) < 1.5
    assert np.std(error) < 1.25 * np.median(sigma)


def test_without_a_base_station_the_level_is_less_certain_than_with_one(
    command: Command, tmp_path: Path
) -> None:
    """Four hours of a daily variation of 30 nT are an error of the level, which the sigma has to cover."""
    place = with_ways([lanes(0), lanes(1)])
    time = STEP * np.arange(-10.0, len(place) + 10.0)
    varied = 30.0 * np.sin(2.0 * np.pi * time / 86_400.0)
    raw = flown("comet", place)
    columns = {
        "anomaly": ("time", rock(place) + varied[10:-10], {"units": "nT"}),
        "line": ("time", (np.arange(len(place)) // 60).astype(float)),
    }
    log = raw.drop_vars(["mag_x", "mag_y", "mag_z"]).assign(columns)
    write(log, tmp_path / "log.nc")
    base = xr.Dataset({"total_field": ("time", 53_000.0 + varied, {"units": "nT"})}, {"time": START + time})
    write(base, tmp_path / "base.nc")
    words = "survey", tmp_path / "log.nc", "-o", tmp_path / "map.nc"
    with_base = command.json(*words, "--base", tmp_path / "base.nc")["level_sigma_nT"]
    level_sigma = command.json(*words)["level_sigma_nT"]
    assert level_sigma > with_base > 5.0
    grid = read_grid(tmp_path / "map.nc")
    assert grid.level_sigma == level_sigma
    latitude, longitude = offset(*ORIGIN, place[::5, 0], place[::5, 1])
    error = np.mean(grid.evaluate(longitude, latitude).anomaly - rock(place[::5]))
    assert error == pytest.approx(np.mean(varied), abs=2.0)
    assert 0.3 < error / level_sigma < 1.5
    assert f"level known to {level_sigma:.1f} nT" in command(*words).out
    write(log.assign(level_sigma=("time", np.full(len(place), 100.0))), tmp_path / "log.nc")
    assert command.json(*words)["level_sigma_nT"] == pytest.approx(np.hypot(100.0, level_sigma))


def test_what_correct_has_flagged_and_what_has_no_place_stay_out_of_the_map(
    command: Command, tmp_path: Path
) -> None:
    """A corrected log makes the map that its raw log makes; a flagged sample may be off by anything.

    Nor does a hole in the positions count as a straight line from one end to the other.
    """
    write(flown("comet", with_ways([lanes(0), lanes(1)])), tmp_path / "log.nc")
    cal = calibrated("comet", tmp_path / "cal.json")
    command("correct", tmp_path / "log.nc", "--calibration", cal, "-o", tmp_path / "corrected.nc")
    (corrected,) = read_each([tmp_path / "corrected.nc"])
    spoilt = corrected.load().copy(deep=True)
    spoilt["anomaly"][::10] += 80.0
    spoilt["quality"][::10] = float(Quality.MOVING)
    spoilt["latitude"][100:170] = np.nan
    write(spoilt, tmp_path / "spoilt.nc")
    error, _, facts = judged(command, tmp_path, tmp_path / "spoilt.nc")
    flags = spoilt["quality"].to_numpy().astype(int) & ~int(Quality.NO_BORESIGHT)
    used = (flags == 0) & np.isfinite(spoilt["latitude"].to_numpy())
    assert facts["samples"] == used.sum() < 0.81 * len(flags)
    assert np.std(error) < 1.5


def test_flagged_samples_that_stay_out_of_the_map_are_counted(command: Command, tmp_path: Path) -> None:
    """Half of a log cannot be the Earth's field: its crossings went with it, and nothing told why."""
    log = flown("comet", with_ways([lanes(0), lanes(1)]))
    n = log.sizes["time"]
    log["mag_x"][n // 2 :] += 40_000.0
    write(log, tmp_path / "log.nc")
    words = tmp_path / "log.nc", "--calibration", calibrated("comet", tmp_path / "cal.json")
    facts = json.loads(command("survey", *words, "-o", tmp_path / "map.nc", "--json").out)
    (told,) = (warning for warning in facts["warnings"] if "flagged" in warning)
    assert told.startswith(f"{n - facts['samples']} of {n} samples are flagged and left out: ")
    assert "implausible" in told
    log["mag_x"][: n // 2] += 40_000.0
    write(log, tmp_path / "log.nc")
    said = command("survey", *words, "-o", tmp_path / "map.nc", code=1).err
    assert f"only 0 samples with a field and a position; {n} of {n} samples are flagged" in said


def test_lines_of_a_raw_log_get_a_level_each_and_without_them_the_misties_are_told(
    command: Command, tmp_path: Path
) -> None:
    """Eight lines whose levels differ by 12 nT: the mis-ties are ten times the noise."""
    place = np.concatenate([lanes(0, 4), lanes(1, 4)])
    half = np.arange(len(place) // 2) // 57  # 44 places of a line, 13 of the way to the next
    line = np.concatenate([half, half + 4])
    levels = np.random.default_rng(3).normal(0.0, 12.0, line.max() + 1)[line]
    log = flown("comet", place, varied=levels)
    words = tmp_path / "log.nc", "--calibration", calibrated("comet", tmp_path / "cal.json")
    write(log, tmp_path / "log.nc")
    *_, facts = judged(command, tmp_path, *words)
    assert any("a column line gives each line a level of its own" in text for text in facts["warnings"])
    write(log.assign(line=("time", line.astype(float))), tmp_path / "log.nc")
    error, _, facts = judged(command, tmp_path, *words)
    assert facts["lines"] == line.max() + 1
    assert facts["misties_after_nT"] < 0.3 * facts["misties_before_nT"]
    assert np.std(error) < 3.0 * NOISE
    assert not any("crossings differ" in text for text in facts["warnings"])


def test_one_straight_line_has_a_crustal_field(command: Command, tmp_path: Path) -> None:
    """Distinguished or not, changes along it are neither noise nor only the vehicle's."""
    place = np.stack([np.linspace(-3000.0, 3000.0, 300), np.zeros(300)], axis=1)
    write(flown("comet", place), tmp_path / "log.nc")
    map_file = tmp_path / "map.nc"
    said = command("survey", tmp_path / "log.nc", "-o", map_file).err
    assert "do not support this fit" in said
    assert "never crossed your own track" in said
    latitude, longitude = offset(*ORIGIN, place[20:-20:5, 0], place[20:-20:5, 1])
    there = read_grid(map_file).evaluate(longitude, latitude)
    error = there.anomaly - rock(place[20:-20:5])
    error -= error.mean()
    assert np.std(error) < 1.5
    assert np.sqrt(np.mean(error**2 / there.variance)) < 1.5
