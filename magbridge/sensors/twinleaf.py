"""``twinleaf``: vector magnetometers that send TIO (the packets: :mod:`magbridge.sensors.tio`)."""

from __future__ import annotations

import struct
from itertools import accumulate
from math import nan
from operator import itemgetter
from typing import Annotated, Any, ClassVar, NamedTuple
from zlib import crc32

import msgspec
from msgspec import Meta

from magbridge.columns import NT_PER_UNIT
from magbridge.records import MAX_MEASURED_NT, Reading
from magbridge.sensors import tio
from magbridge.sensors.framing import CRC32_RESIDUE, Framer, saturated

__all__ = ["Twinleaf", "TwinleafOptions"]

SEND_ALL, METADATA = 1, 2
"""Numbers of our two requests."""
WRAP_1, WRAP_2 = 1 << 32, 1 << 24
"""Where the sample numbers of the two generations wrap."""
MAX_DESCRIPTORS = 256
"""Descriptors of each kind that are kept at most."""


class TwinleafOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[sensor.options]`` of a TIO device."""

    columns: tuple[str, str, str] = ("vector.x", "vector.y", "vector.z")
    """The three channels, as the device calls them."""
    temperature: str = ""
    """The column with the temperature in degC, if there is one."""
    unit: str | None = None
    """Unit of the channels, instead of the one that the device states."""
    route: Annotated[str, Meta(pattern=r"^/?(\d+(/\d+)*/?)?$")] = "/"
    """Which device of a tree, as in ``/0/2``."""
    range: Annotated[float, Meta(gt=0)] = 100_000.0
    """nT at which a channel saturates."""

    def __post_init__(self) -> None:
        if self.unit is not None and self.unit not in NT_PER_UNIT:
            raise ValueError(f"unit: expected one of {' '.join(NT_PER_UNIT)}")
        hops = self.hops()
        if len(hops) > tio.MAX_ROUTING or max(hops, default=0) > 255:
            raise ValueError(f"route: expected at most {tio.MAX_ROUTING} numbers up to 255")

    def hops(self) -> list[int]:
        """Return the port numbers on the way from the root to the device."""
        return [int(hop) for hop in self.route.split("/") if hop]


class _Row(NamedTuple):
    """How a sample is read: `pick` takes channels and temperature from what `fields` unpacks.

    `size` is the length of a whole sample in bytes, `sizes` the lengths at which it may end, after any part.
    """

    sizes: frozenset[int]
    size: int
    fields: struct.Struct
    pick: Any
    scale: float


class Twinleaf:
    """Parser of a TIO device, of either generation.

    ``Reading.power_cycle`` is the session number of the device, which differs after every power-on.
    ``Reading.sequence`` counts the samples, through all segments.
    """

    Options: ClassVar = TwinleafOptions
    sequence_modulo = WRAP_1
    time_modulo = 0.0
    period = 0.0
    nt_per_count = 0.0

    def __init__(self, options: TwinleafOptions) -> None:
        self._options = options
        self._routing = bytes(reversed(options.hops()))
        self.range_nt = options.range
        self._framer = Framer(tio.END, tio.MAX_FRAME_BYTES)
        self.frames_bad = 0
        self._session: int | None = None
        self._timebases: dict[int, float] = {}
        self._sources: dict[int, tuple[tio.StreamColumn, ...]] = {}
        self._streams: dict[int, tio.StreamLayout] = {}
        self._columns: dict[tuple[int, int], tio.StreamColumn] = {}
        self._segments: dict[tuple[int, int], tio.Segment] = {}
        self._rows: dict[int, _Row | None] = {}
        self._last: tuple[int, int, int] = (0, 0, 0)

    @property
    def bytes_skipped(self) -> int:
        """Bytes that belonged to no valid frame, or to samples of the wanted stream not yet described."""
        return self._framer.skipped

    def start(self) -> tuple[bytes, ...]:
        """Return a heartbeat, and the two generations' requests for descriptors."""
        packets = (
            tio.pack(tio.HEARTBEAT, b"", self._routing),
            tio.request(SEND_ALL, "data.send_all", self._routing),
            tio.request(METADATA, "dev.metadata", self._routing),
        )
        return (tio.END + b"".join(map(tio.slip, packets)),)

    def feed(self, data: bytes) -> list[Reading]:
        """Process received bytes; return the readings that they complete."""
        readings: list[Reading] = []
        for frame in self._framer.split(data):
            try:
                kind, payload = self._open(frame)
                if kind >= tio.STREAM_TYPE:
                    readings += self._samples(kind - tio.STREAM_TYPE, payload)
                else:
                    self._describe(kind, payload)
            except (ValueError, IndexError, struct.error):
                self.frames_bad += 1
                self._framer.skipped += len(frame)
        return readings

    def _open(self, frame: bytes) -> tuple[int, bytes]:
        """Return type and payload of a packet, the type 0 where it is another device's.

        ValueError: the packet is damaged.
        """
        packet = tio.unslip(frame)
        if crc32(packet) != CRC32_RESIDUE:
            raise ValueError
        kind, routing, length = tio.TIO_HEADER.unpack_from(packet)
        end = 4 + length
        if len(packet) != end + (routing & 0x0F) + 4:
            raise ValueError
        return (kind if packet[end:-4] == self._routing else 0), packet[4:end]

    def _describe(self, kind: int, payload: bytes) -> None:
        """Take a packet that is not samples."""
        if kind == tio.METADATA:
            self._record(payload[0], payload[2:])
        elif kind == tio.RPC_REPLY and int.from_bytes(payload[:2], "little") == METADATA:
            at = 2
            while at + 1 < len(payload):
                self._record(payload[at], payload[at + 2 : at + 2 + payload[at + 1]])
                at += 2 + payload[at + 1]
        elif kind == tio.HEARTBEAT and len(payload) == 4:
            self._session = int.from_bytes(payload, "little")
        elif kind == tio.TIMEBASE:
            self._remember(self._timebases, *tio.timebase(payload))
        elif kind == tio.SOURCE:
            self._remember(self._sources, *tio.source(payload))
        elif kind == tio.STREAM:
            self._remember(self._streams, *tio.stream(payload))

    def _record(self, kind: int, record: bytes) -> None:
        """Take a record of generation 2."""
        if kind == tio.DEVICE_RECORD:
            self._session = int.from_bytes(record[2:6], "little")
        elif kind == tio.STREAM_RECORD:
            self._remember(self._streams, *tio.stream_record(record))
        elif kind == tio.COLUMN_RECORD:
            self._remember(self._columns, *tio.column(record))
        elif kind == tio.SEGMENT_RECORD:
            self._remember(self._segments, *tio.segment(record))

    def _remember(self, table: dict[Any, Any], key: Any, value: Any) -> None:
        if table.get(key) != value:
            if len(table) >= MAX_DESCRIPTORS:
                table.clear()
            table[key] = value
            self._rows.clear()

    def _samples(self, number: int, payload: bytes) -> list[Reading]:
        """Return the readings in a packet of samples of the stream `number`."""
        if number not in self._rows:
            parts = self._described(number)
            if parts is None:
                self._framer.skipped += len(payload)
                return []
            self._rows[number] = self._compile(parts)
        row = self._rows[number]
        if row is None:
            return []
        timing = self._timing(number, payload)
        if timing is None:
            self._framer.skipped += len(payload)
            return []
        first, begin, zero, period = timing
        count, rest = divmod(len(payload) - 4, row.size)
        if rest:
            if len(payload) - 4 not in row.sizes:
                raise ValueError
            count = int(len(payload) - 4 >= row.fields.size)
        readings = []
        for n in range(first, first + count):
            values = row.pick(row.fields.unpack_from(payload, 4 + (n - first) * row.size))
            x, y, z = values[0] * row.scale, values[1] * row.scale, values[2] * row.scale
            temperature = values[3] if len(values) == 4 else nan
            if (
                not abs(x) + abs(y) + abs(z) < MAX_MEASURED_NT or abs(temperature) > MAX_MEASURED_NT
            ):  # also NaN
                self.frames_bad += 1
                self._framer.skipped += row.fields.size
                continue
            readings.append(
                Reading(
                    (x, y, z),
                    sequence=(zero + n) % WRAP_1,
                    device_time=begin + n * period,
                    temperature=temperature,
                    power_cycle=self._session,
                    saturated=saturated(x, y, z, self.range_nt),
                )
            )
        return readings

    def _timing(self, number: int, payload: bytes) -> tuple[int, int, int, float] | None:
        """Return a packet's first sample number, and its segment's start (s), number and period (s)."""
        if len(payload) < 4:
            raise ValueError
        first = int.from_bytes(payload[:4], "little")
        if number == 0:
            stream = self._streams[0]
            return self._unwrap(0, first, WRAP_1), 0, 0, self._timebases[stream.timebase] * stream.period
        segment = self._segments.get((number, first >> 24))
        if segment is None:
            return None
        zero = segment.start * segment.rate // segment.decimation
        first = self._unwrap(first >> 24, first % WRAP_2, WRAP_2)
        return first, segment.start, zero, segment.decimation / segment.rate

    def _unwrap(self, key: int, number: int, wrap: int) -> int:
        """Return the sample number with its wraps within the segment undone."""
        last_key, last, turns = self._last
        if key != last_key:
            turns = 0
        elif last - number > wrap // 2:
            turns += 1
        self._last = key, number, turns
        return number + turns * wrap

    def _described(self, number: int) -> list[tuple[tio.StreamColumn, ...]] | None:
        """Return the parts of a stream's samples, each with its columns; None where not all are known yet."""
        stream = self._streams.get(number)
        if stream is None or (number == 0 and stream.timebase not in self._timebases):
            return None
        if number == 0:
            sources = [self._sources.get(part) for part in stream.parts]
            return [source for source in sources if source is not None] if all(sources) else None
        columns = [self._columns.get((number, part)) for part in stream.parts]
        return [(column,) for column in columns if column is not None] if all(columns) else None

    def _compile(self, parts: list[tuple[tio.StreamColumn, ...]]) -> _Row | None:
        """Return how to read samples of these parts; None where our channels are not among them."""
        columns = [column for part in parts for column in part]
        names = [column.name for column in columns]
        if not set(self._options.columns) <= set(names):
            return None
        wanted = [names.index(name) for name in self._options.columns]
        if self._options.temperature in names:
            wanted.append(names.index(self._options.temperature))
        scale = NT_PER_UNIT.get(self._options.unit or columns[wanted[0]].unit)
        if scale is None or any(columns[index].type not in tio.TYPE_FORMATS for index in wanted):
            raise ValueError
        offsets = [0, *accumulate(column.type >> 4 for column in columns)]
        text, at = "<", 0
        for index in sorted(wanted):
            text += f"{offsets[index] - at}x{tio.TYPE_FORMATS[columns[index].type]}"
            at = offsets[index + 1]
        ends = accumulate(len(part) for part in parts)
        return _Row(
            frozenset(offsets[end] for end in ends),
            offsets[-1],
            struct.Struct(text),
            itemgetter(*(sorted(wanted).index(index) for index in wanted)),
            scale,
        )
