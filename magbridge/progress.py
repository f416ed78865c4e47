"""A progress bar on a terminal, for what takes more than two seconds; nothing elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator
from typing import TypeVar

__all__ = ["track"]

T = TypeVar("T")
PATIENCE = 2.0
"""s before a bar appears."""


def track(items: Iterable[T], what: str, total: float | None = None) -> Iterator[T]:
    """Yield `items`; once that has taken two seconds, show on a terminal how far it is."""
    if not sys.stderr.isatty():
        yield from items
        return
    from rich.console import Console  # noqa: PLC0415 - only where there is somebody to look
    from rich.progress import Progress  # noqa: PLC0415

    begun = time.monotonic()
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(what, total=total, visible=False)
        for item in items:
            yield item
            progress.update(task, advance=1, visible=time.monotonic() - begun > PATIENCE)
