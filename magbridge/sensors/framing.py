"""Code that several drivers share: frames between delimiters or of one size, COBS, the end of a range."""

from __future__ import annotations

from functools import reduce
from itertools import pairwise
from math import inf
from operator import sub, xor
from struct import Struct

from magbridge.records import Reading

__all__ = [
    "CRC32_RESIDUE", "FixedFramer", "FramedDriver", "Framer", "cobs_decode", "cobs_encode", "nmea_checksum",
    "saturated",
]  # fmt: skip

CRC32_RESIDUE = 0x2144DF1C
"""CRC-32 (IEEE 802.3) of any message followed by its own CRC-32 in little-endian order."""


class Framer:
    """Cuts a byte stream at a delimiter; a frame longer than `limit` bytes is skipped, not kept.

    `delimiter`: one byte.
    `limit`: longest frame, without its delimiter.
    `skipped`: bytes of frames that were too long; the driver adds those of frames that it rejects.
    """

    __slots__ = ("_delimiter", "_limit", "_overlong", "_rest", "skipped")

    def __init__(self, delimiter: bytes, limit: int) -> None:
        self._delimiter = delimiter
        self._limit = limit
        self._rest = b""
        self._overlong = False
        self.skipped = 0

    def begin(self, *, inside_frame: bool) -> None:
        """Restart: bytes that wait for their delimiter are skipped.

        `inside_frame`: the next byte may be in the middle of a frame: all up to the first delimiter is
            skipped.
        """
        self.skipped += len(self._rest)
        self._rest, self._overlong = b"", inside_frame

    def split(self, data: bytes) -> list[bytes]:
        """Process bytes; return the frames that they complete, empty ones left out."""
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


class FramedDriver:
    """A driver whose readings are frames between delimiters; it has to define :meth:`read_frame`.

    The attributes are those of :class:`magbridge.sensors.Driver`.

    Parameters
    ----------
    delimiter : bytes
        One byte.
    limit : int
        Longest frame, without its delimiter.
    """

    range_nt: float = inf
    nt_per_count: float = 0.0
    sequence_modulo: int = 0
    time_modulo: float = 0.0
    period: float = 0.0
    is_scalar: bool = False

    def __init__(self, delimiter: bytes, limit: int) -> None:
        self._framer = Framer(delimiter, limit)
        self.frames_bad = 0

    @property
    def bytes_skipped(self) -> int:
        """Bytes that belonged to no valid frame."""
        return self._framer.skipped

    def start(self) -> tuple[bytes, ...]:
        """Discard half a frame; return no commands."""
        self._framer.begin(inside_frame=False)
        return ()

    def feed(self, data: bytes) -> list[Reading]:
        """Parse bytes in any chunks; return the readings that they complete."""
        readings = []
        for frame in self._framer.split(data):
            try:
                reading = self.read_frame(frame)
            except ValueError:
                self._framer.skipped += len(frame)
                self.frames_bad += self.is_bad(frame)
            else:
                if reading is not None:
                    readings.append(reading)
        return readings

    def read_frame(self, frame: bytes) -> Reading | None:
        """Return the reading in a frame, None if it is a message without one; ValueError: it is invalid."""
        raise NotImplementedError

    def is_bad(self, frame: bytes) -> bool:  # noqa: ARG002 - some drivers look at it
        """Return True if an invalid frame counts as bad: not so the reply to a command."""
        return True


class FixedFramer:
    """Cuts a byte stream into frames of one size whose last byte is a delimiter that may be data as well.

    `layout`: numbers of a frame, without its delimiter.
    `delimiter`: last byte.
    `text`: bytes of replies to commands: a first frame of these only is skipped.
    `skipped`, `broken`: bytes that belonged to no frame, and how often the alignment was lost.

    Notes
    -----
    In a steady field a data byte may have the delimiter's value at the same place for long. So a place is
    taken for the end of a frame if `CONFIRM` frames in a row end there, and of several such places the one
    where the numbers change least from frame to frame: elsewhere low bytes, which are noise, are taken for
    high bytes.
    """

    CONFIRM = 4

    def __init__(self, layout: Struct, delimiter: int, text: bytes) -> None:
        self._layout, self._delimiter, self._text = layout, delimiter, text
        self._size = layout.size + 1
        self._rest, self._aligned = b"", False
        self.skipped = self.broken = 0

    def begin(self) -> None:
        """Restart: bytes that wait are skipped."""
        self.skipped += len(self._rest)
        self._rest, self._aligned = b"", False

    def split(self, data: bytes) -> list[tuple[int, ...]]:
        """Process bytes; return the numbers of the frames that they complete."""
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
        """Return the number of bytes from `position` to the first frame, and whether there is one."""
        size = self._size
        best, least, found = size, 0, False
        for offset in range(size):
            starts = range(position + offset, position + offset + size * self.CONFIRM, size)
            if all(buffer[start + size - 1] == self._delimiter for start in starts):
                frames = [self._layout.unpack_from(buffer, start) for start in starts]
                # without the first frame: it may be text, and its step to the second large
                variation = sum(sum(map(abs, map(sub, new, old))) for old, new in pairwise(frames[1:]))
                if not found or variation < least:
                    best, least, found = offset, variation, True
        if found and not buffer[position + best : position + best + size].translate(None, self._text):
            best += size
        return best, found


def cobs_encode(data: bytes) -> bytes:
    """Return `data`, at most 253 bytes, without zeros and one byte longer (delimiter not included).

    Notes
    -----
    Consistent Overhead Byte Stuffing (Cheshire & Baker 1999): a leading byte says how far it is to the first
    zero, each zero is replaced by the distance to the next one, the last by the distance to the end. Up to
    this length the code 255 ("no zero follows") is never needed.
    """
    stuffed = bytearray(b"\0" + data + b"\0")
    at = 0
    while (zero := stuffed.find(0, at + 1)) > 0:
        stuffed[at] = zero - at
        at = zero
    return bytes(stuffed[:-1])


def cobs_decode(frame: bytes) -> bytes:
    """Return the data of a frame of :func:`cobs_encode`; empty where it is not one."""
    pieces: list[bytes] = []  # between the zeros
    at, end = 0, len(frame)
    while at < end:
        step = frame[at]
        if not step:
            return b""
        pieces.append(frame[at + 1 : at + step])
        at += step
    return b"\0".join(pieces) if at == end else b""


def nmea_checksum(text: bytes) -> int:
    """Return the exclusive or of all bytes but the first, the ``$``."""
    return reduce(xor, text[1:], 0)


def saturated(x: float, y: float, z: float, limit: float) -> bool:
    """Return True if a channel is at the end of its range, or beyond: ``|channel| >= limit``, in one unit.

    The channels are numbers: a driver has counted a reading with a NaN as bad before it asks.
    """
    return not (-limit < x < limit and -limit < y < limit and -limit < z < limit)
