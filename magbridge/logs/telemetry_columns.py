"""An autopilot's telemetry log as columns: what a station recorded, which is all of one clock.

The values are those of :class:`~magbridge.logs.telemetry.TelemetryRows`, which reads a bridge's log message
by message; here each field of all messages is read at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from msgspec.structs import replace

from magbridge.arrays import FloatArray, IndexArray
from magbridge.logs.compasses import LogCompass, compass_notes, listed
from magbridge.logs.deployment import NOTES, deployment, noted
from magbridge.logs.resample import MAX_AGE
from magbridge.logs.telemetry_fields import IMUS, TELEMETRY
from magbridge.logs.telemetry_survey import LogContents
from magbridge.mavlink import spec
from magbridge.mavlink.tlog import Block, blocks

__all__ = ["read_at_once"]

NAMED = spec("NAMED_VALUE_FLOAT")
Part = tuple[IndexArray, IndexArray, FloatArray]
"""Places in the file (m,), µs (m,) and values (m,)."""


def read_at_once(
    path: Path, survey: LogContents, compasses: Sequence[LogCompass], wanted: str | None
) -> xr.Dataset:
    """Return the log as one deployment; of the file, one block at a time is held."""
    source = spec(survey.source).id
    own = IMUS.get(survey.source, [])
    fields: dict[str, list[FloatArray]] = {value.column: [] for value in own}
    telemetry: dict[str, list[Part]] = {}
    places, stamps = [], []
    base = skipped = damages = 0
    with path.open("rb") as file:
        for block in blocks(file):
            sent = block.system == survey.system
            rows = np.flatnonzero(sent & (block.number == source) & (block.component == survey.component))
            if len(rows):
                places.append(base + rows)
                stamps.append(block.time_us[rows])
                payloads = block.payloads(rows)
                for value in own:
                    fields[value.column].append(value.column_of(payloads))
            for column, part in _telemetry(block, survey, sent, base):
                telemetry.setdefault(column, []).append(part)
            base += len(block.number)
            skipped, damages = skipped + block.bytes_skipped, damages + block.damages
    at, time_us = np.concatenate(places), np.concatenate(stamps)
    columns = {name: np.concatenate(parts) for name, parts in fields.items()}
    for name in survey.columns:
        if name not in columns and name in telemetry:
            columns[name] = _last(at, time_us, telemetry[name])
    if "heading" in columns:
        columns["heading"] %= 360.0
    units = {name: survey.columns.get(name, "") for name in columns}
    attrs = {**survey.attrs, "bytes_skipped": skipped, "damages": damages}
    if compasses:
        seconds = float(time_us[-1] - time_us[0]) / 1e6
        timed = [replace(one, rate=(one.samples - 1) / seconds if seconds > 0 else 0.0) for one in compasses]
        attrs |= listed(timed)
        attrs[NOTES] = "\n".join([*noted(survey.attrs), *compass_notes(timed, wanted)])
    return deployment(path, time_us / 1e6, columns, units, attrs)


def _telemetry(
    block: Block, survey: LogContents, sent: np.ndarray[tuple[int], np.dtype[np.bool_]], base: int
) -> list[tuple[str, Part]]:
    """Return the values in a block of each column that is not the source's own field."""
    found = []
    raw = {
        value.column for value in TELEMETRY.get(spec(survey.source).id, []) if value.column.startswith("mag")
    }
    for number, component in survey.senders.items():
        which = np.flatnonzero(sent & (block.number == number) & (block.component == component))
        if len(which):
            payloads, when = block.payloads(which), block.time_us[which]
            found += [
                (value.column, (base + which, when, value.column_of(payloads)))
                for value in TELEMETRY[number]
                if value.column in survey.columns and value.column not in raw
            ]
    named = np.flatnonzero(sent & (block.number == NAMED.id))
    senders = block.component[named]
    if len(named):
        payloads = block.payloads(named)
        offset = NAMED.fields["value"].offset
        values = payloads[:, offset : offset + 4].copy().view("<f4")[:, 0].astype(np.float64)
        letters = payloads[:, NAMED.fields["name"].offset :]
        for name, columns in survey.named.items():
            here = (letters == np.frombuffer(name, np.uint8)).all(axis=1)
            here = np.flatnonzero(here & (senders == survey.speakers.get(name, -1)))
            if len(here):
                which = named[here]
                found += [
                    (column, (base + which, block.time_us[which], values[here] * scale + shift))
                    for column, scale, shift in columns
                ]
    return found


def _last(at: IndexArray, time_us: IndexArray, parts: list[Part]) -> FloatArray:
    """Return the last value that the file has before each row; NaN where it is older than `MAX_AGE`."""
    place, when, values = (np.concatenate(one) for one in zip(*parts, strict=True))
    order = np.argsort(place, kind="stable")  # two messages may hold one column
    k = np.searchsorted(place[order], at, side="right") - 1
    last = order[np.maximum(k, 0)]
    fresh = (k >= 0) & (when[last] >= time_us - round(MAX_AGE * 1e6))
    return np.where(fresh, values[last], np.nan)
