"""Test the findings for a scalar magnetometer: lag, heading error, and the channel that disturbs."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from scipy.spatial.transform import Rotation

from magbridge import logs
from magbridge.calibration.file import save
from magbridge.calibration.fitting.scalar_log import calibrate_scalar
from magbridge.calibration.model import Calibration, identity
from magbridge.cli import main
from magbridge.diagnose.scalar import scalar_findings

RATE, MINUTES = 2.0, 8
SCALAR = "mag_cabin"


def flown(seed: int, lag: float = 0.0, heading_nt: float = 0.0, pump_nt: float = 0.0) -> xr.Dataset:
    """Return a flight over a varying field, with a motor that is calibrated and the given further faults."""
    random = np.random.default_rng(seed)
    n = int(MINUTES * 60 * RATE)
    t = np.arange(n) / RATE

    def slow(period_s: float) -> np.ndarray:
        return np.sin(2.0 * np.pi * (t / period_s + random.random()))

    heading = np.repeat(90.0 * np.arange(MINUTES // 2), int(120 * RATE))
    angles = np.column_stack([heading + 3.0 * slow(17.0), 6.0 * slow(13.0), 9.0 * slow(11.0)])
    earth = np.array([17_000.0, -3_500.0, 51_000.0])
    total = np.linalg.norm(earth) + 30.0 * slow(90.0)
    u = Rotation.from_euler("ZYX", angles, degrees=True).inv().apply(earth / np.linalg.norm(earth))
    motor, pump = 5.0 + 3.0 * slow(170.0), (np.sin(t / 40.0 + random.random()) > 0.3) * 2.0
    body = u * total[:, None] + [400.0 + heading_nt, -250.0, 600.0]
    body = body + motor[:, None] * [3.0, -2.0, 4.0] + pump[:, None] * [0.0, 0.0, 0.5 * pump_nt]
    reading = np.interp(t - lag, t, np.linalg.norm(body, axis=1)) + 0.2 * random.normal(size=n)
    vector = u * total[:, None] + random.normal(0.0, 1.0, (n, 3))
    columns = {f"mag_{axis}": (vector[:, k], "nT") for k, axis in enumerate("xyz")}
    columns |= {SCALAR: (reading, "nT"), "reference_field": (total, "nT")}
    columns |= {"motor_current": (motor, "A"), "pump_current": (pump, "A")}
    return xr.Dataset(
        {name: ("time", values, {"units": unit}) for name, (values, unit) in columns.items()},
        coords={"time": t + 1.6e9},
        attrs={"source": "flight"},
    )


@pytest.fixture(scope="module")
def known() -> Calibration:
    """Return a calibration with a scalar sensor, compensated for the motor only."""
    fit = calibrate_scalar(flown(1), identity(), SCALAR, ("motor_current",), map_known=True)
    return replace(identity(), sensors=(fit.sensor,))


def test_nothing_is_found_where_the_compensation_holds(known: Calibration) -> None:
    assert scalar_findings([flown(2)], known, None) == ()


def test_a_lag_is_found_and_no_other_name_with_it(known: Calibration) -> None:
    (found,) = scalar_findings([flown(2, lag=0.4)], known, None)
    assert found.code == "scalar.lag"
    assert found.values["lag_s"] == pytest.approx(0.4, abs=0.15)


def test_a_heading_error_is_found(known: Calibration) -> None:
    (found,) = scalar_findings([flown(2, heading_nt=30.0)], known, None)
    assert found.code == "scalar.heading_error"
    assert 2.0 < found.values["effect_nT"] < 20.0


def test_the_channel_that_disturbs_is_named(known: Calibration, tmp_path: Path) -> None:
    """The command writes the finding to ``findings.json`` and to the report, and prints it."""
    log = flown(2, pump_nt=4.0)
    logs.write(log, tmp_path / "flight.nc")
    save(known, tmp_path / "cal.json")
    arguments = ["diagnose", str(tmp_path / "flight.nc"), "--calibration", str(tmp_path / "cal.json")]
    assert main([*arguments, "-o", str(tmp_path / "out")]) == 0
    (found,) = json.loads((tmp_path / "out" / "findings.json").read_bytes())["scalar"]
    assert (found["column"], found["cause"], found["channel"]) == (SCALAR, "channel", "pump_current")
    assert found["numbers"]["effect_nT"] == pytest.approx(1.9, rel=0.3)
    assert found["text"] in (tmp_path / "out" / "report.html").read_text().replace("\N{NO-BREAK SPACE}", " ")


def test_a_log_without_the_scalar_is_diagnosed_without_it(known: Calibration) -> None:
    assert scalar_findings([flown(2).drop_vars(SCALAR)], known, None) == ()


def test_a_log_that_is_too_short_is_reported(known: Calibration) -> None:
    (found,) = scalar_findings([flown(2).isel(time=slice(60))], known, None)
    assert found.code == "scalar.untested"
    assert "at least 100 samples" in found.text
