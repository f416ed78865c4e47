"""Driver ``twinleaf``: vector magnetometers that send either generation of Twinleaf I/O (TIO).

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
from struct import Struct, error
from typing import Annotated, Any, ClassVar, NamedTuple
from zlib import crc32

import msgspec
from msgspec import Meta

from magbridge.columns import NT_PER_UNIT
from magbridge.records import MAX_MEASURED_NT, Reading
from magbridge.sensors.framing import CRC32_RESIDUE, FramedDriver, saturated

__all__ = ["Twinleaf", "TwinleafOptions", "pack", "slip", "unslip"]

END = b"\xc0"
MAX_FRAME_BYTES = 2 * (512 + 4)
"""Length of the longest SLIP frame, with every byte escaped."""
MAX_ROUTING = 8

RPC_REQUEST, RPC_REPLY, RPC_ERROR, HEARTBEAT, TIMEBASE, SOURCE, STREAM, METADATA = 2, 3, 4, 5, 6, 7, 8, 11
STREAM_TYPE = 128
"""Packet type of stream 0; samples of stream n have the type 128 + n."""
DEVICE_RECORD, STREAM_RECORD, SEGMENT_RECORD, COLUMN_RECORD = 1, 2, 3, 4

TYPE_FORMATS = {
    0x10: "B", 0x11: "b", 0x20: "H", 0x21: "h", 0x40: "I", 0x41: "i", 0x42: "f",
    0x80: "Q", 0x81: "q", 0x82: "d",
}  # fmt: skip
"""Data type -> format character of :mod:`struct`. The high nibble of a type is its size in bytes; the 24-bit
types have no format character."""

TIO_HEADER = Struct("<BBH")
RPC_HEADER = Struct("<HH")
TIMEBASE_HEADER = Struct("<HBBQIIIf")
"""Layout: number, source, epoch, start, numerator and denominator of the period in µs, flags, stability."""
SOURCE_HEADER = Struct("<HHIIiHHB")
"""Layout: number, timebase, period, offset, format, flags, channels, type. The texts name, columns, title and
unit follow, separated by tabs."""
STREAM_HEADER = Struct("<HHIIQHH")
"""Layout: number, timebase, period in ticks of the timebase, offset, sample number, components, flags."""
COMPONENT = Struct("<HHII")
"""Layout: source, flags, period, offset."""
DEVICE_HEADER = Struct("<BBIBBB")
"""Layout: length, length of the name, session, lengths of two strings, number of streams."""
STREAM_RECORD_HEADER = Struct("<BBBBHHB")
"""Layout: length, stream, columns, segments, bytes of a sample, buffered samples, length of the name."""
SEGMENT_HEADER = Struct("<BBBBBBIIIIfB")
"""Layout: length, stream, segment, flags, epoch, length of a string, session, start, rate, decimation, and
two numbers of the filter."""
COLUMN_HEADER = Struct("<BBBBBBB")
"""Layout: length, stream, index, type, lengths of name, unit and description."""
SEND_ALL_REQUEST, METADATA_REQUEST = 1, 2
"""Numbers of the driver's two requests for descriptors."""
WRAP_1, WRAP_2 = 1 << 32, 1 << 24
"""Values at which the sample numbers of the two generations wrap to 0."""
MAX_DESCRIPTORS = 256
"""Most descriptors of each kind that are stored."""


class TwinleafOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[sensor.options]`` of a TIO device."""

    columns: tuple[str, str, str] = ("vector.x", "vector.y", "vector.z")
    """The device's names of the three channels."""
    temperature: str = ""
    """The device's name of the column with the temperature in degC; empty for none."""
    unit: str | None = None
    """Unit of the channels, in place of the unit that the device states."""
    route: Annotated[str, Meta(pattern=r"^/?(\d+(/\d+)*/?)?$")] = "/"
    """Port numbers from the root to the device in a tree of devices, such as ``/0/2``."""
    range: Annotated[float, Meta(gt=0)] = 100_000.0
    """Field at which a channel saturates, nT."""

    def __post_init__(self) -> None:
        if self.unit is not None and self.unit not in NT_PER_UNIT:
            raise ValueError(f"unit: expected one of {' '.join(NT_PER_UNIT)}")
        hops = self.hops()
        if len(hops) > MAX_ROUTING or max(hops, default=0) > 255:
            raise ValueError(f"route: expected at most {MAX_ROUTING} numbers up to 255")

    def hops(self) -> list[int]:
        """Return the port numbers from the root of the device tree to the device."""
        return [int(hop) for hop in self.route.split("/") if hop]


class StreamColumn(NamedTuple):
    """Description of one number of a sample; `type` is a key of :data:`TYPE_FORMATS`."""

    name: str
    unit: str
    type: int


class Segment(NamedTuple):
    """Uninterrupted part of a stream, whose sample n is number ``first + n``, at ``start + n * period``."""

    start: int
    """Time of the first sample on the device's clock, s."""
    first: int
    """Number of the first sample in the stream."""
    period: float
    """Time between two samples, s."""


class SampleLayout(NamedTuple):
    """Layout of the samples of one stream."""

    fields: list[tuple[int, Struct]]
    """Offset and format of the three channels, and of the temperature if it is configured."""
    needed: int
    """Number of bytes up to the end of the last of `fields`."""
    sizes: list[int]
    """Lengths at which a sample may end, after each part, bytes; the last is that of a whole sample."""
    scale: float
    """Conversion factor from the channels' unit to nT."""


class Twinleaf(FramedDriver):
    """Parser of the packets of a TIO device of either generation.

    ``Reading.power_cycle`` is the session number of the device, which changes at every power-on.
    ``Reading.sequence`` counts the samples of all segments.
    """

    Options: ClassVar = TwinleafOptions
    sequence_modulo = WRAP_1

    def __init__(self, options: TwinleafOptions) -> None:
        super().__init__(END, MAX_FRAME_BYTES)
        self._options = options
        self._routing = bytes(reversed(options.hops()))
        self.range_nt = options.range
        self._session: int | None = None
        # generation 1: timebase -> s, source -> columns, stream -> sources, timebase, period in ticks
        self._timebases: dict[int, float] = {}
        self._sources: dict[int, tuple[StreamColumn, ...]] = {}
        # generation 2: each part of a stream is one column; segments by stream and number
        self._streams: dict[int, tuple[tuple[int, ...], int, int]] = {}
        self._columns: dict[tuple[int, int], StreamColumn] = {}
        self._segments: dict[tuple[int, int], Segment] = {}
        self._layouts: dict[int, SampleLayout | None] = {}
        self._last = 0, 0, 0  # segment, sample number and wraps of the last packet

    def start(self) -> tuple[bytes, ...]:
        """Return one command: a heartbeat, and each generation's request for descriptors."""
        packets = [pack(HEARTBEAT, b"", self._routing)]
        for number, method in ((SEND_ALL_REQUEST, b"data.send_all"), (METADATA_REQUEST, b"dev.metadata")):
            call = RPC_HEADER.pack(number, 0x8000 | len(method)) + method
            packets.append(pack(RPC_REQUEST, call, self._routing))
        return (END + b"".join(map(slip, packets)),)

    def feed(self, data: bytes) -> list[Reading]:
        """Process received bytes; return the readings that they complete."""
        readings: list[Reading] = []
        for frame in self._framer.split(data):
            try:
                kind, payload = self._open(frame)
                if kind >= STREAM_TYPE:
                    readings += self._samples(kind - STREAM_TYPE, payload)
                else:
                    self._describe(kind, payload)
            except (ValueError, IndexError, error):
                self.frames_bad += 1
                self._framer.skipped += len(frame)
        return readings

    def _open(self, frame: bytes) -> tuple[int, bytes]:
        """Return type and payload of the packet in a frame; type 0 for a packet of another device.

        ValueError: the packet is damaged.
        """
        packet = unslip(frame)
        if crc32(packet) != CRC32_RESIDUE:
            raise ValueError
        kind, routing, length = TIO_HEADER.unpack_from(packet)
        end = 4 + length
        if len(packet) != end + (routing & 0x0F) + 4:
            raise ValueError
        return (kind if packet[end:-4] == self._routing else 0), packet[4:end]

    def _describe(self, kind: int, payload: bytes) -> None:
        """Process a packet without samples, such as a heartbeat or a descriptor."""
        if kind == METADATA:
            self._record(payload[0], payload[2:])
        elif kind == RPC_REPLY and int.from_bytes(payload[:2], "little") == METADATA_REQUEST:
            at = 2
            while at + 1 < len(payload):
                end = at + 2 + payload[at + 1]
                self._record(payload[at], payload[at + 2 : end])
                at = end
        elif kind == HEARTBEAT and len(payload) == 4:
            self._session = int.from_bytes(payload, "little")
        elif kind == TIMEBASE:
            number, _, _, _, numerator, denominator, _, _ = TIMEBASE_HEADER.unpack_from(payload)
            self._remember(self._timebases, number, 1e-6 * numerator / (denominator or 1))
        elif kind == SOURCE:
            number, _, _, _, _, _, channels, code = SOURCE_HEADER.unpack_from(payload)
            self._remember(self._sources, number, _columns(payload[SOURCE_HEADER.size :], channels, code))
        elif kind == STREAM:
            number, timebase, period, _, _, count, _ = STREAM_HEADER.unpack_from(payload)
            places = range(STREAM_HEADER.size, STREAM_HEADER.size + COMPONENT.size * count, COMPONENT.size)
            parts = tuple(COMPONENT.unpack_from(payload, place)[0] for place in places)
            self._remember(self._streams, number, (parts, timebase, period))

    def _record(self, kind: int, record: bytes) -> None:
        """Process a metadata record of generation 2."""
        if kind == DEVICE_RECORD:
            self._session = int.from_bytes(record[2:6], "little")
        elif kind == STREAM_RECORD:
            _, number, columns, _, _, _, _ = STREAM_RECORD_HEADER.unpack_from(record)
            self._remember(self._streams, number, (tuple(range(columns)), 0, 1))
        elif kind == COLUMN_RECORD:
            size, number, index, code, name, unit, _ = COLUMN_HEADER.unpack_from(record)
            text = record[size:]
            words = [part.decode("utf-8", "replace") for part in (text[:name], text[name : name + unit])]
            self._remember(self._columns, (number, index), StreamColumn(words[0], words[1], code))
        elif kind == SEGMENT_RECORD:
            header = SEGMENT_HEADER.unpack_from(record)
            start, rate, decimation = header[7], header[8] or 1, header[9] or 1
            segment = Segment(start, start * rate // decimation, decimation / rate)
            self._remember(self._segments, (header[1], header[2]), segment)

    def _remember(self, table: dict[Any, Any], key: Any, value: Any) -> None:
        if table.get(key) != value:
            if len(table) >= MAX_DESCRIPTORS:
                table.clear()
            table[key] = value
            self._layouts.clear()

    def _samples(self, number: int, payload: bytes) -> list[Reading]:
        """Return the readings in a sample packet of the stream `number`; ValueError: a wrong length."""
        if len(payload) < 4:
            raise ValueError
        if number not in self._layouts and (parts := self._parts(number)) is not None:
            self._layouts[number] = self._layout(parts)
        count = int.from_bytes(payload[:4], "little")
        segment = self._segment(number, count >> 24)
        if number not in self._layouts or segment is None:  # not described yet
            self._framer.skipped += len(payload)
            return []
        layout = self._layouts[number]
        if layout is None:  # a stream without our channels
            return []
        count = (
            self._unwrap(count >> 24, count % WRAP_2, WRAP_2) if number else self._unwrap(0, count, WRAP_1)
        )
        size = layout.sizes[-1]
        samples, rest = divmod(len(payload) - 4, size)
        if rest:
            if len(payload) - 4 not in layout.sizes:
                raise ValueError
            samples = int(len(payload) - 4 >= layout.needed)
        readings = []
        for n in range(samples):
            start = 4 + n * size
            x, y, z, *more = [form.unpack_from(payload, start + place)[0] for place, form in layout.fields]
            x, y, z = x * layout.scale, y * layout.scale, z * layout.scale
            temperature = more[0] if more else nan
            is_field = abs(x) + abs(y) + abs(z) < MAX_MEASURED_NT  # False for NaN
            if not is_field or abs(temperature) > MAX_MEASURED_NT:
                self.frames_bad += 1
                self._framer.skipped += layout.needed
                continue
            reading = Reading(
                (x, y, z), None, (segment.first + count + n) % WRAP_1,
                segment.start + (count + n) * segment.period, temperature=temperature,
                power_cycle=self._session, saturated=saturated(x, y, z, self.range_nt),
            )  # fmt: skip
            readings.append(reading)
        return readings

    def _segment(self, number: int, segment: int) -> Segment | None:
        """Return a segment of the stream `number`; None if the device has not described it yet.

        In generation 1 (stream 0), the whole stream is one segment.
        """
        if number:
            return self._segments.get((number, segment))
        _, timebase, period = self._streams.get(0, ((), -1, 0))
        if timebase not in self._timebases:
            return None
        return Segment(0, 0, self._timebases[timebase] * period)

    def _unwrap(self, segment: int, number: int, wrap: int) -> int:
        """Return the sample number within `segment` after unwrapping: `number` plus a multiple of `wrap`."""
        last_segment, last, turns = self._last
        if segment != last_segment:
            turns = 0
        elif last - number > wrap // 2:
            turns += 1
        self._last = segment, number, turns
        return number + turns * wrap

    def _parts(self, number: int) -> list[tuple[StreamColumn, ...]] | None:
        """Return the columns of each part of a stream's samples; None if a part is not described yet."""
        parts = []
        for part in self._streams.get(number, ((), 0, 1))[0]:
            column = self._columns.get((number, part))
            columns = (column,) if column is not None else ()
            parts.append(columns if number else self._sources.get(part, ()))
        return parts if parts and all(parts) else None

    def _layout(self, parts: list[tuple[StreamColumn, ...]]) -> SampleLayout | None:
        """Return the layout of samples with the given parts; None if they lack a configured channel."""
        columns = [column for part in parts for column in part]
        names = [column.name for column in columns]
        if not set(self._options.columns) <= set(names):
            return None
        wanted = [names.index(name) for name in self._options.columns]
        if self._options.temperature in names:
            wanted.append(names.index(self._options.temperature))
        scale = NT_PER_UNIT.get(self._options.unit or columns[wanted[0]].unit)
        if scale is None or any(columns[index].type not in TYPE_FORMATS for index in wanted):
            raise ValueError
        offsets = [0, *accumulate(column.type >> 4 for column in columns)]
        fields = [(offsets[index], Struct(f"<{TYPE_FORMATS[columns[index].type]}")) for index in wanted]
        sizes = [offsets[end] for end in accumulate(len(part) for part in parts)]
        return SampleLayout(fields, offsets[max(wanted) + 1], sizes, scale)


def unslip(frame: bytes) -> bytes:
    """Return the packet in a SLIP frame, followed by its CRC-32."""
    return frame.replace(b"\xdb\xdc", b"\xc0").replace(b"\xdb\xdd", b"\xdb")


def slip(packet: bytes) -> bytes:
    """Return the SLIP frame of a packet, with its CRC-32 and delimiter."""
    packet += crc32(packet).to_bytes(4, "little")
    return packet.replace(b"\xdb", b"\xdb\xdd").replace(b"\xc0", b"\xdb\xdc") + END


def pack(kind: int, payload: bytes, routing: bytes = b"") -> bytes:
    """Return a packet of the type `kind`; `routing` has the port numbers to the device, last hop first."""
    return TIO_HEADER.pack(kind, len(routing), len(payload)) + payload + routing


def _columns(text: bytes, channels: int, code: int) -> tuple[StreamColumn, ...]:
    """Return the columns of a source, with names of the form ``source.column``.

    `text`: name, columns, title and unit of the source, separated by tabs.
    `channels`, `code`: number of columns, and their data type.
    """
    texts = [*text.decode("utf-8", "replace").split("\t"), "", "", ""]
    name, unit, names = texts[0], texts[3], texts[1].split(",")
    if channels == 1 or len(names) != channels:
        return (StreamColumn(name, unit, code),) * min(channels, 128)
    return tuple(StreamColumn(f"{name}.{column}", unit, code) for column in names)
