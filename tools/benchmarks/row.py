"""Row of the benchmarks' table, and functions that measure processor time."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from statistics import median
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


def in_own_process(function: Callable[..., Any], *arguments: Any) -> Any:
    """Return the result of a function that runs in a new process, so that its memory can be measured."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def peak_memory() -> float:
    """Return the largest memory of this process so far, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1.024e-3


def processor_time(work: Callable[[], object]) -> float:
    """Return the processor time, in s, that `work` takes in all threads."""
    begun = time.process_time()
    work()
    return time.process_time() - begun


def alternating(repetitions: int, *measures: Callable[[], float]) -> list[list[float]]:
    """Return the values of measurements taken in turn, without the first ones, which fill the caches."""
    rows = [[measure() for measure in measures] for _ in range(repetitions + 1)]
    return [list(values) for values in zip(*rows[1:], strict=True)]


def median_ratio(above: Sequence[float], below: Sequence[float]) -> float:
    """Return the median over the repetitions of a value divided by another."""
    return median(a / b for a, b in zip(above, below, strict=True))
