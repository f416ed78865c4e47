"""Read MAVLink telemetry logs (``.tlog``) as deployments.

Each row is one magnetometer message, of the best kind in the log (:data:`SOURCES`) and from its most frequent
sender. Every other column is the vehicle's last value at or before the row, and NaN once it is older than
:data:`~magbridge.logs.fields.MAX_AGE`.

- ``MAG_RAW`` of a bridge: the field in nT, computed from the counts if the log declares the nT per count,
  else float32 (0.004 nT at 50,000 nT). It also has the time to 1 µs, channel times, temperature, supply and
  power cycles. The ``MAG_FIELD`` that follows becomes the columns of ``magbridge correct``.
- ``HIGHRES_IMU`` (gauss), ``RAW_IMU`` and ``SCALED_IMU*`` (mgauss, so steps of 100 nT): the field in the
  autopilot's axes, with its offsets applied. The time is the record's stamp. Further magnetometers become
  ``mag1_x`` ... ``mag3_z``.
- Without these messages, each ``ATTITUDE`` or position makes a row, and the deployment has no ``mag_x``.

Telemetry has three sources: columns that the log declares by ``MAG_COLUMN``, the fields of ``fields.csv``,
and every ``NAMED_VALUE_FLOAT`` by its name. Logs of a bridge (with the age of each value) and of
:mod:`.telemetry_writer` declare columns. If a bridge's clock was set, all rows are dated by its last setting.
Attitude and position come from the autopilot, not from a gimbal. A named value never replaces a column that
has another source in the log. Damaged bytes are skipped and counted in the attributes ``bytes_skipped`` and
``damages``. All messages that are read are in memory.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magbridge.arrays import BoolArray, FloatArray, IndexArray
from magbridge.columns import AGE, CHANNEL_TIMES, CHANNELS, CORRECTED
from magbridge.errors import FormatError
from magbridge.logs.compasses import LogCompass, by_columns, choose, compass_notes, listed
from magbridge.logs.deployment import CHANGES_SETTING, deployment, sliced, with_notes
from magbridge.logs.fields import MAX_AGE, FieldMap, field_maps, fields_of
from magbridge.logs.mapping import Options
from magbridge.logs.telemetry_writer import POWER_CYCLE, FileWriter
from magbridge.mavlink import Source, spec
from magbridge.mavlink.messages import split_index
from magbridge.mavlink.tlog import blocks
from magbridge.records import Channel

__all__ = ["FileWriter", "chunks"]

Payloads = NDArray[np.uint8]
"""(n, size): Payloads of messages of one kind, padded with zeros to full size."""
MAVLINK_FIELDS = {spec(message).id: fields for message, fields in field_maps("mavlink").items()}
"""Message id -> fields that fill columns."""
SOURCES = field_maps("mavlink_rows") | {"ATTITUDE": [], "GLOBAL_POSITION_INT": []}
"""Messages that can make the rows, the best first -> fields of the message that fill columns."""
SOURCE_FIELDS = {spec(message).id: fields for message, fields in SOURCES.items()}
RAW, FIELD, COLUMN, STEP = (spec(f"MAG_{name}").id for name in ("RAW", "FIELD", "COLUMN", "CLOCK_STEP"))
START, BYTES = spec("MAG_BRIDGE_START").id, spec("MAG_SENSOR_BYTES").id
SET, VALUE = spec("PARAM_SET").id, spec("PARAM_VALUE").id
NAMED_VALUE_FLOAT = spec("NAMED_VALUE_FLOAT").id
NAME_LETTERS = spec(NAMED_VALUE_FLOAT).fields["name"]
RAW_COLUMNS = {one.column: one.unit for one in SOURCE_FIELDS[RAW]}
READ_MESSAGES = [*MAVLINK_FIELDS, *SOURCE_FIELDS, NAMED_VALUE_FLOAT, COLUMN, STEP, START, BYTES, SET, VALUE]
"""Ids of the messages that are always read; a log adds those in which it declares a column."""
COMPASS_NUMBERS = {"HIGHRES_IMU": 0, "RAW_IMU": 0, "SCALED_IMU": 0, "SCALED_IMU2": 1, "SCALED_IMU3": 2}
"""Message -> number of the compass whose field it holds; of several for one compass, the first is read."""
AUTOPILOT = 1
GIMBALS = {154, 171, 172, 173, 174, 175}
"""Component ids of gimbals, which send their own attitude and not the vehicle's."""
RESERVED_COLUMNS = {"time", *CHANNELS}
"""Columns that a named value never fills."""
MAX_TELEMETRY_AGE_US = round(MAX_AGE * 1e6)
SINGLE = 1e-7
"""Relative error of a float32; a declared value that differs from the channel by more is not used."""
SENSOR_ID, OTHER_TIME = "sensor_id", "_time"
"""Field that assigns a column to a second or further sensor; ending of the column with its times."""


@cache
def _place(number: int, field: str) -> tuple[slice, np.dtype[Any], float | None]:
    """Return the bytes, the type and the invalid value of a field of numbers, as ``roll`` or ``data[3]``.

    KeyError, ValueError: message `number` has no field of numbers with this name.
    """
    name, index = split_index(field)
    one = spec(number).fields[name]
    if one.code == "s":
        raise ValueError(f"{spec(number).name}.{name}: expected a field of numbers")
    kind = np.dtype(f"<{one.code}")
    start = one.offset + (index or 0) * kind.itemsize
    return slice(start, start + kind.itemsize), kind, one.invalid


class LogMessages(NamedTuple):
    """Messages of one kind in the order of the log; the arrays are (n,), the payloads (n, size)."""

    number: int
    at: IndexArray
    """Index of the record in the log."""
    time_us: IndexArray
    """Time stamp of the record, µs since 1970 UTC."""
    channel: IndexArray
    """:class:`~magbridge.records.Channel` of the record, in a bridge's own log."""
    system: IndexArray
    component: IndexArray
    payloads: Payloads

    def chosen(self, keep: BoolArray) -> LogMessages:
        """Return the messages that a mask (n,) selects."""
        arrays: list[Any] = [array[keep] for array in self[1:]]
        return LogMessages(self.number, *arrays)

    def numbers(self, field: str) -> FloatArray:
        """Return the values (n,) of a field, as float64; NaN where the sender states that it has none."""
        place, kind, invalid = _place(self.number, field)
        raw = self.payloads[:, place].copy().view(kind)[:, 0].astype(np.float64)
        return raw if invalid is None else np.where(raw == invalid, np.nan, raw)

    def columns(self, fields: Sequence[FieldMap]) -> Iterator[tuple[str, str, FloatArray]]:
        """Yield column, unit and values (n,) of each of the `fields`."""
        return fields_of(fields, {one.field: self.numbers(one.field) for one in fields})

    @property
    def is_of_main_sensor(self) -> BoolArray:
        """Return a mask (n,) that is False for samples of a second or further sensor."""
        if self.number not in (RAW, FIELD):
            return np.ones(len(self.at), bool)
        return np.asarray(self.numbers(SENSOR_ID) == 0)

    def senders(self) -> dict[tuple[int, int], int]:
        """Return the number of messages of each system and component."""
        codes, counts = np.unique(self.system << 8 | self.component, return_counts=True)
        return {divmod(code, 256): n for code, n in zip(codes.tolist(), counts.tolist(), strict=True)}

    def decoded(self) -> list[dict[str, Any]]:
        """Return the fields of each message by name."""
        fields = spec(self.number).fields
        return [{name: one.get(row.tobytes()) for name, one in fields.items()} for row in self.payloads]


class DeclaredColumn(NamedTuple):
    """Column that the log itself declares by a ``MAG_COLUMN``: ``factor * number + offset``."""

    number: int
    """Id of the message that holds the column."""
    source: FieldMap
    offset: float
    match: dict[str, str]
    """Values, as text, that other fields of the message must have."""
    component: int | None
    """The only sender that counts; None for any."""

    def values(self, messages: LogMessages) -> FloatArray:
        """Return the values (n,) of the column in messages of its kind."""
        return self.source.values(messages.numbers(self.source.field)) + self.offset

    def matches(self, messages: LogMessages) -> BoolArray:
        """Return a mask (n,) of the messages that hold the column."""
        found = np.ones(len(messages.at), bool)
        for name, text in self.match.items():
            field = spec(messages.number).fields[name]
            part = messages.payloads[:, field.offset : field.offset + field.struct.size]
            kinds, first, kind = np.unique(part, axis=0, return_index=True, return_inverse=True)
            shown = text.encode().decode("ascii", "replace")  # as fields are read
            equal = [str(field.get(messages.payloads[k].tobytes())) == shown for k in first.tolist()]
            found &= np.array(equal, bool)[kind.ravel()] if len(kinds) else found
        return found


def _declared(fields: Mapping[str, Any]) -> DeclaredColumn:
    """Return the column that the fields of a ``MAG_COLUMN`` declare.

    KeyError, ValueError: the dialect lacks the message or a field.
    """
    layout = spec(fields["message"])
    match = dict(part.split("=", 1) for part in fields["match"].split(",") if part)
    for name in match:
        layout.fields[name]
    _place(layout.id, fields["field"])
    unit = fields["unit"] or "1"
    source = FieldMap(layout.name, fields["field"], fields["column"], unit, fields["scale"])
    return DeclaredColumn(layout.id, source, fields["offset"], match, fields["component"] or None)


def source_columns(messages: LogMessages) -> dict[str, FloatArray]:
    """Return the columns (n,) that messages fill in their own rows; a bridge's also fill ``time``."""
    columns = {column: values for column, _, values in messages.columns(SOURCE_FIELDS[messages.number])}
    if messages.number not in (RAW, FIELD):
        return columns
    time_us = messages.numbers("time_usec")
    columns["time"] = time_us / 1e6
    if messages.number == RAW:
        delays_us = [messages.numbers(f"delay_{axis}") for axis in "xyz"]
        in_turn = np.any(delays_us, axis=0)
        for name, delay_us in zip(CHANNEL_TIMES, delays_us, strict=True):
            columns[name] = np.where(in_turn, (time_us + delay_us) / 1e6, np.nan)
        counted = messages.numbers("flags").astype(np.int64) & POWER_CYCLE
        columns["power_cycle"] = np.where(counted > 0, columns["power_cycle"], np.nan)
    return columns


Kinds = dict[int, LogMessages]
"""Messages by their id."""
Update = tuple[LogMessages, FloatArray]
"""Messages of one kind, and the values (n,) of a column in them."""


def chunks(path: Path, rows: int, options: Options | None = None) -> Iterator[xr.Dataset]:
    """Yield the log in pieces of at most `rows` rows."""
    log = TelemetryLog(path)
    wanted = options.compass if options else None
    if log.is_plain and (compasses := log.compasses()):
        found = choose(path, compasses, wanted)
        log.source = next(one for one in found if one.chosen).id
        log.attrs |= listed(found)
        log.notes += compass_notes(found, wanted)
    whole = with_notes(deployment(path, *log.table(), attrs=log.attrs | log.lost), log.notes)
    yield from sliced(whole if log.is_plain else by_columns(whole, wanted), rows)


def _messages(path: Path) -> tuple[Kinds, dict[str, int]]:
    """Return the messages of a log by id, and the counts of damaged bytes and places."""
    parts: dict[int, list[LogMessages]] = {}
    lost = {"bytes_skipped": 0, "damages": 0}
    wanted, before = {*READ_MESSAGES}, 0
    with path.open("rb") as file:
        for block in blocks(file):
            lost["bytes_skipped"] += block.bytes_skipped
            lost["damages"] += block.damages
            for k in np.flatnonzero(block.number == COLUMN).tolist():
                with suppress(KeyError):
                    wanted.add(spec(block.message(k)["message"]).id)
            for number in np.intersect1d(block.number, [*wanted]).tolist():
                at = np.flatnonzero(block.number == number)
                sender = block.system[at], block.component[at]
                part = LogMessages(
                    number, before + at, block.time_us[at], block.channel[at], *sender, block.payloads(at)
                )
                parts.setdefault(number, []).append(part)
            before += len(block.number)
    return {number: _joined(found) for number, found in parts.items()}, lost


def _messages_of(kinds: Kinds, number: int) -> LogMessages:
    """Return the messages with id `number`; empty if the log has none."""
    nothing = np.empty(0, np.int64)
    arrays: list[Any] = [*[nothing] * 5, np.empty((0, spec(number).size), np.uint8)]
    return kinds.get(number, LogMessages(number, *arrays))


def _joined(parts: Sequence[LogMessages]) -> LogMessages:
    arrays = zip(*(part[1:] for part in parts), strict=True)
    return LogMessages(parts[0].number, *map(np.concatenate, arrays))


class TelemetryLog:
    """Messages of a log, with the source of each column.

    `source`: name of the message that makes the rows. `ours`: True for a bridge's own log. `is_plain`: True
    for an autopilot's log without a bridge. `attrs`: declared attributes. `lost`: counts of damage.
    """

    def __init__(self, path: Path) -> None:
        kinds, self.lost = _messages(path)
        self.attrs: dict[str, Any] = {}
        self.notes: list[str] = []
        self.ours = bool(kinds.keys() & {START, BYTES})
        if self.ours:  # the bridge's own messages are not telemetry
            self._count_settings(kinds)
            kinds = {
                number: one if number in (RAW, FIELD) else one.chosen(one.channel != Channel.SENT)
                for number, one in kinds.items()
            }
        declared = self._declarations(_messages_of(kinds, COLUMN))
        steps = _messages_of(kinds, STEP)
        self._steps_at = steps.at
        self._steps_us = np.cumsum([0, *(one["step"] for one in steps.decoded())])
        self.source, (system, self._component) = self._source_of(path, kinds)
        self._kinds = {number: one.chosen(one.system == system) for number, one in kinds.items()}
        is_of_bridge = self.source in ("MAG_RAW", "MAG_FIELD")
        self.is_plain = not (is_of_bridge or self.ours or declared or self._steps_us[-1])
        self._updates: dict[str, list[Update]] = {}
        self._units = self._telemetry({one.source.column for one in declared})
        self._units |= self._columns_of_bridge()
        self._declared = declared
        self._add_declared()
        by_name = (one.match for one in declared if one.number == NAMED_VALUE_FLOAT)
        self._add_named({match["name"] for match in by_name if match.keys() == {"name"}})

    def _source_of(self, path: Path, kinds: Kinds) -> tuple[str, tuple[int, int]]:
        """Return the message that makes the rows, and its most frequent sender (system, component)."""
        for source in SOURCES:
            senders = _messages_of(kinds, spec(source).id).senders()
            # the autopilot's compass does not replace the instrument
            if senders and not (self.ours and "IMU" in source):
                return source, max(senders, key=senders.__getitem__)
        raise FormatError(path, f"expected MAVLink records with one of {' '.join(SOURCES)}")

    def _count_settings(self, kinds: Kinds) -> None:
        """Count the changes of alignment settings that a station requested and the bridge confirmed."""
        asked: dict[str, float] = {}
        stated = []
        for one in (_messages_of(kinds, SET), _messages_of(kinds, VALUE)):
            for at, channel, fields in zip(one.at, one.channel, one.decoded(), strict=True):
                stated.append((at, one.number, channel, fields["param_id"], fields["param_value"]))
        for _, number, channel, name, value in sorted(stated):
            if number == SET:
                asked[name] = value
            elif channel == Channel.SENT and asked.pop(name, None) == value:
                # MB_R_ are rates of messages
                aligns = name.startswith("MB_") and not name.startswith("MB_R_")
                self.attrs[CHANGES_SETTING] = self.attrs.get(CHANGES_SETTING, 0) + aligns

    def _declarations(self, messages: LogMessages) -> list[DeclaredColumn]:
        """Return the columns that the log declares; store its declared attributes in `attrs`."""
        found: dict[str, DeclaredColumn] = {}
        for one in messages.decoded():
            if not one["message"]:
                self.attrs[one["column"]] = one["unit"] or one["scale"]
                continue
            with suppress(KeyError, ValueError):  # a message or field that this dialect lacks
                found[one["column"]] = _declared(one)
        return [*found.values()]

    def compasses(self) -> list[LogCompass]:
        """Return the compasses whose field the sender's messages hold, in the order of their numbers."""
        found = {}
        for message, number in COMPASS_NUMBERS.items():
            time_us = self._samples(message).time_us
            if number not in found and (n := len(time_us)):
                mean_rate = 1e6 * (n - 1) / max(int(time_us[-1] - time_us[0]), 1)
                found[number] = LogCompass(number, n, mean_rate, message)
        return [found[number] for number in sorted(found)]

    def _samples(self, message: str) -> LogMessages:
        """Return the messages of one kind from the component that sends the rows."""
        found = _messages_of(self._kinds, spec(message).id)
        return found.chosen(found.component == self._component)

    def _telemetry(self, declared: set[str]) -> dict[str, str]:
        """Add the columns of :data:`MAVLINK_FIELDS`; return the units of the columns that have a value.

        Each message is read from one component: the sender of the rows, else the autopilot, else the most
        frequent sender. Gimbals come last.
        """
        units: dict[str, str] = {}
        for number, fields in MAVLINK_FIELDS.items():
            messages = _messages_of(self._kinds, number)
            ranks = [
                (one == self._component, one == AUTOPILOT, one not in GIMBALS, n, one)
                for (_, one), n in messages.senders().items()
            ]
            if not ranks:
                continue
            messages = messages.chosen(messages.component == max(ranks)[-1])
            for column, unit, values in messages.columns(fields):
                if not np.isnan(values).all():
                    units.setdefault(column, unit)
                    if column not in declared:
                        self._add(column, messages, values)
        return units

    def _add(self, column: str, messages: LogMessages, values: FloatArray) -> None:
        """Add messages with the values (n,) of a column to the sources of this column."""
        self._updates.setdefault(column, []).append((messages, values))

    def _columns_of_bridge(self) -> dict[str, str]:
        """Return the units of the columns that have a value in a bridge's ``MAG_RAW`` or ``MAG_FIELD``."""
        raw = _messages_of(self._kinds, RAW)
        columns = source_columns(raw.chosen(raw.is_of_main_sensor))
        possible = (*CHANNELS, *CHANNEL_TIMES, *RAW_COLUMNS)
        there = [name for name in possible if not np.isnan(columns[name]).all()]
        there = [*CHANNELS, *there] if {*CHANNELS} & {*there} else there
        units = {name: RAW_COLUMNS.get(name, "") for name in there}
        is_corrected = _messages_of(self._kinds, FIELD).is_of_main_sensor.any()
        return units | dict.fromkeys(CORRECTED, "") if is_corrected else units

    def _add_declared(self) -> None:
        """Add the columns that the log declares, with the ages of their values in a bridge's own log."""
        source = spec(self.source).id
        for one in self._declared:
            self._units[one.source.column] = one.source.unit
            if self.ours and one.number not in (RAW, FIELD):
                self._units[AGE + one.source.column] = "s"
            if one.number == source:
                continue
            messages = _messages_of(self._kinds, one.number)
            messages = messages.chosen(one.matches(messages))
            self._add_admitted(one.source.column, one.component, messages, one.values(messages))

    def _add_admitted(
        self, column: str, component: int | None, messages: LogMessages, values: FloatArray
    ) -> None:
        """Add the values (n,) of a column from one of its senders, which is chosen as in the live bridge."""
        max_age_s = self.attrs.get(f"telemetry.{column}.max_age", MAX_AGE)
        source = Source(AUTOPILOT, round(1e6 * max_age_s), component)
        senders = zip(messages.component.tolist(), messages.time_us.tolist(), strict=True)
        admitted = np.array([source.admit(one, time_us) for one, time_us in senders], bool)
        self._add(column, messages.chosen(admitted), values[admitted])

    def _add_named(self, declared: set[str]) -> None:
        """Add a column for each name of a ``NAMED_VALUE_FLOAT``, except the names in `declared`."""
        named = _messages_of(self._kinds, NAMED_VALUE_FLOAT)
        start = NAME_LETTERS.offset
        letters = named.payloads[:, start : start + NAME_LETTERS.struct.size]
        for row in np.unique(letters, axis=0):
            name = NAME_LETTERS.get(bytes(start) + row.tobytes())
            if name in declared:
                continue
            messages = named.chosen((letters == row).all(axis=1))
            values = messages.numbers("value")
            own = f"named_{name}" if name in self._units or name in RESERVED_COLUMNS else name
            if own != name:
                why = f"the log has a {name} of its own"
                self.notes.append(f"NAMED_VALUE_FLOAT {name!r} is read as {own}: {why}")
            self._units.setdefault(own, "1")
            if not self.is_plain:
                self._add_admitted(own, None, messages, values)
                continue
            counts = [(one == AUTOPILOT, n, one) for (_, one), n in messages.senders().items()]
            here = messages.component == max(counts)[-1]
            self._add(own, messages.chosen(here), values[here])

    def table(self) -> tuple[FloatArray, dict[str, FloatArray], dict[str, str]]:
        """Return the times (n,), s since 1970 UTC, the columns (n,) by name, and their units."""
        samples = self._samples(self.source)
        main = samples.is_of_main_sensor
        rows = samples.chosen(main)
        others = samples.chosen(~main)
        of_others = [one for one in self._declared if one.number == others.number and SENSOR_ID in one.match]
        for one in of_others:
            messages = others.chosen(one.matches(others))
            values = one.values(messages)
            if one.source.column.endswith(OTHER_TIME):
                values = values + self._to_step_us(messages.at) / 1e6
            self._add(one.source.column, messages, values)
        raw = {one.column for one in MAVLINK_FIELDS.get(rows.number, []) if one.column.startswith("mag")}
        own = [f"mag_{axis}" for axis in "xyz" if "IMU" in self.source]
        columns = {name: np.full(len(rows.at), np.nan) for name in (*own, *self._units) if name not in raw}
        for name, updates in self._updates.items():
            if name in columns:
                columns[name], age_s = _carried(rows, updates)
                if self.ours and AGE + name in columns:
                    columns[AGE + name] = age_s
        time = self._fill(rows, columns)
        self._correct(rows, columns)
        _bring_to_rows(time, columns, [one.source.column for one in of_others])
        if "heading" in columns:
            columns["heading"] %= 360.0
        return time, columns, {name: self._units.get(name, "") for name in columns}

    def _to_step_us(self, places: IndexArray) -> IndexArray:
        """Return the sum of the clock steps after each record index in `places` (n,), µs (n,)."""
        passed = self._steps_us[np.searchsorted(self._steps_at, places, side="right")]
        return np.asarray(self._steps_us[-1] - passed)

    def _fill(self, rows: LogMessages, columns: dict[str, FloatArray]) -> FloatArray:
        """Set the columns (n,) that the rows' own messages hold, in place; return the times (n,), s."""
        found = source_columns(rows)
        for one in self._declared:
            if one.number == rows.number and SENSOR_ID not in one.match and one.source.column in found:
                exact, single = one.values(rows), found[one.source.column]
                same = np.isclose(exact, single, rtol=SINGLE, atol=0.0) & one.matches(rows)
                found[one.source.column] = np.where(same, exact, single)
        to_step_us = self._to_step_us(rows.at)
        if "time" not in found:
            found["time"] = (rows.time_us + self._steps_us[-1] - to_step_us) / 1e6
        for name in ("time", *CHANNEL_TIMES):
            if name in found:
                moved = (np.rint(1e6 * found[name]) + to_step_us) / 1e6
                found[name] = np.where(to_step_us != 0, moved, found[name])
        for name, values in found.items():
            if name in columns:
                columns[name] = np.where(np.isnan(values), columns[name], values)
        return found["time"]

    def _correct(self, rows: LogMessages, columns: dict[str, FloatArray]) -> None:
        """Add the values of each ``MAG_FIELD`` to the row before it, unless the row has a total field."""
        found = _messages_of(self._kinds, FIELD)
        found = found.chosen(found.is_of_main_sensor & ~np.isin(found.at, rows.at))
        if not len(found.at):
            return
        row = np.searchsorted(rows.at, found.at, side="right") - 1
        values = source_columns(found)
        is_free = (row >= 0) & np.isnan(columns["total_field"][row])
        # of several for one row, the first with a total field counts: it is written last
        has_total = ~np.isnan(values["total_field"])
        order = np.concatenate(
            [np.flatnonzero(is_free & ~has_total), np.flatnonzero(is_free & has_total)[::-1]]
        )
        for name in CORRECTED:
            columns[name][row[order]] = values[name][order]


def _carried(rows: LogMessages, updates: Sequence[Update]) -> tuple[FloatArray, FloatArray]:
    """Return the last value of a column at or before each row (n,), and its age, s (n,); NaN once too old."""
    at = np.concatenate([messages.at for messages, _ in updates])
    if not len(at):
        return np.full(len(rows.at), np.nan), np.full(len(rows.at), np.nan)
    order = np.argsort(at, kind="stable")  # two messages may hold one column
    values = np.concatenate([values for _, values in updates])[order]
    time_us = np.concatenate([messages.time_us for messages, _ in updates])[order]
    k = np.searchsorted(at[order], rows.at, side="right") - 1
    age_us = rows.time_us - time_us[k]
    fresh = (k >= 0) & (age_us <= MAX_TELEMETRY_AGE_US)
    return np.where(fresh, values[k], np.nan), np.where(fresh, age_us * 1e-6, np.nan)


def _bring_to_rows(time: FloatArray, columns: dict[str, FloatArray], names: Sequence[str]) -> None:
    """Interpolate the readings of the second and further sensors to the rows' times (n,), s, in place."""
    for time_name in [name for name in names if name.endswith(OTHER_TIME)]:
        sampled, sensor = columns.pop(time_name), time_name.removesuffix(OTHER_TIME)
        times, first = np.unique(sampled[np.isfinite(sampled)], return_index=True)
        for name in names:
            if len(times) and name in (sensor, *(f"{sensor}_{axis}" for axis in "xyz")):
                values = columns[name][np.isfinite(sampled)][first]
                rows = np.interp(time, times, values, left=np.nan)
                columns[name] = np.where(np.isfinite(columns[name]), rows, np.nan)
