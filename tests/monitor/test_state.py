"""What the page knows, from frames as a bridge sends them."""

from __future__ import annotations

from math import inf, nan

import pytest

from magbridge.config import Align, Link
from magbridge.link import Component, alignment
from magbridge.mavlink import Codec
from magbridge.monitor.state import State
from magbridge.monitor.words import ago, health, measured, silence, whereabouts
from magbridge.records import Quality

NOW = 1_700_000_000.0


class Air:
    """A bridge's codec and a station's ear."""

    def __init__(self) -> None:
        self.state, self.bridge, self.codec = State(), Codec(1, 191), Codec(255, 190)

    def say(self, now: float, name: str, /, **fields: object) -> None:
        self.give(self.bridge.pack(name, **fields), now)

    def give(self, data: bytes, now: float) -> None:
        for message in self.codec.parse(data):
            self.state.hear(message, now)

    def field(self, now: float, total: float = 52_000.0, flags: int = 0, **fields: object) -> None:
        fields = {"total_field_sigma": 1.0, "time_usec": round(now * 1e6), "anomaly": nan, **fields}
        self.say(now, "MAG_FIELD", total_field=total, flags=flags, **fields)


@pytest.fixture
def air() -> Air:
    return Air()


def test_silence_is_told(air: Air) -> None:
    assert silence(air.state, NOW) == "nothing heard yet"
    assert air.state.heard == -inf
    air.say(NOW, "MAG_STATUS", uptime=5)
    assert silence(air.state, NOW) == "no field heard yet"
    air.field(NOW)
    assert silence(air.state, NOW + 3) == ""
    assert silence(air.state, NOW + 12) == "nothing heard for 12 s"
    air.say(NOW + 12, "MAG_STATUS", uptime=17)
    assert silence(air.state, NOW + 13) == "no field heard for 13 s"
    assert [ago(s) for s in (-1, 0, 119, 121, 7200)] == ["0 s", "0 s", "119 s", "2 min", "2 h"]


def test_a_slow_sensor_is_not_silent(air: Air) -> None:
    for k in range(0, 40, 4):
        air.field(NOW + k)
        air.say(NOW + k + 3.9, "MAG_STATUS", uptime=k)
        assert silence(air.state, NOW + k + 3.9) == ("" if k else "no field heard for 4 s")
    air.say(NOW + 49, "MAG_STATUS", uptime=50)
    assert silence(air.state, NOW + 49) == "no field heard for 13 s"


def test_a_status_that_stops_is_not_the_present_one(air: Air) -> None:
    """Its rate is a parameter: it may be switched off, or once in ten seconds."""
    for k in range(10):
        air.field(NOW + k)
    assert silence(air.state, NOW + 9) == ""  # it never came: dashes are shown
    air.say(NOW + 9, "MAG_STATUS", uptime=9)
    air.field(NOW + 14)
    assert silence(air.state, NOW + 14) == "no status heard for 5 s"
    air.say(NOW + 30, "HEARTBEAT")
    assert silence(air.state, NOW + 31) == "no field heard for 17 s; no status heard for 22 s"
    air.say(NOW + 31, "MAG_STATUS", uptime=31)
    air.field(NOW + 50)
    assert silence(air.state, NOW + 50) == ""


def test_figures_of_a_field_that_stopped_are_not_the_present_ones(air: Air) -> None:
    air.field(NOW, latency=0.0042, telemetry_age=0.3)
    air.say(NOW, "MAG_STATUS", uptime=1)
    air.say(NOW, "MAG_NAVIGATION", state=2)
    assert [health(air.state, NOW)[name][0] for name in ("Latency", "Telemetry age")] == ["4.2 ms", "0.3 s"]
    assert [health(air.state, NOW + 4)[name][0] for name in ("Latency", "Telemetry age")] == ["–", "–"]
    assert whereabouts(air.state, NOW + 40)["Last update"][0] == "40 s ago"


def test_a_restart_loses_nothing(air: Air) -> None:
    """The sequence numbers begin anew; what was lost before and is lost after counts."""
    for k in range(100):
        air.field(NOW + k * 0.1)
    air.bridge.sequence += 3
    air.say(NOW + 11, "MAG_STATUS", uptime=11)
    assert air.state.lost == 3
    air.bridge = Codec(1, 191)
    air.bridge.sequence = 200
    air.field(NOW + 12)
    air.say(NOW + 12, "MAG_STATUS", uptime=1)
    assert air.state.lost == 3
    air.bridge.sequence += 2
    air.field(NOW + 13)
    assert air.state.lost == 5


def test_figures(air: Air) -> None:
    assert {value for value, _ in measured(air.state).values()} == {"–"}
    air.field(NOW, 52_134.268, x=-4_203.04, sigma_x=1.1, y=nan, latency=0.0042, calibration_id=0xBEEF)
    shown = measured(air.state)
    assert shown["Total field"] == ("52\u202f134.27", "± 2.00")
    assert shown["Forward"] == ("-4\u202f203.0", "± 2.2")
    assert shown["Anomaly"][0] == shown["Starboard"][0] == "–"
    air.say(NOW, "MAG_STATUS", sensor_state=3, autopilot_state=1, log_state=2, samples_lost=7, uptime=4)
    assert health(State(), NOW)["Calibration"] == ("–", True)
    items = health(air.state, NOW)
    assert items["Sensor"] == ("lost", False)
    assert items["Autopilot"] == ("ok", True)
    assert items["Log"] == ("failed", False)
    assert items["Latency"] == ("4.2 ms", True)
    assert items["Calibration"] == ("0000beef", True)
    assert items["Samples lost at the sensor"] == ("7", False)


def test_the_position_by_the_field(air: Air) -> None:
    air.field(NOW)
    assert whereabouts(air.state, NOW)["State"] == ("off", True)
    place = {"lat": 495_000_000, "lon": -579_000_000, "covariance_nn": 400.0, "covariance_ee": 900.0}
    air.say(NOW, "MAG_NAVIGATION", state=4, innovation=2.5, innovation_variance=1.0, bias=1.0, **place)
    items = whereabouts(air.state, NOW)
    assert items["State"] == ("lost", False)
    assert items["Position"][0] == "49.50000, -57.90000"
    assert items["1σ of the longer axis"][0] == "30 m"
    assert items["Innovation ± 2σ"] == ("+2.5 ± 2.0", False)


def test_what_a_newer_bridge_says_is_shown_as_far_as_it_is_known(air: Air) -> None:
    air.say(NOW, "MAG_STATUS", sensor_state=200, log_state=201)
    air.say(NOW, "MAG_NAVIGATION", state=202)
    air.say(NOW, "STATUSTEXT", chunk_seq=1, text="the end of what was not heard")
    assert health(air.state, NOW)["Sensor"] == ("state 200", False)
    assert health(air.state, NOW)["Log"] == ("state 201", False)
    assert whereabouts(air.state, NOW)["State"][0] == "state 202"
    assert [said.text for said in air.state.texts] == ["the end of what was not heard"]


def test_only_the_first_bridge_is_heard(air: Air) -> None:
    air.give(Codec(1, 1).pack("STATUSTEXT", text="autopilot", severity=4), NOW)
    before = air.state.bridge
    air.field(NOW, 50_000)
    air.give(Codec(2, 191).pack("MAG_FIELD", total_field=1.0), NOW)
    air.give(b"\xfd noise \xfe", NOW)
    assert (before, air.state.bridge) == (None, (1, 191))
    assert air.state.field["total_field"] == 50_000
    assert not air.state.texts


def test_another_bridge_takes_the_place_of_one_that_is_silent(air: Air) -> None:
    """The vehicle was changed, or its component id: the page begins anew with what is there."""
    air.field(NOW)
    air.bridge = Codec(1, 192)
    air.field(NOW + 29.0)
    assert air.state.bridge == (1, 191)
    air.field(NOW + 31.0, 51_000.0)
    assert (air.state.bridge, air.state.lost, len(air.state.trace)) == ((1, 192), 0, 1)
    assert air.state.field["total_field"] == 51_000.0
    assert silence(air.state, NOW + 32.0) == ""


def test_messages_lost_on_the_way_are_counted(air: Air) -> None:
    frames = [air.bridge.pack("MAG_STATUS", uptime=k) for k in range(600)]
    late = frames.pop(310)
    frames.insert(312, late)
    for frame in (frame for k, frame in enumerate(frames) if k not in {0, 40, 255, 256, 257}):
        air.give(frame, NOW)
    assert air.state.received == 595
    assert air.state.lost == 4 + 1 + 2  # a late one is a gap before it, and one after it


def test_flags_stand_since_they_came(air: Air) -> None:
    for k in range(10):
        air.field(NOW + k, flags=Quality.NO_BORESIGHT | (Quality.MOVING if k in {4, 5, 7} else 0))
    assert air.state.flags == {"no_boresight": (NOW, NOW + 9), "moving": (NOW + 4, NOW + 7)}
    air.field(NOW + 11)
    assert set(air.state.flags) == {"no_boresight"}
    air.field(NOW + 20)
    assert not air.state.flags


def test_trace_is_the_outline_of_the_last_ten_minutes(air: Air) -> None:
    for k in range(7000):
        air.field(
            NOW + k / 10, 52_000.0 + (50 if k == 5005 else 0), total_field_sigma=3.0 if k == 5007 else 1.0
        )
    trace = air.state.trace
    assert len(trace) == 601
    assert {point.count for point in trace} == {10}
    spike = next(point for point in trace if point.time == NOW + 500)
    assert (spike.sum / spike.count, spike.low, spike.high) == pytest.approx((52_005, 51_994, 52_052))
    air.field(NOW + 701, nan)
    assert len(trace) == 601
    air.field(NOW - 60)  # its clock was set back
    assert [point.time for point in trace] == [NOW - 60]


def test_a_long_text_is_put_together(air: Air) -> None:
    air.field(NOW)
    for piece, text in enumerate(("a" * 50, "b" * 50, "c")):
        air.say(NOW + piece, "STATUSTEXT", severity=4, text=text, id=9, chunk_seq=piece)
    air.say(NOW + 3, "STATUSTEXT", severity=6, text="short")
    assert [said.text for said in air.state.texts] == ["short", "a" * 50 + "b" * 50 + "c"]
    assert air.state.texts[1].time == NOW + 2


class Exchange:
    """The station and a real bridge, whose first answers for the parameters of `lose` are lost."""

    def __init__(self, air: Air, *lose: str) -> None:
        self.bridge = Component(Link("udpout:h:1"), {}, alignment(Align()), start_us=round(NOW * 1e6))
        self.air, self.lose, self.now = air, set(lose), NOW

    def run(self, seconds: float, *, answers: bool = True) -> None:
        end = self.now + seconds
        while self.now < end:
            self.now += 0.1
            us = round(self.now * 1e6)
            for name, fields in self.air.state.due(self.now):
                if answers:
                    self.bridge.receive(self.air.codec.pack(name, **fields), us)
            self.bridge.advance(us)
            for _, frame in self.bridge.outbox.drain():
                message = next(iter(Codec(0, 0).parse(frame)))
                if message.name == "PARAM_VALUE" and message["param_id"] in self.lose:
                    self.lose.remove(message["param_id"])
                else:
                    self.air.give(frame, self.now)


def test_parameters_are_fetched_also_where_some_are_lost_on_the_way(air: Air) -> None:
    exchange = Exchange(air, "MB_SETTLE_TIME", "MB_GAP_FACTOR")
    exchange.run(8)
    assert not exchange.lose
    parameters = exchange.bridge.parameters
    assert set(air.state.parameters) == set(parameters.names)
    assert air.state.parameters["MB_SETTLE_TIME"].value == pytest.approx(parameters["MB_SETTLE_TIME"])


def test_a_parameter_is_set_or_refused_with_the_bridges_own_words(air: Air) -> None:
    exchange = Exchange(air)
    exchange.run(8)
    settle = air.state.parameters["MB_SETTLE_TIME"]

    air.state.set("MB_SETTLE_TIME", 7.3)
    exchange.run(1)
    assert exchange.bridge.parameters["MB_SETTLE_TIME"] == pytest.approx(7.3)
    assert settle.value == pytest.approx(7.3)
    assert (settle.asked, settle.error) == (None, "")

    air.state.set("MB_SETTLE_TIME", -1)
    exchange.run(1)
    assert settle.error == "-1 is not within 0 to 3600 s"
    assert settle.value == pytest.approx(7.3)
    assert settle.asked is None

    air.state.set("MB_SETTLE_TIME", 1e39)
    assert settle.error == "expected a number"


def test_a_parameter_that_is_not_answered_is_asked_for_again(air: Air) -> None:
    exchange = Exchange(air)
    exchange.run(8)
    settle = air.state.parameters["MB_SETTLE_TIME"]
    air.state.set("MB_SETTLE_TIME", 8)
    exchange.run(4, answers=False)
    assert (settle.error, settle.asked) == ("no answer yet", 8)
    exchange.run(2)
    assert (settle.error, settle.value) == ("", 8)


def test_another_run_s_parameters_are_fetched_anew(air: Air) -> None:
    exchange = Exchange(air)
    exchange.run(8)
    air.say(exchange.now, "MAG_STATUS", uptime=0)
    assert not air.state.parameters
    exchange.run(4)
    assert len(air.state.parameters) == len(exchange.bridge.parameters.names)
