"""Measure processor time in units of a fixed loop, so that limits hold on slow and fast computers."""

from __future__ import annotations

import time
from collections.abc import Callable

__all__ = ["cost"]


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
