"""The bridge stands still just before a mass moves: what waited is joined with the telemetry of its time."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from checks import Row, replays, seconds
from devices import TRUTH
from rig import OPTIONS, Rig, calibration

from magbridge.calibration.file import save
from magbridge.calibration.model import CalibratedSensor
from magbridge.records import Quality

SLOPE = np.array([300.0, -200.0, 100.0])
"""nT that the mass adds, from the middle of its range to the end."""
TOTAL = float(np.linalg.norm(TRUTH))
LINES = 'columns = ["x", "y", "z"]'


@pytest.mark.parametrize(
    ("sensor", "answers", "still"),
    [
        (("digitizer", OPTIONS), True, 1.5),
        (("digitizer", OPTIONS), False, 1.5),
        (("ascii", LINES + "\nrate = 4.0"), True, 1.5),
        (("ascii", LINES), False, 2.5),
    ],
)
def test_a_standstill_just_before_a_mass_moves(
    make_rig: Callable[..., Rig], table: Row, sensor: tuple[str, str], answers: bool, still: float
) -> None:
    rig = make_rig(sensor=sensor, hz=4.0)
    moved = replace(calibration(tuple(SLOPE.tolist())), sensor=CalibratedSensor(sensor[0]))
    save(moved, rig.folder / "cal.json")
    moves = [np.inf]

    def position(now: float) -> float:
        return 0.5 + 1.5 * float(np.clip(now - moves[0], 0.0, 1.0))

    def field(now: float) -> Any:
        return tuple(np.array(TRUTH) + SLOPE * (position(now) - 0.5) / 1.5)

    rig.autopilot.position, rig.fluxgate.field, rig.autopilot.answers = position, field, answers
    rig.start()
    mark = rig.mark
    rig.process.send_signal(signal.SIGSTOP)
    moves[0] = time.monotonic() + 0.1
    rig.run(still)
    rig.process.send_signal(signal.SIGCONT)
    back = rig.until_well()
    rig.until_reported("stood still for", mark)
    assert [text for text in rig.texts(mark) if "silent" in text] == [], "nobody listened"
    rig.run(0.5)
    samples = rig.of("MAG_FIELD", mark)
    assert len(samples) >= 4 * still
    wrong = 0.0
    for one in samples:
        error = abs(one["total_field"] - TOTAL)
        if one["flags"] == rig.normal:
            assert error <= 3.0 * one["total_field_sigma"], one.fields
        elif one["flags"] & Quality.LATE_JOIN:
            wrong = max(wrong, error / one["total_field_sigma"])
    flagged = sum(bool(one["flags"] & Quality.LATE_JOIN) for one in samples)
    assert flagged >= (4 if not answers or sensor[0] == "ascii" else 0)
    assert wrong < 4.0  # the sigma grows, too
    table(
        f"process stopped for {still} s just before a mass moves; {sensor[0]}, "
        f"{'with' if answers else 'without'} TIMESYNC",
        "samples that waited: at their own times, `late_join` where their time or the telemetry's is guessed",
        seconds(back),
        f"nothing; {flagged} of {len(samples)} samples flagged",
    )
    replays(rig)
