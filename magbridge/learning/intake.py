"""Which samples are learned from: at most so many a second, each once newer telemetry has come."""

from __future__ import annotations

from collections import deque
from typing import Final, NamedTuple

from magbridge.arrays import FloatArray
from magbridge.field.geodesy import separation
from magbridge.records import Vector

__all__ = ["Intake", "Sample"]

MOST_HELD: Final = 64
"""Samples that wait for newer telemetry, at most: the first are then left out."""
SHORT_US: Final = 3_600_000_000
"""Time without a usable sample after which the bridge sends a notification, µs."""


class Sample(NamedTuple):
    """One that may be learned from, unless it is `faulty`: see :meth:`.Learner.sample`.

    ``phi`` (m,) are all regressors, ``positions`` the masses', scaled.
    """

    time_us: int
    field: Vector
    reference: float
    phi: FloatArray
    positions: list[float]
    where: tuple[float, float]
    watched: tuple[float, ...]
    faulty: bool


class Intake:
    """Holds the samples that wait.

    Parameters
    ----------
    max_rate : float
        Hz.
    """

    def __init__(self, max_rate: float) -> None:
        self._period_us = round(1e6 / max_rate)
        self._held: deque[Sample] = deque(maxlen=MOST_HELD)
        self._last_us = self._looked_us = self._taken_us = self._reported_us = 0
        self._where: tuple[float, float] | None = None
        self._newest = False

    def due(self, time_us: int, *, fit: bool) -> bool:
        """Return whether it is time for another sample, `fit` to learn from or not."""
        return not 0 <= time_us - (self._taken_us if fit else self._looked_us) < 0.99 * self._period_us

    def drop(self) -> None:
        """Discard the waiting sample, because a mass had begun to move or the sensor was power-cycled."""
        self._held.clear()

    def confirmed(self, time_us: int, age: float) -> list[Sample]:
        """Return those that waited for a sample now, at which nothing moves, with telemetry `age` (s) old."""
        self._looked_us = time_us
        out = []
        while self._held and self._held[0].time_us < time_us - age * 1e6:
            out.append(self._held.popleft())
        return out

    def wait(self, sample: Sample) -> None:
        """Let a sample wait."""
        if not sample.faulty:
            self._taken_us = sample.time_us
        self._held.append(sample)
        self._newest = True

    def settle(self, field: Vector | None) -> None:
        """Correct the waiting sample's field (nT) from the next reading, if a sample waits."""
        if self._newest and self._held and field is not None:
            self._held[-1] = self._held[-1]._replace(field=field)
        self._newest = False

    def short(self, time_us: int) -> bool:
        """Count an unusable sample; return True if a notification of the shortage is due."""
        self._last_us = self._last_us or time_us
        if time_us - self._last_us <= SHORT_US or self._reported_us == self._last_us:
            return False
        self._reported_us = self._last_us
        return True

    def moved(self, sample: Sample) -> tuple[float, float]:
        """Return m and s since the last sample that was taken, which this one is now."""
        before, last_us = self._where or sample.where, self._last_us or sample.time_us
        self._where, self._last_us = sample.where, sample.time_us
        north, east = separation(*before, *sample.where)
        return (north * north + east * east) ** 0.5, max(sample.time_us - last_us, 0) * 1e-6
