"""Telemetry logs: each record an 8-byte big-endian time stamp (µs of UNIX time) and one MAVLink frame.

A record counts when its frame's checksum is right (for a message outside the dialect: when another record
follows it) and its stamp lies before 2112. :func:`blocks` returns many records at once, as arrays: every
place where a record may begin is tried, and of those with a right checksum the first that begins after the
last is taken. :class:`LogReader` yields the same records one by one.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Iterator
from struct import Struct
from typing import BinaryIO, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from magbridge.arrays import IndexArray
from magbridge.mavlink.messages import (
    EXTRA,
    MAX_MESSAGE_ID,
    SIGNATURE,
    SIGNED,
    V1,
    V2,
    Message,
    checksum,
    message,
    spec,
)

__all__ = ["LogReader", "RecordBlock", "TlogRecord", "blocks", "pack_record", "pack_records"]

TLOG_STAMP: Final = Struct(">Q")
LATEST: Final = 1 << 52
"""Stamp of the year 2112, µs; a later one is damage."""
BLOCK_BYTES: Final = 1 << 22
"""Bytes read at a time."""
MAX_RECORD_BYTES = 8 + 10 + 255 + 2 + SIGNATURE + 9
"""Bytes of the longest record, and of what shows that another follows."""
RECORD_LAYOUT = np.dtype([("stamp", ">u8"), ("head", "u1", 10)])
KNOWN_LENGTHS = np.full(1 << 16, -1, dtype=np.int64)
KNOWN_LENGTHS[[number for number in EXTRA if number < len(KNOWN_LENGTHS)]] = [
    EXTRA[number][0] for number in EXTRA if number < len(KNOWN_LENGTHS)
]
"""CRC_EXTRA of each message in the dialect, -1 of the others."""


class TlogRecord(msgspec.Struct, frozen=True, gc=False):
    """One record of a log."""

    time_us: int
    """µs of UNIX time; a multiple of 4."""
    channel: int
    """The stamp's low two bits: :class:`magbridge.records.Channel` in our logs, a link number elsewhere."""
    frame: bytes
    """The MAVLink frame."""

    @property
    def message(self) -> Message:
        """The parsed frame."""
        return message(self.frame)


def pack_record(time_us: int, channel: int, frame: bytes) -> bytes:
    """Return the bytes of a record; `time_us` loses its low two bits to the channel."""
    return TLOG_STAMP.pack(time_us & ~3 | channel) + frame


def pack_records(records: Iterable[tuple[int, int, bytes]]) -> bytes:
    """Return the bytes of records: time, channel and frame of each."""
    pieces: list[bytes] = []
    for time_us, channel, frame in records:
        pieces.append(TLOG_STAMP.pack(time_us & ~3 | channel))
        pieces.append(frame)
    return b"".join(pieces)


class RecordBlock(NamedTuple):
    """Records that follow each other."""

    data: bytes
    time_us: IndexArray
    channel: IndexArray
    number: IndexArray
    system: IndexArray
    component: IndexArray
    """`time_us`, `channel`, `number`, `system`, `component`, (n,): The stamp and its low two bits, the
    message's id, and its sender."""
    frame: IndexArray
    payload: IndexArray
    end: IndexArray
    """`frame`, `payload`, `end`, (n,): Where in `data` the frame and the payload begin, and where the payload
    ends."""
    bytes_skipped: int
    damages: int
    """`bytes_skipped`, `damages`: Bytes between them that belong to no record, and the places."""

    def payloads(self, records: IndexArray) -> NDArray[np.uint8]:
        """Return the payloads (n, size) of records of one message, with the zeros that were cut off."""
        size = spec(int(self.number[records[0]])).size
        start, length = self.payload[records], self.end[records] - self.payload[records]
        at = np.arange(size)
        raw = np.frombuffer(self.data, np.uint8)
        taken: NDArray[np.uint8] = raw[np.minimum(start[:, None] + at, len(raw) - 1)]
        taken[at >= length[:, None]] = 0
        return taken

    def record(self, k: int) -> TlogRecord:
        """Return one record."""
        start, end = int(self.frame[k]), int(self.end[k]) + 2
        signed = self.data[start] == V2 and self.data[start + 2] & SIGNED
        frame = self.data[start : end + (SIGNATURE if signed else 0)]
        return TlogRecord(int(self.time_us[k]), int(self.channel[k]), frame)

    def message(self, k: int) -> Message:
        """Return one record's message."""
        return self.record(k).message


def blocks(file: BinaryIO, block_bytes: int = BLOCK_BYTES) -> Iterator[RecordBlock]:
    """Yield the records of a log, read `block_bytes` at a time; memory does not grow with the file."""
    data, broken, last = b"", False, False
    while not last:
        chunk = file.read(block_bytes)
        last = not chunk
        data += chunk
        block, at, broken = _block(data, broken, last=last)
        yield block
        data = data[at:]


class LogReader:
    """Reads the records of a log one by one and skips damaged bytes.

    Parameters
    ----------
    file : binary file
        Read from where it stands to its end.
    block_bytes : int
        Bytes read at a time; few where only the first records are wanted.

    Attributes
    ----------
    records : int
        Records read so far.
    bytes_skipped : int
        Bytes that belonged to no record, in the blocks read so far.
    damages : int
        Number of places with such bytes.
    """

    def __init__(self, file: BinaryIO, block_bytes: int = BLOCK_BYTES) -> None:
        self._blocks = blocks(file, block_bytes)
        self.records = self.bytes_skipped = self.damages = 0

    def __iter__(self) -> Iterator[TlogRecord]:
        for block in self._blocks:
            self.bytes_skipped += block.bytes_skipped
            self.damages += block.damages
            for k in range(len(block.number)):
                self.records += 1
                yield block.record(k)


def _block(data: bytes, broken: bool, *, last: bool) -> tuple[RecordBlock, int, bool]:
    """Return the records in `data`, where the undecided ones begin, and whether that is damage."""
    stop = len(data) if last else max(len(data) - MAX_RECORD_BYTES, 0)
    start, found = _candidates(data, stop)
    ends = found.pop("stop")
    taken, at, skipped, damages = [], 0, 0, 0
    # where each record is followed by another, they are taken all at once
    joins = np.append(start[1:] == ends[:-1], False)
    breaks, starts = np.flatnonzero(~joins).tolist(), start.tolist()
    k = 0
    while k < len(starts):
        gap = starts[k] - at
        damages += gap > 0 and not broken
        skipped, broken = skipped + gap, False
        b = breaks[bisect_left(breaks, k)]
        taken.append((k, b + 1))
        at = int(ends[b])
        k = bisect_left(starts, at, b + 1)
    if at < stop:  # nothing begins here
        damages += not broken
        skipped, broken, at = skipped + stop - at, True, stop
    which = np.concatenate([np.arange(*one) for one in taken]) if taken else np.empty(0, dtype=np.int64)
    fields = {name: values[which] for name, values in found.items()}
    return RecordBlock(data=data, **fields, bytes_skipped=skipped, damages=damages), at, broken


def _candidates(data: bytes, stop: int) -> tuple[IndexArray, dict[str, IndexArray]]:
    """Return where records begin whose frames are right, and what they are; some lie within others."""
    raw = np.frombuffer(data, np.uint8)
    # a stamp before 2112 has twelve bits of zeros
    n = max(min(stop, len(raw) - 16), 0)
    magic = raw[8 : 8 + n]
    start = np.flatnonzero(((magic == V2) | (magic == V1)) & (raw[:n] == 0) & (raw[1 : n + 1] < 0x10))
    window = raw[np.minimum(start[:, None] + np.arange(RECORD_LAYOUT.itemsize), len(raw) - 1)]
    records = window.view(RECORD_LAYOUT)[:, 0] if len(start) else np.empty(0, RECORD_LAYOUT)
    stamp, header = records["stamp"].astype(np.int64), records["head"].astype(np.int64)
    two = header[:, 0] == V2
    flags = np.where(two, header[:, 2], 0)
    number = np.where(two, header[:, 7] | header[:, 8] << 8 | header[:, 9] << 16, header[:, 5])
    system, component = np.where(two, header[:, 5], header[:, 3]), np.where(two, header[:, 6], header[:, 4])
    frame = start + 8
    payload = frame + np.where(two, 10, 6)
    body_end = payload + header[:, 1]
    end = body_end + 2 + np.where(flags > 0, SIGNATURE, 0)
    extra = np.where(
        number < len(KNOWN_LENGTHS), KNOWN_LENGTHS[np.minimum(number, len(KNOWN_LENGTHS) - 1)], -1
    )
    fits = (flags <= 1) & (end <= len(raw)) & (stamp < LATEST)
    known = np.flatnonzero(fits & (extra >= 0))
    spans = zip((frame[known] + 1).tolist(), body_end[known].tolist(), number[known].tolist(), strict=True)
    crc = np.array([checksum(data[first:after], EXTRA[n]) for first, after, n in spans], dtype=np.int64)
    good = np.zeros(len(start), dtype=bool)
    at = body_end[known]
    good[known] = crc == (raw[at].astype(np.int64) | raw[at + 1].astype(np.int64) << 8)
    # outside the dialect: believed where another follows
    unknown = np.flatnonzero(fits & (extra < 0) & two & (header[:, 3] == 0) & (number <= MAX_MESSAGE_ID))
    after = end[unknown] + 8
    follows = np.isin(raw[np.minimum(after, len(raw) - 1)], (V1, V2)) & (after < len(raw))
    good[unknown] = follows | (after >= len(raw))
    found = {
        "time_us": stamp & ~3, "channel": stamp & 3, "number": number, "system": system,
        "component": component, "frame": frame, "payload": payload, "end": body_end,
    }  # fmt: skip
    return start[good], {name: values[good] for name, values in {**found, "stop": end}.items()}
