"""Telemetry logs: each record an 8-byte big-endian time stamp (µs of UNIX time) and one MAVLink frame."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from struct import Struct
from typing import BinaryIO, Final

import msgspec

from magbridge.mavlink.framing import MAGIC, MORE, NOT_A_FRAME, find_magic, frame_end, message
from magbridge.mavlink.messages import Message

__all__ = ["LATEST", "LogReader", "Record", "pack_record", "pack_records"]

STAMP: Final = Struct(">Q")
LATEST: Final = 1 << 52
"""µs; a stamp beyond the year 2112 is damage."""
CHUNK: Final = 1 << 20
STEP: Final = 4096
"""Bytes of damage to search at once for the next record."""


class Record(msgspec.Struct, frozen=True, gc=False):
    """One record of a log."""

    time_us: int
    """µs of UNIX time; a multiple of 4."""
    channel: int
    """The stamp's low two bits: :class:`magbridge.records.Channel` in our logs, a link number in others'."""
    frame: bytes
    """The MAVLink frame."""

    @property
    def message(self) -> Message:
        """The parsed frame."""
        return message(self.frame)


def pack_record(time_us: int, channel: int, frame: bytes) -> bytes:
    """Return the bytes of a record; `time_us` loses its low two bits to the channel."""
    return STAMP.pack(time_us & ~3 | channel) + frame


def pack_records(records: Iterable[tuple[int, int, bytes]]) -> bytes:
    """Return the bytes of records: time, channel and frame of each."""
    return b"".join([pack_record(time_us, channel, frame) for time_us, channel, frame in records])


class LogReader:
    """Reads the records of a log and skips damaged bytes.

    A record counts when its frame's checksum is right (for a message outside the dialect: when another record
    follows it) and its stamp lies before 2112. Memory does not grow with the file.

    Attributes
    ----------
    records : int
        Records read so far.
    bytes_skipped : int
        Bytes so far that belonged to no record.
    damages : int
        Number of places with such bytes.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.records = self.bytes_skipped = self.damages = 0

    def __iter__(self) -> Iterator[Record]:
        data, at, whole = b"", 0, True
        last = False
        while not last:
            chunk = self._file.read(CHUNK)
            last = not chunk
            data, at = data[at:] + chunk, 0
            while len(data) - at > 8:
                begins = data[at + 8] in MAGIC
                end = frame_end(data, at + 8, len(data), 8, last=last) if begins else NOT_A_FRAME
                if end == MORE and not last:
                    break
                stamp = STAMP.unpack_from(data, at)[0]
                if end > 0 and stamp < LATEST:
                    self.records += 1
                    yield Record(stamp & ~3, stamp & 3, data[at + 8 : end])
                    at, whole = end, True
                    continue
                following = find_magic(data, at + 9, min(at + 9 + STEP, len(data))) - 8
                self.damages += whole
                self.bytes_skipped += following - at
                at, whole = following, False
        if at < len(data):
            self.damages += whole
            self.bytes_skipped += len(data) - at
