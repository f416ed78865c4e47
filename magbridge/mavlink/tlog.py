"""Telemetry logs, whose records are an 8-byte big-endian time stamp (µs of UNIX time) and one MAVLink frame.

A record is valid if its stamp is before 2112 and the checksum of its frame is correct. If its message is not
in the dialect, a further record must follow instead. :func:`blocks` yields many records at once, as arrays.
It tests every place where a record may begin, and each time takes the first valid record after the previous
one. :class:`LogReader` yields the same records one by one.
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
"""Stamp of the year 2112, µs; a later stamp is damaged."""
BLOCK_BYTES: Final = 1 << 22
"""Number of bytes that are read from the file at a time."""
MAX_RECORD_BYTES = 8 + 10 + 255 + 2 + SIGNATURE + 9
"""Length of the longest record and of the next record up to its magic byte, bytes."""
RECORD_LAYOUT = np.dtype([("stamp", ">u8"), ("head", "u1", 10)])
IN_DIALECT = np.isin(np.arange(MAX_MESSAGE_ID + 1), list(EXTRA))
"""True for each message id in the dialect, (65536,)."""


class TlogRecord(msgspec.Struct, frozen=True, gc=False):
    """One record of a telemetry log."""

    time_us: int
    """Time of the record, µs of UNIX time; a multiple of 4."""
    channel: int
    """Low two bits of the stamp: :class:`magbridge.records.Channel` in our logs, else a link number."""
    frame: bytes
    """MAVLink frame of the record."""

    @property
    def message(self) -> Message:
        """Message in the record's frame."""
        return message(self.frame)


def pack_record(time_us: int, channel: int, frame: bytes) -> bytes:
    """Return the bytes of a record; `channel` replaces the low two bits of `time_us`."""
    return TLOG_STAMP.pack(time_us & ~3 | channel) + frame


def pack_records(records: Iterable[tuple[int, int, bytes]]) -> bytes:
    """Return the bytes of records, each given as time (µs), channel and frame."""
    stamp = TLOG_STAMP.pack
    return b"".join([stamp(time_us & ~3 | channel) + frame for time_us, channel, frame in records])


class RecordBlock(NamedTuple):
    """Consecutive records of a log, as arrays over the records, (n,)."""

    data: bytes
    time_us: IndexArray
    channel: IndexArray
    number: IndexArray
    system: IndexArray
    component: IndexArray
    """`time_us`, `channel`, `number`, `system`, `component`, (n,): Time (µs) and channel, message id, and
    system id and component id of the sender."""
    frame: IndexArray
    payload: IndexArray
    end: IndexArray
    """`frame`, `payload`, `end`, (n,): Positions in `data` where the frame begins, and where the payload
    begins and ends."""
    bytes_skipped: int
    damages: int
    """`bytes_skipped`, `damages`: Number of bytes that belong to no record, and of places with such bytes."""

    def payloads(self, records: IndexArray) -> NDArray[np.uint8]:
        """Return the payloads (n, size) of `records`, indices (n,) of one message id, padded with zeros."""
        size = spec(int(self.number[records[0]])).size
        start, length = self.payload[records], self.end[records] - self.payload[records]
        at = np.arange(size)
        raw = np.frombuffer(self.data, np.uint8)
        taken: NDArray[np.uint8] = raw[np.minimum(start[:, None] + at, len(raw) - 1)]
        taken[at >= length[:, None]] = 0
        return taken

    def record(self, k: int) -> TlogRecord:
        """Return the record with index `k`."""
        start, end = int(self.frame[k]), int(self.end[k]) + 2
        signed = self.data[start] == V2 and self.data[start + 2] & SIGNED
        frame = self.data[start : end + (SIGNATURE if signed else 0)]
        return TlogRecord(int(self.time_us[k]), int(self.channel[k]), frame)

    def message(self, k: int) -> Message:
        """Return the message of the record with index `k`."""
        return self.record(k).message


def blocks(file: BinaryIO, block_bytes: int = BLOCK_BYTES) -> Iterator[RecordBlock]:
    """Yield the records of a log in blocks of about `block_bytes`; memory does not grow with the file."""
    data, broken, last = b"", False, False
    while not last:
        chunk = file.read(block_bytes)
        last = not chunk
        data += chunk
        block, at, broken = _block(data, broken, last=last)
        yield block
        data = data[at:]


class LogReader:
    """Iterator over the records of a log, which skips damaged bytes.

    `file`: file, which is read from its present position to its end.
    `block_bytes`: number of bytes that are read at a time; a small number suits a caller that needs few
        records.
    `records`: number of records read so far.
    `bytes_skipped`: number of bytes that belonged to no record, in the blocks read so far.
    `damages`: number of places with such bytes.
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
    """Return the records in `data`, the position of the undecided rest, and True if `data` end in damage.

    `broken`: true if the bytes before `data` were damaged. `last`: True if no bytes follow.
    """
    stop = len(data) if last else max(len(data) - MAX_RECORD_BYTES, 0)
    start, found = _candidates(data, stop)
    ends = found.pop("stop")
    taken, at, skipped, damages = [], 0, 0, 0
    # records that follow each other without a gap are taken all at once
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
    """Return the positions (n,) of valid records that begin before `stop`, and their fields as arrays (n,).

    Records may overlap, because a frame's payload may contain bytes that look like a record.
    """
    raw = np.frombuffer(data, np.uint8)
    # a stamp before 2112 begins with twelve zero bits
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
    in_dialect = IN_DIALECT[np.minimum(number, MAX_MESSAGE_ID)] & (number <= MAX_MESSAGE_ID)
    fits = (flags <= 1) & (end <= len(raw)) & (stamp < LATEST)
    known = np.flatnonzero(fits & in_dialect)
    spans = zip((frame[known] + 1).tolist(), body_end[known].tolist(), number[known].tolist(), strict=True)
    crc = np.array([checksum(data[first:after], EXTRA[n]) for first, after, n in spans], dtype=np.int64)
    good = np.zeros(len(start), dtype=bool)
    at = body_end[known]
    good[known] = crc == (raw[at].astype(np.int64) | raw[at + 1].astype(np.int64) << 8)
    # a record of a message outside the dialect is accepted if another record follows
    unknown = np.flatnonzero(fits & ~in_dialect & two & (header[:, 3] == 0) & (number <= MAX_MESSAGE_ID))
    after = end[unknown] + 8
    follows = np.isin(raw[np.minimum(after, len(raw) - 1)], (V1, V2)) & (after < len(raw))
    good[unknown] = follows | (after >= len(raw))
    found = {
        "time_us": stamp & ~3, "channel": stamp & 3, "number": number, "system": system,
        "component": component, "frame": frame, "payload": payload, "end": body_end,
    }  # fmt: skip
    return start[good], {name: values[good] for name, values in {**found, "stop": end}.items()}
