"""`magbridge navigate` as a user has it: a log or a plan, maps of every kind, and what it answers."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from voyages.simulated import voyage

from magbridge.calibration.file import save
from magbridge.calibration.model import Noise, identity
from magbridge.cli import main
from magbridge.field.grid import AnomalyGrid
from magbridge.logs import read, write
from magbridge.navigate.options import Options

PLAN = """time,latitude,longitude
1386201600,49.48,-57.95
1386208800,49.50,-57.90
1386216000,49.50,-57.85
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, grid: AnomalyGrid, options: Options) -> Path:
    """A log of two hours whose channels are the field itself, its map, a calibration that changes nothing."""
    path = tmp_path_factory.mktemp("navigate")
    ds = voyage(grid, options, 6, hours=2.0)
    field = ds["total_field"].to_numpy()
    unit = {"units": "nT"}
    channels = {"mag_x": 0.6 * field, "mag_y": 0.0 * field, "mag_z": 0.8 * field}
    log = ds.drop_vars(["total_field", "total_field_sigma", "away_north", "away_east"]).assign(
        {name: ("time", values, unit) for name, values in channels.items()}
    )
    # GPS at the start: the dead-reckoned position there, which is the truth less what it was off
    first = {"gps_latitude": 49.5, "gps_longitude": -57.9}
    for name, value in first.items():
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


def run(folder: Path, *arguments: str, calibration: bool = True) -> int:
    given = ["--calibration", str(folder / "cal.json")] if calibration else []
    return main(["navigate", *arguments, *given, "-o", str(folder / "out.nc")])


def test_a_log_against_its_map(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = folder / "track.png"
    code = run(
        folder,
        *(str(folder / "log.nc"), "--map", str(folder / "grid.nc"), "--config", str(folder / "bridge.toml")),
        *("--picture", str(picture), "--json"),
    )
    assert code == 0
    said = capsys.readouterr()
    result = json.loads(said.out)
    assert result["findings"] == said.err == ""
    track = read(folder / "out.nc")
    error = np.hypot(track["error_north"], track["error_east"])
    assert result["error_m"] == pytest.approx(float((error**2).mean()) ** 0.5)
    alone = np.hypot(track["error_north"] - track["north"], track["error_east"] - track["east"])
    assert result["dead_reckoning_error_m"] == pytest.approx(float((alone**2).mean()) ** 0.5)
    assert 0.0 < result["valid"] <= 1.0
    assert float(error[-100:].mean()) < 150.0
    assert picture.stat().st_size > 40_000


def test_a_map_that_cannot_be_meant_is_one_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with xr.open_dataset(folder / "grid.nc") as whole:
        whole.assign(anomaly=whole["anomaly"] + 52_000.0).to_netcdf(folder / "bad.nc")
    assert run(folder, str(folder / "log.nc"), "--map", str(folder / "bad.nc")) == 1
    line = capsys.readouterr().err
    assert "subtract the IGRF first" in line
    assert line.count("\n") == 1


def test_a_plan_is_told_what_the_map_is_worth(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = folder / "bound.png"
    plan = (str(folder / "plan.csv"), "--map", str(folder / "grid.nc"), "--bound")
    assert run(folder, *plan, "--picture", str(picture), calibration=False) == 0
    assert "dead reckoning alone" in capsys.readouterr().out
    bound = read(folder / "out.nc")
    assert (bound["sigma"] <= bound["unaided"]).all()
    assert picture.stat().st_size > 20_000


@pytest.mark.parametrize(
    ("text", "answer"),
    [(PLAN.replace("1386216000", "1386201000"), "time"), (PLAN.replace("longitude", "x"), "longitude")],
)
def test_a_plan_that_cannot_be_flown_is_one_line(
    folder: Path, capsys: pytest.CaptureFixture[str], text: str, answer: str
) -> None:
    (folder / "bad.csv").write_text(text)
    plan = (str(folder / "bad.csv"), "--map", str(folder / "grid.nc"), "--bound")
    assert run(folder, *plan, calibration=False) in {1, 2}
    line = capsys.readouterr().err
    assert answer in line
    assert line.count("\n") == 1


def test_wrong_use_is_one_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(folder, str(folder / "log.nc"), "--map", str(folder / "grid.nc"), calibration=False) == 2
    assert "expected --calibration" in capsys.readouterr().err
    (folder / "other.toml").write_text("[navigation.options]\nstart_sgma = 1.0\n")
    others = (
        *(str(folder / "log.nc"), "--map", str(folder / "grid.nc")),
        *("--config", str(folder / "other.toml")),
    )
    assert run(folder, *others) == 2
    assert "navigation.options.start_sgma: unknown key" in capsys.readouterr().err
    (folder / "other.toml").write_text("[navigation.options]\nstart_sigma = -1.0\n")
    assert run(folder, *others) == 2
    assert "navigation.options.start_sigma: expected `float` > 0.0" in capsys.readouterr().err
