"""MAVLink telemetry logs (``.tlog``) as deployments.

A row is a magnetometer message of the best kind that the log holds
(:data:`~magbridge.logs.telemetry_fields.SOURCES`), from the component that sent most of them; every other
column is the last value from this vehicle before it (NaN once older than
:data:`~magbridge.logs.resample.MAX_AGE`).

- ``MAG_RAW`` (ours): nT computed from the counts as by the driver, where the log declares the nT per count,
  else float32 (0.004 nT at 50,000 nT); time to the µs, channel times, temperature, supply, power cycles. The
  ``MAG_FIELD`` that follows it becomes the columns of ``magbridge correct``.
- ``HIGHRES_IMU`` (gauss), ``RAW_IMU`` and ``SCALED_IMU*`` (mgauss, so steps of 100 nT): in the autopilot's
  axes, with its own offsets applied; time is the record's time stamp. Further magnetometers become ``mag1_x``
  ... ``mag3_z``.
- Without any of these, each ``ATTITUDE`` or position makes a row, and there is no ``mag_x``.

Telemetry is what the log itself declares by ``MAG_COLUMN`` (a bridge's own, with the age of each value; one
from :mod:`magbridge.logs`), what :data:`~magbridge.logs.telemetry_fields.TELEMETRY` lists, and every
``NAMED_VALUE_FLOAT`` by its name.
Where the clock of a bridge was set, its rows are dated by the clock as it was set last in the file.
Attitude and position are the autopilot's, not a gimbal's, and a named value never takes the place of a column
that the log has a source for. Damaged bytes are skipped and counted in the attributes ``bytes_skipped`` and
``damages``. A log that no bridge wrote has one clock and declares nothing: each field of all its messages is
read at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import isclose, isnan, nan
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from magbridge.columns import AGE, CHANNEL_TIMES, CORRECTED
from magbridge.logs.compasses import LogCompass, by_columns, choose
from magbridge.logs.deployment import deployment, sliced
from magbridge.logs.resample import MAX_AGE
from magbridge.logs.telemetry_fields import SOURCES, TELEMETRY, Columns, correction, is_of_main_sensor
from magbridge.logs.telemetry_survey import AUTOPILOT, LogContents, survey
from magbridge.logs.telemetry_writer import FileWriter
from magbridge.mavlink import LogReader, Message, Source, TlogRecord, spec
from magbridge.records import Channel

if TYPE_CHECKING:
    from magbridge.logs.options import Options
from collections.abc import Sequence

from msgspec.structs import replace

from magbridge.arrays import FloatArray, IndexArray
from magbridge.logs.compasses import compass_notes, listed
from magbridge.logs.deployment import NOTES, noted
from magbridge.logs.telemetry_fields import IMUS
from magbridge.mavlink.tlog import RecordBlock, blocks

__all__ = ["FileWriter", "chunks", "read_at_once"]

NAMED = spec("NAMED_VALUE_FLOAT")
Part = tuple[IndexArray, IndexArray, FloatArray]
"""Places in the file (m,), µs (m,) and values (m,)."""
MAX_TELEMETRY_AGE_US = round(MAX_AGE * 1e6)
NEVER = -(1 << 62)
SINGLE = 1e-7
"""Relative error of a float32; counts that differ from the channel by more belong to another sensor."""
SENSOR_ID, OTHER_TIME = "sensor_id", "_time"
"""Field by which a column belongs to a sensor after the first; ending of the column with the times."""
FIELD, STEP, NAMED = spec("MAG_FIELD").id, spec("MAG_CLOCK_STEP").id, spec("NAMED_VALUE_FLOAT")
TIME_COLUMNS = ("time", *CHANNEL_TIMES)


def chunks(path: Path, rows: int, options: Options | None = None) -> Iterator[xr.Dataset]:
    """Yield the log as deployments of at most `rows` rows; it is read twice.

    FormatError: nothing in it makes a row.
    """
    status = path.stat()
    found = survey(path, status.st_mtime_ns, status.st_size)
    wanted = options.compass if options else None
    if found.plain:
        yield from sliced(read_at_once(path, *_of_compass(path, found, wanted), wanted), rows)
        return
    pieces = TelemetryRows(path, found)
    with path.open("rb") as file:
        pieces.reader = LogReader(file)
        for record in pieces.reader:
            pieces.put(record)
            if len(pieces.rows) > rows:  # the last one still waits for its correction
                yield by_columns(pieces.pop_rows(rows), wanted)
        if pieces.rows:
            yield by_columns(pieces.pop_rows(len(pieces.rows)), wanted)


def _of_compass(path: Path, found: LogContents, wanted: str | None) -> tuple[LogContents, list[LogCompass]]:
    """Return the survey with the compass that is wanted as the source of its rows, and all compasses."""
    if not (there := found.compasses):
        return found, []
    compasses = choose(path, there, wanted)
    chosen = next(one for one in compasses if one.chosen)
    return found.of_compass(chosen.id), compasses


class TelemetryRows:
    """Turns messages into rows: keeps the last value of each column, and the rows not yet taken."""

    reader: LogReader

    def __init__(self, path: Path, survey: LogContents) -> None:
        self.rows: list[list[float]] = []
        self._path, self._survey = path, survey
        self._source, self._make = spec(survey.source).id, SOURCES[survey.source]
        columns = ["time", *(f"mag_{axis}" for axis in "xyz" if "IMU" in survey.source)]
        raw = {value.column for value in TELEMETRY.get(self._source, []) if value.column.startswith("mag")}
        columns += [name for name in survey.columns if name not in raw]
        self._slot = {name: k for k, name in enumerate(columns)}
        self._values = [nan] * len(columns)
        self._stamps = [NEVER] * len(columns)
        self._named = {
            letters: [(self._slot[column], scale, offset) for column, scale, offset in columns]
            for letters, columns in survey.named.items()
        }
        known = {column for columns in survey.named.values() for column, _, _ in columns}
        known |= {one.column for one in survey.declared}
        self._tables = {
            number: [
                (self._slot[value.column], value.get)
                for value in values
                if value.column in self._slot and value.column not in known
            ]
            for number, values in TELEMETRY.items()
        }
        of_source = [one for one in survey.declared if one.message == self._source]
        self._counted = [one for one in of_source if SENSOR_ID not in one.match]
        # of the sensors after the first: the last reading, and when it was taken
        self._others = [(self._slot[one.column], one) for one in of_source if SENSOR_ID in one.match]
        self._declared: dict[int, list[tuple[int, Callable[[bytes], float | None]]]] = {}
        for one in survey.declared:
            if one.message != self._source:
                self._declared.setdefault(one.message, []).append((self._slot[one.column], one.find))
        self._sources = {  # as live: of several components that send a value, one counts
            self._slot[column]: Source(
                AUTOPILOT, round(1e6 * survey.attrs.get(f"telemetry.{column}.max_age", MAX_AGE)), wanted
            )
            for column, wanted in survey.wanted.items()
        }
        aged = [one for one in survey.columns if survey.ours and AGE + one in survey.columns]
        self._aged = [(self._slot[AGE + one], self._slot[one]) for one in aged]
        self._to_step_us = survey.stepped_us
        self._skipped = self._damages = 0

    def put(self, record: TlogRecord) -> None:
        """Process the next record of the log."""
        message = record.message
        number = message.id
        if number == STEP:
            self._to_step_us -= message["step"]
        if message.system != self._survey.system:
            return
        if not (self._survey.ours and record.channel == Channel.SENT):
            self._receive(message, record.time_us)
        if not is_of_main_sensor(number, message.payload):
            if number == self._source and message.component == self._survey.component:
                self._note_other(record.time_us, message.payload)
        elif number == self._source and message.component == self._survey.component:
            columns = self._make(message.payload)
            for one in self._counted:
                exact = one.find(message.payload)
                if exact is not None and isclose(exact, columns.get(one.column, nan), rel_tol=SINGLE):
                    columns[one.column] = exact
            self._row(record.time_us, columns)
        elif number == FIELD and self.rows:
            self._correct(correction(message.payload))

    def _note_other(self, time_us: int, payload: bytes) -> None:
        """Note the reading of a sensor after the first."""
        for slot, declared in self._others:
            value = declared.find(payload)
            if value is not None:
                step_s = self._to_step_us / 1e6 if declared.column.endswith(OTHER_TIME) else 0.0
                self._note(time_us, slot, value + step_s)

    def _receive(self, message: Message, time_us: int) -> None:
        """Note the telemetry in a message, from the component that each column is taken from."""
        number, payload, component = message.id, message.payload, message.component
        if self._survey.senders.get(number) == component:
            for slot, get in self._tables.get(number, ()):
                self._note(time_us, slot, get(payload))
        found = [(slot, find(payload)) for slot, find in self._declared.get(number, ())]
        if number == NAMED.id:
            _, raw, letters = NAMED.struct.unpack(payload)
            found += [(slot, raw * scale + offset) for slot, scale, offset in self._named.get(letters, ())]
        for slot, value in found:
            if value is not None and self._sources[slot].admit(component, time_us):
                self._note(time_us, slot, value)

    def _note(self, time_us: int, slot: int, value: float) -> None:
        self._values[slot], self._stamps[slot] = value, time_us

    def _row(self, time_us: int, columns: Columns) -> None:
        columns.setdefault("time", (time_us + self._survey.stepped_us - self._to_step_us) / 1e6)
        if self._to_step_us:
            later = {
                name: round(1e6 * columns[name]) + self._to_step_us
                for name in TIME_COLUMNS
                if name in columns
            }
            columns |= {name: at_us / 1e6 for name, at_us in later.items()}
        time = columns["time"]
        oldest = time_us - MAX_TELEMETRY_AGE_US
        row = [v if t >= oldest else nan for v, t in zip(self._values, self._stamps, strict=True)]
        for slot, of in self._aged:
            row[slot] = (time_us - self._stamps[of]) * 1e-6 if self._stamps[of] >= oldest else nan
        for name, value in columns.items():
            row[self._slot[name]] = value
        row[0] = time
        self.rows.append(row)

    def _correct(self, columns: Columns) -> None:
        """Add a ``MAG_FIELD`` to the last row, that of its reading, unless the row has one already."""
        row = self.rows[-1]
        if isnan(row[self._slot["total_field"]]):
            for name in CORRECTED:
                row[self._slot[name]] = columns[name]

    def pop_rows(self, n: int) -> xr.Dataset:
        """Return the first `n` rows; the attributes count the losses since the last call."""
        array, self.rows = np.array(self.rows[:n]), self.rows[n:]
        lost = self.reader.bytes_skipped, self.reader.damages
        attrs = {"bytes_skipped": lost[0] - self._skipped, "damages": lost[1] - self._damages}
        self._skipped, self._damages = lost
        columns = {name: array[:, k] for name, k in self._slot.items() if k}
        self._bring_to_rows(array[:, 0], columns)
        if "heading" in columns:
            columns["heading"] %= 360.0
        units = {name: self._survey.columns.get(name, "") for name in columns}
        return deployment(self._path, array[:, 0], columns, units, self._survey.attrs | attrs)

    def _bring_to_rows(self, time: FloatArray, columns: dict[str, FloatArray]) -> None:
        """Interpolate the readings of the sensors after the first to the rows' times (s)."""
        names = [declared.column for _, declared in self._others]
        for time_name in [name for name in names if name.endswith(OTHER_TIME)]:
            sampled, sensor = columns.pop(time_name), time_name.removesuffix(OTHER_TIME)
            times, first = np.unique(sampled[np.isfinite(sampled)], return_index=True)
            for name in names:
                if len(times) and name in (sensor, *(f"{sensor}_{axis}" for axis in "xyz")):
                    values = columns[name][np.isfinite(sampled)][first]
                    rows = np.interp(time, times, values, left=np.nan)
                    columns[name] = np.where(np.isfinite(columns[name]), rows, np.nan)


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
    block: RecordBlock, survey: LogContents, sent: np.ndarray[tuple[int], np.dtype[np.bool_]], base: int
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


def _last(rows: IndexArray, time_us: IndexArray, parts: list[Part]) -> FloatArray:
    """Return the last value that the file has before each row; NaN where it is older than `MAX_AGE`."""
    place, when, values = (np.concatenate(one) for one in zip(*parts, strict=True))
    order = np.argsort(place, kind="stable")  # two messages may hold one column
    k = np.searchsorted(place[order], rows, side="right") - 1
    last = order[np.maximum(k, 0)]
    fresh = (k >= 0) & (when[last] >= time_us - round(MAX_AGE * 1e6))
    return np.where(fresh, values[last], np.nan)
