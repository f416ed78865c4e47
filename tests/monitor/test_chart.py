"""The curve, its axis and its marks; the history behind them; the map."""

from __future__ import annotations

from itertools import pairwise
from math import inf, nan

import pytest

from magbridge.field.geodesy import separation
from magbridge.monitor.charts import ASPECT, axis_range, drawn, ellipse, extent, spikes
from magbridge.monitor.history import TIERS, TRAIL, Point, Series, TrackPoint, Trail

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
    assert series.added == 2
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
