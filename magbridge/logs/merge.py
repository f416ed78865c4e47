"""Several logs as one stream, sorted in time, without holding them whole."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import xarray as xr

from magbridge.logs.deployment import join, same_columns, uncounted

__all__ = ["merge"]

Open = Callable[[int], Iterator[xr.Dataset]]


def merge(sources: Sequence[Open], rows: int) -> Iterator[xr.Dataset]:
    """Yield the logs that `sources` open as one deployment in pieces, sorted in time, with the same columns.

    Each log is opened twice: once for its first row, which gives its start and its columns, and once when the
    stream has reached that start.
    """
    firsts = [next(source(1)) for source in sources]
    whole = join(firsts)  # also checks that they agree on units and on what heading means
    columns = {str(name): dict(whole[name].attrs) for name in whole.data_vars}
    waiting = sorted((float(first["time"][0]), k) for k, first in enumerate(firsts))
    active: dict[int, tuple[xr.Dataset, Iterator[xr.Dataset]]] = {}

    def advance(k: int, pieces: Iterator[xr.Dataset]) -> None:
        piece = next(pieces, None)
        if piece is None:
            active.pop(k, None)
        else:
            active[k] = piece, pieces

    while waiting or active:
        # no log can add another row up to the horizon
        horizon = min((float(piece["time"][-1]) for piece, _ in active.values()), default=np.inf)
        if waiting and waiting[0][0] <= horizon:
            _, k = waiting.pop(0)
            advance(k, sources[k](rows))
            continue
        parts = []
        for k, (piece, pieces) in sorted(active.items()):
            n = int(np.searchsorted(piece["time"].values, horizon, side="right"))
            parts.append(piece.isel(time=slice(0, n)))
            if n == piece.sizes["time"]:
                advance(k, pieces)
            else:
                active[k] = uncounted(piece.isel(time=slice(n, None))), pieces
        piece = join([part for part in parts if part.sizes["time"]])
        # a file's attributes are those of the first piece, and must name all sources
        yield same_columns(piece, columns).assign_attrs(source=whole.attrs["source"])
