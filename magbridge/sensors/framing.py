"""Code that several drivers share: framing by delimiter or size, COBS, checksums, saturation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce
from itertools import pairwise
from math import nan
from operator import sub, xor
from struct import Struct, error
from time import monotonic
from typing import ClassVar

from magbridge.records import MAX_DEVICE_TIME_S, Reading
from magbridge.sensors import Bus, Driver

__all__ = [
    "CRC32_RESIDUE", "BusDriver", "FixedFramer", "FramedDriver", "Framer", "cobs_decode", "cobs_encode",
    "nmea_checksum", "saturated", "wait_until",
]  # fmt: skip

CRC32_RESIDUE = 0x2144DF1C
"""CRC-32 (IEEE 802.3) of any message followed by its own CRC-32 in little-endian order."""


class Framer:
    """Splitter of a byte stream into frames between delimiters; longer frames than `limit` are skipped.

    `delimiter`: one byte.
    `limit`: length of the longest frame without its delimiter, bytes.
    `skipped`: number of skipped bytes; the driver adds the bytes of frames that it rejects.
    """

    __slots__ = ("_delimiter", "_limit", "_overlong", "_rest", "skipped")

    def __init__(self, delimiter: bytes, limit: int) -> None:
        self._delimiter = delimiter
        self._limit = limit
        self._rest = b""
        self._overlong = False
        self.skipped = 0

    def begin(self, *, inside_frame: bool) -> None:
        """Skip the bytes of an incomplete frame, and start again with the next byte.

        `inside_frame`: True if the next byte may be in the middle of a frame; then all bytes up to the first
            delimiter are skipped.
        """
        self.skipped += len(self._rest)
        self._rest, self._overlong = b"", inside_frame

    def split(self, data: bytes) -> list[bytes]:
        """Process received bytes; return the frames that they complete, without empty frames."""
        pieces = (self._rest + data).split(self._delimiter)
        rest = pieces.pop()
        if pieces and self._overlong:
            self.skipped += len(pieces[0])
            pieces[0] = b""
            self._overlong = False
        if self._overlong or len(rest) > self._limit:
            self.skipped += len(rest)
            self._overlong = True
            rest = b""
        self._rest = rest
        frames = []
        for piece in pieces:
            if len(piece) > self._limit:
                self.skipped += len(piece)
            elif piece:
                frames.append(piece)
        return frames


class FramedDriver(Driver):
    """Base of drivers whose readings are frames between delimiters; a subclass defines :meth:`read_frame`.

    `delimiter`: one byte.
    `limit`: length of the longest frame without its delimiter, bytes.
    """

    def __init__(self, delimiter: bytes, limit: int) -> None:
        self._framer = Framer(delimiter, limit)

    @property
    def bytes_skipped(self) -> int:
        """Number of bytes that belonged to no valid frame."""
        return self._framer.skipped

    def start(self) -> tuple[bytes, ...]:
        """Discard an incomplete frame; return no commands."""
        self._framer.begin(inside_frame=False)
        return ()

    def feed(self, data: bytes) -> list[Reading]:
        """Process received bytes; return the readings that they complete."""
        readings: list[Reading] = []
        for frame in self._framer.split(data):
            try:
                found = self.read_frame(frame)
            except (ValueError, IndexError, error):
                self._framer.skipped += len(frame)
                self.frames_bad += self.is_bad(frame)
                continue
            if isinstance(found, Reading):
                readings.append(found)
            elif found:
                readings += found
        return readings

    def read_frame(self, frame: bytes) -> Reading | list[Reading] | None:
        """Return the reading or readings in a frame, or None if it has none.

        ValueError, IndexError, struct.error: the frame is invalid.
        """
        raise NotImplementedError

    def from_counts(self, counts: Sequence[int], limit: int, device_time: float = nan) -> Reading:
        """Return the reading with `counts`; a channel of `limit` counts or more is saturated."""
        x, y, z = counts
        field = (x * self.nt_per_count, y * self.nt_per_count, z * self.nt_per_count)
        return Reading(field, (x, y, z), device_time=device_time, saturated=saturated(x, y, z, limit))

    def is_bad(self, frame: bytes) -> bool:  # noqa: ARG002 - some drivers look at it
        """Return True if an invalid frame counts in `frames_bad`; False for the reply to a command."""
        return True


class BusDriver(FramedDriver):
    """Base of drivers of parts on an I2C or SPI bus, whose results are logged as lines of text.

    A subclass defines :meth:`configure`, :meth:`read_results`, :meth:`to_reading`, and the class attributes
    `name` and `results_size`, the number of result registers. A line is ``$NAME,time,results*checksum``, with
    the bytes of the result registers in hexadecimal digits.
    """

    name: ClassVar[bytes]
    results_size: ClassVar[int]

    def __init__(self) -> None:
        super().__init__(b"\n", 64)

    def configure(self, bus: Bus) -> None:
        """Stop, configure, test and start the part; OSError: another part responds, or it is at fault."""
        raise NotImplementedError

    def read_results(self, bus: Bus) -> bytes:
        """Return the bytes of the result registers if a measurement is complete, else no bytes."""
        raise NotImplementedError

    def to_reading(self, results: bytes, time: float) -> Reading:
        """Return the reading in result registers read at `time` (s); ValueError: they are invalid."""
        raise NotImplementedError

    def poll(self, bus: Bus, time: float) -> bytes:
        """Return the line of a completed measurement at `time` (s, steady clock); empty if not ready."""
        results = self.read_results(bus)
        return self.encode_line(results, time) if results else b""

    @classmethod
    def encode_line(cls, results: bytes, time: float) -> bytes:
        """Return the line of text for the result registers, read at `time` (s)."""
        text = b"$%s,%.6f,%s" % (cls.name, time, results.hex().encode())
        return b"%s*%02X\n" % (text, nmea_checksum(text))

    def read_frame(self, frame: bytes) -> Reading:
        """Return the reading in a line; ValueError: the line does not contain a valid reading."""
        text, _, digits = frame.partition(b"*")
        prefix, time, results = text.split(b",")
        if len(digits) != 2 or int(digits, 16) != nmea_checksum(text) or prefix != b"$" + self.name:
            raise ValueError
        if not abs(float(time)) < MAX_DEVICE_TIME_S:
            raise ValueError
        registers = bytes.fromhex(results.decode("ascii"))
        if len(registers) != self.results_size:
            raise ValueError
        return self.to_reading(registers, float(time))


class FixedFramer:
    """Splitter of a byte stream into frames of one size, whose last byte is a delimiter.

    Data bytes may have the delimiter's value.

    `layout`: layout of a frame's numbers, without its delimiter.
    `delimiter`: value of the last byte of a frame.
    `text`: bytes that occur in replies to commands; a first frame of only these bytes is skipped.
    `skipped`, `broken`: number of bytes that belonged to no frame, and of losses of the alignment.

    Notes
    -----
    In a steady field a data byte may have the delimiter's value in many frames. So a place counts as the end
    of frames if `CONFIRM` frames in a row end there. If several places qualify, the splitter takes the place
    where the numbers change least from frame to frame. At a wrong place, noisy low bytes act as high bytes.
    """

    CONFIRM = 4

    def __init__(self, layout: Struct, delimiter: int, text: bytes) -> None:
        self._layout, self._delimiter, self._text = layout, delimiter, text
        self._size = layout.size + 1
        self._rest, self._aligned = b"", False
        self.skipped = self.broken = 0

    def begin(self) -> None:
        """Skip the bytes of an incomplete frame, and search for the alignment again."""
        self.skipped += len(self._rest)
        self._rest, self._aligned = b"", False

    def split(self, data: bytes) -> list[tuple[int, ...]]:
        """Process received bytes; return the numbers of each frame that they complete."""
        buffer, size = self._rest + data, self._size
        frames: list[tuple[int, ...]] = []
        position = 0
        while len(buffer) - position >= (size if self._aligned else size * (self.CONFIRM + 1) - 1):
            if not self._aligned:
                offset, self._aligned = self._align(buffer, position)
                self.skipped += offset
                position += offset
            elif buffer[position + size - 1] == self._delimiter:
                frames.append(self._layout.unpack_from(buffer, position))
                position += size
            else:
                self.broken += 1
                self._aligned = False
        self._rest = buffer[position:]
        return frames

    def _align(self, buffer: bytes, position: int) -> tuple[int, bool]:
        """Return the number of bytes from `position` to the first frame, and True if a frame was found."""
        size = self._size
        best, least, found = size, 0, False
        for offset in range(size):
            starts = range(position + offset, position + offset + size * self.CONFIRM, size)
            if all(buffer[start + size - 1] == self._delimiter for start in starts):
                frames = [self._layout.unpack_from(buffer, start) for start in starts]
                # without the first frame, which may be text with a large step to the second frame
                variation = sum(sum(map(abs, map(sub, new, old))) for old, new in pairwise(frames[1:]))
                if not found or variation < least:
                    best, least, found = offset, variation, True
        if found and not buffer[position + best : position + best + size].translate(None, self._text):
            best += size
        return best, found


def cobs_encode(data: bytes) -> bytes:
    """Return `data`, at most 253 bytes, encoded without zero bytes; the result is one byte longer.

    Notes
    -----
    Consistent Overhead Byte Stuffing (Cheshire & Baker 1999): a leading byte states the distance to the first
    zero, each zero is replaced by the distance to the next zero, the last by the distance to the end. Up to
    253 bytes, the code 255 ("no zero follows") is never needed. The delimiter is not included.
    """
    stuffed = bytearray(b"\0" + data + b"\0")
    at = 0
    while (zero := stuffed.find(0, at + 1)) > 0:
        stuffed[at] = zero - at
        at = zero
    return bytes(stuffed[:-1])


def cobs_decode(frame: bytes) -> bytes:
    """Return the data that :func:`cobs_encode` encoded as `frame`; empty if the frame is not valid."""
    pieces: list[bytes] = []  # data between the zeros
    at, end = 0, len(frame)
    while at < end:
        step = frame[at]
        if not step:
            return b""
        pieces.append(frame[at + 1 : at + step])
        at += step
    return b"\0".join(pieces) if at == end else b""


def nmea_checksum(text: bytes) -> int:
    """Return the NMEA checksum of `text`: the exclusive or of all bytes except the first, the ``$``."""
    return reduce(xor, text[1:], 0)


def wait_until(condition: Callable[[], bool], seconds: float, failure: str) -> None:
    """Return when `condition()` is true; OSError with the text `failure`: it is false for `seconds`."""
    end = monotonic() + seconds
    while not condition():
        if monotonic() > end:
            raise OSError(failure)


def saturated(x: float, y: float, z: float, limit: float) -> bool:
    """Return True if a channel saturates: ``|channel| >= limit``, all in one unit.

    No channel may be NaN; drivers count readings with a NaN as bad before.
    """
    return not (-limit < x < limit and -limit < y < limit and -limit < z < limit)
