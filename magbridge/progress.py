"""Show the progress of long operations: a bar on a terminal, else nothing or a line at intervals."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from threading import Timer
from typing import TypeVar

__all__ = ["track", "waiting"]

T = TypeVar("T")
BAR_DELAY_S = 2.0
"""Time before a bar appears, s."""
BAR_INTERVAL_S = 0.1
"""Time between two updates of the bar, s; most items take less time than drawing the bar."""
LINE_INTERVAL_S = 10.0
"""Time between two lines if stderr is not a terminal, s."""


def track(items: Iterable[T], task: str, total: int | None = None, *, in_lines: bool = False) -> Iterator[T]:
    """Yield `items`, and after 2 s show a bar with the fraction of the items that are done.

    If stderr is not a terminal, no bar is shown; with `in_lines`, a line is printed to stderr every
    :data:`LINE_INTERVAL_S`. `total` is the number of items, and `task` the title.
    """
    if in_lines and not sys.stderr.isatty():
        yield from _lines(items, task, total)
        return
    with _bar(task, total) as update:
        updated = time.monotonic()
        for done, item in enumerate(items, 1):
            yield item
            now = time.monotonic()
            if now - updated > BAR_INTERVAL_S:
                update(completed=done)
                updated = now


def _lines(items: Iterable[T], task: str, total: int | None) -> Iterator[T]:
    """Yield `items`, and print the number of finished items at intervals and after the last item."""
    begin = printed = time.monotonic()
    of = "" if total is None else f" of {total}"
    for done, item in enumerate(items, 1):
        yield item
        now = time.monotonic()
        is_last = done == total and now - begin >= LINE_INTERVAL_S
        if now - printed >= LINE_INTERVAL_S or is_last:
            print(f"magbridge: {task}: {done}{of}, {now - begin:.0f} s", file=sys.stderr, flush=True)
            printed = now


@contextmanager
def waiting(task: str) -> Iterator[Callable[[str], object]]:
    """Show on a terminal the title and the elapsed time of the block, from 2 s after its start.

    Yields a function that replaces the title, to name the next step.
    """
    with _bar(task) as update:
        yield lambda step: update(description=step)


@contextmanager
def _bar(title: str, total: float | None = None) -> Iterator[Callable[..., object]]:
    """Show a bar and the elapsed time, from 2 s after the start; yield a function that updates the bar."""
    if not sys.stderr.isatty():
        yield lambda **_: None
        return
    from rich.console import Console  # noqa: PLC0415 - needed on a terminal only
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn  # noqa: PLC0415 - likewise

    columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(title, total=total, visible=False)
        appear = Timer(BAR_DELAY_S, progress.update, (task,), {"visible": True})
        appear.daemon = True
        appear.start()
        try:
            yield lambda **fields: progress.update(task, **fields)
        finally:
            appear.cancel()
