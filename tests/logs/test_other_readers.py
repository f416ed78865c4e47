"""Test that every column equals the result of another reader: xarray, pyulog or pymavlink."""

from collections.abc import Iterator
from contextlib import closing
from math import degrees
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import pytest
import xarray as xr
from log_files import Output, ulog_of

from magbridge import logs
from magbridge.errors import FormatError
from magbridge.logs.compasses import compasses_in
from magbridge.logs.fields import MAX_AGE

pyulog = pytest.importorskip("pyulog")
UTC = 1_700_000_000
BATTERY = "uint64_t timestamp;float voltage_v;float current_a;", "<Q2f"
"""Definition and struct format of PX4's battery_status."""
Series = tuple[list[float], list[float]]
"""Times (s) and values of a column."""


def carried(at: np.ndarray, series: Series) -> list[float]:
    """Return, one by one, the last value at or before each time: what :func:`.fields.latest` is to do."""
    found = []
    for now in at.tolist():
        known = [(t, v) for t, v in zip(*series, strict=True) if t <= now and np.isfinite(v)]
        found.append(known[-1][1] if known and now - known[-1][0] <= MAX_AGE else np.nan)
    return found


def test_a_trajectory_is_as_xarray_reads_it(tmp_path: Path) -> None:
    """Packed integers, a fill value, days since a date, a record dimension: xarray decodes all of them."""
    rng = np.random.default_rng(4)
    path = tmp_path / "other.nc"
    with netCDF4.Dataset(path, "w", format="NETCDF3_CLASSIC") as file:
        file.createDimension("obs", None)
        time = file.createVariable("time", "f8", ("obs",))
        time.setncatts({"units": "days since 2020-02-28", "standard_name": "time"})
        time[:] = np.arange(50) / 86_400.0
        for name, kind, more in (
            ("mag_x", "i2", {"scale_factor": 3.5, "add_offset": 100.0, "units": "nT"}),
            ("mag_y", "f4", {"units": "nT"}),
            ("mag_z", "i4", {"units": "nT"}),
            ("pump", "f8", {"units": "A"}),
        ):
            variable = file.createVariable(name, kind, ("obs",), fill_value=-99)
            variable.setncatts(more)
            variable.set_auto_maskandscale(False)
            variable[:] = rng.integers(-3000, 3000, 50)
            variable[[3, 7]] = -99
    theirs = xr.open_dataset(path)
    back = logs.read(path)
    seconds = theirs["time"].to_numpy().astype("datetime64[us]").astype(float) * 1e-6
    np.testing.assert_allclose(back["time"], seconds, rtol=0, atol=1e-5)
    assert set(back.data_vars) == set(theirs.data_vars) - {"time"}
    for column in back.data_vars:
        np.testing.assert_allclose(back[column], theirs[column], rtol=1e-6, err_msg=str(column))
        assert np.flatnonzero(np.isnan(back[column])).tolist() == [3, 7]


@pytest.mark.real
def test_a_seaglider_is_as_xarray_reads_it(real_data: Path) -> None:
    path = sorted((real_data / "seaglider_sg167").glob("*.nc"))[0]
    back, theirs = logs.read(path), xr.open_dataset(path, decode_times=False)
    np.testing.assert_allclose(back["time"], theirs["time"], rtol=0, atol=1e-6)
    for ours, name, scale in (
        *((f"mag_{axis}", f"eng_mag_{axis}", 100.0) for axis in "xyz"),
        ("roll", "eng_rollAng", 1.0), ("pitch", "eng_pitchAng", 1.0), ("heading", "eng_head", 1.0),
        ("pitchCtl", "eng_pitchCtl", 1.0), ("rollCtl", "eng_rollCtl", 1.0), ("vbdCC", "eng_vbdCC", 1.0),
        ("depth", "depth", 1.0),
    ):  # fmt: skip
        np.testing.assert_allclose(back[ours], scale * theirs[name], rtol=1e-7, err_msg=ours)
    inside = (back["time"] > float(theirs["ctd_time"][0])) & (back["time"] < float(theirs["ctd_time"][-1]))
    for ours, name in (("latitude",) * 2, ("longitude",) * 2, ("water_temperature", "temperature")):
        between = np.asarray(np.interp(back["time"], theirs["ctd_time"], theirs[name]))
        np.testing.assert_allclose(back[ours][inside], between[inside], rtol=1e-9, err_msg=ours)


def ulog() -> bytes:
    """Return a log of all that is read of PX4, each topic at its own rate; UTC from the second row on."""
    axes = "float x;float y;float z;"
    topics = {
        "sensor_mag": (f"uint64_t timestamp;uint64_t timestamp_sample;uint32_t device_id;{axes}", "<QQI3f"),
        "vehicle_attitude": ("uint64_t timestamp;float[4] q;", "<Q4f"),
        "vehicle_global_position": ("uint64_t timestamp;double lat;double lon;float alt;", "<Q2df"),
        "vehicle_local_position": (f"uint64_t timestamp;{axes}", "<Q3f"),
        "battery_status": BATTERY,
        "sensor_gps": ("uint64_t timestamp;uint64_t time_utc_usec;", "<QQ"),
        "debug_key_value": ("uint64_t timestamp;float value;char[10] key;uint8_t[2] _padding0;", "<Qf10s"),
        "vehicle_air_data": ("uint64_t timestamp;float baro_pressure_pa;", "<Qf"),
        "actuator_outputs": ("uint64_t timestamp;float[4] output;", "<Q4f"),
        "actuator_motors": ("uint64_t timestamp;float[4] control;", "<Q4f"),
    }
    output: Output = []
    for k in range(30):
        us = 2_000_000 + 100_000 * k
        output.append(("debug_key_value", 0, (us, k, b"battpos")))
        output.append(("sensor_mag", 0, (us + 20, us, 11, 0.2 + 0.01 * k, 0.1, -0.4)))
        if k % 2:
            output.append(("actuator_outputs", 0, (us + 7, 1100.0 + k, 0.0, 1200.0, 0.0)))
            output.append(("actuator_motors", 0, (us + 9, 0.01 * k, 0.0, 0.5, 0.0)))
        if k % 3 == 0:
            output.append(("vehicle_local_position", 0, (us - 5, 1.0, 2.0, -0.1 * k)))
            output += [("battery_status", n, (us + 3, 16.0 - n, -1.0 if k == 6 else k + n)) for n in range(2)]
        if k % 5 == 1:
            output.append(("vehicle_global_position", 0, (us, 47.0 + 1e-5 * k, 8.0, 500.0 + k)))
            output.append(("vehicle_air_data", 0, (us, 1e5 + k)))
            half = np.radians(-90) / 2  # heading 270
            output.append(("vehicle_attitude", 0, (us, np.cos(half), 0.0, 0.0, np.sin(half))))
            output.append(("sensor_gps", 0, (us, UTC * 1_000_000 + us)))
    return ulog_of(topics, {"CAL_MAG0_ID": 11}, output)


def test_every_column_of_px4_is_as_pyulog_reads_it(tmp_path: Path) -> None:
    path = tmp_path / "log.ulg"
    path.write_bytes(ulog())
    theirs = pyulog.ULog(str(path))

    def series(topic: str, field: str, number: int = 0, scale: float = 1.0) -> Series:
        (one,) = [one for one in theirs.data_list if (one.name, one.multi_id) == (topic, number)]
        values = one.data[field].astype(float) * scale
        if field == "current_a":
            values[values == -1.0] = np.nan  # not measured
        when = one.data.get("timestamp_sample", one.data["timestamp"])
        return (when * 1e-6).tolist(), values.tolist()

    back = logs.read(path)
    np.testing.assert_allclose(back["time"], UTC + 2 + 0.1 * np.arange(30), rtol=0, atol=1e-6)
    since_boot = np.round(back["time"].to_numpy() - UTC, 6)
    expected = {
        **{f"mag_{axis}": series("sensor_mag", axis, scale=1e5) for axis in "xyz"},
        "latitude": series("vehicle_global_position", "lat"),
        "longitude": series("vehicle_global_position", "lon"),
        "depth": series("vehicle_global_position", "alt", scale=-1.0),  # above the sea, not the start
        "pressure": series("vehicle_air_data", "baro_pressure_pa", scale=0.01),
        "battery_voltage": series("battery_status", "voltage_v"),
        "battery_current": series("battery_status", "current_a"),
        "battery2_voltage": series("battery_status", "voltage_v", 1),
        "battery2_current": series("battery_status", "current_a", 1),
        **{f"servo{k + 1}": series("actuator_outputs", f"output[{k}]") for k in (0, 2)},
        **{f"motor{k + 1}": series("actuator_motors", f"control[{k}]") for k in (0, 2)},
        "battpos": series("debug_key_value", "value"),
    }
    for name, one in expected.items():
        np.testing.assert_allclose(back[name], carried(since_boot, one), err_msg=name)
    np.testing.assert_allclose(back["heading"], [np.nan] + [270] * 29, rtol=1e-6)
    assert set(back.data_vars) == {*expected, "roll", "pitch", "heading"}
    assert (back.attrs["damages"], "time_reference" in back.attrs) == (0, False)


def _pymavlink(path: Path) -> Iterator[tuple[float, Any]]:
    from pymavlink import mavutil  # noqa: PLC0415 - beside the project's own dialect, only here

    connection: Any = mavutil.mavlink_connection(str(path), dialect="ardupilotmega")
    with closing(connection):
        while (message := connection.recv_match()) is not None:
            yield float(message._timestamp), message


@pytest.mark.real
def test_every_column_of_a_telemetry_log_is_as_pymavlink_reads_it(real_data: Path) -> None:
    path = real_data / "ardusub" / "small.tlog"
    known: dict[str, tuple[float, float]] = {}
    rows: list[dict[str, float]] = []
    for when, message in _pymavlink(path):
        kind = message.get_type()
        if kind == "BAD_DATA" or message.get_srcComponent() != 1:
            continue
        output: dict[str, float] = {}
        if kind == "ATTITUDE":
            output = {"roll": degrees(message.roll), "pitch": degrees(message.pitch),
                    "heading": degrees(message.yaw) % 360.0}  # fmt: skip
        elif kind == "GLOBAL_POSITION_INT":
            output = {"latitude": message.lat * 1e-7, "longitude": message.lon * 1e-7,
                    "depth": -message.relative_alt * 1e-3}  # fmt: skip
        elif kind == "SYS_STATUS":
            output = {"battery_current": message.current_battery * 1e-2,
                    "battery_voltage": message.voltage_battery * 1e-3}  # fmt: skip
        elif kind == "SCALED_PRESSURE2":
            output = {"pressure2": message.press_abs, "pressure2_temperature": message.temperature * 1e-2}
        elif kind == "SERVO_OUTPUT_RAW":
            output = {f"servo{k}": float(getattr(message, f"servo{k}_raw")) for k in (1, 2, 3, 4, 5, 6)}
        elif kind == "SCALED_IMU2":
            output = {f"mag2_{axis}": 100.0 * getattr(message, f"{axis}mag") for axis in "xyz"}
        elif kind == "NAMED_VALUE_FLOAT":
            output = {message.name: message.value}
        known |= {name: (when, value) for name, value in output.items()}
        if kind == "RAW_IMU":
            own = {f"mag_{axis}": 100.0 * getattr(message, f"{axis}mag") for axis in "xyz"}
            rows.append(
                {"time": when, **own, **{name: v for name, (t, v) in known.items() if when - t <= MAX_AGE}}
            )
    back = logs.read(path)
    assert (len(rows), back.sizes["time"], back.attrs["damages"]) == (528, 528, 4)
    for name in {name for row in rows for name in row}:
        theirs = [row.get(name, np.nan) for row in rows]
        np.testing.assert_allclose(back[name], theirs, rtol=1e-6, atol=1e-9, err_msg=name)


# ---- PX4 logs that the tests write by the specification of ULog --------------------------------------------


@pytest.mark.parametrize("kept", [0.8, 0.95])
def test_a_truncated_log_is_read_to_its_end(
    kept: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, data = tmp_path / "log.ulg", ulog()
    path.write_bytes(data[: int(kept * len(data))])
    assert 22 <= logs.read(path).sizes["time"] < 30
    assert capsys.readouterr().out == ""
    path.write_bytes(data[:300])
    with pytest.raises(FormatError, match=r"log\.ulg: expected a PX4 log"):
        logs.read(path)


def test_damage_is_reported(tmp_path: Path) -> None:
    path, data = tmp_path / "log.ulg", bytearray(ulog())
    middle = len(data) * 7 // 8
    data[middle : middle + 60] = bytes(60)
    path.write_bytes(data)
    back = logs.read(path)
    assert 20 < back.sizes["time"] < 30
    assert back.attrs["damages"] == 1


def test_the_compass_that_vehicle_magnetometer_names(tmp_path: Path) -> None:
    """The first is disabled; that in use is taken at its full rate, with PX4's calibration undone."""
    topics = {
        "sensor_mag": ("uint64_t timestamp;uint32_t device_id;float x;float y;float z;", "<QI3f"),
        "vehicle_magnetometer": ("uint64_t timestamp;uint32_t device_id;float[3] magnetometer_ga;", "<QI3f"),
    }
    parameters = {"CAL_MAG0_ID": 11, "CAL_MAG0_PRIO": 0, "CAL_MAG1_ID": 22, "CAL_MAG1_PRIO": 75}
    offset = {"CAL_MAG1_XOFF": 0.05, "CAL_MAG1_XSCALE": 1.25}
    output: Output = []
    for k in range(20):
        us = 1_000_000 + k * 100_000
        if k % 10 == 0:
            output += [("sensor_mag", 0, (us, 11, 9, 9, 9)), ("sensor_mag", 1, (us, 22, 0.2, 0.1, -0.4))]
        output.append(("vehicle_magnetometer", 0, (us, 22, 1.25 * (0.2 - 0.05), 0.1, -0.4)))
    path = tmp_path / "log.ulg"
    path.write_bytes(ulog_of(topics, parameters | offset, output))
    back = logs.read(path)
    assert back.sizes["time"] == 20
    np.testing.assert_allclose(back["mag_x"], 20_000, rtol=1e-6)
    assert (back["mag1_x"] == 900_000).all()
    facts = [(one.id, one.enabled, one.in_use) for one in compasses_in(back)]
    assert facts == [("11", False, False), ("22", True, True)]


def test_an_old_log_has_its_field_in_sensor_combined(tmp_path: Path) -> None:
    """With raw GPS as the only position, and outputs, currents that are used or not."""
    position = "uint64_t timestamp;uint64_t time_utc_usec;int32_t lat;int32_t lon;uint8_t fix_type;"
    topics = {
        "sensor_combined": ("uint64_t timestamp;float[3] magnetometer_ga;", "<Q3f"),
        "vehicle_gps_position": (position, "<QQiiB"),
        "battery_status": BATTERY,
        "actuator_motors": ("uint64_t timestamp;float[2] control;", "<Q2f"),
    }
    output: Output = []
    for k in range(20):
        us = 1_000_000 + k * 100_000
        fix = (us, UTC * 1_000_000 + us + (k == 0) * 10**14, 450_000_000, -630_000_000, 3 if k > 5 else 1)
        output += [
            ("vehicle_gps_position", 0, fix),
            ("battery_status", 0, (us, 16, 2.5 if k > 9 else -1)),
            ("actuator_motors", 0, (us, 0.1 * k, float("nan"))),
            ("sensor_combined", 0, (us, 0.2, 0.1, -0.4)),
        ]
    path = tmp_path / "log.ulg"
    path.write_bytes(ulog_of(topics, {}, output))
    back = logs.read(path)
    np.testing.assert_allclose(back["mag_x"], 20_000, rtol=1e-6)
    np.testing.assert_allclose(back["time"], UTC + 1 + 0.1 * np.arange(20), rtol=0, atol=1e-5)
    np.testing.assert_allclose(back["latitude"], [np.nan] * 6 + [45] * 14)
    assert np.isnan(back["battery_current"][:10]).all()  # -1 A: not measured
    np.testing.assert_allclose(back["motor1"], 0.1 * np.arange(20), rtol=1e-6)
    assert "motor2" not in back
