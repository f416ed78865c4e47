"""``hmr2300``: Honeywell's smart digital magnetometer, its binary and its ASCII output.

Facts from Honeywell's data sheet (900139): ±2 gauss as ±30,000 counts, so 15,000 counts/gauss; binary,
7 bytes, three 16-bit two's complement numbers, high byte first, and a carriage return; ASCII, 28
characters, three times sign, two digits, comma, three digits (leading zeros and their comma are blanks),
two blanks between, and a carriage return. Neither output has a checksum, a counter or a clock. Commands
begin with ``*dd`` (``dd`` the device's number, 99 all) and end with a carriage return; a change needs
``*ddWE`` before it.
"""

from __future__ import annotations

import re
from itertools import pairwise
from operator import sub
from struct import Struct
from typing import Annotated, ClassVar, Literal

import msgspec
from msgspec import Meta

from magbridge.columns import NT_PER_UNIT
from magbridge.records import Reading
from magbridge.sensors.framing import Framer, saturated

__all__ = ["Hmr2300", "Hmr2300Options"]

NT_PER_COUNT = NT_PER_UNIT["G"] / 15_000
MAX_COUNTS = 30_000
READING_BYTES = 7
RETURN = 0x0D
COUNTS_LAYOUT = Struct(">hhh")
CONFIRM = 4
"""Frames in a row that must end in a carriage return before an alignment is believed."""
PRINTABLE = bytes(range(0x20, 0x7F)) + b"\r\n"
ALIGNMENT_BYTES = READING_BYTES * CONFIRM + READING_BYTES - 1
"""Bytes in which each of the seven alignments has `CONFIRM` frames."""
ASCII_NUMBER = rb"([ +-][\d ]{2}[, ][\d ]{2}\d)"
ANSWER_LINE = re.compile(rb"\s?" + ASCII_NUMBER + rb"  " + ASCII_NUMBER + rb"  " + ASCII_NUMBER + rb" *")
LINE_LIMIT = 64


class Hmr2300Options(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[sensor.options]`` of the HMR2300."""

    output: Literal["binary", "ascii"] = "binary"
    """Set at start-up. At 9600 bit/s ASCII reaches 30 readings/s, binary 100; at 19,200 50 and 154."""
    rate: Literal[10, 20, 25, 30, 40, 50, 60, 100, 123, 154] = 20
    """Readings per second; only the device's own rates."""
    device: Annotated[int, Meta(ge=0, le=99)] = 99
    """Number of the device on an RS-485 line; 99 addresses all."""


class Hmr2300:
    """Parser of the HMR2300's two outputs.

    Notes
    -----
    A carriage return ends a binary frame but may as well be one of its data bytes, and in a steady field may
    stay at the same place for long (a high byte of 0x0D is a field near 22 µT). So a place is taken for the
    end of the frame only when it holds a carriage return in `CONFIRM` frames in a row; among several such
    places the one whose numbers vary least is right, because any other takes low bytes, which are noise,
    for high bytes.
    """

    Options: ClassVar = Hmr2300Options
    range_nt = MAX_COUNTS * NT_PER_COUNT
    nt_per_count = NT_PER_COUNT
    sequence_modulo = 0
    time_modulo = 0.0

    def __init__(self, options: Hmr2300Options) -> None:
        self._options = options
        self.period = 1.0 / options.rate
        self.frames_bad = 0
        self._rest = b""
        self._aligned = False
        self._lines = Framer(b"\r", LINE_LIMIT)

    @property
    def bytes_skipped(self) -> int:
        """Bytes that belonged to no valid frame."""
        return self._lines.skipped

    def start(self) -> tuple[bytes, ...]:
        """Forget half a frame; return the commands: stop, set output and rate, send continuously."""
        self._lines.skipped += len(self._rest)
        self._lines.begin(inside=False)
        self._rest, self._aligned = b"", False
        do = f"*{self._options.device:02d}"
        output = "A" if self._options.output == "ascii" else "B"
        enable = f"{do}WE\r"
        lines = ("\x1b", enable, f"{do}{output}\r", enable, f"{do}R={self._options.rate}\r", f"{do}C\r")
        return tuple(line.encode() for line in lines)

    def feed(self, data: bytes) -> list[Reading]:
        """Process received bytes; return the readings that they complete."""
        return self._feed_ascii(data) if self._options.output == "ascii" else self._feed_binary(data)

    def _feed_binary(self, data: bytes) -> list[Reading]:
        buffer = self._rest + data
        readings = []
        at, end = 0, len(buffer)
        while True:
            if not self._aligned:
                if end - at < ALIGNMENT_BYTES:
                    break
                offset, self._aligned = _alignment(buffer, at)
                self._lines.skipped += offset
                at += offset
            elif end - at < READING_BYTES:
                break
            elif buffer[at + READING_BYTES - 1] == RETURN:
                readings.append(_reading(*COUNTS_LAYOUT.unpack_from(buffer, at)))
                at += READING_BYTES
            else:
                self.frames_bad += 1
                self._aligned = False
        self._rest = buffer[at:]
        return readings

    def _feed_ascii(self, data: bytes) -> list[Reading]:
        readings = []
        for line in self._lines.split(data):
            if match := ANSWER_LINE.fullmatch(line):
                x, y, z = (int(number.translate(None, b" ,")) for number in match.groups())
                readings.append(_reading(x, y, z))
            else:
                self._lines.skipped += len(line)
                self.frames_bad += not line[:1].isalpha()  # a word is the reply to a command
        return readings


def _reading(x: int, y: int, z: int) -> Reading:
    field = (x * NT_PER_COUNT, y * NT_PER_COUNT, z * NT_PER_COUNT)
    return Reading(field, (x, y, z), saturated=saturated(x, y, z, MAX_COUNTS))


def _alignment(buffer: bytes, at: int) -> tuple[int, bool]:
    """Return how many bytes after `at` the first frame begins, and whether the window has one at all.

    The end of a reply to a command may look like a frame just before the first real one, so a first frame
    that is all text is skipped.
    """
    best, least, found = READING_BYTES, 0, False
    for offset in range(READING_BYTES):
        starts = range(at + offset, at + offset + READING_BYTES * CONFIRM, READING_BYTES)
        if all(buffer[start + READING_BYTES - 1] == RETURN for start in starts):
            frames = [COUNTS_LAYOUT.unpack_from(buffer, start) for start in starts]
            # without the first frame: it may be text, and its step to the second large
            variation = sum(sum(map(abs, map(sub, after, before))) for before, after in pairwise(frames[1:]))
            if not found or variation < least:
                best, least, found = offset, variation, True
    if found and not buffer[at + best : at + best + READING_BYTES].translate(None, PRINTABLE):
        best += READING_BYTES
    return best, found
