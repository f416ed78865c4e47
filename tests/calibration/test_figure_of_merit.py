"""Figure of merit and improvement ratio: twelve manoeuvres of a box, of known size."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from commands import Command
from scipy.spatial.transform import Rotation

from magbridge import logs
from magbridge.arrays import FloatArray
from magbridge.calibration.figure_of_merit import box_flight, figure_of_merit

RATE, LEG_S = 5.0, 90.0
AMPLITUDES = (10.0, 5.0, 5.0)


def box(first_heading: float = 20.0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return times (n,), angles (n, 3) roll pitch heading, and which axis swings (n,), -1 for none."""
    n = int(4 * LEG_S * RATE)
    time = np.arange(n) / RATE
    within = time % LEG_S
    axis = np.where(within < 20.0, -1, np.minimum((within - 20.0) // 20.0, 3)).astype(int)
    axis[(within - 20.0) % 20.0 > 15.0] = -1
    axis[axis == 3] = -1
    angles = np.zeros((n, 3))
    for k, amplitude in enumerate(AMPLITUDES):
        angles[:, k] = np.where(axis == k, amplitude * np.sin(2 * np.pi * within / 5.0), 0.0)
    angles[:, 2] += first_heading + 90.0 * (time // LEG_S)
    return time, angles, axis


def test_the_twelve_manoeuvres_and_their_sum() -> None:
    time, angles, axis = box()
    found = box_flight(time, *angles.T)
    assert found is not None
    assert len(found.manoeuvres) == 12
    assert [one.axis for one in found.manoeuvres] == ["roll", "pitch", "yaw"] * 4
    swing = np.where(axis >= 0, np.sin(2 * np.pi * (time % LEG_S) / 5.0), 0.0)
    merit = figure_of_merit(found, 50_000.0 + 3.0 * swing, 50_000.0 + 0.1 * swing)
    assert merit["before_nT"] == pytest.approx(12 * 6.0, rel=0.15)
    assert merit["after_nT"] == pytest.approx(12 * 0.2, rel=0.15)
    assert merit["improvement_ratio"] == pytest.approx(30.0, rel=0.01)


def test_a_flight_without_manoeuvres_and_a_slow_log_do_not_count_as_a_box() -> None:
    time, angles, _ = box()
    assert box_flight(time, 0.1 * angles[:, 0], 0.1 * angles[:, 1], np.full(len(time), 20.0)) is None
    assert box_flight(time[::10], *angles[::10].T) is None


def test_calibrate_prints_the_figure_of_merit(tmp_path: Path, command: Command) -> None:
    time, angles, _ = box()
    random = np.random.default_rng(1)
    earth = np.array([17_000.0, -3_500.0, 51_000.0])
    u = Rotation.from_euler("ZYX", angles[:, ::-1], degrees=True).inv().apply(earth)
    vector = u + random.normal(0, 1.0, u.shape)
    scalar = np.linalg.norm(u + np.array([300.0, -200.0, 100.0]), axis=1) + random.normal(0, 0.05, len(u))
    columns = {f"mag_{axis}": (vector[:, k], "nT") for k, axis in enumerate("xyz")}
    columns |= {name: (angles[:, k], "deg") for k, name in enumerate(("roll", "pitch", "heading"))}
    columns |= {"tail": (scalar, "nT"), "reference_field": (np.full(len(u), np.linalg.norm(earth)), "nT")}
    ds = xr.Dataset(
        {name: ("time", values, {"units": units}) for name, (values, units) in columns.items()},
        coords={"time": time + 1.6e9},
    )
    log, cal = tmp_path / "box.nc", tmp_path / "cal.json"
    logs.write(ds, log)
    said = command("calibrate", log, "--scalar", "tail", "-o", cal, "--force").out
    assert "figure of merit" in said
    assert "over 12 manoeuvres" in said
    merit = json.loads(command("calibrate", log, "--scalar", "tail", "-o", cal, "--force", "--json").out)
    merit = merit["scalar"]["figure_of_merit"]
    assert merit["fitted"] is True
    assert len(merit["peak_to_peak"]) == 12
    assert merit["after_nT"] < 3.0 < 30.0 < merit["before_nT"]
    assert merit["improvement_ratio"] > 10.0
