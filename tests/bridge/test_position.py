"""The Earth's main field where the vehicle says it is."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from math import isnan
from pathlib import Path

import numpy as np
import pytest
from small import small_bridge

from magbridge.bridge.events import Event, StartEvent, clock_step
from magbridge.bridge.position import Position
from magbridge.calibration.model import Parameter
from magbridge.field.igrf import igrf, total_field
from magbridge.mavlink import Codec
from magbridge.records import Channel

START, SECOND, YEAR = 1_780_000_000_000_000, 1_000_000, 31_557_600_000_000
AGO = 20 * YEAR


def position_at(
    latitude: float, longitude: float, altitude: float, notify: Callable[[str], None] = print
) -> Position:
    fields = {"lat": round(latitude * 1e7), "lon": round(longitude * 1e7), "alt": round(altitude * 1e3)}
    (message,) = Codec(0, 0).parse(Codec(1, 1).pack("GLOBAL_POSITION_INT", **fields))
    position = Position(notify)
    position.update(message, START)
    return position


def test_a_dive_is_nearer_to_the_core() -> None:
    surface, deep = (
        position_at(49.5, -57.9, altitude).main_field(START, START) for altitude in (0.0, -1000.0)
    )
    for field, depth in ((surface, 0.0), (deep, 1000.0)):
        assert field == pytest.approx(total_field(-57.9, 49.5, depth, START * 1e-6).item(), abs=0.1)
    assert 15.0 < deep - surface < 35.0


def test_the_vector_is_that_of_a_place_at_most_a_kilometre_away() -> None:
    position = position_at(49.5, -57.9, 0.0)
    for latitude in (49.5, 49.505, 49.55):
        (message,) = Codec(0, 0).parse(
            Codec(1, 1).pack("GLOBAL_POSITION_INT", lat=round(latitude * 1e7), lon=-579_000_000)
        )
        position.update(message, START)
        vector = igrf(-57.9, latitude, 0.0, START * 1e-6)[0]
        assert np.linalg.norm(vector - position.direction(START, START)) < 10.0


def test_an_old_position_or_none_gives_no_field() -> None:
    position = position_at(49.5, -57.9, 0.0)
    assert not isnan(position.main_field(START + 59 * SECOND, START))
    assert isnan(position.main_field(START + 61 * SECOND, START))
    assert isnan(position_at(0.0, 0.0, 0.0).main_field(START, START))
    assert isnan(Position(print).main_field(START, START))


def test_the_field_is_that_of_the_day_to_which_the_clock_was_set() -> None:
    """A computer without a real-time clock starts years ago, or in 1970, which is not plausible."""
    position = position_at(49.5, -57.9, 0.0)
    assert isnan(position.main_field(START + SECOND, 0))
    for year in (2005, 2026, 2005):
        day = datetime(year, 7, 1, tzinfo=UTC).timestamp()
        expected = total_field(-57.9, 49.5, 0.0, day).item()
        assert position.main_field(START + SECOND, round(day * 1e6)) == pytest.approx(expected, abs=0.1)


def test_the_anomaly_follows_when_the_host_s_clock_is_set(tmp_path: Path) -> None:
    bridge = small_bridge(
        tmp_path, StartEvent(START), Parameter("battpos", "", -1.0, 1.0, 0.0, 1.0), ["MAG_FIELD"]
    )
    place = {"lat": 495_000_000, "lon": -579_000_000}
    bridge.feed(Event(START, Channel.LINK, Codec(1, 1).pack("GLOBAL_POSITION_INT", **place)))
    ear, seen = Codec(0, 0), []
    for second in (1, 3):
        sent = bridge.feed(
            Event(START + second * SECOND, Channel.SENSOR, b"1 2 50000 4 %d %d\n" % (second, second))
        )
        received = [message for _, frame in sent for message in ear.parse(frame)]
        seen += [message for message in received if message.name == "MAG_FIELD"]
        bridge.feed(Event(START + 2 * SECOND, Channel.STATE, clock_step(START, -AGO)))
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
