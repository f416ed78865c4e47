"""Detect that this machine had no processor time for a while, so that no test counts it as a fault."""

from __future__ import annotations

import os
import threading
import time
from functools import cache

__all__ = ["Standstill", "standstill"]

NAP = 0.01
"""s between two looks at the clock."""
LATE = 0.1
"""s by which a look comes late where a processor stood still; a busy one is late by less."""


class Standstill:
    """A thread on each processor sleeps, and writes down when it was woken late."""

    def __init__(self) -> None:
        self._spells: list[tuple[float, float]] = []
        self._looked: dict[int, float] = {}
        for processor in os.sched_getaffinity(0):
            self._looked[processor] = time.monotonic()
            threading.Thread(target=self._watch, args=(processor,), daemon=True).start()

    def _watch(self, processor: int) -> None:
        os.sched_setaffinity(0, {processor})  # of this thread
        while True:
            time.sleep(NAP)
            last, self._looked[processor] = self._looked[processor], time.monotonic()
            self._spells += _late(last, self._looked[processor])

    def seconds(self, begin: float, end: float) -> float:
        """Return for how many s a processor stood still between the two (s, monotonic)."""
        now, seconds = time.monotonic(), 0.0
        still = [spell for last in self._looked.values() for spell in _late(last, now)]
        for first, last in sorted(self._spells + still):
            seconds += max(min(last, end) - max(first, begin), 0.0)
            begin = max(begin, last)
        return seconds


def _late(last: float, now: float) -> list[tuple[float, float]]:
    """Return begin and end of a standstill, if there was one between two looks (s, monotonic)."""
    return [(last + NAP, now)] if now - last > NAP + LATE else []


@cache
def standstill() -> Standstill:
    """Return the watch over this machine; it begins with the first call."""
    return Standstill()
