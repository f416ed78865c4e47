"""A line of the benchmarks' table, and how times are measured."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

__all__ = ["Row", "in_own_process", "processor_time"]


class Row(NamedTuple):
    """A measured figure, with its floor in the same run and its target.

    Attributes
    ----------
    what : str
    value : float
    unit : str
    floor : float or None
        The same work at its barest, in the same unit; `floor_is` says how.
    ratio : float or None
        The figure that `most` or `least` limits, where it is not `value` itself: the median over the
        repetitions of value divided by floor.
    most, least : float or None
        The target: upper or lower limit.
    """

    what: str
    value: float
    unit: str
    floor: float | None = None
    floor_is: str = ""
    ratio: float | None = None
    most: float | None = None
    least: float | None = None

    @property
    def holds(self) -> bool | None:
        """True if the target is met; None without a target."""
        judged = self.value if self.ratio is None else self.ratio
        if self.most is not None:
            return judged <= self.most
        return judged >= self.least if self.least is not None else None


def in_own_process(script: str, *arguments: object) -> Any:
    """Run a script with arguments in another process; return its output, which is JSON, or None."""
    command = [sys.executable, "-c", script, *map(str, arguments)]
    place = Path(__file__).parents[1]
    done = subprocess.run(command, cwd=place, capture_output=True, text=True, check=True)
    return json.loads(done.stdout or "null")


def processor_time(work: Callable[[], object]) -> float:
    """Return the processor time, in s, that `work` takes in all threads."""
    begun = time.process_time()
    work()
    return time.process_time() - begun
