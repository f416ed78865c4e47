"""Packets of Twinleaf I/O (TIO), and the descriptors with which a device describes its streams.

Sources of the format are the public drivers ``libtio`` (protocol overview), ``tio-python`` (devices before
2025) and ``twinleaf-rust`` (since 2025). On a serial line, SLIP delimiters (RFC 1055) separate packets, each
with a CRC-32::

    packet = type u8, routing length in the low 4 bits u8, payload length u16, payload, routing

All numbers are little-endian. Both generations describe a stream before its samples can be read:

* Generation 1 sends TIMEBASE, SOURCE and STREAM packets. Samples of stream 0 begin with a 32-bit number.
* Generation 2 sends METADATA packets with records (device, stream, segment, column). Samples of streams 1 to
  127 begin with a 24-bit sample number and the number of their segment. A record begins with the length of
  its fixed part, which later firmware may extend; strings follow.
"""

from __future__ import annotations

from itertools import accumulate
from math import nan
from struct import Struct
from typing import Any, NamedTuple
from zlib import crc32

from magbridge.columns import NT_PER_UNIT
from magbridge.sensors.framing import CRC32_RESIDUE

__all__ = ["END", "MAX_FRAME_BYTES", "STREAM_TYPE", "WRAP_1", "Device", "pack", "requests", "slip", "unpack"]

END = b"\xc0"
RPC_REQUEST, RPC_REPLY, RPC_ERROR, HEARTBEAT, TIMEBASE, SOURCE, STREAM, METADATA = 2, 3, 4, 5, 6, 7, 8, 11
STREAM_TYPE = 128
"""Packet type of stream 0; samples of stream n have the type 128 + n."""
DEVICE_RECORD, STREAM_RECORD, SEGMENT_RECORD, COLUMN_RECORD = 1, 2, 3, 4
METADATA_REQUEST = 2
DESCRIPTOR_REQUESTS = {1: b"data.send_all", METADATA_REQUEST: b"dev.metadata"}
"""Number and method of each generation's request for descriptors."""
TYPE_FORMATS = {
    0x10: "B", 0x11: "b", 0x20: "H", 0x21: "h", 0x40: "I", 0x41: "i", 0x42: "f",
    0x80: "Q", 0x81: "q", 0x82: "d",
}  # fmt: skip
"""Data type -> format character of :mod:`struct`. The high nibble of a type is its size in bytes; the 24-bit
types have no format character."""
TIO_HEADER, RPC_HEADER = Struct("<BBH"), Struct("<HH")
# layouts of descriptors; unused fields are padding
TIMEBASE_HEADER = Struct("<H10xII8x")
"""Number, numerator and denominator of the period in µs."""
SOURCE_HEADER = Struct("<H16xHB")
"""Number, channels, type. The texts name, columns, title and unit follow, separated by tabs."""
STREAM_HEADER, COMPONENT = Struct("<HHI12xH2x"), Struct("<H10x")
"""Number, timebase, period in ticks of the timebase, components; and the source of each component."""
DEVICE_HEADER = Struct("<xxI3x")
"""Session."""
STREAM_RECORD_HEADER = Struct("<xBB6x")
"""Stream, columns."""
SEGMENT_HEADER = Struct("<xBB7xIII5x")
"""Stream, segment, start in s, rate in Hz, decimation."""
COLUMN_HEADER = Struct("<BBBBBBx")
"""Length, stream, index, type, lengths of name and unit."""
WRAP_1, WRAP_2 = 1 << 32, 1 << 24
"""Values at which the sample numbers of the two generations wrap to 0."""
MAX_FRAME_BYTES = 2 * (512 + 4)
"""Length of the longest SLIP frame, with every byte escaped."""
MAX_DESCRIPTORS = 1024
"""Most descriptors that are stored."""


class StreamColumn(NamedTuple):
    """Description of one number of a sample; `type` is a key of :data:`TYPE_FORMATS`."""

    name: str
    unit: str
    type: int


class SampleLayout(NamedTuple):
    """Layout and times of the samples of one segment; sample n has the time ``start + n * period``."""

    struct: Struct
    """Format of a sample up to the last needed channel, with padding for other columns."""
    order: list[int]
    """Index in `struct` of the three channels and of the temperature (-1: none); empty without channels."""
    sizes: list[int]
    """Lengths at which a sample may end, after each part, bytes; the last is that of a whole sample."""
    scale: float
    """Conversion factor from the channels' unit to nT."""
    start: int
    """Time of the first sample on the device's clock, s."""
    first: int
    """Number of the first sample in the stream."""
    period: float
    """Time between two samples, s."""


class Device:
    """Descriptors that a device has sent, with which its samples are read.

    `channels`, `temperature`: names of the columns to read; without temperature, its name is empty.
    `unit`: unit of the channels in place of the one that the device states, or None.
    `session`: number of the device's session, which changes at every power-on; None if unknown.
    """

    def __init__(self, channels: tuple[str, str, str], temperature: str, unit: str | None) -> None:
        self.session: int | None = None
        self._wanted, self._unit = (*channels, temperature), unit
        self._last = 0, 0, 0  # segment, sample number and wraps of the last packet
        self._known: dict[tuple[Any, ...], Any] = {}
        self._layouts: dict[tuple[int, int], SampleLayout] = {}

    def receive(self, kind: int, payload: bytes) -> None:
        """Process a packet without samples; struct.error, IndexError: its content is invalid."""
        if kind == METADATA:
            self._record(payload[0], payload[2:])
        elif kind == RPC_REPLY and int.from_bytes(payload[:2], "little") == METADATA_REQUEST:
            at = 2
            while at + 1 < len(payload):
                end = at + 2 + payload[at + 1]
                self._record(payload[at], payload[at + 2 : end])
                at = end
        elif kind == HEARTBEAT and len(payload) == 4:
            self.session = int.from_bytes(payload, "little")
        elif kind == TIMEBASE:
            number, numerator, denominator = TIMEBASE_HEADER.unpack_from(payload)
            self._store(1e-6 * numerator / (denominator or 1), "timebase", number)
        elif kind == SOURCE:
            number, channels, code = SOURCE_HEADER.unpack_from(payload)
            self._store(_columns(payload[SOURCE_HEADER.size :], channels, code), "source", number)
        elif kind == STREAM:
            number, timebase, period, count = STREAM_HEADER.unpack_from(payload)
            places = range(STREAM_HEADER.size, STREAM_HEADER.size + COMPONENT.size * count, COMPONENT.size)
            sources = [COMPONENT.unpack_from(payload, place)[0] for place in places]
            self._store((sources, timebase, period), "stream", number)

    def _record(self, kind: int, record: bytes) -> None:
        """Process a metadata record of generation 2."""
        if kind == DEVICE_RECORD:
            (self.session,) = DEVICE_HEADER.unpack_from(record)
        elif kind == STREAM_RECORD:
            number, columns = STREAM_RECORD_HEADER.unpack_from(record)
            self._store((range(columns), 0, 1), "stream", number)
        elif kind == COLUMN_RECORD:
            size, number, index, code, name, unit = COLUMN_HEADER.unpack_from(record)
            texts = record[size : size + name], record[size + name : size + name + unit]
            words = [text.decode("utf-8", "replace") for text in texts]
            self._store((StreamColumn(words[0], words[1], code),), "column", number, index)
        elif kind == SEGMENT_RECORD:
            number, segment, start, rate, decimation = SEGMENT_HEADER.unpack_from(record)
            rate, decimation = rate or 1, decimation or 1
            times = start, start * rate // decimation, decimation / rate
            self._store(times, "segment", number, segment)

    def _store(self, value: Any, *key: Any) -> None:
        if self._known.get(key) != value:
            if len(self._known) >= MAX_DESCRIPTORS:
                self._known.clear()
            self._known[key] = value
            self._layouts.clear()

    def samples(self, stream: int, payload: bytes) -> list[tuple[int, float, list[float]]] | None:
        """Return the samples in a packet of a stream; None if the stream is not described yet.

        A sample has its number in the stream, its time on the device's clock (s), and the three channels (nT)
        and the temperature (degC; NaN if the stream lacks it). The list is empty if the stream lacks a
        channel. ValueError: the packet has a wrong length, or a channel has an unknown type or unit.
        """
        if len(payload) < 4:
            raise ValueError
        count, segment, wrap = int.from_bytes(payload[:4], "little"), 0, WRAP_1
        if stream:  # generation 2: the upper 8 bits are the segment
            count, segment, wrap = count % WRAP_2, count >> 24, WRAP_2
        layout = self._layouts.get((stream, segment)) or self._layout(stream, segment)
        if layout is None or not layout.order:
            return None if layout is None else []
        number = self._unwrap(segment, count, wrap)
        size = len(payload) - 4
        whole, rest = divmod(size, layout.sizes[-1])
        if rest:
            if size not in layout.sizes:
                raise ValueError
            whole = int(size >= layout.struct.size)
        samples = []
        for n in range(whole):
            values = (*layout.struct.unpack_from(payload, 4 + n * layout.sizes[-1]), nan)
            x, y, z, temperature = (values[index] for index in layout.order)
            channels = [x * layout.scale, y * layout.scale, z * layout.scale, temperature]
            time = layout.start + (number + n) * layout.period
            samples.append((layout.first + number + n, time, channels))
        return samples

    def _unwrap(self, segment: int, number: int, wrap: int) -> int:
        """Return the sample number within `segment` after unwrapping: `number` plus a multiple of `wrap`."""
        last_segment, last, turns = self._last
        if segment != last_segment:
            turns = 0
        elif last - number > wrap // 2:
            turns += 1
        self._last = segment, number, turns
        return number + turns * wrap

    def _layout(self, stream: int, segment: int) -> SampleLayout | None:
        """Return the layout of the samples of a segment, and store it; None if it is not described yet."""
        sources, timebase, ticks = self._known.get(("stream", stream), ((), -1, 0))
        keys = [("column", stream, part) if stream else ("source", part) for part in sources]
        parts = [self._known.get(key, ()) for key in keys]
        times = self._known.get(("segment", stream, segment))
        if not stream and ("timebase", timebase) in self._known:  # generation 1 has one segment
            times = 0, 0, self._known["timebase", timebase] * ticks
        if times is None or not parts or not all(parts):
            return None
        columns = [column for part in parts for column in part]
        # the format skips the columns that are not wanted, also those of unknown types
        names = [column.name for column in columns]
        wanted = [names.index(name) for name in self._wanted if name in names]
        form, order, scale = "<", [], 1.0
        if set(self._wanted[:3]) <= set(names):
            scale = NT_PER_UNIT.get(self._unit or columns[wanted[0]].unit, 0.0)
            if not scale or any(columns[index].type not in TYPE_FORMATS for index in wanted):
                raise ValueError
            for index, column in enumerate(columns[: max(wanted) + 1]):
                form += TYPE_FORMATS[column.type] if index in wanted else f"{column.type >> 4}x"
            places = sorted(set(wanted))
            order = [*(places.index(index) for index in wanted), -1][:4]
        ends = [0, *accumulate(column.type >> 4 for column in columns)]
        sizes = [ends[count] for count in accumulate(map(len, parts))]
        layout = self._layouts[stream, segment] = SampleLayout(Struct(form), order, sizes, scale, *times)
        return layout


def _columns(text: bytes, channels: int, code: int) -> tuple[StreamColumn, ...]:
    """Return the columns of a source, with names of the form ``source.column``; `code`: their data type."""
    name, listed, _, unit, *_ = [*text.decode("utf-8", "replace").split("\t"), "", "", ""]
    names = listed.split(",")
    if channels == 1 or len(names) != channels:
        return (StreamColumn(name, unit, code),) * min(channels, 128)
    return tuple(StreamColumn(f"{name}.{column}", unit, code) for column in names)


def slip(packet: bytes) -> bytes:
    """Return the SLIP frame of a packet, with its CRC-32 and delimiter."""
    packet += crc32(packet).to_bytes(4, "little")
    return packet.replace(b"\xdb", b"\xdb\xdd").replace(b"\xc0", b"\xdb\xdc") + END


def pack(kind: int, payload: bytes, routing: bytes = b"") -> bytes:
    """Return a packet of the type `kind`; `routing` has the port numbers to the device, last hop first."""
    return TIO_HEADER.pack(kind, len(routing), len(payload)) + payload + routing


def unpack(frame: bytes) -> tuple[int, bytes, bytes]:
    """Return type, payload and routing of the packet in a SLIP frame.

    ValueError, struct.error: the packet is damaged.
    """
    packet = frame.replace(b"\xdb\xdc", b"\xc0").replace(b"\xdb\xdd", b"\xdb")
    if crc32(packet) != CRC32_RESIDUE:
        raise ValueError
    kind, routing, length = TIO_HEADER.unpack_from(packet)
    end = TIO_HEADER.size + length
    if len(packet) != end + (routing & 0x0F) + 4:
        raise ValueError
    return kind, packet[TIO_HEADER.size : end], packet[end:-4]


def requests(routing: bytes) -> bytes:
    """Return the bytes that start a device: a heartbeat, and each generation's request for descriptors."""
    packets = [pack(HEARTBEAT, b"", routing)]
    for number, method in DESCRIPTOR_REQUESTS.items():
        call = RPC_HEADER.pack(number, 0x8000 | len(method)) + method
        packets.append(pack(RPC_REQUEST, call, routing))
    return END + b"".join(map(slip, packets))
