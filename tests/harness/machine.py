"""Measure pauses and processor time of this machine, and limit its disk, so that tests hold everywhere."""

import os
import resource
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache

NAP = 0.01
"""Time between two readings of the clock, s."""
LATE = 0.1
"""Minimum delay of a reading that proves a pause, s; a busy processor delays a reading by less."""


class Standstill:
    """Monitor of pauses: a thread on each processor sleeps and records when it woke late."""

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
        """Return the total time (s) of pauses between `begin` and `end` (s, monotonic)."""
        now, seconds = time.monotonic(), 0.0
        still = [spell for last in self._looked.values() for spell in _late(last, now)]
        for first, last in sorted(self._spells + still):
            seconds += max(min(last, end) - max(first, begin), 0.0)
            begin = max(begin, last)
        return seconds


def _late(last: float, now: float) -> list[tuple[float, float]]:
    """Return begin and end of the pause between two readings of the clock (s, monotonic); empty if none."""
    return [(last + NAP, now)] if now - last > NAP + LATE else []


@cache
def standstill() -> Standstill:
    """Return the monitor of this machine's pauses; it starts with the first call."""
    return Standstill()


def cost(work: Callable[[], object]) -> float:
    """Return the processor time of `work`, in units of a loop of 100,000 additions."""
    units = []
    for part in (_loop, _loop, work, _loop):
        begun = time.process_time()
        part()
        units.append(time.process_time() - begun)
    return units[2] / max(min(units[0], units[1], units[3]), 1e-6)


def _loop() -> float:
    total = 0.0
    for k in range(100_000):
        total += k
    return total


@contextmanager
def full_disk(room: int) -> Iterator[None]:
    """Limit the size of every file to `room` bytes."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
