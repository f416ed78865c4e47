"""Test logs of live links: the telemetry of each row."""

from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from pymavlink import mavutil
from pymavlink.dialects.v10 import common as v1

from magbridge import logs
from magbridge.bridge.events import declarations
from magbridge.config import Config, Link, Sensor
from magbridge.errors import FormatError
from magbridge.logs import Options, telemetry
from magbridge.logs.compasses import compasses_in
from magbridge.logs.deployment import deployment, noted, passed_over
from magbridge.logs.tlog import TlogWriter
from magbridge.mavlink import Codec, pack_record
from magbridge.mavlink.tlog import blocks
from magbridge.records import Channel, Quality
from magbridge.sensors import open_driver

T0 = 1_700_000_000_000_000  # µs
S = 1_000_000


class Log:
    """Telemetry log that a test writes; times are in s after its start."""

    def __init__(self) -> None:
        self.data = b""
        self.codecs: dict[tuple[int, int], Codec] = {}

    def write_message(
        self, t: float, message: str, /, *, by: tuple[int, int] = (1, 1), channel: int = 0, **fields: Any
    ) -> None:
        frame = self.codecs.setdefault(by, Codec(*by)).pack(message, **fields)
        self.data += pack_record(T0 + round(t * S), channel, frame)

    def ours(self, t: float, message: str, /, channel: int = Channel.SENT, **fields: Any) -> None:
        """Write a message of the bridge, which it sends unless `channel` is another."""
        self.write_message(t, message, by=(1, 191), channel=channel, **fields)

    def mag(self, t: float, x: int, **fields: Any) -> None:
        self.write_message(t, "RAW_IMU", xmag=x, ymag=10, zmag=-20, temperature=2550, **fields)

    def read(self, tmp_path: Path, **options: Any) -> Any:
        path = tmp_path / "log.tlog"
        path.write_bytes(self.data)
        return logs.read(path, options=Options(**options))


def test_a_row_holds_what_was_known_then(tmp_path: Path) -> None:
    log = Log()
    log.mag(0, 1)
    log.write_message(1, "ATTITUDE", roll=0.1, pitch=-0.2, yaw=-np.pi / 2)
    log.write_message(1.5, "NAMED_VALUE_FLOAT", name="battpos", value=0.5)
    log.mag(2, 2)
    log.write_message(3, "NAMED_VALUE_FLOAT", name="battpos", value=0.75)
    log.write_message(3, "NAMED_VALUE_FLOAT", name="ballast", value=200)
    log.write_message(3, "GLOBAL_POSITION_INT", lat=450_000_000, lon=-630_000_000, relative_alt=-12_000)
    log.write_message(3, "SYS_STATUS", current_battery=123, voltage_battery=0xFFFF)
    log.mag(4, 3)
    log.mag(31, 4)
    log.mag(33.5, 5)
    back = log.read(tmp_path)
    np.testing.assert_allclose(back["time"] - T0 / S, [0, 2, 4, 31, 33.5], atol=1e-6)
    np.testing.assert_array_equal(back["mag_x"], [100, 200, 300, 400, 500])
    np.testing.assert_array_equal(back["mag_z"], np.full(5, -2000))
    nan = np.nan
    np.testing.assert_allclose(back["roll"], np.degrees([nan, 0.1, 0.1, 0.1, nan]), rtol=1e-6)
    np.testing.assert_allclose(back["heading"], [nan, 270, 270, 270, nan], rtol=1e-6)
    np.testing.assert_array_equal(back["battpos"], [nan, 0.5, 0.75, 0.75, nan])
    np.testing.assert_array_equal(back["ballast"], [nan, nan, 200, 200, nan])
    np.testing.assert_allclose(back["latitude"], [nan, nan, 45, 45, nan])
    np.testing.assert_allclose(back["depth"], [nan, nan, 12, 12, nan])
    np.testing.assert_allclose(back["battery_current"], [nan, nan, 1.23, 1.23, nan])
    np.testing.assert_allclose(back["imu_temperature"], 25.5)
    assert back["battery_current"].attrs["units"] == "A"
    assert "battery_voltage" not in back  # never known
    assert "mag1_x" not in back  # that is mag_x
    assert not passed_over(back.attrs)


def test_only_the_vehicle_with_the_magnetometer_counts(tmp_path: Path) -> None:
    log = Log()
    log.write_message(0, "ATTITUDE", roll=0.1)
    log.write_message(0, "NAMED_VALUE_FLOAT", name="battpos", value=1)
    for by in ((2, 1), (255, 190)):
        log.write_message(1, "ATTITUDE", by=by, roll=9)
        log.write_message(1, "NAMED_VALUE_FLOAT", by=by, name="battpos", value=9)
        log.write_message(1, "NAMED_VALUE_FLOAT", by=by, name="other", value=9)
    log.mag(2, 1)
    log.mag(3, 2)
    log.mag(3.5, 7, by=(2, 1))
    back = log.read(tmp_path)
    np.testing.assert_array_equal(back["mag_x"], [100, 200])
    np.testing.assert_array_equal(back["battpos"], [1, 1])
    np.testing.assert_allclose(back["roll"], np.degrees(0.1), rtol=1e-6)
    assert "other" not in back


def test_without_a_magnetometer_attitude_makes_the_rows(tmp_path: Path) -> None:
    log = Log()
    for k in range(3):
        log.write_message(k, "NAMED_VALUE_FLOAT", name="battpos", value=k)
        log.write_message(k, "ATTITUDE", roll=0.1 * k)
    back = log.read(tmp_path)
    assert "mag_x" not in back
    np.testing.assert_array_equal(back["battpos"], [0, 1, 2])
    np.testing.assert_allclose(back["roll"], np.degrees([0, 0.1, 0.2]), rtol=1e-6)


def test_a_bridges_own_log(tmp_path: Path) -> None:
    """Reports of the bridge are not telemetry; a correction is in the row of its reading."""
    log = Log()
    log.ours(0, "MAG_BRIDGE_START", channel=Channel.STATE)
    for k in range(3):
        time_us = T0 + k * S
        log.write_message(k, "NAMED_VALUE_FLOAT", channel=Channel.LINK, name="battpos", value=k)
        log.mag(k, 9, channel=Channel.LINK)
        log.ours(k, "MAG_SENSOR_BYTES", channel=Channel.SENSOR, length=1, data=b"x")
        raw: dict[str, Any] = {"x": 1.5, "y": 2.5, "z": k, "delay_y": 10, "delay_z": 20, "supply": np.nan}
        log.ours(k, "MAG_RAW", time_usec=time_us - 7, power_cycle=2, flags=8, temperature=4, **raw)
        if k != 1:
            field: dict[str, Any] = {"total_field": 50_000.125 + k, "total_field_sigma": 2, "x": 1}
            field |= {"anomaly": np.nan, "flags": int(Quality.GAP)}
            log.ours(k, "MAG_FIELD", time_usec=time_us - 7, **field)
        log.ours(k, "NAMED_VALUE_FLOAT", name="mag", value=50_000)
        log.ours(k, "HIGHRES_IMU", xmag=0.5)
    back = log.read(tmp_path)
    np.testing.assert_allclose(back["time"], (T0 - 7) / S + np.arange(3.0), rtol=0, atol=1e-6)
    np.testing.assert_allclose(back["mag_time_z"] - back["time"], 20e-6, rtol=0, atol=0.5e-6)
    np.testing.assert_array_equal(back["mag_z"], [0, 1, 2])
    np.testing.assert_array_equal(back["battpos"], [0, 1, 2])
    np.testing.assert_array_equal(back["power_cycle"], [2, 2, 2])
    np.testing.assert_array_equal(back["sensor_temperature"], [4, 4, 4])
    np.testing.assert_array_equal(back["total_field"], [50_000.125, np.nan, 50_002.125])
    np.testing.assert_array_equal(back["quality"], [128, np.nan, 128])
    np.testing.assert_array_equal(back["imu_temperature"], [25.5] * 3)  # the autopilot's; ours says none
    assert not {"mag", "sensor_supply"} & set(back.data_vars)


@pytest.mark.parametrize(("wanted", "expected"), [(0, [7, 1, 2]), (99, [7, 8, 9])])
def test_of_two_components_a_bridges_log_is_read_as_it_was_corrected(
    tmp_path: Path, wanted: int, expected: list[float]
) -> None:
    """The autopilot's value from the first on, unless the configuration names another component."""
    log = Log()
    log.ours(0, "MAG_BRIDGE_START", channel=Channel.STATE)
    for column, what in (
        ("battpos", {"message": "NAMED_VALUE_FLOAT", "field": "value", "match": "name=battpos"}),
        ("ballast", {"message": "DEBUG_FLOAT_ARRAY", "field": "data[0]", "match": "array_id=7"}),
    ):
        log.ours(0, "MAG_COLUMN", channel=Channel.STATE, column=column, scale=1, component=wanted, **what)
    for k in range(3):
        for component, value in ((99, 7 + k), (1, k)):
            by: dict[str, Any] = {"by": (1, component), "channel": Channel.LINK}
            if k or component != 1:
                log.write_message(k, "NAMED_VALUE_FLOAT", name="battpos", value=value, **by)
                log.write_message(k, "DEBUG_FLOAT_ARRAY", array_id=7, data=[value, *[0] * 57], **by)
        log.ours(k, "MAG_RAW", time_usec=T0 + k * S, x=1.0, y=2.0, z=3.0)
    back = log.read(tmp_path)
    np.testing.assert_array_equal(back["battpos"], expected)
    np.testing.assert_array_equal(back["ballast"], expected)


@pytest.mark.parametrize("step", [-3600 * S, 3600 * S, 50 * 31_557_600 * S])
def test_a_clock_that_is_set_costs_no_rows_and_dates_those_before(tmp_path: Path, step: int) -> None:
    """The stamps of the records continue; published messages are dated by the clock as it is set."""
    log = Log()
    log.ours(0, "MAG_BRIDGE_START", channel=Channel.STATE)
    for k in range(6):
        set_us = step if k >= 3 else 0
        if k == 3:
            log.write_message(
                k, "MAG_CLOCK_STEP", by=(0, 0), channel=Channel.STATE, time_usec=T0 + k * S + step, step=step
            )
        log.ours(k, "MAG_RAW", time_usec=T0 + k * S + set_us, x=k, delay_z=20)
    back = log.read(tmp_path)
    np.testing.assert_array_equal(back["time"], [(T0 + step) / S + k for k in range(6)])
    np.testing.assert_array_equal(back["mag_x"], range(6))
    np.testing.assert_allclose(back["mag_time_z"] - back["time"], 20e-6, rtol=0, atol=0.5e-6)
    assert not passed_over(back.attrs)


def test_a_bridges_log_without_readings_gives_no_compass_instead(tmp_path: Path) -> None:
    log = Log()
    log.ours(0, "MAG_BRIDGE_START", channel=Channel.STATE)
    log.mag(1, 9, channel=Channel.LINK)
    with pytest.raises(FormatError, match=r"log\.tlog: expected MAVLink records with one of MAG_RAW"):
        log.read(tmp_path)


def test_the_log_says_what_its_parameters_are(tmp_path: Path) -> None:
    """Like a bridge's ``[telemetry]``, the log declares any field of any message, scaled and named."""
    log = Log()
    name: dict[str, Any] = {"message": "NAMED_VALUE_FLOAT", "field": "value", "match": "name=batt"}
    array: dict[str, Any] = {"message": "DEBUG_FLOAT_ARRAY", "field": "data[3]"}
    array["match"] = "name=masses,array_id=7"
    servo: dict[str, Any] = {"message": "SERVO_OUTPUT_RAW", "field": "servo2_raw"}
    log.write_message(0, "MAG_COLUMN", column="battery_position", unit="in", scale=0.5, offset=1, **name)
    log.write_message(0, "MAG_COLUMN", column="ballast", unit="cc", scale=2, **array)
    log.write_message(0, "MAG_COLUMN", column="servo2", unit="deg", scale=0.1, offset=-150, **servo)
    log.write_message(
        0, "MAG_COLUMN", column="other", unit="1", scale=1, message="NOT_YET_INVENTED", field="x"
    )
    log.write_message(0, "MAG_COLUMN", column="heading_reference", unit="magnetic")
    for k in range(3):
        log.write_message(k, "NAMED_VALUE_FLOAT", name="batt", value=k)
        log.write_message(k, "DEBUG_FLOAT_ARRAY", name="masses", array_id=7, data=[0, 0, 0, k, *[0] * 54])
        log.write_message(k, "DEBUG_FLOAT_ARRAY", name="masses", array_id=8, data=[9] * 58)
        log.write_message(k, "SERVO_OUTPUT_RAW", servo1_raw=1500, servo2_raw=1600 + k)
        log.mag(k, k)
    back = log.read(tmp_path)
    np.testing.assert_array_equal(back["battery_position"], [1, 1.5, 2])
    np.testing.assert_array_equal(back["ballast"], [0, 2, 4])
    np.testing.assert_allclose(back["servo2"], [10, 10.1, 10.2])
    np.testing.assert_array_equal(back["servo1"], [1500] * 3)
    units = [back[name].attrs["units"] for name in ("battery_position", "ballast", "servo2")]
    assert units == ["in", "cc", "deg"]
    assert back.attrs["heading_reference"] == "magnetic"
    assert not {"batt", "other"} & set(back.data_vars)


def test_damage_is_passed_over_and_counted(tmp_path: Path) -> None:
    log = Log()
    ends = []
    for k in range(50):
        log.mag(k, k)
        ends.append(len(log.data))
    whole = log.data
    torn = bytearray(whole)
    torn[ends[9] + 20] ^= 0x40  # in record 10
    del torn[ends[29] : ends[29] + 7]  # the head of record 30
    log.data = bytes(torn[:-5])  # and the tail of the last
    back = log.read(tmp_path)
    np.testing.assert_array_equal(back["mag_x"], [100 * k for k in range(50) if k not in (10, 30, 49)])
    assert back.attrs["damages"] == 3
    assert back.attrs["bytes_skipped"] == len(log.data) - 47 * ends[0]
    pieces = list(logs.read_chunks(tmp_path / "log.tlog", 7))
    assert passed_over(*(piece.attrs for piece in pieces))["damages"] == 3


def test_version_1_frames(tmp_path: Path) -> None:
    mav = v1.MAVLink(None, srcSystem=1, srcComponent=1)
    log = Log()
    for k in range(4):
        for message in (
            v1.MAVLink_named_value_float_message(0, b"battpos", k),
            v1.MAVLink_named_value_float_message(0, b"ballast", -k),
            v1.MAVLink_raw_imu_message(0, 0, 0, 0, 0, 0, 0, k, 2, 3),
        ):
            log.data += pack_record(T0 + k * S, 0, message.pack(mav))
    back = log.read(tmp_path)
    np.testing.assert_array_equal(back["battpos"], [0, 1, 2, 3])
    np.testing.assert_array_equal(back["ballast"], [0, -1, -2, -3])
    np.testing.assert_array_equal(back["mag_x"], [0, 100, 200, 300])


def test_a_live_log_is_read_back(tmp_path: Path) -> None:
    codec = Codec(1, 191)
    with closing(TlogWriter(tmp_path, max_size=0.01)) as log:
        for k in range(500):
            frame = codec.pack("MAG_RAW", time_usec=T0 + k * S + 1, x=k, temperature=np.nan, supply=np.nan)
            log.extend([(T0 + k * S, Channel.SENT, frame)])
    files = sorted(tmp_path.iterdir())
    assert len(files) > 2
    with files[-1].open("ab") as file:
        file.write(pack_record(T0 + 500 * S, 0, frame)[:-3])  # torn by a power cut
    back = logs.read(files)
    np.testing.assert_array_equal(back["mag_x"], np.arange(500.0))
    np.testing.assert_allclose(back["time"], T0 / S + 1e-6 + np.arange(500.0), rtol=0, atol=0.5e-6)
    assert back.attrs["damages"] == 1


def header_of(driver: str, options: dict[str, Any]) -> list[bytes]:
    """Return the frames at the begin of each log file of a bridge with one sensor."""
    config = Config(Sensor(driver, "/dev/ttyUSB0"), Link("udpout:h:1"))
    return declarations(config, [open_driver(driver, options)], {})


def test_channels_are_what_the_driver_made_of_its_counts(tmp_path: Path) -> None:
    """Bit for bit, where MAG_RAW's float32 is off by up to 0.002 nT; counts of another number are none."""
    options = {"sensitivity": 2.5e-5}  # of a digitizer at 100,000 nT
    nt_per_count = open_driver("digitizer", options).nt_per_count
    counts = np.random.default_rng(1).integers(-(2**22), 2**22, (100, 3))
    field = counts * nt_per_count
    codec = Codec(1, 191)
    with closing(TlogWriter(tmp_path, header=header_of("digitizer", options))) as log:
        log.extend([(T0, Channel.STATE, codec.pack("MAG_BRIDGE_START"))])
        for k, (channels, numbers) in enumerate(zip(field, counts.tolist(), strict=True)):
            values = dict(zip("xyz", channels, strict=True))
            for axis, number in zip("xyz", numbers, strict=True):
                values[f"count_{axis}"] = 0 if k == 99 else number
            log.extend([(T0 + k * S, Channel.SENT, codec.pack("MAG_RAW", time_usec=T0 + k * S, **values))])
    back = logs.read(sorted(tmp_path.iterdir()))
    for axis, exact in zip("xyz", field.T, strict=True):
        single = exact.astype(np.float32).astype(float)
        np.testing.assert_array_equal(back[f"mag_{axis}"], [*exact[:-1], single[-1]])
        assert np.abs(single - exact).max() > 1e-4


def test_names_longer_than_ten_letters(tmp_path: Path) -> None:
    """Cut for the message, whole again in the deployment; any MAVLink tool plots the short one."""
    values = {"water_temperature": 0.0, "water_temperatures": 1.0, "water_temp": 2.0}
    columns = {name: [value] for name, value in values.items()}
    logs.write(deployment("made", [1.0], columns, {"water_temp": "degC"}), tmp_path / "log.tlog")
    back = logs.read(tmp_path / "log.tlog")
    assert {name: back[name].item() for name in back.data_vars} == values
    assert back["water_temp"].attrs["units"] == "degC"


def test_any_mavlink_tool_reads_what_we_write(tmp_path: Path) -> None:
    dataset = deployment(
        "made", [1.0, 2.0], {"mag_x": [5, 6], "roll": [90, 0], "battpos": [0.5, 1]}, {"battpos": "in"}
    )
    logs.write(dataset, tmp_path / "log.tlog")
    log = mavutil.mavlink_connection(str(tmp_path / "log.tlog"))
    seen = list(iter(log.recv_match, None))
    log.close()
    rolls = [message.roll for message in seen if message.get_type() == "ATTITUDE"]
    assert rolls == pytest.approx([np.pi / 2, 0])
    assert [message.value for message in seen if message.get_type() == "NAMED_VALUE_FLOAT"] == [0.5, 1]
    assert not [message for message in seen if message.get_type() == "BAD_DATA"]


# ---- which of several senders a column is taken from ------------------------------------------------------


NAMED, FIVE = "NAMED_VALUE_FLOAT", np.arange(5)
GIMBAL = [("ATTITUDE", (1, 154), {"pitch": -1.2})] * 3
Sent = Callable[[int], list[tuple[str, tuple[int, int], dict[str, Any]]]]
"""Number of the row -> message, sender and fields."""
SENDERS: dict[str, tuple[Sent, dict[str, Any]]] = {
    "a named value never takes a column with a source": (
        lambda _: [
            ("ATTITUDE", (1, 1), {"yaw": 1.0}),
            (NAMED, (1, 1), {"name": "heading", "value": 7.0}),
            (NAMED, (1, 1), {"name": "mag_x", "value": 8.0}),
        ],
        {"heading": np.degrees(1.0), "named_heading": 7.0, "named_mag_x": 8.0},
    ),
    "a named value is the autopilot's where two send it": (
        lambda k: [
            (NAMED, (1, 1), {"name": "battpos", "value": k}),
            (NAMED, (1, 99), {"name": "battpos", "value": -9.0}),
            (NAMED, (1, 99), {"name": "ballast", "value": 200.0 + k}),
        ],
        {"battpos": FIVE, "ballast": 200.0 + FIVE},
    ),
    "a gimbal's attitude is not the vehicle's": (
        lambda _: [("ATTITUDE", (1, 1), {"pitch": 0.1}), *GIMBAL],
        {"pitch": np.degrees(0.1)},
    ),
    "a temperature of 0 is none": (lambda _: [], {}),
}


@pytest.mark.parametrize("case", SENDERS)
def test_a_column_is_taken_from_one_source(case: str, tmp_path: Path) -> None:
    sent, expected = SENDERS[case]
    log = Log()
    for k in range(5):
        for message, by, fields in sent(k):
            log.write_message(k, message, by=by, **fields)
        log.write_message(k, "RAW_IMU", xmag=100 + k)
    back = log.read(tmp_path)
    assert set(back.data_vars) - {"roll", "pitch", "heading"} <= {"mag_x", "mag_y", "mag_z", *expected}
    for name, values in (expected | {"mag_x": 100.0 * (100 + FIVE)}).items():
        np.testing.assert_allclose(back[name], np.broadcast_to(values, 5), rtol=1e-6)
    renamed = [name for name in expected if name.startswith("named_")]
    assert all(name in " ".join(noted(back.attrs)) for name in renamed)


def test_another_compass_makes_the_rows(tmp_path: Path) -> None:
    log = Log()
    for k in range(5):
        log.write_message(k, "RAW_IMU", xmag=k)
        log.write_message(k + 0.5, "SCALED_IMU2", xmag=50 + k)
    assert [one.number for one in compasses_in(log.read(tmp_path))] == [0, 1]
    back = log.read(tmp_path, compass="1")
    np.testing.assert_allclose(back["mag_x"], 100.0 * (50 + FIVE))
    np.testing.assert_allclose(back["time"] - T0 / S, 0.5 + FIVE)


@pytest.mark.real
@pytest.mark.parametrize("name", ["small.tlog", "damaged.tlog"])
def test_blocks_of_any_size_give_the_same(
    name: str, real_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = real_data / "ardusub" / name
    whole = logs.read(path)
    monkeypatch.setattr(telemetry, "blocks", partial(blocks, block_bytes=5_000))
    xr.testing.assert_identical(whole, logs.read(path))
