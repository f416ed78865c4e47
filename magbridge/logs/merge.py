"""Merge several logs into one stream, sorted in time, in bounded memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain, pairwise

import numpy as np
import xarray as xr

from magbridge.logs.deployment import join, same_columns, uncounted
from magbridge.logs.sensor_log import VehicleTelemetry, refuse_offset, sensor_logs, with_note

__all__ = ["merge"]

Open = Callable[[int], Iterator[xr.Dataset]]
Opened = tuple[xr.Dataset, Iterator[xr.Dataset]]
"""A piece of a log, and those after it."""
MAX_BUFFERED_BYTES = 1 << 28
"""Bytes of first pieces that are kept while the others are opened: of small logs, all."""


def merge(
    sources: Sequence[Open], rows: int, named: Sequence[bool] = (), clock_offset_s: float = 0.0
) -> Iterator[xr.Dataset]:
    """Yield the logs that `sources` open as one deployment in pieces, sorted in time, with the same columns.

    Each log is opened for its first piece, which gives its start and its columns; where memory does not
    suffice for that, it is opened again when the stream has reached its start. Short pieces, as of many short
    logs, are joined to pieces of `rows` rows. A log without a piece is left out.

    A sensor's own logs, those `named` or found by :func:`~magbridge.logs.sensor_log.sensor_logs`, get the
    telemetry of the vehicle's logs, which are held whole.
    """
    firsts: dict[int, xr.Dataset] = {}
    opened: dict[int, Opened] = {}
    room = MAX_BUFFERED_BYTES
    for k, source in enumerate(sources):
        pieces = source(rows)
        if (first := next(pieces, None)) is None:
            continue
        firsts[k] = first.isel(time=slice(0, 1)).copy(deep=True)
        room -= first.nbytes
        if room > 0:
            opened[k] = first, pieces
    places = list(firsts)
    kinds = sensor_logs([firsts[k] for k in places], [k < len(named) and named[k] for k in places])
    if kinds[0]:
        sensors, vehicles = ([places[k] for k in kind] for kind in kinds)
        logs = [part for k in vehicles for part in _pieces(sources[k], opened.get(k), rows)]
        telemetry = VehicleTelemetry(join(logs), clock_offset_s)
        combined = {k: telemetry.opener(sources[k], is_first=k == sensors[0]) for k in sensors}
        opened.clear()
        stream = merge([combined.get(k, sources[k]) for k in places if k not in vehicles], rows)
        names = ", ".join(str(firsts[k].attrs["source"]) for k in sensors)
        for piece, following in pairwise(chain(stream, [None])):
            if piece is not None:
                yield piece if following is not None else with_note(piece, telemetry.note(names))
        return
    refuse_offset(clock_offset_s)
    whole = join(list(firsts.values()))  # also checks that they agree on units and on what heading means
    columns = {str(name): dict(whole[name].attrs) for name in whole.data_vars}
    meaning = {key: whole.attrs[key] for key in ("source", "heading_reference") if key in whole.attrs}

    def joined(parts: Sequence[xr.Dataset]) -> xr.Dataset:
        # a file's attributes are those of the first piece, and must name all sources
        return same_columns(join(parts), columns).assign_attrs(meaning)

    parts: list[xr.Dataset] = []
    held = 0  # rows in them, counted as they come: of thousands of short logs a sum would be quadratic
    starts = {k: float(first["time"].values[0]) for k, first in firsts.items()}
    for together in _in_order(sources, starts, opened, rows):
        parts += together
        held += sum(part.sizes["time"] for part in together)
        if held >= rows:
            yield joined(parts)
            parts, held = [], 0
    if parts:
        yield joined(parts)


def _pieces(source: Open, opened: Opened | None, rows: int) -> Iterator[xr.Dataset]:
    """Yield the pieces of a log, of which the first may have been read."""
    if opened is None:
        yield from source(rows)
    else:
        yield opened[0]
        yield from opened[1]


def _in_order(
    sources: Sequence[Open], starts: Mapping[int, float], opened: dict[int, Opened], rows: int
) -> Iterator[list[xr.Dataset]]:
    """Yield the logs' rows up to one time after another, up to which none can add another row.

    `starts` are the times (s) of their first rows: none is opened before, except those in `opened`.
    """
    waiting = deque(sorted((start, k) for k, start in starts.items()))
    active: dict[int, Opened] = {}

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
            if k in opened:
                active[k] = opened.pop(k)
            else:
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
