"""Test ``.BIN`` and ``.ulg`` logs that the tests write by the specification of the formats."""

from __future__ import annotations

from pathlib import Path
from struct import pack

import numpy as np
import pytest
from ulogs import Output, ulog_of

from magbridge import logs
from magbridge.errors import FormatError
from magbridge.logs.compasses import compasses_in

KINDS = {
    # name: (type, letters, struct, fields)
    "MAG": (100, "QBhhhhhhhhhBI", "<QB9hBI", "TimeUS,I,MagX,MagY,MagZ,OfsX,OfsY,OfsZ,MOX,MOY,MOZ,Health,S"),
    "ATT": (101, "QccccCCCCB", "<Q4h4HB", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw,ErrRP,ErrYaw,AEKF"),
    "GPS": (102, "QBIHBcLL", "<QBIHBhii", "TimeUS,Status,GMS,GWk,NSats,HDop,Lat,Lng"),
    "BAT": (103, "QBff", "<QBff", "TimeUS,Instance,Volt,Curr"),
    "MSG": (104, "QZ", "<Q64s", "TimeUS,Message"),
}
SIZES = {
    name: len(pack(form, *([0] * 13)[: len(letters)])) if name != "MSG" else 72
    for name, (_, letters, form, _) in KINDS.items()
}
UTC = 1_700_000_000


def fmt(number: int, size: int, name: str, letters: str, fields: str) -> bytes:
    return b"\xa3\x95\x80" + pack(
        "<BB4s16s64s", number, size, name.encode(), letters.encode(), fields.encode()
    )


def bin_log(*, gps: bool = True) -> bytes:
    data = fmt(128, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")
    for name, (number, letters, _, fields) in KINDS.items():
        data += fmt(number, SIZES[name] + 3, name, letters, fields)

    def write_message(name: str, *values: object) -> bytes:
        number, _, form, _ = KINDS[name]
        return b"\xa3\x95" + bytes([number]) + pack(form, *values)

    gps_s = UTC + 18 - 315_964_800  # GPS time of the boot
    for k in range(20):
        us = k * 100_000
        if k == 5:
            data += write_message("ATT", us, 0, 1234, 0, -500, 0, 27_000, 0, 0, 3)
            data += (
                write_message("BAT", us, 0, 16.0, 1.5)
                + write_message("BAT", us, 1, 12.0, 0.5)
                + write_message("MSG", us, b"hello")
            )
        if k == 7 and gps:
            t = gps_s + us * 1e-6
            data += write_message(
                "GPS", us, 3, round(t % 604_800 * 1000), int(t // 604_800), 9, 100, 450_000_000, -630_000_000
            )
        for instance in (0, 1):
            data += write_message(
                "MAG", us + instance, instance, 100 + k + 7, 20, -300, 7, 0, 0, 0, 0, 50, 1, 0
            )
    return data


def test_bin(tmp_path: Path) -> None:
    path = tmp_path / "log.BIN"
    path.write_bytes(bin_log())
    back = logs.read(path)
    np.testing.assert_allclose(back["time"], UTC + 0.1 * np.arange(20), rtol=0, atol=1e-6)
    np.testing.assert_array_equal(back["mag_x"], 100.0 * (100 + np.arange(20)))  # the offset is off again
    np.testing.assert_array_equal(back["mag_z"], np.full(20, -35_000.0))  # and the motor compensation
    np.testing.assert_array_equal(back["mag2_x"][1:], back["mag_x"][:-1])
    assert np.isnan(back["roll"][:5]).all()
    np.testing.assert_allclose(back["roll"][5:], 12.34)
    np.testing.assert_allclose(back["pitch"][5:], -5)
    np.testing.assert_allclose(back["heading"][5:], 270)
    np.testing.assert_allclose(back["battery_current"][5:], 1.5)
    np.testing.assert_allclose(back["battery2_current"][5:], 0.5)
    np.testing.assert_allclose(back["latitude"][7:], 45)
    assert back.attrs["bytes_skipped"] == 0
    assert "time_reference" not in back.attrs


def test_bin_without_gps_counts_from_the_boot(tmp_path: Path) -> None:
    path = tmp_path / "log.bin"
    path.write_bytes(bin_log(gps=False))
    back = logs.read(path)
    np.testing.assert_allclose(back["time"], 0.1 * np.arange(20), rtol=0, atol=1e-9)
    assert back.attrs["time_reference"] == "boot"


def test_damaged_bin_is_read_to_its_end(tmp_path: Path) -> None:
    data = bytearray(bin_log())
    at = data.index(b"\xa3\x95d", len(data) // 2)  # without a checksum a damaged record stays a record
    data[at : at + 40] = b"garbage " * 5
    path = tmp_path / "log.bin"
    path.write_bytes(bytes(data[:-4]))
    back = logs.read(path)
    assert back.sizes["time"] == 19
    assert back["mag_x"][-1] == 100 * (100 + 19)
    assert back.attrs["bytes_skipped"] > 40


@pytest.mark.parametrize(
    "described",
    [
        fmt(7, 0, "NONE", "", ""),  # a record without a length: a reader may stay there for ever
        fmt(7, 9, "BAD", "Q", "TimeUS"),  # one whose length is not its fields'
        fmt(7, 14, "FMTU", "QBN", "TimeUS,FmtType,UnitIds"),
        fmt(7, 0, "", "xyz", ",,"),
    ],
)
def test_bin_with_damaged_descriptions(described: bytes, tmp_path: Path) -> None:
    path = tmp_path / "log.bin"
    path.write_bytes(described + b"\xa3\x95\x07damage" * 5000 + bin_log())
    back = logs.read(path)
    assert back.sizes["time"] == 20
    assert back.attrs["bytes_skipped"] >= 5000


# ULog: 16 bytes of head, then messages of a 16-bit size, a letter and that many bytes

TOPICS = {
    # name: (id, definition, struct)
    "sensor_mag": (
        0,
        "uint64_t timestamp;uint64_t timestamp_sample;float x;float y;float z;float temperature;",
        "<QQ4f",
    ),
    "vehicle_attitude": (1, "uint64_t timestamp;float[4] q;", "<Q4f"),
    "battery_status": (2, "uint64_t timestamp;float voltage_v;float current_a;", "<Qff"),
    "sensor_gps": (3, "uint64_t timestamp;uint64_t time_utc_usec;", "<QQ"),
    "debug_key_value": (4, "uint64_t timestamp;float value;char[10] key;uint8_t[2] _padding0;", "<Qf10s"),
}


def ulog() -> bytes:
    def message(kind: str, body: bytes) -> bytes:
        return pack("<HB", len(body), ord(kind)) + body

    data = b"ULog\x01\x12\x35\x01" + pack("<Q", 0) + message("B", bytes(40))
    for name, (_, definition, _) in TOPICS.items():
        data += message("F", f"{name}:{definition}".encode())
    for name, (number, _, _) in TOPICS.items():
        data += message("A", pack("<BH", 0, number) + name.encode())

    def write_message(name: str, *values: object) -> bytes:
        number, _, form = TOPICS[name]
        return message("D", pack("<H", number) + pack(form, *values))

    for k in range(20):
        us = 1_000_000 + k * 100_000
        if k == 3:
            half = np.radians(-90) / 2  # heading 270
            data += write_message("vehicle_attitude", us, np.cos(half), 0, 0, np.sin(half))
            data += write_message("battery_status", us, 16, 2.5)
            data += write_message("sensor_gps", us, UTC * 1_000_000 + us)
        data += write_message("debug_key_value", us, k, b"battpos")
        data += write_message("sensor_mag", us + 20, us, 0.2 + k / 100, 0.1, -0.4, 25)
    return data


def test_ulg(tmp_path: Path) -> None:
    pytest.importorskip("pyulog")
    path = tmp_path / "log.ulg"
    path.write_bytes(ulog())
    back = logs.read(path)
    np.testing.assert_allclose(back["time"], UTC + 1 + 0.1 * np.arange(20), rtol=0, atol=1e-6)
    np.testing.assert_allclose(back["mag_x"], 1e5 * (0.2 + np.arange(20) / 100), rtol=1e-6)
    np.testing.assert_allclose(back["mag_z"], -40_000, rtol=1e-6)
    assert np.isnan(back["heading"][:3]).all()
    np.testing.assert_allclose(back["heading"][3:], 270, rtol=1e-6)
    np.testing.assert_allclose(back["battery_current"][3:], 2.5)
    np.testing.assert_array_equal(back["battpos"], np.arange(20))
    assert "time_reference" not in back.attrs


@pytest.mark.parametrize("kept", [0.9, 0.999])
def test_truncated_ulg_is_read_to_its_end(
    kept: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pyulog")
    path = tmp_path / "log.ulg"
    data = ulog()
    path.write_bytes(data[: int(kept * len(data))])
    assert 15 <= logs.read(path).sizes["time"] < 20
    assert capsys.readouterr().out == ""


def test_damage_in_a_ulg_is_reported(tmp_path: Path) -> None:
    pytest.importorskip("pyulog")
    path, data = tmp_path / "log.ulg", bytearray(ulog())
    middle = len(data) * 7 // 8
    data[middle : middle + 60] = bytes(60)
    for content, damaged in ((data, 1), (ulog(), 0)):
        path.write_bytes(content)
        back = logs.read(path)
        assert 10 < back.sizes["time"] <= 20 - damaged
        assert back.attrs["damages"] == damaged


def test_ulg_cut_in_its_definitions(tmp_path: Path) -> None:
    pytest.importorskip("pyulog")
    path = tmp_path / "log.ulg"
    path.write_bytes(ulog()[:300])
    with pytest.raises(FormatError, match=r"log\.ulg: expected a PX4 log"):
        logs.read(path)


def test_the_compass_that_vehicle_magnetometer_names(tmp_path: Path) -> None:
    """The first is disabled; that in use is taken at its full rate, with PX4's calibration undone."""
    pytest.importorskip("pyulog")
    topics = {
        "sensor_mag": ("uint64_t timestamp;uint32_t device_id;float x;float y;float z;", "<QI3f"),
        "vehicle_magnetometer": ("uint64_t timestamp;uint32_t device_id;float[3] magnetometer_ga;", "<QI3f"),
    }
    parameters = {
        "CAL_MAG0_ID": 11,
        "CAL_MAG0_PRIO": 0,
        "CAL_MAG1_ID": 22,
        "CAL_MAG1_PRIO": 75,
        "CAL_MAG1_XOFF": 0.05,
        "CAL_MAG1_XSCALE": 1.25,
    }
    output: Output = []
    for k in range(20):
        us = 1_000_000 + k * 100_000
        if k % 10 == 0:
            output += [("sensor_mag", 0, (us, 11, 9, 9, 9)), ("sensor_mag", 1, (us, 22, 0.2, 0.1, -0.4))]
        output.append(("vehicle_magnetometer", 0, (us, 22, 1.25 * (0.2 - 0.05), 0.1, -0.4)))
    path = tmp_path / "log.ulg"
    path.write_bytes(ulog_of(topics, parameters, output))
    back = logs.read(path)
    assert back.sizes["time"] == 20
    np.testing.assert_allclose(back["mag_x"], 20_000, rtol=1e-6)
    assert (back["mag1_x"] == 900_000).all()
    assert [(one.id, one.enabled, one.in_use) for one in compasses_in(back)] == [
        ("11", False, False),
        ("22", True, True),
    ]


def test_an_old_log_has_its_field_in_sensor_combined(tmp_path: Path) -> None:
    """With raw GPS as the only position, and outputs, currents that are used or not."""
    pytest.importorskip("pyulog")
    topics = {
        "sensor_combined": ("uint64_t timestamp;float[3] magnetometer_ga;", "<Q3f"),
        "vehicle_gps_position": (
            "uint64_t timestamp;uint64_t time_utc_usec;int32_t lat;int32_t lon;uint8_t fix_type;",
            "<QQiiB",
        ),
        "battery_status": ("uint64_t timestamp;float voltage_v;float current_a;", "<Qff"),
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
    assert np.isnan(back["latitude"][:6]).all()
    np.testing.assert_allclose(back["latitude"][6:], 45)
    assert np.isnan(back["battery_current"][:10]).all()  # -1 A: not measured
    np.testing.assert_allclose(back["motor1"], 0.1 * np.arange(20), rtol=1e-6)
    assert "motor2" not in back
