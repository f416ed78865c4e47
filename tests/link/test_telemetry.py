"""Test that any field of any message can become a parameter."""

import time
from math import inf, nan
from pathlib import Path
from typing import Any

import pytest

from magbridge.config import Telemetry
from magbridge.errors import ConfigError
from magbridge.link.telemetry import TelemetryMap, is_possible
from magbridge.link.vehicle import VehicleClock
from magbridge.mavlink import SECRET, Codec, LogReader
from magbridge.mavlink.messages import EXTRA, spec

NOW = 1_700_000_000_000_000


def values(
    telemetry: dict[str, Telemetry],
    message_name: str,
    clock: VehicleClock | None = None,
    component: int = 1,
    /,
    **fields: Any,
) -> list[tuple[str, float, int]]:
    (message,) = Codec(1, 191).parse(Codec(1, component).pack(message_name, **fields))
    return TelemetryMap(telemetry).values(message, NOW, clock or VehicleClock())


def test_scale_offset_and_match() -> None:
    telemetry = {
        "battpos": Telemetry("NAMED_VALUE_FLOAT", "value", match={"name": "battpos"}, scale=2.0, offset=1.0),
        "fin": Telemetry("NAMED_VALUE_FLOAT", "value", match={"name": "fin"}),
        "copy": Telemetry("NAMED_VALUE_FLOAT", "value"),
    }
    got = values(telemetry, "NAMED_VALUE_FLOAT", name="battpos", value=0.5)
    assert got == [("battpos", 2.0, NOW), ("copy", 0.5, NOW)]
    assert values(telemetry, "ATTITUDE", roll=1) == []


def test_a_text_matches_whole() -> None:
    names = "bat", "batteryone"
    named = {name: Telemetry("NAMED_VALUE_FLOAT", "value", match={"name": name}) for name in names}
    for sent in ("bat", "batteryone", "batt", "ba", ""):  # ten bytes fill the field, without a zero
        got = values(named, "NAMED_VALUE_FLOAT", name=sent, value=0.5)
        assert got == [(name, 0.5, NOW) for name in named if name == sent]


def test_arrays_numeric_match_and_unknown_values() -> None:
    telemetry = {
        "first": Telemetry("ACTUATOR_OUTPUT_STATUS", "actuator[0]"),
        "last": Telemetry("ACTUATOR_OUTPUT_STATUS", "actuator[31]"),
        "cell": Telemetry("BATTERY_STATUS", "voltages[1]", match={"id": 1}, scale=1e-3),
        "cov": Telemetry("GPS_STATUS", "satellite_snr[3]"),
    }
    actuators = values(telemetry, "ACTUATOR_OUTPUT_STATUS", actuator=[*range(32)])
    assert actuators == [("first", 0.0, NOW), ("last", 31.0, NOW)]
    cells = [4100, 4200, *[65535] * 8]
    assert values(telemetry, "BATTERY_STATUS", voltages=cells, id=1) == [("cell", 4.2, NOW)]
    assert values(telemetry, "BATTERY_STATUS", voltages=cells, id=0) == []
    assert values(telemetry, "GPS_STATUS", satellite_snr=bytes(range(20))) == [("cov", 3, NOW)]
    telemetry = {"i": Telemetry("SYS_STATUS", "current_battery", scale=0.01)}
    for current, ampere in ((-1, nan), (150, 1.5)):  # -1: not known
        ((_, value, _),) = values(telemetry, "SYS_STATUS", current_battery=current)
        assert value == pytest.approx(ampere, nan_ok=True)


def known_clock(offset_us: int) -> VehicleClock:
    clock = VehicleClock()
    clock.answer((NOW + offset_us) * 1000, clock.ask(NOW), NOW)
    return clock


def test_the_messages_own_time() -> None:
    telemetry = {"roll": Telemetry("ATTITUDE", "roll"), "servo": Telemetry("SERVO_OUTPUT_RAW", "servo1_raw")}
    clock = known_clock(-NOW + 3_600_000_000 * 5)  # the autopilot runs for 5 h
    boot_ms = 3_600_000 * 5
    (one,) = values(telemetry, "ATTITUDE", clock, time_boot_ms=boot_ms - 250, roll=1)
    assert one == ("roll", 1.0, NOW - 250_000)
    (one,) = values(telemetry, "ATTITUDE", clock, time_boot_ms=boot_ms + 250, roll=1)
    assert one[2] == NOW  # not in the future
    (one,) = values(telemetry, "ATTITUDE", clock, 158, time_boot_ms=boot_ms - 250, roll=1)
    assert one[2] == NOW  # another clock
    (one,) = values(telemetry, "ATTITUDE", clock, time_boot_ms=0, roll=1)
    assert one[2] == NOW  # not filled in
    micros = (boot_ms * 1000 - 100_000) % (1 << 32)  # wraps every 71 minutes
    (one,) = values(telemetry, "SERVO_OUTPUT_RAW", clock, time_usec=micros, servo1_raw=1500)
    assert one == ("servo", 1500.0, NOW - 100_000)
    fix = {"gps": Telemetry("GPS_RAW_INT", "satellites_visible")}
    (one,) = values(fix, "GPS_RAW_INT", clock, time_usec=boot_ms * 1000 - 50_000, satellites_visible=9)
    assert one == ("gps", 9.0, NOW - 50_000)
    (one,) = values(fix, "GPS_RAW_INT", clock, time_usec=NOW - 50_000, satellites_visible=9)
    assert one[2] == NOW  # UNIX time, of another clock


NAMED, SERVO = ("NAMED_VALUE_FLOAT", "value"), ("SERVO_OUTPUT_RAW", "servo1_raw")


@pytest.mark.parametrize(
    ("source", "match", "complaint"),
    [
        (("NO_SUCH", "x"), {}, r"b.toml: telemetry.p.message: unknown MAVLink message 'NO_SUCH'"),
        (("ATTITUDE", "rol"), {}, r"p.field: ATTITUDE has no field 'rol'; did you mean roll?"),
        (("ATTITUDE", "roll[0]"), {}, r"telemetry.p.field: roll without an index, not 'roll\[0\]'"),
        (("ACTUATOR_OUTPUT_STATUS", "actuator"), {}, r"actuator\[0\] to actuator\[31\], not 'actuator'"),
        (("ACTUATOR_OUTPUT_STATUS", "actuator[32]"), {}, r"actuator\[0\] to actuator\[31\]"),
        (("ATTITUDE", "roll-pitch"), {}, r"has no field 'roll-pitch'"),
        (("STATUSTEXT", "text"), {}, r"a number, but STATUSTEXT.text is text"),
        (NAMED, {"nam": "a"}, r"telemetry.p.match.nam: .* no field 'nam'"),
        (NAMED, {"name": 3}, r"telemetry.p.match.name: text, not 3"),
        (NAMED, {"name": "battery_position"}, r"p.match.name: at most 10 bytes, not 'battery_position'"),
        (SERVO, {"port": 300}, r"p.match.port: a value that SERVO_OUTPUT_RAW.port can have, not 300"),
        (("BATTERY_STATUS", "id"), {"id": "a"}, r"telemetry.p.match.id: a number, not 'a'"),
    ],
)
def test_mistakes_are_one_clear_line(
    source: tuple[str, str], match: dict[str, str | float], complaint: str
) -> None:
    with pytest.raises(ConfigError, match=complaint):
        TelemetryMap({"p": Telemetry(*source, match=match)}, path=Path("b.toml"))


@pytest.mark.parametrize(
    ("name", "fields", "possible"),
    [
        ("ODOMETRY", {"q": (0.6, 0.0, -0.8, 0.0), "x": nan}, True),
        ("ODOMETRY", {"q": (1.2, 0.0, 0.0, 0.0)}, False),
        ("ODOMETRY", {"vx": inf}, False),
        ("ATTITUDE", {"yaw": -6.3}, True),
        ("ATTITUDE", {"yaw": nan}, False),
        ("GPS_RAW_INT", {"lat": -900_000_001}, False),
    ],
)
def test_values_that_no_vehicle_has_are_impossible(name: str, fields: dict[str, Any], possible: bool) -> None:
    (message,) = Codec(0, 0).parse(Codec(1, 1).pack(name, **fields))
    assert is_possible(message) is possible


def test_every_numeric_field_of_every_message_maps() -> None:
    for number in EXTRA.keys() - SECRET:
        layout = spec(number)
        telemetry = {
            name: Telemetry(layout.name, f"{name}[{field.count - 1}]" if field.count else name)
            for name, field in layout.fields.items()
            if field.code != "s"
        }
        got = values(telemetry, layout.name)
        assert [name for name, _, _ in got] == list(telemetry)
        assert all(isinstance(value, (int, float)) for _, value, _ in got)


@pytest.mark.real
def test_measured_telemetry(real_data: Path) -> None:
    wanted = {
        "roll": Telemetry("ATTITUDE", "roll"),
        "current": Telemetry("SYS_STATUS", "current_battery", scale=0.01, unit="A"),
        "thruster": Telemetry("SERVO_OUTPUT_RAW", "servo3_raw"),
        "mag_x": Telemetry("RAW_IMU", "xmag"),
    }
    telemetry, clock = TelemetryMap(wanted), VehicleClock()
    got: dict[str, list[float]] = {name: [] for name in wanted}
    with (real_data / "ardusub" / "small.tlog").open("rb") as file:
        records = [(one.time_us, one.message) for one in LogReader(file)]
    begin = time.process_time()
    for at, message in records:
        for name, value, _ in telemetry.values(message, at, clock):
            got[name].append(value)
    assert (time.process_time() - begin) / len(records) < 10e-6
    assert len(got["roll"]) > 5000 * 0.9
    assert max(map(abs, got["roll"])) < 3.2
    assert 0 < sum(got["current"]) / len(got["current"]) < 50
    assert all(1000 <= one <= 2000 for one in got["thruster"])
