"""Test the bridge's position with GNSS receivers that are wrong."""

from collections.abc import Callable
from datetime import UTC, datetime
from functools import cache, partial
from math import isnan
from pathlib import Path

import numpy as np
import pytest
from fed import FedBridge, named
from passages import AIRCRAFT, PLACE, flight, steep_map
from referee import ArduPilot
from referee.loop import Receiver, Run, carried_off, frozen, honest, jammed, jumped, sail
from small import small_bridge
from vehicle import Bench

from magbridge.bridge.events import clock_step
from magbridge.bridge.position import Position
from magbridge.field.geodesy import offset
from magbridge.field.igrf import igrf, total_field
from magbridge.mavlink import Codec
from magbridge.navigate.gnss import GnssMonitor, GnssState, Prediction
from magbridge.navigate.record import NavigationState
from magbridge.records import Channel

START, SECOND, YEAR = 1_780_000_000_000_000, 1_000_000, 31_557_600_000_000
AGO = 20 * YEAR


def update(
    position: Position, latitude: float, longitude: float, altitude: float = 0.0, now_us: int = START
) -> Position:
    """Give a position the report of an autopilot (deg, m)."""
    fields = {"lat": round(latitude * 1e7), "lon": round(longitude * 1e7), "alt": round(altitude * 1e3)}
    (message,) = Codec(0, 0).parse(Codec(1, 1).pack("GLOBAL_POSITION_INT", **fields))
    position.update(message, now_us)
    return position


def position_at(
    latitude: float, longitude: float, altitude: float, notify: Callable[[str], None] = print
) -> Position:
    return update(Position(notify), latitude, longitude, altitude)


def test_a_dive_is_nearer_to_the_core() -> None:
    fields = [position_at(49.5, -57.9, -depth).main_field(START, START) for depth in (0.0, 1000.0)]
    expected = [total_field(-57.9, 49.5, depth, START * 1e-6).item() for depth in (0.0, 1000.0)]
    assert fields == pytest.approx(expected, abs=0.1)
    assert 15.0 < fields[1] - fields[0] < 35.0


def test_the_vector_is_that_of_a_place_at_most_a_kilometre_away() -> None:
    position = position_at(49.5, -57.9, 0.0)
    for latitude in (49.5, 49.505, 49.55):
        update(position, latitude, -57.9)
        vector = igrf(-57.9, latitude, 0.0, START * 1e-6)[0]
        assert np.linalg.norm(vector - position.direction(START, START)) < 10.0


def test_an_old_position_or_none_gives_no_field() -> None:
    position = position_at(49.5, -57.9, 0.0)
    assert not isnan(position.main_field(START + 59 * SECOND, START))
    assert isnan(position.main_field(START + 61 * SECOND, START))
    assert isnan(position_at(0.0, 0.0, 0.0).main_field(START, START))
    assert isnan(Position(print).main_field(START, START))


def test_positions_of_an_autopilot_without_a_fix_are_unknown() -> None:
    """A real ArduPilot sends positions that drift about 0, 0 until its first fix."""
    reports: list[str] = []
    position = Position(reports.append)
    for second, place in enumerate([(0.0, 0.0), (1.3e-6, 3.3e-6), (1e-5, -3e-4), (49.5, -57.9)]):
        assert isnan(position.main_field(START + second * SECOND, START))
        update(position, *place, now_us=START + second * SECOND)
    assert position.main_field(START + 3 * SECOND, START) > 50_000.0
    # an origin that another vehicle left: the first minute decides
    update(position, 51.5, -57.9, now_us=START + 30 * SECOND)
    assert position.place_and_depth[0] == (51.5, -57.9)
    assert reports == []


def test_a_jump_gives_no_main_field_until_the_vehicle_is_back() -> None:
    reports: list[str] = []
    position = Position(reports.append)
    for second in range(900):
        is_away, now_us = 100 <= second < 700, START + second * SECOND
        update(position, 50.0 if is_away else 49.5, -57.9, now_us=now_us)  # 56 km
        assert isnan(position.main_field(now_us, now_us)) == is_away
    assert reports == ["the position jumps farther than the vehicle can move"]


def test_the_field_is_that_of_the_day_to_which_the_clock_was_set() -> None:
    """A computer without a real-time clock starts years ago, or in 1970, which is not plausible."""
    position = position_at(49.5, -57.9, 0.0)
    assert isnan(position.main_field(START + SECOND, 0))
    for year in (2005, 2026, 2005):
        day = datetime(year, 7, 1, tzinfo=UTC).timestamp()
        expected = total_field(-57.9, 49.5, 0.0, day).item()
        assert position.main_field(START + SECOND, round(day * 1e6)) == pytest.approx(expected, abs=0.1)


def test_the_anomaly_follows_when_the_host_s_clock_is_set(tmp_path: Path) -> None:
    bridge = FedBridge(small_bridge(tmp_path))
    place = {"lat": 495_000_000, "lon": -579_000_000}
    bridge.feed(0.0, Channel.LINK, Codec(1, 1).pack("GLOBAL_POSITION_INT", **place))
    for second in (1, 3):
        bridge.feed(second, Channel.SENSOR, b"1 2 50000 4 %d %d\n" % (second, second))
        bridge.feed(2.0, Channel.STATE, clock_step(START, -AGO))
    seen = named(bridge.messages, "MAG_FIELD")
    then, now = (total_field(-57.9, 49.5, 0.0, t * 1e-6).item() for t in (START - AGO, START))
    change = seen[1]["anomaly"] - seen[0]["anomaly"] - seen[1]["total_field"] + seen[0]["total_field"]
    assert change == pytest.approx(now - then, abs=0.2)
    assert abs(change) > 300.0


def test_why_there_is_no_field_is_reported() -> None:
    reported: list[str] = []
    position = position_at(49.5, -57.9, 0.0, reported.append)
    assert isnan(position.main_field(START, round(datetime(2031, 1, 1, tzinfo=UTC).timestamp() * 1e6)))
    assert len(reported) == 1
    assert "2031-01-01" in reported[0]


# ---- GPS positions are tested before the navigator uses them: a plane over a map of 120 nT and 1 km ------


BEGIN, END = 180.0, 420.0
"""Begin and end of the GPS fault, s after the start of a flight of 9 minutes."""
NEVER = 1e9


def fly(receiver: Receiver = honest, lost: float = NEVER, minutes: float = 9.0, back: float = END) -> Run:
    make = partial(ArduPilot, streams=("VFR_HUD",))
    passage = flight(minutes, lost, back if lost < NEVER else NEVER, receiver)
    return sail(*passage, steep_map(), AIRCRAFT, "EXTERNAL_POSITION_ESTIMATE", make)[0]


@cache
def without_gps() -> Run:
    return fly(lost=BEGIN)


def window(run: Run, begin: float, end: float) -> np.ndarray:
    return (run.seconds >= begin) & (run.seconds < end)


def first(run: Run, state: GnssState, after: float) -> float:
    """Return the time (s) from a moment until GPS first has a state."""
    found = run.seconds[(run.gnss == state) & (run.seconds >= after)]
    return float(found[0] - after) if found.size else np.inf


def test_a_consistent_receiver_is_never_rejected() -> None:
    run = fly()
    assert (run.gnss == GnssState.GOOD).all()
    assert run.sent[-1] == 0
    assert np.median(run.error[60:]) < 3.0


@pytest.mark.parametrize("accuracy", [None, 18.0])
def test_a_jammed_receiver_is_rejected_and_fixes_go_out(accuracy: float | None) -> None:
    run = fly(jammed(BEGIN, END, accuracy=accuracy))
    assert first(run, GnssState.REJECTED, BEGIN) <= 6.0 + 5.0, "5 s after the 1 to 6 s without a fix"
    jam = window(run, BEGIN, END)
    alone = without_gps()
    assert np.nanpercentile(run.error[jam], 90) <= 1.2 * np.nanpercentile(alone.error[jam], 90) + 5.0
    assert run.sent[jam][-1] - run.sent[jam][0] > 200
    assert first(run, GnssState.GOOD, END) <= 60.0
    assert any(text.startswith("GPS rejected: its position jumps") for _, text in run.texts)
    assert any(text == "GPS good" for _, text in run.texts)


def test_a_receiver_that_is_led_away_is_rejected() -> None:
    """The receiver drifts by 3 m/s; the navigator assumes a wind of 4 m/s (1-sigma)."""
    run = fly(carried_off(BEGIN, 3.0, 0.0))
    assert first(run, GnssState.REJECTED, BEGIN) <= 15.0
    wrong = window(run, BEGIN + 15.0, NEVER)
    assert (run.gnss[wrong] != GnssState.GOOD).all()
    assert (run.error[wrong] < 60.0).all()


def test_a_receiver_that_is_led_away_slowly_is_noticed_by_the_field() -> None:
    """1 m/s is within what the wind may change by; on this map the field tells it before 100 m."""
    run = fly(carried_off(BEGIN, 0.7, 0.7))
    noticed = run.seconds[(run.gnss >= GnssState.SUSPECT) & (run.seconds >= BEGIN)]
    assert noticed.size
    assert noticed[0] - BEGIN < 100.0
    wrong = run.seconds >= BEGIN
    standardised = np.sqrt(np.mean(run.error[wrong] ** 2 / 2.0 / run.sigma[wrong] ** 2))
    assert standardised < 2.0, "suspicion widens sigma"
    assert (run.gnss[run.seconds >= noticed[0]] != GnssState.GOOD).all()


@pytest.mark.parametrize(
    ("receiver", "within_s"),
    [
        (jumped(BEGIN, END, 4000.0, 3000.0), 1.0),
        (jumped(BEGIN, END, 240.0, 180.0), 1.0),
        (frozen(BEGIN, END), 5.0),
    ],
    ids=["jump of 5 km", "jump of 300 m", "frozen"],
)
def test_a_jump_or_a_standstill_is_rejected_at_once_and_the_return_accepted(
    receiver: Receiver, within_s: float
) -> None:
    run = fly(receiver)
    assert first(run, GnssState.REJECTED, BEGIN) <= within_s
    assert (run.gnss[window(run, BEGIN + within_s, END)] == GnssState.REJECTED).all()
    assert (run.error[window(run, BEGIN, NEVER)] < 80.0).all()
    assert first(run, GnssState.GOOD, END) <= 60.0


def test_an_hour_without_gps_with_turns_at_stock_rates() -> None:
    """ATTITUDE and VFR_HUD at 1 Hz, a turn of 90 degrees in 6 s every 5 minutes."""
    lost, back = 300.0, 3900.0
    run = fly(lost=lost, back=back, minutes=67.0)
    hour = window(run, lost, back)
    assert np.percentile(run.error[hour], 90) <= 50.0
    far = hour & (run.error > 200.0)
    assert (run.state[far] == NavigationState.LOST).all()
    standardised = np.sqrt(np.mean(run.error[hour] ** 2 / 2.0 / run.sigma[hour] ** 2))
    assert standardised <= 1.25
    assert run.sent[run.seconds == lost + 10.0] > 0, "the first fix comes within 10 s"
    assert first(run, GnssState.GOOD, back) <= 60.0
    assert np.median(run.error[run.seconds > back + 60.0]) < 5.0


def test_the_claimed_sigma_is_that_of_a_wind_that_changes_as_the_options_state() -> None:
    """In a steady wind, the options claim too much change, and the error is a third of sigma."""
    standardised = []
    for seed in (2, 4):
        passage = flight(15.0, BEGIN, 840.0, seed=seed, changing_wind=True)
        make = partial(ArduPilot, streams=("VFR_HUD",))
        run = sail(*passage, steep_map(), AIRCRAFT, "EXTERNAL_POSITION_ESTIMATE", make)[0]
        alone = window(run, BEGIN, 840.0)
        standardised += list(run.error[alone] ** 2 / 2.0 / run.sigma[alone] ** 2)
        assert (run.error[alone] < 200.0).all()
    assert 0.5 <= np.sqrt(np.mean(standardised)) <= 1.25


@pytest.mark.parametrize(("jamming", "spoofing", "word"), [(1, 3, "rejected"), (3, 1, "suspect")])
def test_the_receiver_s_own_report_counts(jamming: int, spoofing: int, word: str) -> None:
    bench = Bench("EXTERNAL_POSITION_ESTIMATE")
    place = {"fix_type": 3, "lat": round(PLACE[0] * 1e7), "lon": round(PLACE[1] * 1e7), "h_acc": 2000}
    bench.receive("GPS_RAW_INT", **place)
    bench.to(1)
    bench.receive("GNSS_INTEGRITY", jamming_state=jamming, spoofing_state=spoofing)
    bench.receive("GPS_RAW_INT", **place)
    assert bench.navigation.navigator.gnss.state.name.lower() == word
    for second in range(2, 40):
        bench.to(second)
        bench.receive("GNSS_INTEGRITY", jamming_state=1, spoofing_state=1)
        bench.receive("GPS_RAW_INT", **place)
    bench.to(41)
    reported = [text for text in bench.texts if text.startswith("GPS ")]
    assert reported[0].startswith(f"GPS {word}: the receiver reports")
    assert reported[-1] == "GPS good"


def test_positions_that_go_on_drifting_are_not_used_again() -> None:
    """A wide covariance agrees with any position, but the position still drifts by 3 m/s."""
    returned = {}
    for drift in (0.0, 3.0):
        monitor = GnssMonitor(steep_map(), AIRCRAFT)
        states = []
        for k in range(241):  # twice a second: right for 30 s, then a step of 60 m
            seconds = 0.5 * k
            late = max(seconds - 30.0, 0.0)
            north = 60.0 * (late > 0.0) + drift * late
            P = np.eye(2) * (3.0 if late == 0.0 else 200.0) ** 2
            prediction = Prediction(
                np.zeros(2), P, P, np.zeros(2), 0.3, 0.0, 22.0 * seconds, 22.0, lost=False, informed=True
            )
            place = offset(*PLACE, north + 22.0 * seconds, 0.0)
            states.append(monitor.check(round(5e5 * k) + 1, place, (north, 0.0), 1.0, prediction))
        assert states[50] is GnssState.GOOD
        assert states[62] is GnssState.REJECTED
        returned[drift] = GnssState.GOOD in states[62:150]
    assert returned == {0.0: True, 3.0: False}
