"""Driver ``hmr2300``: binary and ASCII output of Honeywell's smart digital magnetometer.

Facts from Honeywell's data sheet (900139):

* ±2 gauss are ±30,000 counts, so 15,000 counts/gauss.
* A binary frame has 7 bytes: three 16-bit two's complement numbers, high byte first, and a carriage return.
* An ASCII line has 28 characters: three numbers with two blanks between them, and a carriage return. A number
  has a sign, two digits, a comma and three digits; leading zeros and their comma are blanks.
* Neither output has a checksum, a counter or a clock.
* A command begins with ``*dd`` (``dd`` is the device's number, 99 addresses all) and ends with a carriage
  return. A command that changes a setting needs ``*ddWE`` before it.
"""

from __future__ import annotations

import re
from struct import Struct
from typing import Annotated, ClassVar, Literal

import msgspec
from msgspec import Meta

from magbridge.columns import NT_PER_UNIT
from magbridge.records import Reading
from magbridge.sensors.framing import FixedFramer, FramedDriver

__all__ = ["Hmr2300", "Hmr2300Options"]

NT_PER_COUNT = NT_PER_UNIT["G"] / 15_000
MAX_COUNTS = 30_000
COUNTS_LAYOUT = Struct(">hhh")
PRINTABLE = bytes(range(0x20, 0x7F)) + b"\r\n"
ASCII_NUMBER = rb"([ +-][\d ]{2}[, ][\d ]{2}\d)"
ANSWER_LINE = re.compile(rb"\s?" + ASCII_NUMBER + rb"  " + ASCII_NUMBER + rb"  " + ASCII_NUMBER + rb" *")
LINE_LIMIT = 64


class Hmr2300Options(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[sensor.options]`` of the HMR2300."""

    output: Literal["binary", "ascii"] = "binary"
    """Output format, set at start-up. At 9600 bit/s ASCII reaches 30 readings/s, binary 100; at 19,200 bit/s
    50 and 154."""
    rate: Literal[10, 20, 25, 30, 40, 50, 60, 100, 123, 154] = 20
    """Readings per second, one of the device's rates."""
    device: Annotated[int, Meta(ge=0, le=99)] = 99
    """Number of the device on an RS-485 line; 99 addresses all."""


class Hmr2300(FramedDriver):
    """Parser of the HMR2300's binary or ASCII output, as the options select."""

    Options: ClassVar = Hmr2300Options
    range_nt = MAX_COUNTS * NT_PER_COUNT
    nt_per_count = NT_PER_COUNT

    def __init__(self, options: Hmr2300Options) -> None:
        super().__init__(b"\r", LINE_LIMIT)
        self._options = options
        self.period = 1.0 / options.rate
        self._binary = FixedFramer(COUNTS_LAYOUT, ord("\r"), PRINTABLE)

    @property
    def bytes_skipped(self) -> int:
        """Number of bytes that belonged to no valid frame."""
        return self._framer.skipped + self._binary.skipped

    def start(self) -> tuple[bytes, ...]:
        """Discard an incomplete frame; return the commands: stop, set output and rate, send continuously."""
        super().start()
        self._binary.begin()
        address = f"*{self._options.device:02d}"
        output = "A" if self._options.output == "ascii" else "B"
        enable, rate = f"{address}WE\r", self._options.rate
        lines = ("\x1b", enable, f"{address}{output}\r", enable, f"{address}R={rate}\r", f"{address}C\r")
        return tuple(line.encode() for line in lines)

    def feed(self, data: bytes) -> list[Reading]:
        """Process received bytes; return the readings that they complete."""
        if self._options.output == "ascii":
            return super().feed(data)
        readings = [self.from_counts(counts, MAX_COUNTS) for counts in self._binary.split(data)]
        self.frames_bad = self._binary.broken
        return readings

    def read_frame(self, frame: bytes) -> Reading:
        """Return the reading in a line; ValueError: the line does not contain a reading."""
        match = ANSWER_LINE.fullmatch(frame)
        if match is None:
            raise ValueError
        counts = [int(number.translate(None, b" ,")) for number in match.groups()]
        return self.from_counts(counts, MAX_COUNTS)

    def is_bad(self, frame: bytes) -> bool:
        """Return True for an invalid line, unless it begins with a letter, as the reply to a command does."""
        return not frame[:1].isalpha()
