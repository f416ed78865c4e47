"""GNSS receivers that measure another position than the true one, and do not report it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from magbridge.field.geodesy import offset
from referee.autopilot import GPS_SIGMA

Place = tuple[float, float]
Receiver = Callable[[float, Place], tuple[Place, float] | None]
"""Takes s since the start and the true position (deg); returns the measured one and the accuracy (m) that the
receiver claims, or None without a fix."""


def honest(second: float, place: Place) -> tuple[Place, float]:  # noqa: ARG001 - as the other receivers
    """Measure the true position."""
    return place, GPS_SIGMA


def carried_off(start: float, north: float, east: float) -> Receiver:
    """Return a receiver that is led away at a velocity (m/s) from a time (s) on."""

    def measure(second: float, place: Place) -> tuple[Place, float]:
        elapsed = max(second - start, 0.0)
        return offset(*place, north * elapsed, east * elapsed), GPS_SIGMA

    return measure


def jumped(start: float, end: float, north: float, east: float) -> Receiver:
    """Return a receiver whose position is wrong by a constant (m) between two times (s)."""

    def measure(second: float, place: Place) -> tuple[Place, float]:
        wrong = start <= second < end
        return (offset(*place, north, east) if wrong else place), GPS_SIGMA

    return measure


def frozen(start: float, end: float) -> Receiver:
    """Return a receiver that repeats one position between two times (s)."""
    held: list[Place] = []

    def measure(second: float, place: Place) -> tuple[Place, float]:
        if not start <= second < end:
            return place, GPS_SIGMA
        held[:] = held or [place]
        return held[0], GPS_SIGMA

    return measure


def jammed(start: float, end: float, seed: int = 0, accuracy: float | None = None) -> Receiver:
    """Return a receiver that is jammed between two times (s), as ArduPilot's simulator does it.

    ``libraries/SITL/SIM_GPS.cpp``, simulate_jamming: no fix for 1 to 6 s; then the number of satellites is
    drawn again and again, with a fix in 11 of 30 cases; the position starts where the jamming began and walks
    by up to 200 m on each axis about once a second; the accuracy is drawn between 0 and 300 m (or is
    constant: `accuracy`, m).
    """
    rng = np.random.default_rng(seed)
    silent = start + rng.uniform(1.0, 6.0)
    walk: list[Place] = []

    def measure(second: float, place: Place) -> tuple[Place, float] | None:
        if not start <= second < end:
            return place, GPS_SIGMA
        walk[:] = [offset(*(walk or [place])[0], *rng.uniform(-200.0, 200.0, 2).tolist())]
        claimed = accuracy if accuracy is not None else float(rng.uniform(0.0, 300.0))
        return (walk[0], claimed) if second > silent and rng.uniform() < 0.7 else None

    return measure
