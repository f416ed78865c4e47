"""Set up a bridge that calibrates in flight, without ports; the tests feed it events."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from small import ASCII_OPTIONS, START, polynomial, write_bridge

from magbridge.bridge.events import Event, StartEvent
from magbridge.bridge.pipeline import Pipeline, set_up
from magbridge.calibration.file import load
from magbridge.config import load as load_config
from magbridge.mavlink import Codec
from magbridge.records import Channel

__all__ = ["bridge", "events"]

PLACE = (49.52, -57.87)
SAMPLES = 700
COUNT = 1.0 / 64.0
"""Resolution of a reading, nT."""
SHIFT = np.array([14.0, -11.0, 13.0])
LEARNING = "[learning]\nenabled = true\n"


def bridge(folder: Path, learning: str = LEARNING, *, known: bool = True) -> Pipeline:
    """Set up a bridge with a nominal calibration (1 nT, 1-sigma), or without a calibration if not `known`."""
    coefficients = np.random.default_rng(1).normal(size=9) * 100.0
    config = write_bridge(
        folder,
        polynomial(coefficients, field_nt=51_900.0, method="nominal"),
        options=f'unit = "counts", scale = {COUNT}, {ASCII_OPTIONS}',
        masses={},
        calibration=known,
        publish={"MAG_FIELD": 0},
        more=learning,
    )
    return set_up(load_config(config), StartEvent(START))


def events(folder: Path) -> list[Event]:
    """Return the events of a vehicle that turns and pitches, whose offset differs from its calibration."""
    rng, autopilot = np.random.default_rng(2), Codec(1, 1)
    cal = load(folder / "cal.json")
    A, T = (one[0] for one in cal.matrices(np.empty((1, 0))))
    made = []
    for k in range(SAMPLES):
        time_us = START + k * 4_000_000
        frame = autopilot.pack(
            "GLOBAL_POSITION_INT",
            time_boot_ms=k * 4000,
            lat=round(PLACE[0] * 1e7) + k * 120,
            lon=round(PLACE[1] * 1e7),
        )
        made.append(Event(time_us - 400_000, Channel.LINK, frame))
        yaw, pitch = (
            0.7 * (k // 40) + 0.1 * rng.normal(),
            (0.45 if k // 40 % 2 else -0.4) + 0.05 * rng.normal(),
        )
        unit = np.array([0.4 * np.cos(yaw) - 0.9 * pitch, 0.4 * np.sin(yaw), 0.9 + 0.4 * pitch * np.cos(yaw)])
        total = 51_900.0 + 40.0 * np.sin(k / 400.0)
        x, y, z = np.linalg.solve(A, total * unit / np.linalg.norm(unit)) + T + SHIFT + rng.normal(size=3)
        counts = (round(x / COUNT), round(y / COUNT), round(z / COUNT))
        made.append(Event(time_us, Channel.SENSOR, b"%d %d %d 4.0 %d 7\r\n" % (*counts, k)))
    return made
