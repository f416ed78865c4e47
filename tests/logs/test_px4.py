"""Test PX4 logs that the tests write by the specification of ULog."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from log_files import Output, ulog_of

from magbridge import logs
from magbridge.errors import FormatError
from magbridge.logs.compasses import compasses_in

pytest.importorskip("pyulog")
UTC = 1_700_000_000
TOPICS = {
    "sensor_mag": ("uint64_t timestamp;uint64_t timestamp_sample;float x;float y;float z;", "<QQ3f"),
    "vehicle_attitude": ("uint64_t timestamp;float[4] q;", "<Q4f"),
    "battery_status": ("uint64_t timestamp;float voltage_v;float current_a;", "<Qff"),
    "sensor_gps": ("uint64_t timestamp;uint64_t time_utc_usec;", "<QQ"),
    "debug_key_value": ("uint64_t timestamp;float value;char[10] key;uint8_t[2] _padding0;", "<Qf10s"),
}


def ulog() -> bytes:
    """Return a log of 20 rows, with attitude and UTC from the fourth row on."""
    output: Output = []
    for k in range(20):
        us = 1_000_000 + k * 100_000
        if k == 3:
            half = np.radians(-90) / 2  # heading 270
            output.append(("vehicle_attitude", 0, (us, np.cos(half), 0, 0, np.sin(half))))
            output.append(("battery_status", 0, (us, 16, 2.5)))
            output.append(("sensor_gps", 0, (us, UTC * 1_000_000 + us)))
        output.append(("debug_key_value", 0, (us, k, b"battpos")))
        output.append(("sensor_mag", 0, (us + 20, us, 0.2 + k / 100, 0.1, -0.4)))
    return ulog_of(TOPICS, {}, output)


def test_rows_are_dated_by_the_receiver_and_named_values_are_columns(tmp_path: Path) -> None:
    path = tmp_path / "log.ulg"
    path.write_bytes(ulog())
    back = logs.read(path)
    np.testing.assert_allclose(back["time"], UTC + 1 + 0.1 * np.arange(20), rtol=0, atol=1e-6)
    np.testing.assert_allclose(back["mag_x"], 1e5 * (0.2 + np.arange(20) / 100), rtol=1e-6)
    np.testing.assert_allclose(back["heading"], [np.nan] * 3 + [270] * 17, rtol=1e-6)
    np.testing.assert_array_equal(back["battpos"], np.arange(20))
    assert (back.attrs["damages"], "time_reference" in back.attrs) == (0, False)


@pytest.mark.parametrize("kept", [0.9, 0.999])
def test_a_truncated_log_is_read_to_its_end(
    kept: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, data = tmp_path / "log.ulg", ulog()
    path.write_bytes(data[: int(kept * len(data))])
    assert 15 <= logs.read(path).sizes["time"] < 20
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
    assert 10 < back.sizes["time"] < 20
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
        "battery_status": TOPICS["battery_status"],
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
