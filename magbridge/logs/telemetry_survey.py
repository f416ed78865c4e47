"""First pass through a telemetry log: the fields of its messages that become columns, and its contents."""

from __future__ import annotations

from collections import Counter
from contextlib import suppress
from copy import copy
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magbridge.arrays import BoolArray, FloatArray, IndexArray
from magbridge.columns import AGE, CHANNEL_TIMES, CHANNELS, CORRECTED
from magbridge.errors import FormatError
from magbridge.logs.compasses import LogCompass
from magbridge.logs.deployment import CHANGES_SETTING
from magbridge.logs.fields import FieldMap, field_maps
from magbridge.mavlink import Message, spec
from magbridge.mavlink.enums import MAG_RAW_FLAGS
from magbridge.mavlink.messages import split_index
from magbridge.mavlink.tlog import RecordBlock, blocks
from magbridge.records import Channel

__all__ = [
    "AUTOPILOT", "POWER_CYCLE", "TELEMETRY", "UNKNOWN_INT", "DeclaredField", "LogContents",
    "are_of_main_sensor", "source_columns", "survey",
]  # fmt: skip

Payloads = NDArray[np.uint8]
"""(n, size): the payloads of messages of one kind, without zeros cut off."""
UNKNOWN_INT = 0x7FFFFFFF
MAVLINK_FIELDS = field_maps("mavlink")
"""Message to its fields; the values that the dialect declares to be invalid are missing, too."""
SOURCES = field_maps("mavlink_rows") | {"ATTITUDE": [], "GLOBAL_POSITION_INT": []}
"""The messages that make a row, the best first, and the fields whose values the row has from them."""
POWER_CYCLE = int(MAG_RAW_FLAGS.POWER_CYCLE)
"""Flag of MAG_RAW: its power cycle is counted."""
RAW, FIELD, COLUMN, STEP = (spec(f"MAG_{name}").id for name in ("RAW", "FIELD", "COLUMN", "CLOCK_STEP"))
START, BYTES = spec("MAG_BRIDGE_START").id, spec("MAG_SENSOR_BYTES").id
SET, VALUE = spec("PARAM_SET").id, spec("PARAM_VALUE").id
NAMED = spec("NAMED_VALUE_FLOAT")
RAW_COLUMNS = {one.column: one.unit for one in SOURCES["MAG_RAW"]}
COMPASS_NUMBERS = {"HIGHRES_IMU": 0, "RAW_IMU": 0, "SCALED_IMU": 0, "SCALED_IMU2": 1, "SCALED_IMU3": 2}
"""Message to the number of the compass whose field it holds; of several for one, the first is read."""
AUTOPILOT = 1
GIMBALS = {154, 171, 172, 173, 174, 175}
"""Components whose attitude is their own, and not the vehicle's."""
RESERVED_COLUMNS = {"time", *CHANNELS}
"""Columns that a named value never is."""


class MessageField:
    """How a column is read from the payloads of a message: ``factor * field + offset``, in `unit`."""

    def __init__(self, source: FieldMap, offset: float = 0.0) -> None:
        name, index = split_index(source.field)
        field = spec(source.record).fields[name]
        if field.code == "s":
            raise ValueError(f"{source.record}.{name}: expected a field of numbers")
        self.message = spec(source.record).id
        self.column, self.unit, self.factor, self.offset = source.column, source.unit, source.factor, offset
        self._layout = np.dtype(f"<{field.code}")
        self._start = field.offset + (index or 0) * self._layout.itemsize
        unknown = source.missing if field.invalid is None else (*source.missing, field.invalid)
        self._source = source._replace(missing=unknown)

    def values(self, payloads: Payloads) -> FloatArray:
        """Return the values (n,) of the column in payloads (n, size); NaN where the sender knows none."""
        raw = payloads[:, self._start : self._start + self._layout.itemsize].copy().view(self._layout)[:, 0]
        return self._source.values(raw) + self.offset


class DeclaredField(MessageField):
    """A column that the log itself declares, by a ``MAG_COLUMN``.

    `match` has the values that other fields of the message must have, as text; `component` is the only sender
    that counts.
    """

    def __init__(self, declaration: Message) -> None:
        layout = spec(declaration["message"])
        unit, scale = declaration["unit"] or "1", declaration["scale"]
        source = FieldMap(layout.name, declaration["field"], declaration["column"], unit, scale)
        super().__init__(source, declaration["offset"])
        self.component: int | None = declaration["component"] or None
        self.match = dict(part.split("=", 1) for part in declaration["match"].split(",") if part)
        self._others = [(layout.fields[name], text) for name, text in self.match.items()]

    def matches(self, payloads: Payloads) -> BoolArray:
        """Return the payloads (n,) of the messages that hold the column."""
        found = np.ones(len(payloads), bool)
        for field, text in self._others:
            part = payloads[:, field.offset : field.offset + field.struct.size]
            kinds, first, kind = np.unique(part, axis=0, return_index=True, return_inverse=True)
            equal = [str(field.get(payloads[k].tobytes())) == text for k in first.tolist()]
            found &= np.array(equal, bool)[kind.ravel()] if len(kinds) else found
        return found


TELEMETRY = {
    spec(message).id: [MessageField(one) for one in fields] for message, fields in MAVLINK_FIELDS.items()
}
"""Message id to the columns in the message."""
SOURCE_FIELDS = {
    spec(message).id: [MessageField(one) for one in fields] for message, fields in SOURCES.items()
}
SENSOR_IDS = {spec(name).id: spec(name).fields["sensor_id"].offset for name in ("MAG_RAW", "MAG_FIELD")}
STAMP_FIELDS = {
    spec(name).id: MessageField(FieldMap(name, "time_usec", "time", "us"))
    for name in ("MAG_RAW", "MAG_FIELD")
}
DELAY_FIELDS = [
    MessageField(FieldMap("MAG_RAW", f"delay_{axis}", name, "us"))
    for axis, name in zip("xyz", CHANNEL_TIMES, strict=True)
]
RAW_FLAGS = MessageField(FieldMap("MAG_RAW", "flags", "flags", ""))


def are_of_main_sensor(number: int, payloads: Payloads) -> BoolArray:
    """Return the messages (n,) of one id that are not samples of a sensor after the first."""
    if number not in SENSOR_IDS:
        return np.ones(len(payloads), bool)
    return np.asarray(payloads[:, SENSOR_IDS[number]] == 0)


def source_columns(number: int, payloads: Payloads) -> dict[str, FloatArray]:
    """Return the columns (n,) of the rows that messages of one id make; those of a bridge have ``time``."""
    columns = {one.column: one.values(payloads) for one in SOURCE_FIELDS[number]}
    if number not in SENSOR_IDS:
        return columns
    time_us = STAMP_FIELDS[number].values(payloads)
    columns["time"] = time_us / 1e6
    if number == RAW:
        delays_us = [field.values(payloads) for field in DELAY_FIELDS]
        in_turn = np.any(delays_us, axis=0)
        for one, delay_us in zip(DELAY_FIELDS, delays_us, strict=True):
            columns[one.column] = np.where(in_turn, (time_us + delay_us) / 1e6, np.nan)
        counted = RAW_FLAGS.values(payloads).astype(np.int64) & POWER_CYCLE
        columns["power_cycle"] = np.where(counted > 0, columns["power_cycle"], np.nan)
    return columns


class LogContents:
    """Contents of a log, found in a first pass, so that all pieces of a stream have the same columns.

    The messages `source` of the sender `system`, `component` make the rows. `senders` are the components
    whose other messages are taken: the sender of the rows or the autopilot (1) where they send it, and hardly
    a gimbal; `speakers` are those of a ``NAMED_VALUE_FLOAT.name``.

    `columns` has the unit of each column that has a value at least once, `named` the columns of each
    ``NAMED_VALUE_FLOAT.name`` with scale and offset, `declared` the columns that the log itself declares to
    be in other messages, and `wanted` the only component that a column may come from, if there is one.
    `attrs` are attributes that the log declares, and ``notes``.

    `ours` is a bridge's own log, whose time stamps carry the :class:`~magbridge.records.Channel`; its clock
    was set by `stepped_us` in the course of the log.
    """

    def __init__(self, path: Path) -> None:
        self.attrs: dict[str, Any] = {}
        self.ours = False
        self.stepped_us = 0
        self._senders: dict[int, Counter[tuple[int, int]]] = {}
        self._spans: dict[tuple[int, int, int], tuple[int, int]] = {}
        self._known: dict[tuple[int, int, int], dict[str, str]] = {}
        self._named: dict[int, dict[bytes, str]] = {}
        self._speakers: dict[tuple[int, bytes], Counter[int]] = {}
        self._declared: dict[str, DeclaredField] = {}
        self._open: dict[tuple[int, int, int], list[MessageField]] = {}
        self._asked: dict[str, float] = {}
        self._read(path)
        for self.source in SOURCES:
            senders = self._senders.get(spec(self.source).id)
            if not senders or (self.ours and "IMU" in self.source):
                continue  # the autopilot's compass does not replace the instrument
            (self.system, self.component), _ = senders.most_common(1)[0]
            self.senders = self._chosen()
            self.columns = {
                column: unit
                for (system, component, number), columns in self._known.items()
                if system == self.system and component == self.senders.get(number, component)
                for column, unit in columns.items()
            }
            self._name()
            return
        raise FormatError(path, f"expected MAVLink records with one of {' '.join(SOURCES)}")

    @property
    def compasses(self) -> list[LogCompass]:
        """The compasses whose field messages of the sender hold: ``RAW_IMU`` has the first."""
        found = {}
        for message, number in COMPASS_NUMBERS.items():
            n = self._senders.get(spec(message).id, Counter())[self.system, self.component]
            if n and number not in found:
                found[number] = LogCompass(number, n, 0.0, message)
        return [found[number] for number in sorted(found)]

    @property
    def span_s(self) -> float:
        """The s from the first to the last of the messages that make the rows."""
        first_us, last_us = self._spans[spec(self.source).id, self.system, self.component]
        return (last_us - first_us) / 1e6

    def of_compass(self, message: str) -> LogContents:
        """Return the survey with the rows made by another message."""
        other = copy(self)
        other.source = message
        return other

    @property
    def plain(self) -> bool:
        """Return True if no bridge wrote the log."""
        is_of_bridge = self.source in ("MAG_RAW", "MAG_FIELD")
        return not (is_of_bridge or self.ours or self.declared or self.stepped_us)

    def _chosen(self) -> dict[int, int]:
        """Return the component that each message of :data:`TELEMETRY` is taken from."""
        chosen = {}
        for number in TELEMETRY.keys() & self._senders.keys():
            senders = self._senders[number]
            mine = [component for system, component in senders if system == self.system]
            ranks = {
                one: (one == self.component, one == AUTOPILOT, one not in GIMBALS, senders[self.system, one])
                for one in mine
            }
            if mine:
                chosen[number] = max(mine, key=ranks.__getitem__)
        return chosen

    def _name(self) -> None:
        """Map each ``NAMED_VALUE_FLOAT`` to the columns that the log declares, else to its name."""
        self.named: dict[bytes, list[tuple[str, float, float]]] = {}
        self.speakers = {
            letters: AUTOPILOT if AUTOPILOT in senders else senders.most_common(1)[0][0]
            for (system, letters), senders in self._speakers.items()
            if system == self.system
        }
        self.declared: list[DeclaredField] = []
        self.wanted: dict[str, int | None] = {}
        notes: list[str] = []
        for one in self._declared.values():
            self.wanted[one.column] = one.component
            self.columns[one.column] = one.unit
            if self.ours and one.message not in (RAW, FIELD):
                self.columns[AGE + one.column] = "s"
            if one.message != NAMED.id or one.match.keys() != {"name"}:
                self.declared.append(one)
            else:
                letters = one.match["name"].encode().ljust(10, b"\0")
                self.named.setdefault(letters, []).append((one.column, one.factor, one.offset))
        for letters, name in self._named.get(self.system, {}).items():
            if letters not in self.named:
                own = f"named_{name}" if name in self.columns or name in RESERVED_COLUMNS else name
                if own != name:
                    why = f"the log has a {name} of its own"
                    notes.append(f"NAMED_VALUE_FLOAT {name!r} is read as {own}: {why}")
                self.named[letters] = [(own, 1.0, 0.0)]
                self.wanted[own] = None
                self.columns.setdefault(own, "1")
        if notes:
            self.attrs["notes"] = "\n".join(notes)

    def _read(self, path: Path) -> None:
        """Read every record, but decode only those that may add information."""
        settled: set[int] = set()
        with path.open("rb") as file:
            for block in blocks(file):
                if np.isin(block.number, (START, BYTES)).any():
                    self.ours = True
                if self.ours:
                    self._tuned(block)
                which = np.arange(len(block.number))
                if self.ours:  # the bridge's own messages are not telemetry
                    which = which[(block.channel != Channel.SENT) | np.isin(block.number, (RAW, FIELD))]
                codes = block.number[which] << 16 | block.system[which] << 8 | block.component[which]
                for code in np.unique(codes).tolist():
                    number, system, component = code >> 16, code >> 8 & 0xFF, code & 0xFF
                    of_kind = which[codes == code]
                    self._senders.setdefault(number, Counter())[system, component] += len(of_kind)
                    first_us, last_us = block.time_us[of_kind[[0, -1]]].tolist()
                    first_us, _ = self._spans.get((number, system, component), (first_us, last_us))
                    self._spans[number, system, component] = first_us, last_us
                    if code not in settled and self._look(block, number, of_kind):
                        settled.add(code)

    def _tuned(self, block: RecordBlock) -> None:
        """Count how often a station has set what the alignment computes with; the bridge confirms it."""
        for k in np.flatnonzero(np.isin(block.number, (SET, VALUE))).tolist():
            message = block.message(k)
            name, value = message["param_id"], message["param_value"]
            if message.id == SET:
                self._asked[name] = value
            elif block.channel[k] == Channel.SENT and self._asked.pop(name, None) == value:
                # MB_R_ are rates of messages
                aligns = name.startswith("MB_") and not name.startswith("MB_R_")
                self.attrs[CHANGES_SETTING] = self.attrs.get(CHANGES_SETTING, 0) + aligns

    def _look(self, block: RecordBlock, number: int, records: IndexArray) -> bool:
        """Record new facts in messages of one kind; return whether further ones can add nothing."""
        system, component = int(block.system[records[0]]), int(block.component[records[0]])
        if number in TELEMETRY:
            return self._values((system, component, number), block.payloads(records))
        if number == NAMED.id:
            letters = block.payloads(records)[:, NAMED.fields["name"].offset :]
            _, first, counts = np.unique(letters, axis=0, return_index=True, return_counts=True)
            for k, n in zip(first.tolist(), counts.tolist(), strict=True):
                name = bytes(letters[k])
                self._named.setdefault(system, {})[name] = block.message(int(records[k]))["name"]
                self._speakers.setdefault((system, name), Counter())[component] += n
            return False
        if number in (RAW, FIELD):
            known = self._known.setdefault((system, component, number), {})
            payloads = block.payloads(records)
            payloads = payloads[are_of_main_sensor(number, payloads)]
            if number == FIELD and len(payloads):
                known |= dict.fromkeys(CORRECTED, "")
                return True
            return number == RAW and self._raw(known, payloads)
        if number in (COLUMN, STEP):
            for k in records.tolist():
                self._declares(block.message(k))
            return False
        return True

    def _raw(self, known: dict[str, str], payloads: Payloads) -> bool:
        """Note which columns samples of a bridge have; return whether they have all."""
        columns = source_columns(RAW, payloads)
        possible = (*CHANNELS, *CHANNEL_TIMES, *RAW_COLUMNS)
        there = [name for name in possible if not np.isnan(columns[name]).all()]
        there = [*CHANNELS, *there] if {*CHANNELS} & {*there} else there
        for name in there:
            known.setdefault(name, RAW_COLUMNS.get(name, ""))
        return {*CHANNEL_TIMES, *RAW_COLUMNS} <= known.keys()

    def _declares(self, message: Message) -> None:
        """Note what a message of a bridge, or of :mod:`magbridge.logs`, declares."""
        if message.id == STEP:
            self.stepped_us += message["step"]
        elif not message["message"]:
            self.attrs[message["column"]] = message["unit"] or message["scale"]
        else:
            with suppress(KeyError, ValueError):  # of a dialect that we do not know
                self._declared[message["column"]] = DeclaredField(message)

    def _values(self, sender: tuple[int, int, int], payloads: Payloads) -> bool:
        """Note which fields of a message have a value; return whether all have."""
        known = self._known.setdefault(sender, {})
        still = self._open.setdefault(sender, list(TELEMETRY[sender[2]]))
        for value in [one for one in still if not np.isnan(one.values(payloads)).all()]:
            still.remove(value)
            known.setdefault(value.column, value.unit)
        return not still


@lru_cache(maxsize=64)
def survey(path: Path, mtime_ns: int, size: int) -> LogContents:  # noqa: ARG001 - a log that changed is surveyed again
    """Return the contents of a log; cached."""
    return LogContents(path)
