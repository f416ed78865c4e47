"""Test ten first hours: the commands of the documentation, word for word, on files like those of users."""

import json
import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import theirs
import xarray as xr
from pages import blocks
from small import polynomial
from station import free, get

from magbridge import logs
from magbridge.calibration.file import load, save
from magbridge.calibration.model import Calibration, Parameter

from .conftest import SHOWN, Walk


def right(file: str, within: float) -> None:
    """Assert that a corrected log shows the Earth's field, whatever the vehicle's own iron."""
    log = logs.read(file)
    error = log["total_field"].to_numpy() - theirs.FIELD
    assert np.sqrt(np.nanmean(error**2)) < within
    assert np.isfinite(error).mean() > 0.95


@pytest.fixture
def calibration(here: Path) -> Calibration:
    """Return the calibration of a vehicle with a moving mass and without a boresight."""
    coefficients = np.random.default_rng(1).normal(size=18) * 300.0
    made = polynomial(coefficients, Parameter("battpos", "in", -1.0, 1.0, 0.0, 1.0))
    save(made, here / "cal.json")
    return made


def test_an_engineer_with_a_german_spreadsheet(walk: Walk, here: Path) -> None:
    theirs.engineer(here / "mine.csv")
    # which column is the time?
    assert "stern position [mm]" in walk("magbridge info mine.csv", code=1).err
    (mapping,) = (one.text for one in blocks("toml") if "[columns.time]" in one.text)
    (here / "columns.toml").write_text(mapping)
    assert "nT" in walk("magbridge info mine.csv --columns columns.toml").out
    walk(
        'magbridge calibrate mine.csv --column time="when [%d.%m.%Y %H:%M:%S]" --column mag_x="F1 [uT]" '
        '--column mag_y="F2 [uT]" --column mag_z="F3 [uT]" --column battpos="stern position [mm]" '
        "--parameter battpos -o cal.json"
    )
    assert load("cal.json").parameters[0].high == 4.0


def test_a_scientist_with_a_slocum(walk: Walk, here: Path) -> None:
    theirs.slocum(here)
    walk("magbridge convert *.dbd *.ebd -o deployment.nc")
    walk("magbridge info deployment.nc")
    with xr.open_dataset("deployment.nc") as log:
        assert np.issubdtype(log["time"].dtype, np.datetime64)
        assert float(log["latitude"].max()) == pytest.approx(45.0, abs=0.1)
        assert log["battpos"].attrs["units"] == "in"
        assert log["time"].size >= 118


def test_a_pilot_with_ardupilots_log(walk: Walk, here: Path) -> None:
    theirs.ardupilot(here / "flight.BIN")
    assert "may move the field, for --parameter: battery_current" in walk("magbridge info flight.BIN").err
    walk("magbridge calibrate flight.BIN --parameter battery_current -o cal.json")
    walk("magbridge correct   flight.BIN --calibration cal.json -o corrected.csv")
    right("corrected.csv", 100.0)  # the log is in steps of 100 nT
    walk("magbridge calibrate flight.BIN --compass all -o cal.json")
    assert Path("cal_1.json").exists()


def test_a_pilot_with_px4s_log(walk: Walk, here: Path) -> None:
    pytest.importorskip("pyulog")
    theirs.pixhawk(here / "flight.ulg")
    walk("magbridge calibrate flight.ulg -o cal.json")
    walk("magbridge correct flight.ulg --calibration cal.json -o corrected.nc")
    right("corrected.nc", 20.0)


def test_a_roboticist_with_a_bag(walk: Walk, here: Path) -> None:
    pytest.importorskip("rosbags")
    theirs.bag(here / "my_bag")
    walk("magbridge calibrate my_bag/ -o cal.json")
    assert abs(load("cal.json").reference.field - theirs.FIELD) < 5.0


def test_an_integrator_attaches_a_bridge(walk: Walk, here: Path, calibration: Calibration) -> None:
    walk(
        "magbridge init --driver hmr2300 --port '/dev/ttyUSB*' --link udpout:192.0.2.1:14550 "
        "--calibration cal.json"
    )
    written = (here / "bridge.toml").read_text()
    assert "[telemetry.battpos]" in written
    assert "#" in written
    output = walk("magbridge run --check --config bridge.toml")
    assert "battpos" in output.out + output.err + written
    assert not list(here.glob("*.tlog"))


def test_an_operator_opens_the_page(here: Path) -> None:
    pytest.importorskip("nicegui")
    (shown,) = {words for words in SHOWN if words[:2] == ("magbridge", "monitor")}
    ports = [free(socket.SOCK_DGRAM), free(socket.SOCK_STREAM)]
    words = [word.replace("0.0.0.0:14550", f"127.0.0.1:{ports[0]}") for word in shown[1:]]
    page = subprocess.Popen(
        [sys.executable, "-m", "magbridge", *words, "--port", str(ports[1])],
        env={name: value for name, value in os.environ.items() if "PYTEST" not in name},  # NiceGUI reads it
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert "magbridge" in get(f"http://127.0.0.1:{ports[1]}/")
    finally:
        page.terminate()
        _, output = page.communicate(timeout=20)
    assert "Traceback" not in output


def test_a_surveyor_without_calibration_runs(walk: Walk, here: Path) -> None:
    rng = np.random.default_rng(2)
    rows = ["longitude,latitude,anomaly,line,line_type"]
    along, across = np.linspace(0.0, 4.0, 60), np.linspace(0.4, 3.6, 7)
    for number in range(14):
        east, north = (along, np.full(60, across[number % 7]))[:: 1 if number < 7 else -1]
        rock = 40.0 * np.sin(1.6 * east) * np.cos(1.3 * north) + rng.normal(0, 8) + rng.normal(0, 0.5, 60)
        kind = "LINE" if number < 7 else "TIE"
        rows += [
            f"{-57.9 + x / 72.0:.6f},{49.5 + y / 111.2:.6f},{v:.2f},{number},{kind}"
            for x, y, v in zip(east, north, rock, strict=True)
        ]
    (here / "lines.csv").write_text("\n".join(rows) + "\n")
    output = walk("magbridge survey lines.csv -o map.nc --crossovers crossings.csv --json")
    assert json.loads(output.out)["misties_after_nT"] < 0.3 * json.loads(output.out)["misties_before_nT"]
    assert len(Path("crossings.csv").read_text().splitlines()) == 50


def test_a_navigator_with_a_grid_in_microtesla(walk: Walk, here: Path) -> None:
    longitude, latitude = np.meshgrid(np.linspace(-58.0, -57.8, 41), np.linspace(49.4, 49.6, 41))
    value = 0.05 * np.sin(longitude * 250.0) * np.cos(latitude * 170.0)
    rows = [
        f"{x:.5f},{y:.5f},{v:.6f}" for x, y, v in zip(longitude.flat, latitude.flat, value.flat, strict=True)
    ]
    (here / "survey.csv").write_text("lon,lat,mag [uT]\n" + "\n".join(rows) + "\n")
    walk("magbridge map survey.csv -o map.nc")
    with xr.open_dataset("map.nc") as grid:
        assert max(float(abs(one).max()) for one in grid.data_vars.values()) == pytest.approx(50.0, rel=0.1)
    plan = ["time,latitude,longitude,depth,roll,pitch,heading,water_speed"]
    plan += [f"{1.7e9 + 60 * k},{49.42 + 0.002 * k:.5f},-57.9,20,0,0,0,0.4" for k in range(70)]
    (here / "plan.csv").write_text("\n".join(plan) + "\n")
    walk("magbridge navigate plan.csv --bound --map map.nc --sample-interval 0.2 -o bound.csv")
    assert Path("bound.csv").exists()


def test_an_exporter_to_c_and_to_an_autopilot(walk: Walk, here: Path, calibration: Calibration) -> None:
    walk("magbridge export cal.json --c firmware")
    walk("magbridge export cal.json --ardupilot compass.param")
    assert "COMPASS_OFS_X" in Path("compass.param").read_text()
    if compiler := shutil.which("cc"):
        source = "firmware/magbridge_calibration.c"
        subprocess.run(
            [compiler, "-std=c99", "-Wall", "-Werror", "-c", source, "-o", "firmware/cal.o"], check=True
        )
