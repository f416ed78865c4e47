"""Test `magbridge navigate` with a log or a plan, with maps of every kind, and its output."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from commands import Command
from voyages import track_over

from magbridge.calibration.file import save
from magbridge.calibration.model import Noise, identity
from magbridge.field.grid import AnomalyGrid
from magbridge.logs import read, write
from magbridge.navigate.options import NavigationOptions

PLAN = """time,latitude,longitude
1386201600,49.48,-57.95
1386208800,49.50,-57.90
1386216000,49.50,-57.85
"""
TRACK = ("navigate", "log.nc", "--map", "grid.nc", "-o", "out.nc")
BOUND = ("navigate", "--bound", "--map", "grid.nc", "-o", "out.nc")
CALIBRATED = ("--calibration", "cal.json")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, grid: AnomalyGrid, options: NavigationOptions) -> Path:
    """Return a folder with a log of two hours without disturbance, its map, and a neutral calibration."""
    path = tmp_path_factory.mktemp("navigate")
    ds = track_over(grid, options, 6, hours=2.0)
    field = ds["total_field"].to_numpy()
    log = ds.drop_vars(["total_field", "total_field_sigma", "away_north", "away_east"]).assign(
        {f"mag_{k}": ("time", c * field, {"units": "nT"}) for k, c in (("x", 0.6), ("y", 0.0), ("z", 0.8))}
    )
    # GPS at the start: the dead-reckoned position, which is the truth less its error
    for name, value in (("gps_latitude", 49.5), ("gps_longitude", -57.9)):
        log[name] = xr.full_like(log["depth"], np.nan)
        log[name][0] = value
    write(log, path / "log.nc")
    perfect = replace(identity(), covariance=1e-6 * np.eye(9), noise=Noise(1.0), method="nominal")
    save(perfect, path / "cal.json")
    grid.save(path / "grid.nc")
    (path / "plan.csv").write_text(PLAN)
    (path / "bridge.toml").write_text(
        "[navigation.options]\nstart_sigma = 200.0\ncurrent_sigma = 0.05\nbias_sigma = 1.0\nmap_sigma = 1.0\n"
    )
    return path


@pytest.fixture
def here(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(folder)
    return folder


def test_a_log_against_its_map(command: Command) -> None:
    texts = command(*TRACK, *CALIBRATED, "--config", "bridge.toml", "--plot", "track.png", "--json")
    result = json.loads(texts.out)
    assert result["findings"] == texts.err == ""
    found = read("out.nc")
    error = np.hypot(found["error_north"], found["error_east"])
    assert result["error_m"] == pytest.approx(float((error**2).mean()) ** 0.5)
    alone = np.hypot(found["error_north"] - found["north"], found["error_east"] - found["east"])
    assert result["dead_reckoning_error_m"] == pytest.approx(float((alone**2).mean()) ** 0.5)
    assert 0.0 < result["valid"] <= 1.0
    assert float(error[-100:].mean()) < 150.0
    assert Path("track.png").stat().st_size > 40_000


def test_a_map_that_cannot_be_meant_is_one_line(command: Command) -> None:
    with xr.open_dataset("grid.nc") as whole:
        whole.assign(anomaly=whole["anomaly"] + 52_000.0).to_netcdf("bad.nc")
    asked = "navigate", "log.nc", "--map", "bad.nc", "-o", "out.nc"
    assert "subtract the IGRF first" in command.refuses(*asked, *CALIBRATED)


def test_a_plan_reports_the_value_of_the_map(command: Command) -> None:
    assert "dead reckoning alone" in command(*BOUND, "plan.csv", "--plot", "bound.png").out
    bound = read("out.nc")
    assert (bound["sigma"] <= bound["unaided"]).all()
    assert Path("bound.png").stat().st_size > 20_000


@pytest.mark.parametrize(
    ("text", "answer"),
    [(PLAN.replace("1386216000", "1386201000"), "time"), (PLAN.replace("longitude", "x"), "longitude")],
)
def test_a_plan_that_cannot_be_flown_is_one_line(command: Command, text: str, answer: str) -> None:
    Path("bad.csv").write_text(text)
    assert answer in command.refuses(*BOUND, "bad.csv", "--strict")


def test_a_log_that_is_corrected_needs_no_calibration(command: Command, here: Path) -> None:
    """Nor does that of a scalar magnetometer; both are navigated as the raw log is with its calibration."""
    command("correct", "log.nc", *CALIBRATED, "-o", "corrected.nc")
    away = [
        json.loads(command(*TRACK[:1], log, *TRACK[2:], *more, "--json").out)["error_m"]
        for log, more in (("log.nc", CALIBRATED), ("corrected.nc", ()))
    ]
    assert away[1] == pytest.approx(away[0], rel=0.3)


def test_wrong_use_is_one_line(command: Command) -> None:
    assert "expected a column total_field, or --calibration" in command.refuses(*TRACK, code=2)
    for text, line in (
        ("start_sgma = 1.0", "start_sgma: unknown key"),
        ("start_sigma = -1.0", "start_sigma: expected `float` > 0.0"),
    ):
        Path("other.toml").write_text(f"[navigation.options]\n{text}\n")
        texts = command.refuses(*TRACK, *CALIBRATED, "--config", "other.toml", code=2)
        assert f"navigation.options.{line}" in texts


def test_without_a_map_the_track_is_bent_to_its_own_survey(command: Command, here: Path) -> None:
    """One smoothed track with its covariance; what can only be done with a map is refused in a line."""
    given = "navigate", "log.nc", *CALIBRATED, "--config", "bridge.toml", "--plot", "own.png"
    texts = command(*given, "-o", "own.nc")
    assert "dead reckoning alone" in texts.err
    track = read([Path("own.nc")])
    assert (track["covariance_nn"] > 0.0).all()
    assert (track["bound_sigma"] < 1.001 * track["unaided_sigma"]).all()
    assert "no estimator could be better than" in texts.err
    assert Path("own.png").stat().st_size > 40_000
    texts = command("navigate", "--bound", "log.nc", *CALIBRATED, "-o", "none.nc", code=2)
    assert "expected --map" in texts.err
    assert "gives the accuracy of a survey that was flown" in texts.err
    assert not Path("none.nc").exists()


def test_a_bound_takes_the_log_s_own_rate(command: Command, here: Path) -> None:
    """The interval is that of the log, of the calibration, or 4 s, unless an option states it."""
    slow = read([Path("log.nc")]).isel(time=slice(None, None, 5))
    write(slow.assign(latitude=slow["truth_latitude"], longitude=slow["truth_longitude"]), "slow.nc")
    for words, every in (("slow.nc", 20.0), ("plan.csv", 4.0), ("plan.csv --sample-interval 0.2", 0.2)):
        facts = json.loads(command(*BOUND, *words.split(), "--json").out)
        assert facts["sample_interval_s"] == pytest.approx(every)
