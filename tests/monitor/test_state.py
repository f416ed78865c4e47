"""Test the state of the page from the frames of a bridge."""

import csv
import json
from io import BytesIO
from math import inf, nan
from random import Random
from zipfile import ZipFile

import pytest

from magbridge.config import Align, Link
from magbridge.link.component import Component
from magbridge.link.parameters import alignment
from magbridge.mavlink import Codec, spec
from magbridge.monitor.charts import drawn
from magbridge.monitor.charts import series as track_series
from magbridge.monitor.history import TIERS
from magbridge.monitor.link import MAX_BRIDGES, ReceivedBridges
from magbridge.monitor.page import bundle
from magbridge.monitor.panels import rose_picture
from magbridge.monitor.state import TEMPERATURE_SERIES, BridgeState
from magbridge.monitor.words import (
    conditions,
    duration,
    heading_text,
    health,
    learnt,
    losses,
    measured,
    sensor_rows,
    silence,
    whereabouts,
)
from magbridge.records import Quality
from magbridge.version import __version__

orjson = pytest.importorskip("orjson")  # how NiceGUI sends it to the browser

NOW = 1_700_000_000.0


class Air:
    """Codec of a bridge and state of a station that receives its frames."""

    def __init__(self) -> None:
        self.fleet, self.bridge, self.codec = ReceivedBridges(), Codec(1, 191), Codec(255, 190)

    @property
    def state(self) -> BridgeState:
        """Return the state of the sending bridge."""
        return self.fleet.states.get((self.bridge.system, self.bridge.component), BridgeState())

    def feed(self, now: float, name: str, /, **fields: object) -> None:
        self.give(self.bridge.pack(name, **fields), now)

    def give(self, data: bytes, now: float) -> None:
        for message in self.codec.parse(data):
            self.fleet.receive(message, now)

    def field(self, now: float, total: float = 52_000.0, flags: int = 0, **fields: object) -> None:
        fields = {"total_field_sigma": 1.0, "time_usec": round(now * 1e6), "anomaly": nan, **fields}
        self.feed(now, "MAG_FIELD", total_field=total, flags=flags, **fields)


@pytest.fixture
def air() -> Air:
    return Air()


def test_the_rose_shows_the_heading_with_its_band(air: Air) -> None:
    assert heading_text(air.state.field).startswith("No heading")
    assert "<path" not in rose_picture(air.state.field)
    air.field(NOW, magnetic_heading=100.0, heading=90.0, heading_sigma=15.0)
    # turned to the east, from (-80 sin 30, -80 cos 30) to (80 sin 30, -80 cos 30)
    assert 'transform="rotate(90.0)"' in rose_picture(air.state.field)
    assert 'd="M 0 0 L -40.0 -69.28 A 80 80 0 0 1 40.0 -69.28 Z"' in rose_picture(air.state.field)
    assert heading_text(air.state.field) == "090.0\N{DEGREE SIGN} true ± 30.0\N{DEGREE SIGN}"
    air.field(NOW, magnetic_heading=100.0, heading=nan, heading_sigma=120.0)
    assert "100.0\N{DEGREE SIGN} magnetic" in heading_text(air.state.field)
    assert '<circle r="80" fill="#3b82f6"' in rose_picture(air.state.field)
    air.field(NOW, magnetic_heading=0.0, heading=0.0, heading_sigma=0.0)
    assert heading_text(air.state.field).startswith("No heading")


def test_silence_is_reported(air: Air) -> None:
    assert silence(air.state, NOW) == "nothing heard yet"
    assert air.state.received_at == -inf
    air.feed(NOW, "MAG_STATUS", uptime=5)
    assert silence(air.state, NOW) == "no field heard yet"
    air.field(NOW)
    assert silence(air.state, NOW + 3) == ""
    assert silence(air.state, NOW + 12) == "nothing heard for 12 s"
    air.feed(NOW + 12, "MAG_STATUS", uptime=17)
    assert silence(air.state, NOW + 13) == "no field heard for 13 s"
    assert [duration(s) for s in (-1, 0, 119, 121, 7200)] == ["0 s", "0 s", "119 s", "2 min", "2 h"]


def test_a_slow_sensor_is_not_silent(air: Air) -> None:
    for k in range(0, 40, 4):
        air.field(NOW + k)
        air.feed(NOW + k + 3.9, "MAG_STATUS", uptime=k)
        assert silence(air.state, NOW + k + 3.9) == ("" if k else "no field heard for 4 s")
    air.feed(NOW + 49, "MAG_STATUS", uptime=50)
    assert silence(air.state, NOW + 49) == "no field heard for 13 s"


def test_a_status_that_stops_is_not_the_present_one(air: Air) -> None:
    """Its rate is a parameter: it may be switched off, or once in ten seconds."""
    for k in range(10):
        air.field(NOW + k)
    assert silence(air.state, NOW + 9) == ""  # it never came: dashes are shown
    air.feed(NOW + 9, "MAG_STATUS", uptime=9)
    air.field(NOW + 14)
    assert silence(air.state, NOW + 14) == "no status heard for 5 s"
    air.feed(NOW + 30, "HEARTBEAT")
    assert silence(air.state, NOW + 31) == "no field heard for 17 s; no status heard for 22 s"
    air.feed(NOW + 31, "MAG_STATUS", uptime=31)
    air.field(NOW + 50)
    assert silence(air.state, NOW + 50) == ""


def test_figures_of_a_field_that_stopped_are_not_the_present_ones(air: Air) -> None:
    air.field(NOW, latency=0.0042, telemetry_age=0.3)
    air.feed(NOW, "MAG_STATUS", uptime=1)
    air.feed(NOW, "MAG_NAVIGATION", state=2)
    assert [health(air.state, NOW)[name][0] for name in ("Latency", "Telemetry age")] == ["4.2 ms", "0.3 s"]
    assert [health(air.state, NOW + 4)[name][0] for name in ("Latency", "Telemetry age")] == ["–", "–"]
    assert whereabouts(air.state, NOW + 40)["Last update"][0] == "40 s ago"


def test_a_restart_loses_nothing(air: Air) -> None:
    """The sequence numbers restart; losses before and after are counted."""
    for k in range(100):
        air.field(NOW + k * 0.1)
    air.bridge._mav.seq += 3
    air.feed(NOW + 11, "MAG_STATUS", uptime=11)
    assert air.state.lost == 3
    air.bridge = Codec(1, 191)
    air.bridge._mav.seq = 200
    air.field(NOW + 12)
    air.feed(NOW + 12, "MAG_STATUS", uptime=1)
    assert air.state.lost == 3
    air.bridge._mav.seq += 2
    air.field(NOW + 13)
    assert air.state.lost == 5


def test_figures(air: Air) -> None:
    assert {value for value, _ in measured(air.state).values()} == {"–"}
    air.field(NOW, 52_134.268, x=-4_203.04, sigma_x=1.1, y=nan, latency=0.0042, calibration_id=0xBEEF)
    shown = measured(air.state)
    assert shown["Total field"] == ("52\u202f134.27", "± 2.00")
    assert shown["Forward"] == ("-4\u202f203.0", "± 2.2")
    assert shown["Anomaly"][0] == shown["Starboard"][0] == "–"
    air.feed(NOW, "MAG_STATUS", sensor_state=3, autopilot_state=1, log_state=2, samples_lost=7, uptime=4)
    assert health(BridgeState(), NOW)["Calibration"] == ("–", True)
    items = health(air.state, NOW) | losses(air.state)
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
    air.feed(NOW, "MAG_NAVIGATION", state=4, innovation=2.5, innovation_variance=1.0, bias=1.0, **place)
    items = whereabouts(air.state, NOW)
    assert items["State"] == ("lost", False)
    assert items["Position"][0] == "49.50000, -57.90000"
    assert items["1σ of the longer axis"][0] == "30 m"
    assert items["Innovation ± 2σ"] == ("+2.5 ± 2.0", False)


def test_what_a_newer_bridge_says_is_shown_as_far_as_it_is_known(air: Air) -> None:
    air.feed(NOW, "MAG_STATUS", sensor_state=200, log_state=201)
    air.feed(NOW, "MAG_NAVIGATION", state=202)
    air.feed(NOW, "STATUSTEXT", chunk_seq=1, text="the end of a lost text")
    assert list(health(air.state, NOW).values())[0:3:2] == [("state 200", False), ("state 201", False)]
    assert whereabouts(air.state, NOW)["State"][0] == "state 202"
    assert [texts.text for texts in air.state.texts] == ["the end of a lost text"]


def test_each_vehicle_has_a_state_of_its_own(air: Air) -> None:
    air.give(Codec(1, 1).pack("STATUSTEXT", text="autopilot", severity=4), NOW)
    assert not air.fleet.states
    air.field(NOW, 50_000)
    air.give(Codec(2, 191).pack("MAG_FIELD", total_field=1.0), NOW)
    air.give(b"\xfd noise \xfe", NOW)
    assert list(air.fleet.states) == [(1, 191), (2, 191)]
    assert [one.field["total_field"] for one in air.fleet.states.values()] == [50_000, 1.0]
    assert not air.state.texts
    requests = [(name, fields.get("target_system")) for name, fields in air.fleet.due(NOW)]
    assert requests == [("HEARTBEAT", None), ("PARAM_REQUEST_LIST", 1), ("PARAM_REQUEST_LIST", 2)]


def test_vehicles_are_bounded_and_one_that_is_silent_makes_room(air: Air) -> None:
    for system in range(1, 100):
        air.give(Codec(system, 191).pack("MAG_FIELD", total_field=1.0), NOW)
    assert list(air.fleet.states) == [(system, 191) for system in range(1, 1 + MAX_BRIDGES)]
    air.give(Codec(3, 191).pack("MAG_FIELD", total_field=1.0), NOW + 20.0)
    air.give(Codec(100, 191).pack("MAG_FIELD", total_field=1.0), NOW + 31.0)
    assert (1, 191) not in air.fleet.states
    assert {(3, 191), (100, 191)} <= set(air.fleet.states)


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


def test_masses_and_temperature_of_the_same_vehicle_are_kept(air: Air) -> None:
    air.field(NOW)
    air.feed(NOW, "MAG_RAW", time_usec=round(NOW * 1e6), temperature=7.5)
    for system, value in ((1, 0.4), (2, 9.0)):
        named = Codec(system, 1).pack("NAMED_VALUE_FLOAT", name="battpos", value=value)
        air.give(named, NOW + 1)
    for k in range(100):  # bounded, whatever is named
        air.give(Codec(1, 1).pack("NAMED_VALUE_FLOAT", name=f"n{k}", value=k), NOW + 1)
    telemetry = air.state.telemetry
    assert telemetry[TEMPERATURE_SERIES].points("10 min")[-1].mean == 7.5
    (battpos,) = telemetry["battpos"].points("10 min")
    assert battpos.mean == pytest.approx(0.4)
    assert battpos.time == NOW + 1
    assert len(telemetry) == 12


def test_the_tracks_are_kept(air: Air) -> None:
    air.field(NOW)
    place = {"lat": 495_000_000, "lon": -579_000_000}
    air.feed(NOW, "MAG_NAVIGATION", state=1, **place)
    assert not list(air.state.estimated)  # it searches still
    air.feed(NOW, "MAG_NAVIGATION", state=2, covariance_nn=9.0, covariance_ee=4.0, **place)
    air.give(Codec(1, 1).pack("GPS_RAW_INT", fix_type=1, **place), NOW)
    air.give(Codec(1, 1).pack("GLOBAL_POSITION_INT", **place), NOW)
    assert air.state.estimated.latest.covariance == (9.0, 0.0, 4.0)
    assert air.state.reported_track.added == 1


def test_nothing_that_is_received_raises(air: Air) -> None:
    """Whatever the payload's bytes: numbers that are none or absurd, unknown flags and states, any text."""
    extremes = (nan, inf, -inf, 1e308, -1e308, 5e-324, 0.0)
    names = ("MAG_FIELD", "MAG_RAW", "MAG_STATUS", "MAG_NAVIGATION", "STATUSTEXT")
    moment = NOW
    for total in extremes:
        for sigma in (nan, inf, 3e38, -1.0):
            for us in (0, 10**15, 2**64 - 1):
                air.field(moment, total, 65535, total_field_sigma=sigma, time_usec=us, x=sigma)
    random, ear = Random(1), Codec(0, 0)
    for name in [*names, "PARAM_VALUE", "NAMED_VALUE_FLOAT", "GLOBAL_POSITION_INT", "GPS_RAW_INT"]:
        size = spec(name).struct.size
        for payload in [b"\xff" * size, b"\x7f" * size, *(random.randbytes(size) for _ in range(200))]:
            moment += 0.01
            component = 1 if name in ("NAMED_VALUE_FLOAT", "GLOBAL_POSITION_INT", "GPS_RAW_INT") else 191
            (message,) = ear.parse(Codec(1, component).frame(spec(name), payload))
            air.fleet.receive(message, moment)
            air.fleet.due(moment)
    state = air.state
    measured(state), health(state, moment), whereabouts(state, moment), silence(state, moment)
    for tier in TIERS:
        for series in (state.total, *state.telemetry.values()):
            orjson.dumps(drawn(series.points(tier), tier))
    shown, box = track_series(state.reported_track, state.estimated, None)
    orjson.dumps([shown, box])
    assert len(state.parameters) <= 512
    assert len(state.texts) <= 200
    assert len(list(state.alarms)) <= 100
    assert max(len(text) for texts in measured(state).values() for text in texts) < 30
    with ZipFile(BytesIO(bundle(state, moment, "here"))) as archive:
        assert archive.testzip() is None


def test_a_bug_report_holds_what_was_seen(air: Air) -> None:
    air.field(NOW, 52_134.268)
    air.feed(NOW, "STATUSTEXT", severity=3, text='sensor lost: "unplugged", again')
    air.feed(NOW, "PARAM_VALUE", param_id="MB_SETTLE_TIME", param_value=4.0, param_count=1)
    with ZipFile(BytesIO(bundle(air.state, NOW, "udpin:h:1"))) as archive:
        names = [name for name in archive.namelist() if name.endswith(".csv")]
        tables = {name: list(csv.reader(archive.read(name).decode().splitlines())) for name in names}
        about = json.loads(archive.read("about.json"))
    assert (about["magbridge"], about["link"], about["bridge"]) == (__version__, "udpin:h:1", [1, 191])
    assert tables["texts.csv"][1][1:] == ["3", 'sensor lost: "unplugged", again']
    assert tables["parameters.csv"][1] == ["MB_SETTLE_TIME", "4.0", ""]
    sample = dict(zip(*tables["samples.csv"], strict=True))
    assert float(sample["total_field"]) == 52_134.268
    assert tables["alarms.csv"][1][-1] == 'sensor lost: "unplugged", again'


def test_a_long_text_is_put_together_and_one_alarm(air: Air) -> None:
    air.field(NOW)
    for piece, text in enumerate(("a" * 50, "b" * 50, "c")):
        air.feed(NOW + piece, "STATUSTEXT", severity=3, text=text, id=9, chunk_seq=piece)
    air.feed(NOW + 3, "STATUSTEXT", severity=6, text="short")
    assert [texts.text for texts in air.state.texts] == ["short", "a" * 50 + "b" * 50 + "c"]
    assert air.state.texts[1].time == NOW + 2
    assert [alarm.text for alarm in air.state.alarms] == ["a" * 50 + "b" * 50 + "c"]


class Exchange:
    """Station and real bridge, with the first replies for the parameters of `lose` lost."""

    def __init__(self, air: Air, *lose: str) -> None:
        self.bridge = Component(Link("udpout:h:1"), {}, alignment(Align()), start_us=round(NOW * 1e6))
        self.air, self.lose, self.now = air, set(lose), NOW

    def run(self, seconds: float, *, answers: bool = True) -> None:
        end = self.now + seconds
        while self.now < end:
            self.now += 0.1
            us = round(self.now * 1e6)
            for name, fields in self.air.fleet.due(self.now):
                if answers:
                    self.bridge.receive(self.air.codec.pack(name, **fields), us)
            self.bridge.output.advance(us)
            for _, frame in self.bridge.output.drain():
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


def test_another_run_s_parameters_are_fetched_again(air: Air) -> None:
    exchange = Exchange(air)
    exchange.run(8)
    air.feed(exchange.now, "MAG_STATUS", uptime=0)
    assert not air.state.parameters
    exchange.run(4)
    assert len(air.state.parameters) == len(exchange.bridge.parameters.names)


def test_what_is_learned_is_shown_in_words(air: Air) -> None:
    """Both predictions and the alarm with its causes are kept for any time that the sender states."""
    air.field(NOW)
    assert learnt(air.state)["Not explained"] == ("nothing", True)
    doubt = {"alarm_since": 1_780_000_000_000_000, "alarm_amplitude": 12.4, "causes": 1 | 4}
    errors = {"rms_first": 15.25, "rms_published": 1.5, "rms_learned": 1.25, "samples": 4321}
    ids = {"calibration_id": 0xABC, "first_calibration_id": 0xDEF}
    air.feed(NOW, "MAG_LEARNING", state=3, **doubt, **errors, **ids)
    shown = {name: text for name, (text, _) in learnt(air.state).items()}
    assert shown["State"] == "learned"
    assert shown["Published"] == "00000abc; the first is 00000def"
    assert [shown[f"Error of prediction, {one}"] for one in ("first", "published")] == ["15.25 nT", "1.50 nT"]
    assert shown["Not explained"] == "12 nT since 28 May 20:26 UTC"
    assert shown["Causes that fit"] == "offset step, temperature offset"
    air.feed(NOW, "MAG_LEARNING", alarm_since=2**64 - 1, alarm_amplitude=nan, causes=0xFFFF, state=9)
    assert learnt(air.state)["Not explained"][1] is False


def test_an_order_that_goes_back_to_zero_was_taken(air: Air) -> None:
    """MB_LEARN_CMD returns to 0 when the command is done."""
    air.field(NOW)
    air.feed(NOW, "PARAM_VALUE", param_id="MB_LEARN_CMD", param_value=0.0, param_count=1)
    air.state.set("MB_LEARN_CMD", 2.0)
    assert [name for name, _ in air.fleet.due(NOW + 1.0)].count("PARAM_SET") == 1
    air.feed(NOW + 1.1, "PARAM_VALUE", param_id="MB_LEARN_CMD", param_value=0.0, param_count=1)
    assert air.state.parameters["MB_LEARN_CMD"].error == ""
    assert air.state.parameters["MB_LEARN_CMD"].asked is None


def test_every_sensor_has_a_row_with_its_disagreement(air: Air) -> None:
    for k in range(8):
        now = NOW + 2.0 * k
        air.field(now, 52_000.0)
        assert sensor_rows(air.state, now) == {} or k  # one sensor has no row
        air.field(now + 0.1, 52_003.0 if k < 7 else 52_300.0, sensor_id=1, flags=Quality.IMPLAUSIBLE)
        air.field(now + 0.1, 52_001.0, sensor_id=2, total_field_sigma=nan)
        air.feed(now, "MAG_SENSOR", sensor_id=0, state=1, name="flux", sample_rate=0.5)
        air.feed(now, "MAG_SENSOR", sensor_id=1, state=1, name="tail", sample_rate=nan)
    state, now = air.state, NOW + 15.0
    assert [sensor.label for sensor in state.sensors.values()] == ["flux", "tail", "sensor 2"]
    first, tail, third = sensor_rows(state, now).values()
    assert (first["Minus flux"], first["Line"]) == (("–", True), ("ok, 0.50 Hz", True))
    assert tail["Minus flux"] == ("+300.00 ± 2.83", False)
    assert (tail["Total field"][0], tail["Flags"][0]) == ("52\u202f300.00 ± 2.00", "implausible")
    assert third["Minus flux"] == ("+1.00", True)
    assert state.field["total_field"] == 52_000.0
    assert state.telemetry["Sensor 1: total field, nT"].points("10 min")[-1].most == 52_300.0
    assert conditions(state, now)["sensor 1 implausible"].startswith("Sensor tail: It cannot be")
    air.feed(now, "MAG_SENSOR", sensor_id=1, state=3, name="tail")
    assert conditions(state, now + 0.1)["sensor 1"] == "Sensor tail: lost"
    for number in range(256):
        air.field(now, sensor_id=number)
    assert len(state.sensors) == 8
