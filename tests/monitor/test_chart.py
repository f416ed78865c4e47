"""Test the chart's curve, axis and marks, the stored history, and the map."""

from itertools import pairwise
from math import inf, nan

import pytest

from magbridge.field.geodesy import separation
from magbridge.mavlink import Codec
from magbridge.monitor.charts import ASPECT, axis_range, drawn, ellipse, extent, spikes
from magbridge.monitor.history import MAX_ALARMS, TIERS, TRAIL, Alarms, Point, Series, TrackPoint, Trail
from magbridge.monitor.link import ReceivedBridges
from magbridge.monitor.words import learned_worth
from magbridge.records import Quality

DAY = 86_400


def test_the_outline_of_ten_minutes_keeps_a_spike() -> None:
    series = Series()
    for k in range(7000):
        value = 52_000.0 + (50 if k == 5005 else 0)
        series.add(1e9 + k / 10, value, 6.0 if k == 5007 else 2.0)
    points = series.points("10 min")
    assert len(points) == 601
    assert {point.count for point in points} == {10}
    spike = next(point for point in points if point.time == 1e9 + 500)
    assert (spike.mean, spike.low, spike.high) == pytest.approx((52_005, 51_994, 52_052))
    assert (spike.least, spike.most) == (52_000, 52_050)


def test_a_day_is_kept_in_bounded_memory_and_no_spike_is_lost() -> None:
    series = Series()
    for k in range(2 * DAY // 4):
        series.add(1e9 + 4 * k, 52_000.0 + (1000 if k == 30_000 else 0))
    for tier, (window, width) in TIERS.items():
        points = series.points(tier)
        assert len(points) <= window / width + 1
        assert points[-1].time - points[0].time == pytest.approx(window, abs=2 * width)
    assert max(point.most for point in series.points("24 h")) == 53_000


def test_a_clock_that_is_set_back_costs_only_what_it_had_counted_beyond() -> None:
    series = Series()
    for time in (100, 200, 4e9, 300, 400):  # one stamp is far in the future
        series.add(time, 1.0)
    assert [point.time for point in series.points("10 min")] == [100, 200, 300, 400]
    series.add(250, 1.0)
    assert [point.time for point in series.points("10 min")] == [100, 200, 250]


def test_what_is_not_a_number_is_passed_over_and_what_is_absurd_is_kept_finite() -> None:
    series = Series()
    for value, sigma in ((nan, 1.0), (inf, 1.0), (1.0, nan), (1e308, 1.0), (-1e308, 1e308)):
        series.add(1e9, value, sigma)
    series.add(-5.0, 1.0)
    series.add(1e15, 1.0)
    assert series.points("10 min")[0].count == 2
    data, ends = drawn(series.points("10 min"), "10 min")
    assert all(abs(number) < inf for number in (*data[2][0], *ends.values()))


def test_one_spike_does_not_flatten_the_axis_and_is_marked() -> None:
    points = [Point(k) for k in range(300)]
    for point in points:
        point.add(52_000.0 + point.time % 7, 2.0)
    points[100].add(60_000.0, 2.0)
    ends = axis_range(points)
    assert 51_980 <= ends["min"] < 52_000
    assert 52_006 < ends["max"] <= 52_030
    (mark,) = spikes(points, **ends)
    assert mark["value"] == [100_000.0, ends["max"], 60_000.0]
    assert not spikes(points[:100], **ends)


def test_a_step_of_the_field_is_on_the_axis_once_it_has_lasted() -> None:
    points = [Point(k) for k in range(300)]
    for point in points:
        point.add(52_000.0 + (500.0 if point.time >= 290 else 0.0), 2.0)
    ends = axis_range(points)
    assert ends["max"] >= 52_500
    assert not spikes(points, **ends)


def test_the_curve_is_interrupted_where_nothing_came() -> None:
    series = Series()
    for time in (0, 1, 2, 60, 61):
        series.add(1e9 + time, 5.0)
    (low, width, mean, marks), _ = drawn(series.points("10 min"), "10 min")
    assert [value != value for _, value, *_ in mean] == [False, False, False, True, False, False]
    assert len(low) == len(width) == 6
    assert marks == []
    assert drawn([], "2 h") == ([[], [], [], []], {})


def test_the_ellipse_is_the_covariance() -> None:
    """Its points lie at 2 sigma: d' P^-1 d = 4."""
    nn, ne, ee = 900.0, 250.0, 400.0
    place = TrackPoint(60.0, 10.0, (nn, ne, ee))
    polygon = ellipse(place)
    assert len(polygon) > 20
    for longitude, latitude in polygon:
        north, east = separation(60.0, 10.0, latitude, longitude)
        square = (ee * north**2 - 2 * ne * north * east + nn * east**2) / (nn * ee - ne**2)
        assert square == pytest.approx(4.0, rel=1e-3)
    for unknown in ((0.0, 0.0, 0.0), (nan, 0.0, 1.0), (inf, 0.0, 1.0), (-5.0, 0.0, -5.0)):
        assert ellipse(TrackPoint(60.0, 10.0, unknown)) == []


def test_the_map_is_as_wide_as_it_is_drawn() -> None:
    west, south, east, north = extent([(10.0, 60.0), (10.02, 60.001)])
    height, _ = separation(south, 10.0, north, 10.0)
    _, width = separation(60.0, west, 60.0, east)
    assert width / height == pytest.approx(ASPECT, rel=1e-3)
    assert west < 10.0 < 10.02 < east
    assert extent([]) is None


def test_a_trail_is_bounded_and_keeps_its_ends() -> None:
    trail = Trail()
    for k in range(50_000):
        trail.add(TrackPoint(k * 1e-5, 0.0))
    trail.add(TrackPoint(nan, 0.0))
    trail.add(TrackPoint(91.0, 0.0))
    places = list(trail)
    assert len(places) <= TRAIL + 1
    assert places[0].latitude == 0.0
    assert places[-1].latitude == pytest.approx(0.49999)
    steps = [after.latitude - before.latitude for before, after in pairwise(places)]
    assert max(steps[:-1]) == pytest.approx(min(steps[:-1]), rel=1e-6)


# ---- Begin, end and repetition of an alarm, and its acknowledgement --------------------------------------


def test_an_alarm_stands_until_it_is_acknowledged_and_returns_when_it_begins_again() -> None:
    alarms = Alarms()
    alarms.update({"gap": "Samples are missing"}, 1.0)
    alarms.update({"gap": "Samples are missing"}, 2.0)
    (one,) = alarms
    assert (one.since, one.last, one.count, one.active, alarms.unseen) == (1.0, 2.0, 1, True, 1)
    alarms.update({}, 3.0)
    (one,) = alarms
    assert (one.active, alarms.unseen) == (False, 1)  # it was active, and not yet acknowledged
    alarms.acknowledge("sensor")
    assert alarms.unseen == 0
    alarms.update({"gap": "Samples are missing"}, 5.0)
    (one,) = alarms
    assert (one.since, one.count, one.active, alarms.unseen) == (5.0, 2, True, 1)


def test_alarms_are_bounded_and_newest_first() -> None:
    alarms = Alarms()
    for k in range(1000):
        alarms.announce(f"text: {k}", str(k), float(k))
    assert [alarm.text for alarm in alarms][:2] == ["999", "998"]
    assert len(list(alarms)) == MAX_ALARMS
    alarms.acknowledge()
    assert alarms.unseen == 0


def test_which_received_messages_raise_an_alarm() -> None:
    """A moving mass raises no alarm; a stale parameter, a lost sensor, an error and silence do."""
    fleet, bridge = ReceivedBridges(), Codec(1, 191)

    def feed(now: float, name: str, **fields: object) -> None:
        for message in Codec(255, 190).parse(bridge.pack(name, **fields)):
            fleet.receive(message, now)
        fleet.due(now)

    feed(0.0, "MAG_FIELD", flags=int(Quality.MOVING | Quality.NO_BORESIGHT))
    alarms = fleet.states[1, 191].alarms
    assert list(alarms) == []
    feed(1.0, "MAG_FIELD", flags=int(Quality.STALE_TELEMETRY))
    feed(2.0, "MAG_STATUS", sensor_state=3, autopilot_state=0, log_state=1)
    feed(3.0, "STATUSTEXT", severity=3, text="log failed: disk full")
    feed(3.1, "STATUSTEXT", severity=4, text="only a warning")
    fleet.due(20.0)
    keys = {"stale_telemetry", "Sensor", "text: log failed: disk full", "silence"}
    assert {alarm.key for alarm in alarms} == keys


def test_alarms_of_one_cause_are_one_group() -> None:
    alarms = Alarms()
    alarms.announce("text: hmr2300 lost: unplugged", "hmr2300 lost: unplugged", 1.0)
    alarms.update({"gap": "Samples are missing", "Sensor": "Sensor: lost", "Log": "Log: failed"}, 2.0)
    assert [group.cause for group in alarms.groups] == ["sensor", "log"]
    assert alarms.unseen == 2
    sensor = next(group for group in alarms.groups if group.cause == "sensor")
    assert sensor.text == "Samples are missing; Sensor: lost; hmr2300 lost: unplugged"
    alarms.acknowledge("sensor")
    assert alarms.unseen == 1
    assert {group.cause: group.acknowledged for group in alarms.groups} == {"sensor": True, "log": False}


@pytest.mark.parametrize(
    ("first", "published", "samples", "better", "words", "good"),
    [
        (12.0, 3.0, 2000, 20.0, "12.00 nT ...: 0.25 times (95 %: 0.23 to 0.27, over 500", True),
        (10.0, 9.8, 100, 1.0, "0.98 times (95 %: 0.81 to 1.19, over 100 samples). It is not shown", False),
        (10.0, 5.0, 2000, -3.0, "favour the first calibration", False),
        (0.0, 0.0, 0, 0.0, "not known yet", False),
    ],
)
def test_what_an_accepted_calibration_is_worth(
    first: float, published: float, samples: int, better: float, words: str, good: bool
) -> None:
    learning = {"calibration_id": 1, "first_calibration_id": 2, "rms_first": first, "samples": samples}
    text, is_good = learned_worth({**learning, "rms_published": published, "better": better})
    assert is_good == good
    assert all(part in text for part in words.split(" ..."))
    text, is_good = learned_worth({**learning, "calibration_id": 2})
    assert is_good
    assert "only acknowledges" in text
