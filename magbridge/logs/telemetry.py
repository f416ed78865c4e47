"""MAVLink telemetry logs (``.tlog``), ours and anyone's, as deployments.

A row is a magnetometer message of the best kind that the log holds (:data:`SOURCES`), from the sender of most of
them; every other column is the last value that this vehicle said before it (NaN once older than `MAX_AGE_US`).

- ``MAG_RAW`` (ours): nT as float32 (0.004 nT at 50,000 nT), time to the µs, channel times, temperature, supply,
  power cycles. The ``MAG_FIELD`` that follows it becomes the columns of ``magbridge correct``.
- ``HIGHRES_IMU`` (gauss), ``RAW_IMU`` and ``SCALED_IMU*`` (mgauss, so steps of 100 nT): in the autopilot's axes,
  its own offsets already in them; time is the record's stamp. Further magnetometers become ``mag1_x`` ... ``mag3_z``.
- Without any of these, ``ATTITUDE`` or position makes the rows, and there is no ``mag_x``.

Telemetry is what :data:`TELEMETRY` lists, and every ``NAMED_VALUE_FLOAT`` by its name. What is damaged is passed over
and counted in the attributes ``bytes_skipped`` and ``damages``, a row whose time does not increase in
``rows_dropped``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from math import isnan, nan
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from magbridge.columns import CHANNEL_TIMES, CORRECTED
from magbridge.errors import FormatError
from magbridge.logs.deployment import deployment
from magbridge.logs.telemetry_fields import TELEMETRY, Value
from magbridge.logs.telemetry_writer import FileWriter
from magbridge.mavlink import LogReader, Message, spec
from magbridge.records import Channel

__all__ = ["FileWriter", "chunks"]

MAX_AGE_US = 30_000_000
NEVER = -(1 << 62)
RAW, FIELD, NAMED, COLUMN, START, BYTES = (
    spec(name).id
    for name in (
        "MAG_RAW",
        "MAG_FIELD",
        "NAMED_VALUE_FLOAT",
        "MAG_COLUMN",
        "MAG_BRIDGE_START",
        "MAG_SENSOR_BYTES",
    )
)
COUNTED_POWER_CYCLES = 8  # MAG_RAW_FLAGS_POWER_CYCLE

Columns = dict[str, float]


def _raw(payload: bytes) -> Columns:
    time_us, _, x, y, z, _, _, _, *delays, temperature, supply, cycle, _, flags = _RAW.unpack(payload)
    row = {"time": time_us / 1e6}
    if not (isnan(x) and isnan(y) and isnan(z)):
        row |= {"mag_x": x, "mag_y": y, "mag_z": z}
    if any(delays):
        row |= {name: (time_us + delay) / 1e6 for name, delay in zip(CHANNEL_TIMES, delays, strict=True)}
    if not isnan(temperature):
        row["sensor_temperature"] = temperature
    if not isnan(supply):
        row["sensor_supply"] = supply
    if flags & COUNTED_POWER_CYCLES:
        row["power_cycle"] = cycle
    return row


def _field(payload: bytes) -> Columns:
    time_us, total, _, _, sigma, x, y, z, _, _, _, anomaly, _, _, flags, _ = _FIELD.unpack(payload)
    return {
        "time": time_us / 1e6,
        **dict(zip(CORRECTED, (total, sigma, x, y, z, anomaly, flags), strict=True)),
    }


def _of(message: str) -> Callable[[bytes], Columns]:
    values = [Value(f"mag_{axis}", message, f"{axis}mag") for axis in "xyz"]
    return lambda payload: {value.column: value.get(payload) for value in values}


_RAW, _FIELD = spec(RAW).struct, spec(FIELD).struct
SOURCES: dict[str, Callable[[bytes], Columns]] = {
    "MAG_RAW": _raw,
    "MAG_FIELD": _field,
    "HIGHRES_IMU": _of("HIGHRES_IMU"),
    "RAW_IMU": _of("RAW_IMU"),
    "SCALED_IMU": _of("SCALED_IMU"),
    "SCALED_IMU2": _of("SCALED_IMU2"),
    "SCALED_IMU3": _of("SCALED_IMU3"),
    "ATTITUDE": lambda _: {},
    "GLOBAL_POSITION_INT": lambda _: {},
}
"""What makes a row, the best first, and the columns that come with it."""
UNITS = {"sensor_supply": "V", "power_cycle": "1"}


def chunks(path: Path, rows: int) -> Iterator[xr.Dataset]:
    """Yield the log as deployments of at most `rows` rows; it is read twice.

    Raises
    ------
    FormatError
        Nothing in it makes a row.
    """
    survey = Survey(path)
    pieces = Rows(survey)
    with path.open("rb") as file:
        reader, skipped, damages = LogReader(file), 0, 0
        for record in reader:
            if len(pieces.rows) >= rows and record.frame[7:10] == pieces.source_id:
                yield pieces.take(path, reader.bytes_skipped - skipped, reader.damages - damages)
                skipped, damages = reader.bytes_skipped, reader.damages
            pieces.put(record.time_us, record.channel, record.message)
        if pieces.rows:
            yield pieces.take(path, reader.bytes_skipped - skipped, reader.damages - damages)


class Survey:
    """What a log holds: found in a first pass, so that every piece of a stream has the same columns.

    Attributes
    ----------
    source, sender : str, (int, int)
        The message that makes the rows; system and component.
    columns : dict of str to str
        Column to unit, each known at least once.
    names : dict of str to (str, str)
        ``NAMED_VALUE_FLOAT`` name to column and unit, where the log says so.
    ours : bool
        A bridge's own log: the stamps carry the :class:`~magbridge.records.Channel`.
    """

    def __init__(self, path: Path) -> None:
        self.names: dict[str, tuple[str, str]] = {}
        self.attrs: dict[str, Any] = {}
        self.ours = False
        self._senders: dict[int, Counter[tuple[int, int]]] = {}
        self._known: dict[int, dict[str, str]] = {}
        self._open: dict[tuple[int, int], list[Value]] = {}
        with path.open("rb") as file:
            for record in LogReader(file):
                self._look(record.channel, record.message)
        for self.source in SOURCES:
            if self.ours and "IMU" in self.source:
                continue  # the autopilot's compass is no stand-in for the instrument
            if senders := self._senders.get(spec(self.source).id):
                self.sender = senders.most_common(1)[0][0]
                self.columns = self._known[self.sender[0]]
                return
        raise FormatError(path, f"expected MAVLink records with one of {' '.join(SOURCES)}")

    def _look(self, channel: int, message: Message) -> None:
        number, system = message.id, message.system
        if self.ours and channel == Channel.SENT and number not in (RAW, FIELD):
            return  # what the bridge said is no telemetry
        self._senders.setdefault(number, Counter())[system, message.component] += 1
        known = self._known.setdefault(system, {})
        if number == NAMED:
            name = message["name"]
            known.setdefault(*self.names.get(name, (name, "1")))
        elif number == COLUMN and message["name"]:
            self.names[message["name"]] = message["column"], message["unit"]
        elif number == COLUMN:
            self.attrs[message["column"]] = message["unit"]
        elif number in (START, BYTES):
            self.ours = True
        elif number in (RAW, FIELD):
            for column in (_raw if number == RAW else _field)(message.payload).keys() - {"time"}:
                known.setdefault(column, UNITS.get(column, ""))
        elif number in TELEMETRY:
            still = self._open.setdefault((number, system), list(TELEMETRY[number]))
            for value in [one for one in still if not np.isnan(one.get(message.payload))]:
                still.remove(value)
                known.setdefault(value.column, value.unit)


class Rows:
    """Messages to rows: keeps the last value of each column, and the rows not yet taken."""

    def __init__(self, survey: Survey) -> None:
        self.survey = survey
        self.rows: list[list[float]] = []
        self.source_id = spec(survey.source).id.to_bytes(3, "little")
        self._source, self._make = spec(survey.source).id, SOURCES[survey.source]
        columns = ["time", *(f"mag_{axis}" for axis in "xyz" if "IMU" in survey.source)]
        own = {value.column for value in TELEMETRY.get(self._source, []) if value.column.startswith("mag")}
        columns += [name for name in survey.columns if name not in own]
        self._slot = {name: k for k, name in enumerate(columns)}
        self._values = [nan] * len(columns)
        self._stamps = [NEVER] * len(columns)
        self._tables = {
            number: [(self._slot[value.column], value.get) for value in values if value.column in self._slot]
            for number, values in TELEMETRY.items()
        }
        self._last = -np.inf
        self._dropped = 0

    def put(self, time_us: int, channel: int, message: Message) -> None:
        """Take the next message of the log."""
        number = message.id
        if message.system != self.survey.sender[0]:
            return
        if not (self.survey.ours and channel == Channel.SENT):
            self._telemetry(time_us, message)
        if number == self._source and message.component == self.survey.sender[1]:
            self._row(time_us, self._make(message.payload))
        elif number == FIELD and self.rows:
            self._correct(_field(message.payload))

    def _telemetry(self, time_us: int, message: Message) -> None:
        if message.id == NAMED:
            name = message["name"]
            self._note(time_us, self._slot[self.survey.names.get(name, (name, ""))[0]], message["value"])
        for slot, get in self._tables.get(message.id, ()):
            self._note(time_us, slot, get(message.payload))

    def _note(self, time_us: int, slot: int, value: float) -> None:
        self._values[slot], self._stamps[slot] = value, time_us

    def _row(self, time_us: int, columns: Columns) -> None:
        time = columns.get("time", time_us / 1e6)
        if time <= self._last:
            self._dropped += 1
            return
        self._last = time
        oldest = time_us - MAX_AGE_US
        row = [v if t >= oldest else nan for v, t in zip(self._values, self._stamps, strict=True)]
        for name, value in columns.items():
            row[self._slot[name]] = value
        row[0] = time
        self.rows.append(row)

    def _correct(self, columns: Columns) -> None:
        """Put the correction into the row of its reading, the last one; the first that comes is its own."""
        row = self.rows[-1]
        if np.isnan(row[self._slot["total_field"]]):
            for name in CORRECTED:
                row[self._slot[name]] = columns[name]

    def take(self, path: Path, bytes_skipped: int, damages: int) -> xr.Dataset:
        """Return the rows so far and begin anew."""
        array = np.array(self.rows)
        attrs = {"bytes_skipped": bytes_skipped, "damages": damages, "rows_dropped": self._dropped}
        self.rows, self._dropped = [], 0
        columns = {name: array[:, k] for name, k in self._slot.items() if k}
        if "heading" in columns:
            columns["heading"] %= 360.0
        units = {name: self.survey.columns.get(name, "") for name in columns}
        return deployment(path, array[:, 0], columns, units, self.survey.attrs | attrs)
