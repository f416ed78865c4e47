"""Test a base station's variation in calibrations and surveys on a day with a varying field."""

import json
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from commands import Command
from scipy.spatial.transform import Rotation

from magbridge.cli.common import by_base_station
from magbridge.errors import DataError, WrongUse
from magbridge.field.igrf import igrf
from magbridge.field.reference import UNRECORDED_SIGMA_NT, variation_level_sigma, with_daily_variation
from magbridge.logs import read, write
from magbridge.logs.deployment import deployment
from magbridge.survey.read import corrected_by_others

START = 1_700_000_040.0
OFFSET = np.array([300.0, -200.0, 100.0])


def varied(time: np.ndarray) -> np.ndarray:
    """Return the variation of the field by a storm, nT."""
    return 250.0 * np.sin(2 * np.pi * (time - START) / 5400.0)


@pytest.fixture
def storm(here: Path) -> Path:
    """Return a vehicle's log, and the minute values of an observatory on that day."""
    time = START + 30.0 * np.arange(400.0)
    earth = igrf(np.array([-63.0]), np.array([45.0]), np.array([0.0]), time[:1])[0]
    field = earth * (1.0 + varied(time) / np.linalg.norm(earth))[:, None]
    body = Rotation.random(len(time), rng=np.random.default_rng(3)).apply(field) + OFFSET
    place = {"latitude": np.full(400, 45.0), "longitude": np.full(400, -63.0), "depth": np.zeros(400)}
    axes = {f"mag_{axis}": body[:, k] for k, axis in enumerate("xyz")}
    write(deployment("made", time, axes | place), "log.csv")
    lines = [" Format                 IAGA-2002|", " IAGA Code              MDE|",
             "DATE       TIME         DOY     MDEX      MDEY      MDEZ      MDEF   |"]  # fmt: skip
    for t in START - 600.0 + 60.0 * np.arange(230.0):
        stamp = datetime.fromtimestamp(t, UTC)
        lines.append(f"{stamp:%Y-%m-%d %H:%M:%S}.000 {stamp:%j}     0.00 0.00 0.00 {50_000 + varied(t):.2f}")
    (here / "mde.min").write_text("\n".join(lines) + "\n")
    return here


def test_a_calibration_on_a_day_of_storm(storm: Path, command: Command) -> None:
    fit = "calibrate", "log.csv", "--method", "nominal", "-o", "cal.json", "--json"
    bare, listed, named = (
        json.loads(command(*fit, *more).out) for more in ([], ["mde.min"], ["--base-station", "mde.min"])
    )
    assert bare["rms_nT"] > 80
    assert listed["rms_nT"] == named["rms_nT"] < 5
    np.testing.assert_allclose(named["paper"]["T_nT"], OFFSET, rtol=0, atol=3)
    assert named["samples"] == listed["samples"] == 400
    assert json.loads((storm / "cal.json").read_text())["inputs"].keys() == {"log.csv", "mde.min"}


def test_an_observatory_among_the_logs_of_a_survey(storm: Path) -> None:
    """The observatory's file is used as the base station, whether found among the logs or named."""
    log, station = read("log.csv"), read("mde.min")
    for logs, base in (([log, station], None), ([log], Path("mde.min"))):
        (found,) = by_base_station(logs, base)
        variation = found["daily_variation"].to_numpy()
        expected = varied(log["time"].to_numpy())
        np.testing.assert_allclose(variation - variation.mean(), expected - expected.mean(), rtol=0, atol=0.5)
    assert by_base_station([log], None) == [log]


def test_a_station_of_another_day(storm: Path) -> None:
    log, station = read("log.csv"), read("mde.min")
    with pytest.raises(DataError, match=r"^mde\.min: does not cover the time of log\.csv$"):
        with_daily_variation([log.assign_coords(time=log["time"] + 86_400.0)], station)


def test_samples_that_a_station_does_not_cover_are_left_out_with_one_warning(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The station has a hole of 300 s, and ends 305 s before the log; a gap of 30 s is interpolated."""
    time = START + np.arange(0.0, 1800.0, 5.0)
    at = np.arange(START, START + 1500.0)
    hole = (at > START + 600.0) & (at < START + 900.0)
    short = (at > START + 1200.0) & (at < START + 1230.0)
    base = deployment("base", at[~hole & ~short], {"total_field": 50_000.0 + varied(at[~hole & ~short])})
    write(base, here / "base.csv")
    (found,) = by_base_station([deployment("log", time, {"mag_x": 0.0 * time})], Path("base.csv"))
    variation = found["daily_variation"].to_numpy()
    since = time - START
    unknown = ((since > 600.0) & (since < 900.0)) | (since > 1559.0)
    np.testing.assert_array_equal(np.isnan(variation), unknown)
    error = (variation - varied(time))[~unknown & (since < 1500.0)]
    assert np.ptp(error) < 0.1
    said = [line for line in capsys.readouterr().err.splitlines() if "does not cover" in line]
    assert len(said) == 1
    assert "530 s of the logs (295 s in one piece)" in said[0]


@pytest.mark.parametrize("hours", [2.0, 6.0, 12.0])
def test_the_level_of_a_base_station_is_uncertain(hours: float) -> None:
    """The true level is that of all days: of a daily variation and a faster one, of random phases."""
    rng = np.random.default_rng(1)
    time = START + np.arange(0.0, 3600.0 * hours, 60.0)
    log = deployment("log", time, {"anomaly": 0.0 * time, "latitude": 0.0 * time, "longitude": 1e-5 * time})
    off, sigma = [], []
    for _ in range(60):
        phases = rng.uniform(0.0, 2.0 * np.pi, 2)
        variation = 20.0 * np.sin(2.0 * np.pi * time / 86_400.0 + phases[0])
        variation += 15.0 * np.sin(2.0 * np.pi * time / 18_000.0 + phases[1])
        field = 50_000.0 + variation + rng.normal(0.0, 0.2, time.size)
        base = deployment("base", time, {"total_field": field})
        (found,) = with_daily_variation([log], base)
        off.append(float(np.mean(found["daily_variation"].to_numpy() - variation)))
        sigma.append(corrected_by_others(found).level_sigma)
    assert 0.5 < np.sqrt(np.mean(np.square(off) / np.square(sigma))) < 1.25
    exact = found.assign(level_sigma=("time", np.full(time.size, 100.0)))
    assert corrected_by_others(exact).level_sigma == pytest.approx(np.hypot(100.0, sigma[-1]))
    assert corrected_by_others(log).level_sigma == UNRECORDED_SIGMA_NT > max(sigma)


def test_whole_days_of_a_base_station_determine_its_level() -> None:
    time = START + np.arange(0.0, 20 * 86_400.0, 300.0)
    field = 50_000.0 + 20.0 * np.sin(2.0 * np.pi * time / 86_400.0)
    field += np.random.default_rng(0).normal(size=time.size)
    base = deployment("base", time, {"total_field": field})
    (found,) = with_daily_variation([deployment("log", time, {})], base)
    assert variation_level_sigma(found) < 3.0


def test_two_observatories_are_not_one_base_station() -> None:
    time = START + np.arange(9.0)
    log = deployment("log", time, {"mag_x": np.ones(9)})
    first, second = (
        deployment(f"{code}.min", time, {"total_field": np.full(9, 5e4)}, attrs={"observatory": code})
        for code in ("A", "B")
    )
    with pytest.raises(WrongUse, match=r"A\.min and B\.min: expected logs of one observatory, got several"):
        by_base_station([log, first, second], None)
    (found,) = by_base_station([log, first, first.assign_coords(time=time + 9)], None)
    assert (found["daily_variation"] == 0).all()
