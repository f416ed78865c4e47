"""Twinleaf I/O (TIO): packets, and the descriptors of their content.

As the public drivers read them: ``libtio`` (protocol overview), ``tio-python`` (devices before 2025) and
``twinleaf-rust`` (since). On a serial line a packet and its CRC-32 stand between SLIP delimiters (RFC 1055)::

    packet = type u8, routing length in the low 4 bits u8, payload length u16, payload, routing

All numbers are little-endian. Both generations describe a stream before its samples can be read:

* generation 1: TIMEBASE, SOURCE and STREAM packets; samples of stream 0 begin with a 32-bit number;
* generation 2: METADATA packets with records (device, stream, segment, column); samples of streams 1 to 127
  begin with a 24-bit number and the segment they belong to. A record begins with the length of its fixed
  part, which later firmware may extend; strings follow.
"""

from __future__ import annotations

from struct import Struct
from typing import NamedTuple
from zlib import crc32

__all__ = [
    "Segment",
    "StreamColumn",
    "StreamLayout",
    "column",
    "pack",
    "request",
    "segment",
    "slip",
    "source",
    "stream",
    "unslip",
]  # fmt: skip

END = b"\xc0"
MAX_FRAME_BYTES = 2 * (512 + 4)
"""Longest SLIP frame, every byte escaped."""
MAX_ROUTING = 8

RPC_REQUEST, RPC_REPLY, RPC_ERROR, HEARTBEAT, TIMEBASE, SOURCE, STREAM, METADATA = 2, 3, 4, 5, 6, 7, 8, 11
STREAM_TYPE = 128
"""Samples of stream n have the type 128 + n."""
DEVICE_RECORD, STREAM_RECORD, SEGMENT_RECORD, COLUMN_RECORD = 1, 2, 3, 4

TYPE_FORMATS = {
    0x10: "B", 0x11: "b", 0x20: "H", 0x21: "h", 0x40: "I", 0x41: "i", 0x42: "f",
    0x80: "Q", 0x81: "q", 0x82: "d",
}  # fmt: skip
"""Data type: format character. The high nibble of a type is its size in bytes (24 bits have no character)."""

TIO_HEADER = Struct("<BBH")
RPC_HEADER = Struct("<HH")
FLOAT = Struct("<f")
TIMEBASE_HEADER = Struct("<HBBQIIIf")
"""Number, source, epoch, start, numerator and denominator of the period in µs, flags, stability."""
SOURCE_HEADER = Struct("<HHIIiHHB")
"""Number, timebase, period, offset, format, flags, channels, type; then name, columns, title,
unit by tabs."""
STREAM_HEADER = Struct("<HHIIQHH")
"""Number, timebase, period in its ticks, offset, sample number, components, flags."""
COMPONENT = Struct("<HHII")
"""Source, flags, period, offset."""
DEVICE_HEADER = Struct("<BBIBBB")
"""Length, length of the name, session, lengths of two strings, streams."""
STREAM_RECORD_HEADER = Struct("<BBBBHHB")
"""Length, stream, columns, segments, bytes of a sample, samples kept, length of the name."""
SEGMENT_HEADER = Struct("<BBBBBBIIIIfB")
"""Length, stream, segment, flags, epoch, length of a string, session, start, rate, decimation, filter (2)."""
COLUMN_HEADER = Struct("<BBBBBBB")
"""Length, stream, index, type, lengths of name, unit and description."""


class StreamColumn(NamedTuple):
    """One number of a sample; `type` from :data:`TYPE_FORMATS`."""

    name: str
    unit: str
    type: int


class StreamLayout(NamedTuple):
    """What a sample holds.

    `parts` are generation 1's sources in order, or, in generation 2, the numbers of the columns. `period` is
    in ticks of the `timebase` (generation 1 only).
    """

    parts: tuple[int, ...]
    timebase: int = 0
    period: int = 1


class Segment(NamedTuple):
    """A run of samples without a break, sample n at ``(start * rate + n * decimation) / rate`` s."""

    start: int
    rate: int
    decimation: int


def unslip(frame: bytes) -> bytes:
    """Return the packet in a SLIP frame, its CRC-32 still behind it."""
    if b"\xdb" in frame:
        return frame.replace(b"\xdb\xdc", b"\xc0").replace(b"\xdb\xdd", b"\xdb")
    return frame


def slip(packet: bytes) -> bytes:
    """Return a packet as it stands on the line, with its CRC-32 and delimiter."""
    packet += crc32(packet).to_bytes(4, "little")
    return packet.replace(b"\xdb", b"\xdb\xdd").replace(b"\xc0", b"\xdb\xdc") + END


def pack(kind: int, payload: bytes, routing: bytes = b"") -> bytes:
    """Return a packet of the type `kind`; `routing` names the device, last hop first."""
    return TIO_HEADER.pack(kind, len(routing), len(payload)) + payload + routing


def request(number: int, method: str, routing: bytes = b"") -> bytes:
    """Return a remote procedure call without arguments."""
    return pack(RPC_REQUEST, RPC_HEADER.pack(number, 0x8000 | len(method)) + method.encode(), routing)


def timebase(payload: bytes) -> tuple[int, float]:
    """Read a timebase: its number and its period in s."""
    number, _, _, _, numerator, denominator, _, _ = TIMEBASE_HEADER.unpack_from(payload)
    return number, 1e-6 * numerator / (denominator or 1)


def source(payload: bytes) -> tuple[int, tuple[StreamColumn, ...]]:
    """Read a source: its number and its columns, named ``source.column``."""
    number, _, _, _, _, _, channels, kind = SOURCE_HEADER.unpack_from(payload)
    texts = [*payload[SOURCE_HEADER.size :].decode("utf-8", "replace").split("\t"), "", "", ""]
    name, unit, names = texts[0], texts[3], texts[1].split(",")
    if channels == 1 or len(names) != channels:
        return number, (StreamColumn(name, unit, kind),) * min(channels, 128)
    return number, tuple(StreamColumn(f"{name}.{column}", unit, kind) for column in names)


def stream(payload: bytes) -> tuple[int, StreamLayout]:
    """Read a stream of generation 1."""
    number, timebase, period, _, _, count, _ = STREAM_HEADER.unpack_from(payload)
    parts = [COMPONENT.unpack_from(payload, STREAM_HEADER.size + COMPONENT.size * k)[0] for k in range(count)]
    return number, StreamLayout(tuple(parts), timebase, period)


def stream_record(record: bytes) -> tuple[int, StreamLayout]:
    """Read a stream of generation 2."""
    _, number, columns, _, _, _, _ = STREAM_RECORD_HEADER.unpack_from(record)
    return number, StreamLayout(tuple(range(columns)))


def segment(record: bytes) -> tuple[tuple[int, int], Segment]:
    """Read a segment: the numbers of its stream and of itself, and its times."""
    header = SEGMENT_HEADER.unpack_from(record)
    return (header[1], header[2]), Segment(header[7], header[8] or 1, header[9] or 1)


def column(record: bytes) -> tuple[tuple[int, int], StreamColumn]:
    """Read a column: the numbers of its stream and of itself, and its description."""
    size, number, index, kind, name, unit, _ = COLUMN_HEADER.unpack_from(record)
    text = record[size:]
    words = text[:name].decode("utf-8", "replace"), text[name : name + unit].decode("utf-8", "replace")
    return (number, index), StreamColumn(*words, kind)
