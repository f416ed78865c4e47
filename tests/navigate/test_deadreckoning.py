"""Dead reckoning from each kind of telemetry, on a course whose end is known."""

from __future__ import annotations

import numpy as np
import pytest

from magbridge.field.geodesy import separation
from magbridge.navigate.deadreckoning import DeadReckoning

START = (54.0, 15.0)


def sailed(rows: list[tuple[float, dict[str, float]]], end: float = 1000.0) -> tuple[float, float]:
    where = DeadReckoning()
    where.place(*START)
    for time, values in rows:
        where.telemetry(time, values)
    where.advance(end)
    return separation(*START, where.latitude, where.longitude)


@pytest.mark.parametrize(
    "rows",
    [
        [(0.0, {"velocity_north": 0.3, "velocity_east": 0.4})],
        [(0.0, {"speed": 0.5, "heading": np.degrees(np.arctan2(0.4, 0.3))})],
        [(t, {"north": 0.3 * t + 77.0, "east": 0.4 * t}) for t in np.arange(0.0, 1001.0, 10.0)],
        [
            (t, {"dr_latitude": 10.0 + 0.3 * t / 110608.0, "dr_longitude": 179.999 + 0.4 * t / 109639.0})
            for t in np.arange(0.0, 1001.0, 10.0)
        ],
    ],
)
def test_each_kind_of_telemetry_leads_to_the_same_place(rows: list[tuple[float, dict[str, float]]]) -> None:
    assert sailed(rows) == pytest.approx((300.0, 400.0), abs=1.0)


def test_a_glider_moves_by_its_sink_rate_and_pitch() -> None:
    """26 degrees down at 0.17 m/s of depth is 0.35 m/s along; after the turn it continues."""
    rows = []
    for t in np.arange(0.0, 1000.0, 4.0):
        down = t < 500
        depth = 0.17 * (t if down else 1000 - t)
        pitch = -26.0 if down else 26.0
        if 490 < t < 510:
            pitch = 0.0
        rows.append((t, {"depth": depth, "pitch": pitch, "heading": 90.0}))
    north, east = sailed(rows)
    assert east == pytest.approx(0.17 / np.tan(np.radians(26.0)) * 1000, rel=0.03)
    assert north == pytest.approx(0.0, abs=1e-6)


def test_what_is_nan_or_old_changes_nothing() -> None:
    calm = [(0.0, {"speed": 0.5, "heading": 0.0}), (1.0, {"heading": np.nan, "speed": np.nan})]
    assert sailed([*calm, (0.5, {})]) == pytest.approx((500.0, 0.0), abs=1e-6)


def test_a_long_silence_is_not_sailed_through() -> None:
    where = DeadReckoning()
    where.place(*START)
    where.telemetry(0.0, {"speed": 1.0, "heading": 0.0})
    where.advance(86_400.0)
    assert where.latitude == START[0]
