"""Several logs as one stream, sorted in time, without holding them whole."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import xarray as xr

from magbridge.logs.deployment import join, same_columns, uncounted

__all__ = ["merge"]

Open = Callable[[int], Iterator[xr.Dataset]]


def merge(sources: Sequence[Open], rows: int) -> Iterator[xr.Dataset]:
    """Yield the logs that `sources` open as one deployment in pieces, sorted in time, with the same columns.

    Each log is opened twice: once for its first row, which gives its start and its columns, and once when the
    stream has reached that start. Short pieces, as of many short logs, are joined to pieces of `rows` rows.
    """
    firsts = [next(source(1)) for source in sources]
    whole = join(firsts)  # also checks that they agree on units and on what heading means
    columns = {str(name): dict(whole[name].attrs) for name in whole.data_vars}

    def joined(parts: Sequence[xr.Dataset]) -> xr.Dataset:
        # a file's attributes are those of the first piece, and must name all sources
        return same_columns(join(parts), columns).assign_attrs(source=whole.attrs["source"])

    parts: list[xr.Dataset] = []
    held = 0  # rows in them, counted as they come: of thousands of short logs a sum would be quadratic
    for together in _in_order(sources, [float(first["time"].values[0]) for first in firsts], rows):
        parts += together
        held += sum(part.sizes["time"] for part in together)
        if held >= rows:
            yield joined(parts)
            parts, held = [], 0
    if parts:
        yield joined(parts)


def _in_order(sources: Sequence[Open], starts: Sequence[float], rows: int) -> Iterator[list[xr.Dataset]]:
    """Yield the logs' rows up to one time after another, up to which none can add another row.

    `starts` are the times (s) of their first rows: none is opened before.
    """
    waiting = deque(sorted((start, k) for k, start in enumerate(starts)))
    active: dict[int, tuple[xr.Dataset, Iterator[xr.Dataset]]] = {}

    def advance(k: int, pieces: Iterator[xr.Dataset]) -> None:
        piece = next(pieces, None)
        if piece is None:
            active.pop(k, None)
        else:
            active[k] = piece, pieces

    while waiting or active:
        horizon = min((float(piece["time"].values[-1]) for piece, _ in active.values()), default=np.inf)
        if waiting and waiting[0][0] <= horizon:
            _, k = waiting.popleft()
            advance(k, sources[k](rows))
            continue
        parts = []
        for k, (piece, pieces) in sorted(active.items()):
            n = int(np.searchsorted(piece["time"].values, horizon, side="right"))
            if n == piece.sizes["time"]:
                parts.append(piece)
                advance(k, pieces)
            elif n:
                parts.append(piece.isel(time=slice(0, n)))
                active[k] = uncounted(piece.isel(time=slice(n, None))), pieces
        yield parts
