"""A TIO device of either generation, its samples 32-bit floats as the VMR's."""

from __future__ import annotations

from fractions import Fraction
from struct import pack
from zlib import crc32

from magbridge.columns import NT_PER_UNIT
from magbridge.records import Reading
from magbridge.sensors import twinleaf as tio
from magbridge.sensors.framing import CRC32_RESIDUE, Framer
from sitl.fluxgate.encoder import Encoder, clip

FLOAT32 = 0x42
STREAM = {1: 0, 2: 1}
"""The stream that holds the field, in each generation."""


class TwinleafEncoder(Encoder):
    """A TIO device; set `generation` before its first reading to have the older one."""

    Options = tio.TwinleafOptions
    generation = 2

    def power_on(self) -> None:
        """Begin a new session; describe it before its first reading."""
        super().power_on()
        options = self.options
        self._rate = Fraction(self.rate).limit_denominator(1000)
        self._routing = bytes(reversed(options.hops()))
        self._columns = [*options.columns, *([options.temperature] if options.temperature else [])]
        self._unit = options.unit or "nT"
        self._frames = Framer(tio.END, tio.MAX_FRAME_BYTES)
        self._described = False

    def encode(self, reading: Reading) -> bytes:
        """Return one packet of one sample, its number the time times the rate."""
        number = round(reading.device_time * self._rate)
        limit = self.options.range
        values = [clip(value, limit) / NT_PER_UNIT[self._unit] for value in reading.field]
        if self.options.temperature:
            values.append(reading.temperature)
        if self.generation == 1:
            header = (number % tio.WRAP_1).to_bytes(4, "little")
        else:
            header = (number % tio.WRAP_2).to_bytes(3, "little") + bytes([self.power_cycle % 256])
        samples = header + b"".join(pack("<f", value) for value in values)
        packet = self._slip(tio.STREAM_TYPE + STREAM[self.generation], samples)
        if self._described:
            return packet
        self._described = True
        heartbeat = self._slip(tio.HEARTBEAT, self.power_cycle.to_bytes(4, "little"))
        return tio.END + heartbeat + self._describe() + packet

    def feed(self, data: bytes) -> bytes:
        """Answer requests."""
        answers = b""
        for frame in self._frames.split(data):
            packet = tio.unslip(frame)
            if crc32(packet) != CRC32_RESIDUE:
                continue
            kind, _, length = tio.TIO_HEADER.unpack_from(packet)
            if kind != tio.RPC_REQUEST or packet[4 + length : -4] != self._routing:
                continue
            number, size = tio.RPC_HEADER.unpack_from(packet, 4)
            method = packet[8 : 8 + size % 0x8000]
            reply = number.to_bytes(2, "little")
            if method == b"dev.metadata" and self.generation == 2:
                records = b"".join(bytes([kind, len(record)]) + record for kind, record in self._records())
                answers += self._slip(tio.RPC_REPLY, reply + records)
            elif method == b"data.send_all" and self.generation == 1:
                answers += self._describe() + self._slip(tio.RPC_REPLY, reply)
            else:
                not_found = (2).to_bytes(2, "little")
                answers += self._slip(tio.RPC_ERROR, reply + not_found)
        return answers

    def _slip(self, kind: int, payload: bytes) -> bytes:
        return tio.slip(tio.pack(kind, payload, self._routing))

    def _describe(self) -> bytes:
        """Return the packets that describe the contents of a sample."""
        if self.generation == 2:
            return b"".join(
                self._slip(tio.METADATA, bytes([kind, 0]) + record) for kind, record in self._records()
            )
        numerator, denominator = self._rate.denominator * 1_000_000, self._rate.numerator
        name = self._columns[0].partition(".")[0]
        axes = ",".join(column.rpartition(".")[2] for column in self._columns[:3])
        sources = [(f"{name}\t{axes}\t{name}\t{self._unit}", 3)]
        sources += [(f"{column}\t\t{column}\tC", 1) for column in self._columns[3:]]
        packets = self._slip(
            tio.TIMEBASE, tio.TIMEBASE_HEADER.pack(0, 1, 1, 0, numerator, denominator, 1, 0.0) + bytes(16)
        )
        components = b""
        for number, (text, channels) in enumerate(sources):
            header = tio.SOURCE_HEADER.pack(number, 0, 1, 0, 0, 0, channels, FLOAT32)
            packets += self._slip(tio.SOURCE, header + text.encode())
            components += tio.COMPONENT.pack(number, 0, 1, 0)
        return packets + self._slip(
            tio.STREAM, tio.STREAM_HEADER.pack(0, 0, 1, 0, 0, len(sources), 0) + components
        )

    def _records(self) -> list[tuple[int, bytes]]:
        """Return the records of generation 2, each with its type."""
        session, stream = self.power_cycle, STREAM[2]
        size, active = 4 * len(self._columns), 3
        records = [
            (tio.DEVICE_RECORD, tio.DEVICE_HEADER.pack(tio.DEVICE_HEADER.size, 0, session, 0, 0, 1)),
            (
                tio.STREAM_RECORD,
                tio.STREAM_RECORD_HEADER.pack(
                    tio.STREAM_RECORD_HEADER.size, stream, len(self._columns), 1, size, 0, 0
                ),
            ),
            (
                tio.SEGMENT_RECORD,
                tio.SEGMENT_HEADER.pack(
                    tio.SEGMENT_HEADER.size, stream, session % 256, active, 1, 0, session, 0,
                    self._rate.numerator, self._rate.denominator, 0.0, 0,
                ),
            ),
        ]  # fmt: skip
        for index, name in enumerate(self._columns):
            unit = self._unit if index < 3 else "C"
            header = tio.COLUMN_HEADER.pack(
                tio.COLUMN_HEADER.size, stream, index, FLOAT32, len(name), len(unit), 0
            )
            records.append((tio.COLUMN_RECORD, header + name.encode() + unit.encode()))
        return records
