"""Test a scalar with a vector magnetometer: files, commands, and the check of one sensor by the other."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
import xarray as xr
from scipy.spatial.transform import Rotation

import magbridge as mb
from magbridge import logs
from magbridge.arrays import FloatArray
from magbridge.calibration.file import decode_calibration, encode_calibration, load, save
from magbridge.calibration.fitting.scalar_fit import fit_scalar
from magbridge.calibration.model import identity
from magbridge.calibration.scalar import (
    ScalarQuality,
    ScalarSeries,
    compare_sensors,
    correct_scalar,
)
from magbridge.cli import main
from magbridge.errors import CalibrationError, FormatError

RATE, MINUTES = 4.0, 24
CHANNELS = "motor_current", "relay", "rudder"
SCALAR = "mag_cabin"


def flown(seed: int, noise: float = 0.3) -> ScalarSeries:
    """Return a simulated flight over a known field, with dipoles and currents independent of the model."""
    random = np.random.default_rng(seed)
    n = int(MINUTES * 60 * RATE)
    t = np.arange(n) / RATE

    def slow(seconds: float) -> FloatArray:
        kernel = np.exp(-0.5 * (np.arange(-4 * seconds, 4 * seconds, 1 / RATE) / seconds) ** 2)
        y = np.convolve(random.normal(size=n + len(kernel)), kernel, "valid")[:n]
        return np.asarray((y - y.mean()) / y.std())

    # Four headings in legs of two minutes, with rolls and pitches as in a box flight.
    heading = np.repeat(90.0 * np.arange(MINUTES // 2), int(120 * RATE))
    angles = np.column_stack([heading + 3 * slow(4), 6 * slow(3), 9 * slow(3)])
    earth = np.array([17_000.0, -3_500.0, 51_000.0])
    total = np.linalg.norm(earth) + 30.0 * slow(20.0)
    u = Rotation.from_euler("ZYX", angles, degrees=True).inv().apply(earth / np.linalg.norm(earth))
    channels = np.column_stack([5 + 3 * slow(60), (np.sin(t / 50) > 0.3) * 2.0, 8 * slow(2)])
    body = u * total[:, None] + [400.0, -250.0, 600.0]
    body += u * total[:, None] @ np.diag([2e-3, -1e-3, 1.5e-3])
    body += np.gradient(u, t, axis=0) @ random.normal(0, 8, (3, 3)).T
    body += channels @ np.array([[3.0, -2.0, 4.0], [6.0, 5.0, -3.0], [0.3, 0.2, -0.4]])
    flicker = np.cumsum(random.normal(0, 0.01, n))
    scalar = np.linalg.norm(body, axis=1) + noise * random.normal(size=n) + flicker - flicker.mean() + 5.0
    vector = u * total[:, None] + random.normal(0, 1.0, (n, 3))
    return ScalarSeries(t + 1.6e9, scalar, vector, total, channels, np.full(n, np.nan))


def half(series: ScalarSeries, second: bool) -> ScalarSeries:
    middle = len(series.time) // 2
    rows = slice(middle, None) if second else slice(middle)
    return ScalarSeries(*(column[rows] for column in series))


def test_a_disturbance_that_no_channel_shows_is_seen_by_the_vector() -> None:
    n = 400
    truth = np.full(n, 53_000.0)
    random = np.random.default_rng(3)
    scalar, total = truth + random.normal(0, 0.5, n), truth + random.normal(0, 5.0, n)
    scalar[100:160] -= 3_000.0
    seen = compare_sensors(scalar, np.full(n, 0.5), total, np.full(n, 5.0), truth)
    assert seen.disagrees[100:160].all()
    assert seen.disagrees[:100].mean() < 0.01
    assert (np.sqrt(seen.scalar_variance[100:160]) > 2_900.0).all()
    assert (seen.vector_variance[100:160] == 0.0).all()  # the reference tells which one is off
    assert seen.jump[100]
    assert seen.jump[160]
    unknown = compare_sensors(scalar, np.full(n, 0.5), total, np.full(n, 5.0), np.full(n, np.nan))
    assert (unknown.vector_variance[100:160] == 0.0).all()  # so do the samples before and after
    first = slice(100, 160)
    alone = compare_sensors(
        scalar[first], np.full(60, 0.5), total[first], np.full(60, 5.0), np.full(60, np.nan)
    )
    assert (alone.vector_variance > 0.0).all()
    assert (alone.scalar_variance > 0.0).all()


@pytest.mark.filterwarnings("error")
def test_a_disturbance_that_cancels_the_crust_is_not_taken_for_the_truth() -> None:
    """Over an anomaly of 300 nT the disturbed sensor reads the main field, the other one does not."""
    n = 400
    random = np.random.default_rng(5)
    crust = 300.0 + 20.0 * np.sin(np.arange(n) / 30.0)
    scalar = 53_000.0 + crust + random.normal(0, 0.5, n)
    total = 53_000.0 + crust + random.normal(0, 5.0, n)
    main, one, five = np.full(n, 53_000.0), np.full(n, 0.5), np.full(n, 5.0)
    disturbed = np.where((np.arange(n) >= 100) & (np.arange(n) < 160), -300.0, 0.0)
    seen = compare_sensors(scalar + disturbed, one, total, five, main)
    assert (seen.vector_variance[100:160] == 0.0).all()
    assert (seen.scalar_variance[100:160] > 0.0).all()
    seen = compare_sensors(scalar, one, total + disturbed, five, main)
    assert (seen.scalar_variance[100:160] == 0.0).all()
    assert (seen.vector_variance[100:160] > 0.0).all()


@pytest.mark.filterwarnings("error")
def test_channels_that_disturb_are_named_and_an_idle_one_is_not() -> None:
    series = half(flown(6), False)
    idle = np.random.default_rng(1).normal(size=len(series.time))
    series = series._replace(channels=np.column_stack([series.channels, idle]))
    found = fit_scalar(series, (*CHANNELS, "fan"), map_known=True).findings
    assert {finding.code for finding in found} == {"scalar.channel"}
    assert {finding.values["channel"] for finding in found} <= set(CHANNELS)
    assert found[0].values["effect_nT"] == max(finding.values["effect_nT"] for finding in found)


def test_samples_of_one_time_are_fitted_and_corrected() -> None:
    series = half(flown(8), False)
    pairs = np.repeat(np.arange(len(series.time)), 1 + (np.arange(len(series.time)) % 7 == 0))
    twice = ScalarSeries(*(column[pairs] for column in series))
    found = fit_scalar(twice, CHANNELS, map_known=True)
    error = correct_scalar(found.sensor, twice).field - twice.reference
    assert np.sqrt(np.mean(error**2)) < 1.0


def test_the_file_holds_the_sensor_and_refuses_numbers_that_do_not_belong_together() -> None:
    found = fit_scalar(half(flown(4), False), CHANNELS, column=SCALAR, map_known=True)
    both = replace(identity(), sensors=(found.sensor,))
    written = encode_calibration(both)
    assert decode_calibration(written).sensors == both.sensors
    assert b'"format": 5' in written
    sensor = msgspec.structs.replace(found.sensor, coefficients=found.sensor.coefficients[:-1])
    short = replace(both, sensors=(sensor,))
    with pytest.raises(CalibrationError, match=r"sensor 'mag_cabin': expected \d+ coefficients"):
        decode_calibration(encode_calibration(short))


def write(series: ScalarSeries, path: Path) -> None:
    columns = {f"mag_{axis}": series.vector[:, k] for k, axis in enumerate("xyz")}
    columns |= {SCALAR: series.scalar, "reference_field": series.reference}
    columns |= dict(zip(CHANNELS, series.channels.T, strict=True))
    units = {"motor_current": "A", "relay": "A", "rudder": "deg"}
    ds = xr.Dataset(
        {name: ("time", values, {"units": units.get(name, "nT")}) for name, values in columns.items()},
        coords={"time": series.time},
    )
    logs.write(ds, path)


def test_commands_calibrate_and_correct_a_scalar(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    series = flown(5)
    write(half(series, False), tmp_path / "a.nc")
    write(half(series, True), tmp_path / "b.nc")
    cal, out = tmp_path / "cal.json", tmp_path / "out.nc"
    assert main(["calibrate", str(tmp_path / "a.nc"), "--scalar", SCALAR, "-o", str(cal)]) == 0
    assert "with 3 channels" in capsys.readouterr().out
    assert [channel.name for channel in load(cal).sensors[0].channels] == list(CHANNELS)
    assert main(["correct", str(tmp_path / "b.nc"), "--calibration", str(cal), "-o", str(out)]) == 0
    back = logs.read(out)
    error = back["scalar_field"].to_numpy() - half(series, True).reference
    assert np.sqrt(np.mean(error**2)) < 2.0
    assert np.mean(back["scalar_quality"].to_numpy().astype(int) & ScalarQuality.DISAGREES != 0) < 0.01
    assert main(["calibrate", str(tmp_path / "a.nc"), "--lag", "1", "-o", str(cal)]) == 2
    assert "--scalar COLUMN" in capsys.readouterr().err
    wrong = ["calibrate", str(tmp_path / "a.nc"), "--scalar", SCALAR, "--lever", "1,2", "-o", str(cal)]
    assert main(wrong) == 2
    assert "F,R,D" in capsys.readouterr().err


def test_python_calibrates_and_corrects_a_scalar(tmp_path: Path) -> None:
    series = flown(7)
    write(half(series, False), tmp_path / "a.nc")
    write(half(series, True), tmp_path / "b.nc")
    runs, later = logs.read(tmp_path / "a.nc"), logs.read(tmp_path / "b.nc")
    found = mb.calibrate(runs, scalar=SCALAR, channels=CHANNELS[:2])
    assert [channel.name for channel in found.sensors[0].channels] == ["motor_current", "relay"]
    corrected = mb.correct(found, later)
    assert (corrected["time"] == later["time"]).all()
    error = corrected["scalar_field"].to_numpy() - half(series, True).reference
    assert np.sqrt(np.mean(error**2)) < 15.0, "without the rudder, which adds some 10 nT"
    with pytest.raises(FormatError, match="mag_tail"):
        mb.calibrate(runs, scalar="mag_tail")


def test_compiled_c_gives_the_field_of_python(tmp_path: Path) -> None:
    gcc = shutil.which("gcc") or shutil.which("cc")
    if gcc is None:
        pytest.skip("no C compiler is installed")
    series = half(flown(4), False)
    sensor = fit_scalar(series, CHANNELS, column=SCALAR, map_known=True).sensor
    save(replace(identity(), sensors=(sensor,)), tmp_path / "cal.json")
    assert main(["export", str(tmp_path / "cal.json"), "--c", str(tmp_path)]) == 0
    strict = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O2", "-shared", "-fPIC"]
    library = tmp_path / "scalar.so"
    subprocess.run([gcc, *strict, str(tmp_path / "magbridge_scalar.c"), "-o", library, "-lm"], check=True)

    class Corrected(ctypes.Structure):
        _fields_ = [(name, ctypes.c_double) for name in ("field", "sigma", "level_sigma")] + [
            ("extrapolated", ctypes.c_int)
        ]

    correct_in_c = ctypes.CDLL(str(library)).magbridge_correct_scalar
    three = ctypes.c_double * 3
    series = series._replace(reference=np.full(len(series.time), np.nan))
    expected = correct_scalar(sensor, series)
    u = series.vector / np.linalg.norm(series.vector, axis=1)[:, None]
    turn, rate = np.gradient(u, series.time, axis=0), np.gradient(series.scalar, series.time)
    out = Corrected()
    for k in range(0, len(series.time), 97):
        reading = ctypes.c_double(series.scalar[k]), three(*series.vector[k]), three(*turn[k])
        correct_in_c(*reading, ctypes.c_double(rate[k]), three(*series.channels[k]), 1, ctypes.byref(out))
        assert out.field == pytest.approx(expected.field[k], abs=1e-6)
        assert out.sigma == pytest.approx(expected.sigma[k], rel=1e-6)
        assert bool(out.extrapolated) == expected.extrapolated[k]
    correct_in_c(*reading, ctypes.c_double(0.0), three(1e3, 0.0, 0.0), 0, ctypes.byref(out))
    assert out.extrapolated
    assert out.level_sigma == 30.0


def test_the_vector_is_calibrated_by_the_scalar(tmp_path: Path) -> None:
    """A scalar away from the iron is the reference: no map and no position are needed."""
    series = flown(6)
    iron = np.array([300.0, -200.0, 100.0])
    seen = series._replace(scalar=series.reference, vector=np.add(series.vector, iron))
    path, cal, out = tmp_path / "a.nc", tmp_path / "cal.json", tmp_path / "out.nc"
    write(seen, path)
    only = tmp_path / "only.nc"
    logs.write(logs.read(path).drop_vars("reference_field"), only)
    assert main(["calibrate", str(only), "--scalar", SCALAR, "--reference", "scalar", "-o", str(cal)]) == 0
    assert load(cal).sensors == ()
    assert main(["correct", str(path), "--calibration", str(cal), "-o", str(out)]) == 0
    error = logs.read(out)["total_field"].to_numpy() - series.reference
    assert np.sqrt(np.mean(error**2)) < 1.5
