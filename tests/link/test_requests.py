"""The bridge requests the messages that it needs, and never lowers a rate."""

from __future__ import annotations

from collections.abc import Mapping

from magbridge.config import Telemetry
from magbridge.link.output import Announcer, Outbox, Timers
from magbridge.link.telemetry import Stream, StreamRequests, needed_rates
from magbridge.mavlink import Codec, Message, spec
from magbridge.mavlink.enums import MAV_CMD, MAV_RESULT, MAV_TYPE

SECOND = 1_000_000
ATTITUDE, VFR_HUD = (1, spec("ATTITUDE").id), (1, spec("VFR_HUD").id)
NEEDED = {ATTITUDE: (10.0, 4.0), VFR_HUD: (5.0, 2.0)}


class Bench:
    """An autopilot that sends messages at given rates, and answers each request with one result."""

    def __init__(
        self,
        kind: int,
        result: int = MAV_RESULT.ACCEPTED,
        needed: Mapping[Stream, tuple[float, float]] = NEEDED,
    ) -> None:
        self.codec = Codec(1, 191)
        self.outbox, self.timers = Outbox(self.codec), Timers()
        self.announcer = Announcer(self.outbox, self.timers)
        self.requests = StreamRequests((1, 1), needed, self.outbox, self.timers, self.announcer)
        self._ear, self._kind, self._result = Codec(0, 0), kind, result
        self._codecs = {1: Codec(1, 1), 25: Codec(1, 25)}
        self.receivers: set[int] = set()
        self.asked: list[tuple[str, float]] = []
        self.now_us = 0

    def run(self, seconds: int, component: int = 1, **rates: int) -> None:
        for _ in range(seconds):
            self._give("HEARTBEAT", type=self._kind)
            for name, rate in rates.items():
                for _ in range(rate):
                    self._give(name, component)
            self.now_us += SECOND
            self.codec.now_us = self.now_us
            self.timers.advance(self.now_us, lambda _: None)
            self._answer()

    def _give(self, name: str, component: int = 1, **fields: object) -> None:
        (message,) = self._ear.parse(self._codecs[component].pack(name, **fields))
        self.requests.receive(message, self.now_us)

    def _answer(self) -> None:
        while frames := self.outbox.drain():
            for _, frame in frames:
                (message,) = Codec(0, 0).parse(frame)
                if message.name == "COMMAND_LONG":
                    self._keep(message)

    def _keep(self, message: Message) -> None:
        assert message["command"] == MAV_CMD.SET_MESSAGE_INTERVAL
        assert message["target_system"] == 1
        self.receivers.add(message["target_component"])
        self.asked.append((spec(int(message["param1"])).name, 1e6 / message["param2"]))
        self._give(
            "COMMAND_ACK",
            message["target_component"],
            command=MAV_CMD.SET_MESSAGE_INTERVAL,
            result=self._result,
        )


def test_messages_that_arrive_too_rarely_are_requested_at_the_rates_of_the_vehicle() -> None:
    plane, glider = Bench(1), Bench(int(MAV_TYPE.SUBMARINE))
    for bench in (plane, glider):
        bench.run(12, ATTITUDE=1, VFR_HUD=1)
    assert plane.asked == [("ATTITUDE", 10.0), ("VFR_HUD", 5.0)]
    assert glider.asked == [("ATTITUDE", 4.0), ("VFR_HUD", 2.0)]
    assert plane.receivers == {1}


def test_a_rate_that_is_high_enough_stays_as_another_client_has_set_it() -> None:
    bench = Bench(1)
    bench.run(60, ATTITUDE=50, VFR_HUD=4)
    assert bench.asked == []
    assert bench.requests.measured["ATTITUDE"] == 50.0


def test_a_request_is_repeated_a_few_times_and_again_after_a_reboot() -> None:
    bench = Bench(1)
    bench.run(120, ATTITUDE=1, VFR_HUD=5)
    assert bench.asked == [("ATTITUDE", 10.0)] * 3
    bench.requests.rebooted()
    bench.run(12, ATTITUDE=1, VFR_HUD=5)
    assert len(bench.asked) == 4


def test_a_denial_is_reported_and_not_repeated() -> None:
    bench = Bench(1, MAV_RESULT.DENIED)
    bench.run(60, ATTITUDE=1, VFR_HUD=5)
    assert bench.asked == [("ATTITUDE", 10.0)]
    assert [text for _, text in bench.announcer.texts] == [
        "the autopilot does not send ATTITUDE at 10 Hz: DENIED"
    ]


def test_telemetry_is_requested_from_the_component_that_is_its_source() -> None:
    battery = Telemetry("BATTERY_STATUS", "current_battery", component=25)
    needed = needed_rates(1, [battery], attitude=False, navigation=False)
    bench = Bench(1, MAV_RESULT.UNSUPPORTED, needed)
    bench.run(12, 1, GLOBAL_POSITION_INT=5, BATTERY_STATUS=5)
    assert bench.asked == [("BATTERY_STATUS", 5.0)]
    assert bench.receivers == {25}
    assert bench.requests.denied == {
        "BATTERY_STATUS": "component 25 does not send BATTERY_STATUS at 5 Hz: UNSUPPORTED"
    }


def test_telemetry_that_another_component_sends_is_not_requested_from_the_autopilot() -> None:
    needed = needed_rates(1, [Telemetry("RPM", "rpm1")], attitude=False, navigation=False)
    bench = Bench(1, needed={stream: pair for stream, pair in needed.items() if stream[1] == spec("RPM").id})
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
        "VFR_HUD",
    }
