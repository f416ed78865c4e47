"""The Earth's main field where the vehicle says it is."""

from __future__ import annotations

from math import isnan

import pytest

from magbridge.bridge.position import Position
from magbridge.field.igrf import total_field
from magbridge.mavlink import Codec

START, SECOND = 1_780_000_000_000_000, 1_000_000


def position_at(latitude: float, longitude: float, altitude: float) -> Position:
    fields = {"lat": round(latitude * 1e7), "lon": round(longitude * 1e7), "alt": round(altitude * 1e3)}
    (message,) = Codec(0, 0).parse(Codec(1, 1).pack("GLOBAL_POSITION_INT", **fields))
    position = Position()
    position.update(message, START)
    return position


def test_a_dive_is_nearer_to_the_core() -> None:
    surface, deep = (position_at(49.5, -57.9, altitude).main_field(START) for altitude in (0.0, -1000.0))
    for field, depth in ((surface, 0.0), (deep, 1000.0)):
        assert field == pytest.approx(total_field(-57.9, 49.5, depth, START * 1e-6).item(), abs=0.1)
    assert 15.0 < deep - surface < 35.0


def test_an_old_position_or_none_gives_no_field() -> None:
    position = position_at(49.5, -57.9, 0.0)
    assert not isnan(position.main_field(START + 59 * SECOND))
    assert isnan(position.main_field(START + 61 * SECOND))
    assert isnan(position_at(0.0, 0.0, 0.0).main_field(START))
    assert isnan(Position().main_field(START))
