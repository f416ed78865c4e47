"""The first pass through a telemetry log: what it holds."""

from __future__ import annotations

from collections import Counter
from contextlib import suppress
from functools import lru_cache
from math import isnan
from pathlib import Path
from typing import Any

from magbridge.errors import FormatError
from magbridge.logs.telemetry_fields import SOURCES, TELEMETRY, Declared, Value, correction, sample
from magbridge.mavlink import LogReader, Message, spec
from magbridge.records import Channel

__all__ = ["Survey", "survey"]

V2 = 0xFD
RAW, FIELD, COLUMN, START, BYTES = (
    spec(name).id for name in ("MAG_RAW", "MAG_FIELD", "MAG_COLUMN", "MAG_BRIDGE_START", "MAG_SENSOR_BYTES")
)
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
        Column to unit, each known at least once.
    named : dict of bytes to list of (str, float, float)
        ``NAMED_VALUE_FLOAT.name`` to columns, each with scale and offset.
    declared : list of Declared
        Columns that the log itself says stand in other messages.
    attrs : dict
        What the log says of itself.
    ours : bool
        A bridge's own log: the stamps carry the :class:`~magbridge.records.Channel`.
    """

    def __init__(self, path: Path) -> None:
        self.attrs: dict[str, Any] = {}
        self.ours = False
        self._senders: dict[int, Counter[tuple[int, int]]] = {}
        self._known: dict[int, dict[str, str]] = {}
        self._named: dict[int, dict[bytes, str]] = {}
        self._declared: dict[str, Declared] = {}
        self._open: dict[tuple[int, int], list[Value]] = {}
        self._read(path)
        for self.source in SOURCES:
            senders = self._senders.get(spec(self.source).id)
            if not senders or (self.ours and "IMU" in self.source):
                continue  # the autopilot's compass is no stand-in for the instrument
            (self.system, self.component), _ = senders.most_common(1)[0]
            self.columns = self._known.get(self.system, {})
            self._name()
            return
        raise FormatError(path, f"expected MAVLink records with one of {' '.join(SOURCES)}")

    def _name(self) -> None:
        """Give every ``NAMED_VALUE_FLOAT`` of the vehicle its column, or those that the log declares."""
        self.named: dict[bytes, list[tuple[str, float, float]]] = {}
        self.declared: list[Declared] = []
        for one in self._declared.values():
            self.columns[one.column] = one.unit
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
        """Look at every record, but take apart only those that may tell something new."""
        times: Counter[bytes] = Counter()
        settled: set[bytes] = set()
        with path.open("rb") as file:
            for record in LogReader(file):
                frame = record.frame
                head = 10 if frame[0] == V2 else 6
                kind = frame[5 if head == 10 else 3 : head]  # system, component, message id
                number = int.from_bytes(kind[2:], "little")
                if self.ours and record.channel == Channel.SENT and number not in (RAW, FIELD):
                    continue  # what the bridge said is no telemetry
                if number == NAMED.id:
                    kind += frame[head + NAMED.fields["name"].offset : head + frame[1]]
                times[kind] += 1
                if kind not in settled and self._look(record.message):
                    settled.add(kind)
        for kind, n in times.items():
            number = int.from_bytes(kind[2:5], "little")
            self._senders.setdefault(number, Counter())[kind[0], kind[1]] += n

    def _look(self, message: Message) -> bool:
        """Note what the message tells; return whether one like it can tell no more."""
        number, system = message.id, message.system
        known = self._known.setdefault(system, {})
        if number == NAMED.id:
            letters = NAMED.struct.unpack(message.payload)[-1]
            self._named.setdefault(system, {})[letters] = message["name"]
        elif number == COLUMN:
            if not message["message"]:
                self.attrs[message["column"]] = message["unit"]
            else:
                with suppress(KeyError, ValueError):  # of a dialect that we do not know
                    self._declared[message["column"]] = Declared(message)
            return False
        elif number in (START, BYTES):
            self.ours = True
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
def survey(path: Path, mtime_ns: int, size: int) -> Survey:  # noqa: ARG001 - a log that changed is another
    """Return what a log holds, looked through once."""
    return Survey(path)
