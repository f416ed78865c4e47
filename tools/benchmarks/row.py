"""Row of the benchmarks' table, and functions that measure processor time."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple


class Row(NamedTuple):
    """A measured figure, with its floor in the same run and its target.

    The `floor` is the value of a minimal program for the same work; `floor_is` names this program. The target
    `most` or `least` limits the value, or limits `ratio` if `ratio` is not None: the median over the
    repetitions of value divided by floor.
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
    """Run a script with arguments in another process; return its output parsed as JSON, None if empty."""
    command = [sys.executable, "-c", script, *map(str, arguments)]
    place = Path(__file__).parents[1]
    done = subprocess.run(command, cwd=place, capture_output=True, text=True, check=True)
    return json.loads(done.stdout or "null")


def processor_time(work: Callable[[], object]) -> float:
    """Return the processor time, in s, that `work` takes in all threads."""
    begun = time.process_time()
    work()
    return time.process_time() - begun
