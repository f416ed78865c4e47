"""The first pass through a telemetry log: what it holds."""

from __future__ import annotations

from collections import Counter
from contextlib import suppress
from functools import lru_cache
from math import isnan
from pathlib import Path
from typing import Any

from magbridge.columns import AGE
from magbridge.errors import FormatError
from magbridge.logs.deployment import CHANGES
from magbridge.logs.telemetry_fields import SOURCES, TELEMETRY, Declared, Value, correction, sample
from magbridge.mavlink import LogReader, Message, Record, spec
from magbridge.records import Channel

__all__ = ["Survey", "survey"]

V2 = 0xFD
RAW, FIELD, COLUMN, STEP = (spec(f"MAG_{name}").id for name in ("RAW", "FIELD", "COLUMN", "CLOCK_STEP"))
START, BYTES = spec("MAG_BRIDGE_START").id, spec("MAG_SENSOR_BYTES").id
SET, VALUE = spec("PARAM_SET").id, spec("PARAM_VALUE").id
NAMED = spec("NAMED_VALUE_FLOAT")
UNITS = {"sensor_supply": "V"}


class Survey:
    """What a log holds: found in a first pass, so that every piece of a stream has the same columns.

    Attributes
    ----------
    source : str
        The message that makes the rows.
    system, component : int
        Its sender.
    columns : dict of str to str
        Column to unit, of each column that has a value at least once.
    named : dict of bytes to list of (str, float, float)
        ``NAMED_VALUE_FLOAT.name`` to columns, each with scale and offset.
    declared : list of Declared
        Columns that the log itself declares to be in other messages.
    attrs : dict
        Attributes that the log declares.
    ours : bool
        A bridge's own log: the time stamps carry the :class:`~magbridge.records.Channel`.
    stepped_us : int
        µs by which the bridge's clock was set in the course of the log.
    """

    def __init__(self, path: Path) -> None:
        self.attrs: dict[str, Any] = {}
        self.ours = False
        self.stepped_us = 0
        self._senders: dict[int, Counter[tuple[int, int]]] = {}
        self._known: dict[int, dict[str, str]] = {}
        self._named: dict[int, dict[bytes, str]] = {}
        self._declared: dict[str, Declared] = {}
        self._open: dict[tuple[int, int], list[Value]] = {}
        self._asked: dict[str, float] = {}
        self._read(path)
        for self.source in SOURCES:
            senders = self._senders.get(spec(self.source).id)
            if not senders or (self.ours and "IMU" in self.source):
                continue  # the autopilot's compass does not replace the instrument
            (self.system, self.component), _ = senders.most_common(1)[0]
            self.columns = self._known.get(self.system, {})
            self._name()
            return
        raise FormatError(path, f"expected MAVLink records with one of {' '.join(SOURCES)}")

    def _name(self) -> None:
        """Map each ``NAMED_VALUE_FLOAT`` to the columns that the log declares, else to its name."""
        self.named: dict[bytes, list[tuple[str, float, float]]] = {}
        self.declared: list[Declared] = []
        for one in self._declared.values():
            self.columns[one.column] = one.unit
            if self.ours and one.message not in (RAW, FIELD):
                self.columns[AGE + one.column] = "s"
            if one.message != NAMED.id or one.match.keys() != {"name"}:
                self.declared.append(one)
            else:
                letters = one.match["name"].encode().ljust(10, b"\0")
                self.named.setdefault(letters, []).append((one.column, one.scale, one.offset))
        for letters, name in self._named.get(self.system, {}).items():
            if letters not in self.named:
                self.named[letters] = [(name, 1.0, 0.0)]
                self.columns.setdefault(name, "1")

    def _read(self, path: Path) -> None:
        """Read every record, but decode only those that may add to what is known."""
        times: Counter[bytes] = Counter()
        settled: set[bytes] = set()
        with path.open("rb") as file:
            for record in LogReader(file):
                frame = record.frame
                head = 10 if frame[0] == V2 else 6
                kind = frame[5 if head == 10 else 3 : head]  # system, component, message id
                number = int.from_bytes(kind[2:], "little")
                if number in (SET, VALUE) and self.ours:
                    self._tuned(record)
                if self.ours and record.channel == Channel.SENT and number not in (RAW, FIELD):
                    continue  # the bridge's own messages are no telemetry
                if number == NAMED.id:
                    kind += frame[head + NAMED.fields["name"].offset : head + frame[1]]
                times[kind] += 1
                if kind not in settled and self._look(record.message):
                    settled.add(kind)
        for kind, n in times.items():
            number = int.from_bytes(kind[2:5], "little")
            self._senders.setdefault(number, Counter())[kind[0], kind[1]] += n

    def _tuned(self, record: Record) -> None:
        """Count how often a station has set what the alignment computes with; the bridge confirms it."""
        message = record.message
        name, value = message["param_id"], message["param_value"]
        if message.id == SET:
            self._asked[name] = value
        elif record.channel == Channel.SENT and self._asked.pop(name, None) == value:
            aligns = name.startswith("MB_") and not name.startswith("MB_R_")  # which are rates of messages
            self.attrs[CHANGES] = self.attrs.get(CHANGES, 0) + aligns

    def _look(self, message: Message) -> bool:
        """Note what is new in a message; return whether further ones of its kind can add nothing."""
        number, system = message.id, message.system
        known = self._known.setdefault(system, {})
        if number == NAMED.id:
            letters = NAMED.struct.unpack(message.payload)[-1]
            self._named.setdefault(system, {})[letters] = message["name"]
        elif number == COLUMN:
            if not message["message"]:
                self.attrs[message["column"]] = message["unit"] or message["scale"]
            else:
                with suppress(KeyError, ValueError):  # of a dialect that we do not know
                    self._declared[message["column"]] = Declared(message)
            return False
        elif number in (START, BYTES):
            self.ours = True
        elif number == STEP:
            self.stepped_us += message["step"]
            return False
        elif number in (RAW, FIELD):
            for column in (sample if number == RAW else correction)(message.payload):
                if column != "time":
                    known.setdefault(column, UNITS.get(column, ""))
            return number == FIELD
        elif number in TELEMETRY:
            still = self._open.setdefault((number, system), list(TELEMETRY[number]))
            for value in [one for one in still if not isnan(one.get(message.payload))]:
                still.remove(value)
                known.setdefault(value.column, value.unit)
            return not still
        return True


@lru_cache(maxsize=64)
def survey(path: Path, mtime_ns: int, size: int) -> Survey:  # noqa: ARG001 - a log that changed is surveyed again
    """Return what a log holds; cached, so that a log is surveyed only once."""
    return Survey(path)
