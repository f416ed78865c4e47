"""MAVLink telemetry logs (``.tlog``) as deployments.

A row is a magnetometer message of the best kind that the log holds
(:data:`~magbridge.logs.telemetry_survey.SOURCES`), from the component that sent most of them; every other
column is the last value from this vehicle before it (NaN once older than
:data:`~magbridge.logs.fields.MAX_AGE`).

- ``MAG_RAW`` (ours): nT computed from the counts as by the driver, where the log declares the nT per count,
  else float32 (0.004 nT at 50,000 nT); time to the µs, channel times, temperature, supply, power cycles. The
  ``MAG_FIELD`` that follows it becomes the columns of ``magbridge correct``.
- ``HIGHRES_IMU`` (gauss), ``RAW_IMU`` and ``SCALED_IMU*`` (mgauss, so steps of 100 nT): in the autopilot's
  axes, with its own offsets applied; time is the record's time stamp. Further magnetometers become ``mag1_x``
  ... ``mag3_z``.
- Without any of these, each ``ATTITUDE`` or position makes a row, and there is no ``mag_x``.

Telemetry is what the log itself declares by ``MAG_COLUMN`` (a bridge's own, with the age of each value; one
from :mod:`magbridge.logs`), what :data:`~magbridge.logs.telemetry_survey.TELEMETRY` lists, and every
``NAMED_VALUE_FLOAT`` by its name.
Where the clock of a bridge was set, its rows are dated by the clock as it was set last in the file.
Attitude and position are the autopilot's, not a gimbal's, and a named value never takes the place of a column
that the log has a source for. Damaged bytes are skipped and counted in the attributes ``bytes_skipped`` and
``damages``.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from msgspec.structs import replace

from magbridge.arrays import BoolArray, FloatArray, IndexArray
from magbridge.columns import AGE, CHANNEL_TIMES, CORRECTED
from magbridge.logs.compasses import LogCompass, by_columns, choose, compass_notes, listed
from magbridge.logs.deployment import NOTES, deployment, noted
from magbridge.logs.fields import MAX_AGE
from magbridge.logs.telemetry_survey import (
    AUTOPILOT,
    TELEMETRY,
    DeclaredField,
    LogContents,
    are_of_main_sensor,
    source_columns,
    survey,
)
from magbridge.logs.telemetry_writer import FileWriter
from magbridge.mavlink import Source, spec
from magbridge.mavlink.tlog import RecordBlock, blocks
from magbridge.records import Channel

if TYPE_CHECKING:
    from magbridge.logs.mapping import Options

__all__ = ["FileWriter", "chunks"]

NAMED = spec("NAMED_VALUE_FLOAT")
FIELD, STEP = spec("MAG_FIELD").id, spec("MAG_CLOCK_STEP").id
MAX_TELEMETRY_AGE_US = round(MAX_AGE * 1e6)
SINGLE = 1e-7
"""Relative error of a float32; counts that differ from the channel by more belong to another sensor."""
SENSOR_ID, OTHER_TIME = "sensor_id", "_time"
"""Field by which a column belongs to a sensor after the first; ending of the column with the times."""
Updates = tuple[IndexArray, FloatArray]
"""Places in a block (m,), increasing, and the values (m,) of a column there."""


def chunks(path: Path, rows: int, options: Options | None = None) -> Iterator[xr.Dataset]:
    """Yield the log in pieces; it is read twice."""
    status = path.stat()
    found = survey(path, status.st_mtime_ns, status.st_size)
    wanted = options.compass if options else None
    compasses: list[LogCompass] = []
    if found.plain and found.compasses:
        compasses = choose(path, found.compasses, wanted)
        found = found.of_compass(next(one for one in compasses if one.chosen).id)
    attrs, first_attrs = dict(found.attrs), {}
    if compasses:
        span_s = found.span_s
        timed = [replace(one, rate=(one.samples - 1) / span_s if span_s > 0 else 0.0) for one in compasses]
        attrs |= listed(timed)
        first_attrs = {NOTES: "\n".join([*noted(found.attrs), *compass_notes(timed, wanted)])}
    elif NOTES in attrs:
        first_attrs = {NOTES: attrs[NOTES]}
    attrs.pop(NOTES, None)
    for piece in _pieces(path, found, rows, attrs):
        part = piece.assign_attrs(first_attrs)
        yield part if found.plain else by_columns(part, wanted)
        first_attrs = {}


def _pieces(path: Path, found: LogContents, rows: int, attrs: dict[str, Any]) -> Iterator[xr.Dataset]:
    """Yield the log in pieces of at most `rows` rows, each with the losses since the piece before."""
    table = TelemetryTable(found)
    lost = {"bytes_skipped": 0, "damages": 0}
    with path.open("rb") as file:
        for block in blocks(file):
            table.add(block)
            lost["bytes_skipped"] += block.bytes_skipped
            lost["damages"] += block.damages
            while table.rows > rows:  # the last row still waits for its correction
                yield _deployment(path, found, table.pop(rows), attrs | lost)
                lost = dict.fromkeys(lost, 0)
    if table.rows:
        yield _deployment(path, found, table.pop(table.rows), attrs | lost)


def _deployment(
    path: Path, found: LogContents, columns: dict[str, FloatArray], attrs: dict[str, Any]
) -> xr.Dataset:
    time = columns.pop("time")
    _bring_to_rows(time, columns, [one.column for one in _of_other_sensors(found)])
    if "heading" in columns:
        columns["heading"] %= 360.0
    units = {name: found.columns.get(name, "") for name in columns}
    return deployment(path, time, columns, units, attrs)


def _of_other_sensors(found: LogContents) -> list[DeclaredField]:
    """Return the columns of the sensors after the first, which are in the source's messages."""
    source = spec(found.source).id
    return [one for one in found.declared if one.message == source and SENSOR_ID in one.match]


def _bring_to_rows(time: FloatArray, columns: dict[str, FloatArray], names: list[str]) -> None:
    """Interpolate the readings of the sensors after the first to the rows' times (s)."""
    for time_name in [name for name in names if name.endswith(OTHER_TIME)]:
        sampled, sensor = columns.pop(time_name), time_name.removesuffix(OTHER_TIME)
        times, first = np.unique(sampled[np.isfinite(sampled)], return_index=True)
        for name in names:
            if len(times) and name in (sensor, *(f"{sensor}_{axis}" for axis in "xyz")):
                values = columns[name][np.isfinite(sampled)][first]
                rows = np.interp(time, times, values, left=np.nan)
                columns[name] = np.where(np.isfinite(columns[name]), rows, np.nan)


class TelemetryTable:
    """The rows of a log, block by block; the last value of each column is carried to the next block.

    `rows` counts those that are complete, or wait for their correction.
    """

    def __init__(self, found: LogContents) -> None:
        self.rows = 0
        self._found = found
        self._source = spec(found.source).id
        raw = {one.column for one in TELEMETRY.get(self._source, []) if one.column.startswith("mag")}
        own = [f"mag_{axis}" for axis in "xyz" if "IMU" in found.source]
        names = ["time", *own, *(name for name in found.columns if name not in raw)]
        self._place = {name: k for k, name in enumerate(names)}
        declared = {column for columns in found.named.values() for column, _, _ in columns}
        declared |= {one.column for one in found.declared}
        self._tables = {
            number: [one for one in fields if one.column in self._place and one.column not in declared]
            for number, fields in TELEMETRY.items()
        }
        self._further = _of_other_sensors(found)
        in_source = [one for one in found.declared if one.message == self._source]
        self._exact = [one for one in in_source if SENSOR_ID not in one.match]
        self._elsewhere = [one for one in found.declared if one.message != self._source]
        self._sources: dict[str, Source] = {}
        for column, component in found.wanted.items():
            max_age_s = found.attrs.get(f"telemetry.{column}.max_age", MAX_AGE)
            # as live: of several components that send a value, one counts
            self._sources[column] = Source(AUTOPILOT, round(1e6 * max_age_s), component)
        self._to_step_us = found.stepped_us
        self._last: dict[str, tuple[int, float]] = {}
        self._parts: list[FloatArray] = []

    def add(self, block: RecordBlock) -> None:
        """Add the rows of the next block."""
        found = self._found
        is_step = block.number == STEP
        steps_us = [block.message(k)["step"] for k in np.flatnonzero(is_step).tolist()]
        passed_us = np.concatenate([[0], np.cumsum(steps_us, dtype=np.int64)])[np.cumsum(is_step)]
        to_step_us = self._to_step_us - passed_us
        sent = block.system == found.system
        received = sent if not found.ours else sent & (block.channel != Channel.SENT)
        samples = np.flatnonzero(sent & (block.number == self._source) & (block.component == found.component))
        main = _of_main_sensor(block, samples)
        rows = samples[main]
        updates = self._updates(block, received)
        for name, update in self._readings(block, samples[~main], to_step_us):
            updates.setdefault(name, []).append(update)
        table = self._carried(block.time_us, rows, updates)
        if len(rows):
            self._fill(block, rows, to_step_us[rows], table)
            self._parts.append(table)
            self.rows += len(rows)
        corrections = np.flatnonzero(sent & (block.number == FIELD))
        corrections = np.setdiff1d(corrections[_of_main_sensor(block, corrections)], rows)
        if len(corrections) and self._parts:
            self._correct(rows, corrections, source_columns(FIELD, block.payloads(corrections)))
        self._to_step_us = int(to_step_us[-1]) if len(to_step_us) else self._to_step_us

    def pop(self, count: int) -> dict[str, FloatArray]:
        """Return the columns of the first rows, and forget these."""
        table = np.concatenate(self._parts)
        self._parts = [table[count:].copy()] if count < len(table) else []
        self.rows = len(table) - count
        return {name: table[:count, k].copy() for name, k in self._place.items()}

    def _updates(self, block: RecordBlock, received: BoolArray) -> dict[str, list[Updates]]:
        """Return the telemetry in a block by column, from the component that each column is taken from."""
        found: dict[str, list[Updates]] = {}
        for number, component in self._found.senders.items():
            which = np.flatnonzero(received & (block.number == number) & (block.component == component))
            if len(which) and self._tables[number]:
                payloads = block.payloads(which)
                for one in self._tables[number]:
                    found.setdefault(one.column, []).append((which, one.values(payloads)))
        for declared in self._elsewhere:
            which = np.flatnonzero(received & (block.number == declared.message))
            if len(which):
                payloads = block.payloads(which)
                here = declared.matches(payloads)
                which, values = which[here], declared.values(payloads[here])
                admitted = self._admitted(declared.column, block, which)
                found.setdefault(declared.column, []).append((which[admitted], values[admitted]))
        which = np.flatnonzero(received & (block.number == NAMED.id))
        if len(which):
            self._add_named(found, block, which)
        return found

    def _add_named(self, found: dict[str, list[Updates]], block: RecordBlock, records: IndexArray) -> None:
        """Add the values of ``NAMED_VALUE_FLOAT`` by their names."""
        payloads = block.payloads(records)
        start = NAMED.fields["value"].offset
        values = payloads[:, start : start + 4].copy().view("<f4")[:, 0].astype(np.float64)
        letters = payloads[:, NAMED.fields["name"].offset :]
        for name, columns in self._found.named.items():
            here = np.flatnonzero((letters == np.frombuffer(name, np.uint8)).all(axis=1))
            if self._found.plain:
                here = here[block.component[records[here]] == self._found.speakers.get(name, -1)]
            for column, factor, offset in columns:
                places = here
                if not self._found.plain:
                    places = here[self._admitted(column, block, records[here])]
                update = records[places], values[places] * factor + offset
                found.setdefault(column, []).append(update)

    def _admitted(self, column: str, block: RecordBlock, records: IndexArray) -> BoolArray:
        """Return which messages are from the component that a column is taken from at their time."""
        source = self._sources[column]
        senders = zip(block.component[records].tolist(), block.time_us[records].tolist(), strict=True)
        return np.array([source.admit(component, time_us) for component, time_us in senders], bool)

    def _readings(
        self, block: RecordBlock, samples: IndexArray, to_step_us: IndexArray
    ) -> Iterator[tuple[str, Updates]]:
        """Yield the readings of the sensors after the first by column, with the times at which they are."""
        if not len(samples):
            return
        payloads = block.payloads(samples)
        for one in self._further:
            here = one.matches(payloads)
            values = one.values(payloads[here])
            if one.column.endswith(OTHER_TIME):
                values = values + to_step_us[samples[here]] / 1e6
            yield one.column, (samples[here], values)

    def _carried(
        self, time_us: IndexArray, rows: IndexArray, updates: dict[str, list[Updates]]
    ) -> FloatArray:
        """Return the rows with the last value of each column before them; NaN for older ones."""
        table = np.full((len(rows), len(self._place)), np.nan)
        for name in {**self._last, **updates}:
            parts = updates.get(name, [])
            before = [self._last[name]] if name in self._last else []
            at = np.concatenate([np.full(len(before), -1), *(places for places, _ in parts)])
            values = np.concatenate([[value for _, value in before], *(values for _, values in parts)])
            order = np.argsort(at, kind="stable")  # two messages may hold one column
            at, values = at[order], values[order]
            if not len(at):
                continue
            when = np.where(at >= 0, time_us[np.maximum(at, 0)] if len(time_us) else 0, 0)
            when[at < 0] = [stamp_us for stamp_us, _ in before]
            self._last[name] = int(when[-1]), float(values[-1])
            k = np.searchsorted(at, rows, side="right") - 1
            age_us = time_us[rows] - when[k]
            fresh = (k >= 0) & (age_us <= MAX_TELEMETRY_AGE_US)
            table[:, self._place[name]] = np.where(fresh, values[k], np.nan)
            if self._found.ours and AGE + name in self._place:
                table[:, self._place[AGE + name]] = np.where(fresh, age_us * 1e-6, np.nan)
        return table

    def _fill(self, block: RecordBlock, rows: IndexArray, to_step_us: IndexArray, table: FloatArray) -> None:
        """Set the columns of rows that their own messages hold."""
        payloads = block.payloads(rows)
        columns = source_columns(self._source, payloads)
        for one in self._exact:
            if one.column in columns:
                exact, single = one.values(payloads), columns[one.column]
                same = np.isclose(exact, single, rtol=SINGLE, atol=0.0) & one.matches(payloads)
                columns[one.column] = np.where(same, exact, single)
        if "time" not in columns:
            columns["time"] = (block.time_us[rows] + self._found.stepped_us - to_step_us) / 1e6
        for name in ("time", *CHANNEL_TIMES):
            if name in columns:
                moved = (np.rint(1e6 * columns[name]) + to_step_us) / 1e6
                columns[name] = np.where(to_step_us != 0, moved, columns[name])
        for name, values in columns.items():
            if name in self._place:
                k = self._place[name]
                table[:, k] = np.where(np.isnan(values), table[:, k], values)

    def _correct(self, rows: IndexArray, corrections: IndexArray, columns: dict[str, FloatArray]) -> None:
        """Add each ``MAG_FIELD`` to the row before it, that of its reading, unless that has one already."""
        places = [self._place[name] for name in CORRECTED]
        values = np.column_stack([columns[name] for name in CORRECTED])
        # a correction before the first row of the block is that of the last row before the block
        table = self._parts[-1]
        row = np.searchsorted(rows, corrections, side="right") - 1
        if len(rows):
            earlier = self._parts[-2][-1:] if len(self._parts) > 1 else table[:0]
        else:
            earlier, row = table[-1:], np.full(len(corrections), -1)
        # of several, the first with a total field counts: it is written last
        has_total = ~np.isnan(values[:, 0])
        order = np.concatenate([np.flatnonzero(~has_total), np.flatnonzero(has_total)[::-1]])
        for part, of_part in ((earlier, row < 0), (table, row >= 0)):
            which = order[of_part[order]] if len(part) else order[:0]
            which = which[np.isnan(part[np.maximum(row[which], 0), places[0]])]
            part[np.maximum(row[which], 0)[:, None], places] = values[which]


def _of_main_sensor(block: RecordBlock, samples: IndexArray) -> BoolArray:
    """Return which messages of one kind are not samples of a sensor after the first."""
    if not len(samples):
        return np.ones(0, bool)
    return are_of_main_sensor(int(block.number[samples[0]]), block.payloads(samples))
