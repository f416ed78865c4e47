"""Test that commands are acknowledged to their sender."""

from itertools import pairwise
from math import inf, nan
from typing import Any

import pytest
from line import Line, MakeLine

from magbridge.config import Telemetry
from magbridge.link.output import Output
from magbridge.link.telemetry import TelemetryMap, needed_rates
from magbridge.mavlink import Codec, spec
from magbridge.mavlink.enums import MAV_CMD, MAV_RESULT, MAV_TYPE

ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED = 0, 1, 2, 3
FIELD, HEARTBEAT, STATUS, HIGHRES_IMU, VERSION, METADATA = 60101, 0, 60102, 105, 148, 397
GET, SET, REQUEST, CAPABILITIES, START_MAG_CAL = 510, 511, 512, 520, 42424


def result(link: Line, messages: list[Any]) -> int:
    (ack,) = link.only(messages, "COMMAND_ACK")
    assert (ack.get_srcComponent(), ack.command) == (191, link.asked)
    number: int = ack.result
    return number


def test_request_message(link: Line) -> None:
    received = link.command(REQUEST, STATUS)
    assert result(link, received) == ACCEPTED
    assert len(link.only(received, "MAG_STATUS")) == 1
    assert result(link, link.command(REQUEST, FIELD)) == TEMPORARILY_REJECTED  # no sample yet
    for number in (24, nan, inf):
        assert result(link, link.command(REQUEST, number)) == DENIED


def test_version(link: Line) -> None:
    for number, param in ((REQUEST, VERSION), (CAPABILITIES, 1)):
        received = link.command(number, param)
        assert result(link, received) == ACCEPTED
        (version,) = link.only(received, "AUTOPILOT_VERSION")
        assert version.flight_sw_version == 0x010203FF
        assert version.capabilities == 2 | 8 | 32 | 8192 | 131072


def test_intervals(link: Line) -> None:
    received = link.command(SET, HIGHRES_IMU, 100_000)
    assert result(link, received) == ACCEPTED
    (value,) = link.only(received, "PARAM_VALUE")  # a parameter changed: stations want to know
    assert (value.param_id, value.param_value) == ("MB_R_HIGHRES_IMU", 10.0)
    for asked in ((GET, HIGHRES_IMU), (REQUEST, 244, HIGHRES_IMU)):  # MAVLink deprecates the first
        received = link.command(*asked)
        assert result(link, received) == ACCEPTED
        assert link.only(received, "MESSAGE_INTERVAL")[0].interval_us == 100_000
    assert result(link, link.command(SET, HIGHRES_IMU, -1)) == ACCEPTED
    assert link.only(link.command(GET, HIGHRES_IMU), "MESSAGE_INTERVAL")[0].interval_us == -1
    assert result(link, link.command(SET, HEARTBEAT, 200_000)) == ACCEPTED
    assert len(link.only(link.to(10.05), "HEARTBEAT")) == pytest.approx(50, abs=1)
    assert result(link, link.command(SET, HEARTBEAT, 0)) == ACCEPTED
    assert len(link.only(link.to(20.05), "HEARTBEAT")) == pytest.approx(10, abs=1)
    for message in (HIGHRES_IMU, STATUS):  # MESSAGE_INTERVAL holds 36 minutes
        assert result(link, link.command(SET, message, 1e38)) == ACCEPTED
        assert link.only(link.command(GET, message), "MESSAGE_INTERVAL")[0].interval_us == 0x7FFFFFFF
    assert link.only(link.command(GET, 24), "MESSAGE_INTERVAL")[0].interval_us == 0  # not sent
    assert result(link, link.command(GET, 70_000)) == DENIED


@pytest.mark.parametrize(
    ("message", "interval"),
    [(HEARTBEAT, -1), (HEARTBEAT, 1e9), (FIELD, 10), (FIELD, -2), (FIELD, nan), (24, 10), (-1, 0), (1e30, 0)],
)
def test_intervals_that_are_refused(link: Line, message: float, interval: float) -> None:
    before = dict(link.component.parameters.changed())
    assert result(link, link.command(SET, message, interval)) == DENIED
    assert link.component.parameters.changed() == before


def test_an_unknown_command_is_unsupported_and_its_sender_is_told_but_not_for_others(link: Line) -> None:
    assert result(link, link.command(400, 1)) == UNSUPPORTED
    frame = next(frame for _, frame in reversed(link.sent) if frame[7] == 77)
    assert frame[10 + 8 : 10 + 10] == bytes((255, 190))  # target_system, target_component
    assert link.command(400, 1, target=(1, 1)) == []
    assert link.command(400, 1, target=(2, 191)) == []


def test_to_everybody_we_do_only_what_only_we_can(link: Line) -> None:
    assert link.command(START_MAG_CAL, 1, target=(1, 0)) == []
    assert link.command(REQUEST, VERSION, target=(1, 0)) == []
    assert link.command(SET, HIGHRES_IMU, 1000, target=(0, 0)) == []
    received = link.command(REQUEST, STATUS, target=(1, 0))
    assert result(link, received) == ACCEPTED
    assert len(link.only(received, "MAG_STATUS")) == 1


def test_a_flood_is_rejected_and_reported_once_and_costs_no_other_peer(link: Line) -> None:
    """The flood requests metadata: the bridge replies to the first hundred requests in a second."""
    results = [result(link, link.command(REQUEST, METADATA)) for _ in range(300)]
    assert results == [ACCEPTED] * 100 + [TEMPORARILY_REJECTED] * 200
    others = Codec(255, 191)
    ask = {"target_system": 1, "target_component": 191, "command": REQUEST, "param1": METADATA}
    received = link.give(others.pack("COMMAND_LONG", **ask))
    assert [one.result for one in link.only(received, "COMMAND_ACK")] == [ACCEPTED]
    reported = [text for _, text in link.component.output.texts if "commands a second" in text]
    assert reported == ["more than 100 commands a second from 255:190"]
    link.to(2.0)
    assert result(link, link.command(REQUEST, METADATA)) == ACCEPTED


# ---- The bridge requests the messages that it needs, and never lowers a rate -----------------------------


ATTITUDE, VFR_HUD = (1, spec("ATTITUDE").id), (1, spec("VFR_HUD").id)
NEEDED = {ATTITUDE: (10.0, 4.0), VFR_HUD: (5.0, 2.0)}


class Bench:
    """Autopilot that sends messages at given rates, and replies to each request with one result."""

    def __init__(self, link: Line, kind: int, result: int = ACCEPTED) -> None:
        self.link, self.requests = link, link.component.streams
        self._kind, self._result, self._seconds = kind, result, 0
        self.receivers: set[int] = set()
        self.asked: list[tuple[str, float]] = []

    def run(self, seconds: int, component: int = 1, **rates: int) -> None:
        codec = Codec(1, component)
        for _ in range(seconds):
            self.link.fly("HEARTBEAT", type=self._kind)
            self.link.give(b"".join(codec.pack(name) for name, rate in rates.items() for _ in range(rate)))
            self._seconds += 1
            self._answer(self.link.to(self._seconds))

    def _answer(self, received: list[Any]) -> None:
        for request in self.link.only(received, "COMMAND_LONG"):
            assert (request.command, request.target_system) == (SET, 1)
            self.receivers.add(request.target_component)
            self.asked.append((spec(int(request.param1)).name, 1e6 / request.param2))
            sender = Codec(1, request.target_component)
            self._answer(self.link.give(sender.pack("COMMAND_ACK", command=SET, result=self._result)))


def test_messages_that_arrive_too_rarely_are_requested_at_the_rates_of_the_vehicle(
    make_link: MakeLine,
) -> None:
    plane, glider = (Bench(make_link(streams=NEEDED), kind) for kind in (1, MAV_TYPE.SUBMARINE))
    for bench in (plane, glider):
        bench.run(12, ATTITUDE=1, VFR_HUD=1)
    assert plane.asked == [("ATTITUDE", 10.0), ("VFR_HUD", 5.0)]
    assert glider.asked == [("ATTITUDE", 4.0), ("VFR_HUD", 2.0)]
    assert plane.receivers == {1}


def test_a_rate_that_is_high_enough_stays_as_another_client_has_set_it(make_link: MakeLine) -> None:
    bench = Bench(make_link(streams=NEEDED), 1)
    bench.run(60, ATTITUDE=50, VFR_HUD=4)
    assert bench.asked == []
    assert bench.requests.measured["ATTITUDE"] == 50.0


def test_a_request_is_repeated_a_few_times_and_again_after_a_reboot(make_link: MakeLine) -> None:
    bench = Bench(make_link(streams=NEEDED), 1)
    bench.run(120, ATTITUDE=1, VFR_HUD=5)
    assert bench.asked == [("ATTITUDE", 10.0)] * 3
    bench.requests.rebooted()
    bench.run(12, ATTITUDE=1, VFR_HUD=5)
    assert len(bench.asked) == 4


def test_a_denial_is_reported_and_not_repeated(make_link: MakeLine) -> None:
    bench = Bench(make_link(streams=NEEDED), 1, DENIED)
    bench.run(60, ATTITUDE=1, VFR_HUD=5)
    assert bench.asked == [("ATTITUDE", 10.0)]
    told = [text for _, text in bench.link.component.output.texts if "does not send" in text]
    assert told == ["the autopilot does not send ATTITUDE at 10 Hz: DENIED"]


def test_telemetry_is_requested_from_the_component_that_is_its_source(make_link: MakeLine) -> None:
    battery = Telemetry("BATTERY_STATUS", "current_battery", component=25)
    needed = needed_rates(1, [battery], attitude=False, navigation=False)
    bench = Bench(make_link(streams=needed), 1, UNSUPPORTED)
    bench.run(12, 1, GLOBAL_POSITION_INT=5, BATTERY_STATUS=5)
    assert bench.asked == [("BATTERY_STATUS", 5.0)]
    assert bench.receivers == {25}
    denied = "component 25 does not send BATTERY_STATUS at 5 Hz: UNSUPPORTED"
    assert bench.requests.denied == {"BATTERY_STATUS": denied}


def test_telemetry_that_another_component_sends_is_not_requested_from_the_autopilot(
    make_link: MakeLine,
) -> None:
    needed = needed_rates(1, [Telemetry("RPM", "rpm1")], attitude=False, navigation=False)
    rpm = {stream: pair for stream, pair in needed.items() if stream[1] == spec("RPM").id}
    bench = Bench(make_link(streams=rpm), 1)
    bench.run(30, 25, RPM=5)
    assert bench.asked == []
    assert bench.requests.measured == {"RPM": 5.0}
    bench.run(12, 25, RPM=1)
    assert bench.receivers == {1}


def test_what_is_needed_depends_on_the_task() -> None:
    telemetry = [Telemetry("NAMED_VALUE_FLOAT", "value"), Telemetry("SYS_STATUS", "current_battery")]
    plain = needed_rates(1, telemetry, attitude=False, navigation=False)
    assert sorted(spec(number).name for _, number in plain) == ["GLOBAL_POSITION_INT", "SYS_STATUS"]
    full = {spec(number).name for _, number in needed_rates(1, attitude=True, navigation=True)}
    assert full == {
        *("ATTITUDE", "EKF_STATUS_REPORT", "EXTENDED_SYS_STATE", "GLOBAL_POSITION_INT", "GPS_RAW_INT"),
        *("RAW_IMU", "SYS_STATUS", "VFR_HUD"),
    }
    both = needed_rates(1, telemetry, attitude=False, navigation=True)
    assert both[1, spec("SYS_STATUS").id] == plain[1, spec("SYS_STATUS").id] == (5.0, 2.0)


# ---- Who may change what the bridge does, and whose telemetry counts -------------------------------------


GCS, QUADROTOR, ONBOARD = 6, 2, 18


def spoken(link: Line, frames: bytes) -> tuple[list[Any], str]:
    received = link.give(frames)
    return received, "".join(link.texts(received))


def texts_by(system: int, component: int, kind: int | None, name: str, **fields: object) -> bytes:
    """Return what a component says after a heartbeat of that kind, or without one."""
    codec = Codec(system, component)
    beat = b"" if kind is None else codec.pack("HEARTBEAT", type=kind)
    return beat + codec.pack(name, target_system=1, target_component=191, **fields)


@pytest.mark.parametrize(
    ("system", "component", "kind", "may"),
    [
        (1, 1, QUADROTOR, True),  # the autopilot
        (255, 190, GCS, True),
        (255, 190, None, True),  # a script that sends no heartbeat
        (1, 190, GCS, True),  # a station on board
        (1, 99, None, False),
        (1, 99, ONBOARD, False),
        (2, 1, QUADROTOR, False),  # another vehicle
    ],
)
def test_who_may_change_parameters_and_rates(
    link: Line, system: int, component: int, kind: int | None, may: bool
) -> None:
    fields = {"param_id": "MB_AGE_BATTPOS", "param_value": 1e6, "param_type": 9}
    received, text = spoken(link, texts_by(system, component, kind, "PARAM_SET", **fields))
    age = 1e6 if may else 30.0
    ages = [v.param_value for v in link.only(received, "PARAM_VALUE") if v.param_id == "MB_AGE_BATTPOS"]
    assert ages == [age]
    assert link.component.parameters["MB_AGE_BATTPOS"] == age
    assert f"{system}:{component}" in text
    interval = {"command": MAV_CMD.SET_MESSAGE_INTERVAL, "param1": 60101, "param2": -1}
    received, text = spoken(link, texts_by(system, component, kind, "COMMAND_LONG", **interval))
    (ack,) = link.only(received, "COMMAND_ACK")
    assert ack.result == (MAV_RESULT.ACCEPTED if may else MAV_RESULT.DENIED)
    assert link.component.rates["MAG_FIELD"].hertz == (-1.0 if may else 0.0)
    assert (f"{system}:{component} may not set a rate" in text) is not may


@pytest.mark.parametrize(
    ("wanted", "order", "admitted"),
    [
        (None, [(0, 1), (0, 99), (1, 1), (1, 99)], [True, False, True, False]),
        (None, [(0, 99), (0, 1), (1, 99), (1, 1)], [True, True, False, True]),  # the autopilot goes first
        (None, [(0, 25), (1, 99), (2, 25), (3, 99)], [True, False, True, False]),
        (None, [(0, 25), (5, 99), (6, 25)], [True, True, False]),  # it had become stale
        (25, [(0, 99), (0, 1), (0, 25), (9, 99)], [False, False, True, False]),
    ],
)
def test_two_sources_of_one_parameter(
    wanted: int | None, order: list[tuple[int, int]], admitted: list[bool]
) -> None:
    output = Output(Codec(1, 191))
    what = Telemetry("NAMED_VALUE_FLOAT", "value", max_age=2.0, component=wanted)
    both = TelemetryMap({"battpos": what})
    messages = {who: Codec(0, 0).parse(Codec(1, who).pack("NAMED_VALUE_FLOAT"))[0] for _, who in order}
    assert [both.admit("battpos", messages[who], s * 1_000_000, output) for s, who in order] == admitted
    reported = [text for _, text in output.texts]
    refused = {who for (_, who), good in zip(order, admitted, strict=True) if not good}
    assert {who for who in refused if f"battpos also from 1:{who}: not used" in reported} == refused
    used = [who for (_, who), good in zip(order, admitted, strict=True) if good]
    changes = [f"battpos now from 1:{new}, not {old}" for old, new in pairwise(used) if new != old]
    assert [text for text in reported if "now from" in text] == changes


@pytest.mark.parametrize(
    "number", [MAV_CMD.DO_START_MAG_CAL, MAV_CMD.DO_CANCEL_MAG_CAL, MAV_CMD.FIXED_MAG_CAL_YAW]
)
def test_a_calibration_is_refused_in_words_and_left_to_the_autopilot(link: Line, number: MAV_CMD) -> None:
    received = link.command(number, 0.0)
    (ack,) = link.only(received, "COMMAND_ACK")
    assert ack.result == MAV_RESULT.UNSUPPORTED
    assert "magbridge calibrate" in "".join(link.texts(received))
    assert link.command(number, 0.0, target=(1, 0)) == []
    assert link.command(number, 0.0, target=(1, 1)) == []


def beat(link: Line, component: int = 190, kind: int = GCS) -> None:
    link.give(Codec(255, component).pack("HEARTBEAT", type=kind))


def values(link: Line, until: float) -> list[Any]:
    return link.only(link.to(until), "PARAM_VALUE")


def test_a_station_that_never_asks_gets_the_parameters_twice(link: Line) -> None:
    names = link.component.parameters.names
    assert not values(link, 1.0)
    received = []
    for second in range(1, 60):
        beat(link)
        received += values(link, 1.0 + second)
    times = [at for at, frame in link.sent if frame[7:10] == b"\x16\0\0"]
    assert times[len(names)] - times[0] == 10_000_000
    for one in (received[: len(names)], received[len(names) :]):
        assert [value.param_id for value in one] == names
        assert [value.param_index for value in one] == list(range(len(names)))
        assert {value.param_count for value in one} == {len(names)}
    beat(link, kind=ONBOARD, component=1)
    assert not values(link, 75.0)


def test_a_crowd_of_stations_is_not_a_flood(link: Line) -> None:
    """Two thousand names in ten seconds; a station that comes then still gets its two lists."""
    for k in range(200):
        for component in range(10):
            link.give(Codec(200 + k % 50, component + 1).pack("HEARTBEAT", type=GCS))
        link.to(0.1 + 0.05 * k)
    before = len([1 for _, frame in link.sent if frame[7:10] == b"\x16\0\0"])
    names = len(link.component.parameters.names)
    assert before <= 2 * names
    assert len(values(link, 45.0)) == 2 * names


def test_requests_without_end_do_not_keep_the_list_from_its_end(link: Line) -> None:
    received = []
    for k in range(40):
        link.send_message("param_request_list", 1, 191)
        received += values(link, 1.0 + 0.1 * k)
    assert {value.param_id for value in received} == set(link.component.parameters.names)
