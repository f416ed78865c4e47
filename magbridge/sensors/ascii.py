"""Driver ``ascii``: lines of text with three channels or a total field, described in the configuration.

Options for an APS 1540 in its autosend mode (gauss and degrees, separated by blanks)::

    [sensor.options]
    columns = ["x", "y", "z", "temperature"]
    unit = "G"
    range = 65000.0

For an FGsensors FGA logger (comma separated, ms since power-on in 32 bits, with further columns)::

    [sensor.options]
    separator = ","
    columns = ["time", "x", "y", "z", "*"]
    time_unit = "ms"
    time_modulo = 4294967.296

For a sentence similar to NMEA, ``$PMAG,1234.500,12345.6,-234.5,43210.9*5A``::

    [sensor.options]
    prefix = "$PMAG,"
    separator = ","
    columns = ["time", "x", "y", "z"]
    checksum = "nmea"

For the JSON lines of runMag (HamSCI), with counts at a cycle count of 200::

    [sensor.options]
    columns = ["x", "y", "z", "temperature"]
    keys = ["rx", "ry", "rz", "lt"]
    unit = "counts"
    scale = 13.333

For scalar instruments such as Marine Magnetics Explorer and SeaSPY2, whose lines begin with
``*26.150/12:34:56.7 F:050123.456 S:142 D:+001.2m``::

    [sensor.options]
    prefix = "*"
    columns = ["total_field"]
    keys = ["F"]
"""

from __future__ import annotations

import re
from collections.abc import Callable
from math import inf, isfinite, nan
from typing import Annotated, Any, ClassVar, Literal
from zlib import crc32

import msgspec
from msgspec import Meta

from magbridge.columns import NT_PER_UNIT
from magbridge.records import MAX_DEVICE_TIME_S, MAX_MEASURED_NT, Reading
from magbridge.sensors.framing import FramedDriver, nmea_checksum, saturated

__all__ = ["CHECKSUMS", "Ascii", "AsciiOptions", "strip_checksum"]

MAX_LINE_BYTES = 512
"""Longest line, in bytes."""
MAX_ASCII_COUNT = 2**31
"""Limit of the counts in a message; no converter reaches it."""
SCALAR_STEP_NT = 1e-4
"""Field of one count in which the total field of a scalar instrument is logged, nT."""
MAX_DEVICE_COUNT = 2**63
"""Limit of sequence and power-cycle numbers; no instrument reaches it."""
ENCODING = "latin-1"
NAMED_VALUE_PATTERN = re.compile(rb'(\w+)"?\s*:\s*"?([-+.\w]+)')
"""Pattern of a key with its number, both with or without quotation marks."""
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]

CHECKSUMS: dict[str, tuple[int, Callable[[bytes], int]]] = {
    "nmea": (2, nmea_checksum),
    "xor": (2, lambda text: text[0] ^ nmea_checksum(text) if text else 0),
    "sum": (2, lambda text: sum(text) & 0xFF),
    "crc32": (8, crc32),
}
"""Name of each checksum -> number of hexadecimal digits after ``*``, and function of the bytes before ``*``.

``nmea`` omits the first byte, the ``$``.
"""


def _finite(text: bytes) -> float:
    number = float(text)
    if not isfinite(number):
        raise ValueError
    return number


def _measured(text: bytes) -> float:
    number = float(text)  # NaN is accepted, because some instruments send NaN for an unknown value
    if abs(number) > MAX_MEASURED_NT:
        raise ValueError
    return number


def _count(text: bytes) -> int:
    number = int(text)
    if abs(number) > MAX_DEVICE_COUNT:
        raise ValueError
    return number


COLUMN_READERS: dict[str, Callable[[bytes], float]] = {
    "time": _finite,
    "temperature": _measured,
    "supply": _measured,
    "sequence": _count,
    "power_cycle": _count,
}
"""Name of each column except the field's -> function that reads its text."""


class AsciiOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[sensor.options]`` of a line protocol."""

    columns: list[str] = msgspec.field(default_factory=lambda: ["x", "y", "z"])
    """Meaning of each column: ``x y z``, or ``total_field`` of a scalar instrument (one of both is required);
    ``time temperature supply sequence power_cycle``; ``-`` for a column to ignore; ``*`` at the end for any
    number of further columns to ignore."""
    keys: list[str] = msgspec.field(default_factory=list)
    """For lines of JSON, or of text such as ``x:"14"``: the key of each column, in the order of columns."""
    separator: str = ""
    """Text between columns; empty for any number of blanks or tabs."""
    prefix: str = ""
    """Text with which every line begins."""
    terminator: Literal["\n", "\r"] = "\n"
    """Last byte of a line; a carriage return before it is removed."""
    unit: Literal["nT", "uT", "mT", "T", "pT", "fT", "G", "mG", "uG", "counts"] = "nT"
    """Unit of the columns x, y and z, or total_field."""
    scale: float = 1.0
    """Factor on the channels, with its sign; for counts: nT per count."""
    range: Positive | None = None
    """Field at which a channel saturates, nT."""
    checksum: Literal["nmea", "xor", "sum", "crc32"] | None = None
    """Checksum in hexadecimal after a ``*`` at the end of the line; ``nmea`` omits the first byte, ``$``."""
    time_unit: Literal["s", "ms", "us"] = "s"
    """Unit of the column ``time``."""
    time_modulo: NotNegative = 0.0
    """Time at which the device's clock wraps, s; 0: never."""
    sequence_modulo: Annotated[int, Meta(ge=0)] = 0
    """Value at which the column ``sequence`` wraps to 0; 0: never."""
    rate: NotNegative = 0.0
    """Lines per second of a device without a clock, to remove the jitter of their arrival; 0: the rate is not
    constant, and each line has the time of its arrival."""
    start: list[str] = msgspec.field(default_factory=list)
    """Commands to send whenever the port is opened."""

    def __post_init__(self) -> None:
        for key in ("scale", "range", "time_modulo", "rate"):
            if not isfinite(getattr(self, key) or 0.0):
                raise ValueError(f"{key}: expected a finite number, got {getattr(self, key)}")
        if self.scale == 0.0:
            raise ValueError("scale: expected a number other than 0")
        named = self.columns[:-1] if self.columns[-1:] == ["*"] else self.columns
        for name in named:
            if name not in ("x", "y", "z", "total_field", "-", *COLUMN_READERS):
                known = " ".join(COLUMN_READERS)
                raise ValueError(f"columns: {name!r} is none of x y z total_field {known} -")
            if name != "-" and named.count(name) > 1:
                raise ValueError(f"columns: {name!r} stands there twice")
        field = {"x", "y", "z", "total_field"} & set(named)
        if field not in ({"x", "y", "z"}, {"total_field"}):
            raise ValueError("columns: expected x, y and z, or total_field, among them")
        if self.keys and (len(self.keys) != len(self.columns) or "*" in self.columns):
            raise ValueError(f"keys: expected one for each of the {len(self.columns)} columns, without *")


class Ascii(FramedDriver):
    """Parser of lines of text as :class:`AsciiOptions` describe them."""

    Options: ClassVar = AsciiOptions

    def __init__(self, options: AsciiOptions) -> None:
        super().__init__(options.terminator.encode(), MAX_LINE_BYTES)
        self._options = options
        columns = options.columns
        self._more = columns[-1] == "*"
        self._width = len(columns) - self._more
        self._keys = [key.encode(ENCODING) for key in options.keys]
        self.is_scalar = "total_field" in columns
        self._field = [columns.index(name) for name in (("total_field",) if self.is_scalar else "xyz")]
        readers = COLUMN_READERS
        self._others = [(name, at, readers[name]) for at, name in enumerate(columns) if name in readers]
        self._used = [*self._field, *(index for _, index, _ in self._others)]
        self._prefix = options.prefix.encode(ENCODING)
        self._separator = options.separator.encode(ENCODING) or None
        self._counts = options.unit == "counts"
        self._scale = options.scale * NT_PER_UNIT.get(options.unit, 1.0)
        self.nt_per_count = self._scale if self._counts else SCALAR_STEP_NT if self.is_scalar else 0.0
        self._seconds = SECONDS[options.time_unit]
        self.range_nt = options.range or inf
        self.sequence_modulo = options.sequence_modulo
        self.time_modulo = options.time_modulo
        self.period = 1.0 / options.rate if options.rate else 0.0

    def start(self) -> tuple[bytes, ...]:
        """Discard an incomplete line, and the next line if nothing would show that it is incomplete.

        Return the configured commands.
        """
        self._framer.begin(inside_frame=not (self._prefix or self._options.checksum))
        return tuple(command.encode(ENCODING) for command in self._options.start)

    def is_bad(self, frame: bytes) -> bool:
        """Return True for an invalid line, except a lone carriage return."""
        return frame != b"\r"

    def _cells(self, text: bytes) -> list[bytes]:
        """Return the texts of the columns in a line, in the order of the options."""
        if not self._keys:
            return text.split(self._separator)
        found = dict(NAMED_VALUE_PATTERN.findall(text))
        return [found[key] for key in self._keys if key in found]

    def read_frame(self, frame: bytes) -> Reading:
        """Return the reading in a line; raise ValueError if the line does not contain a valid reading."""
        line = frame.rstrip(b"\r")
        if self._options.checksum:
            line = strip_checksum(line, self._options.checksum)
        if not line.startswith(self._prefix):
            raise ValueError
        cells = self._cells(line[len(self._prefix) :])
        if len(cells) != self._width and not (self._more and len(cells) > self._width):
            raise ValueError
        if b"_" in line and any(b"_" in cells[index] for index in self._used):
            raise ValueError  # float() and int() would accept underscores in a number
        x, y, z = [*(float(cells[index]) for index in self._field), 0.0, 0.0][:3]
        scale = self._scale
        field = (x * scale, y * scale, z * scale)
        largest = abs(field[0]) + abs(field[1]) + abs(field[2])
        if not largest < MAX_MEASURED_NT or (self._counts and not abs(x) + abs(y) + abs(z) < MAX_ASCII_COUNT):
            raise ValueError
        others: dict[str, Any] = {name: kind(cells[at]) for name, at, kind in self._others}
        if abs(others.get("time", 0.0) * self._seconds) > MAX_DEVICE_TIME_S:
            raise ValueError
        return Reading(
            field,
            self._counts_of(x, y, z, field[0]),
            others.get("sequence"),
            others.get("time", nan) * self._seconds,
            temperature=others.get("temperature", nan),
            supply=others.get("supply", nan),
            power_cycle=others.get("power_cycle"),
            saturated=saturated(*field, self.range_nt),
        )

    def _counts_of(self, x: float, y: float, z: float, total: float) -> tuple[int, int, int] | None:
        """Return the counts of a reading, or None without counts."""
        if self._counts:
            return int(x), int(y), int(z)
        # counts of `SCALAR_STEP_NT` are more precise than a float32
        if self.is_scalar and abs(total) < MAX_ASCII_COUNT * SCALAR_STEP_NT:
            return round(total / SCALAR_STEP_NT), 0, 0
        return None


def strip_checksum(line: bytes, checksum: str) -> bytes:
    """Return the part of `line` before its ``*`` and checksum; raise ValueError if the checksum is wrong."""
    digits, function = CHECKSUMS[checksum]
    text, star, stated = line[: -digits - 1], line[-digits - 1 : -digits], line[-digits:]
    if star != b"*" or int(stated, 16) != function(text):
        raise ValueError
    return text
