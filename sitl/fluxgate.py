"""Emulate magnetometers: each encoder sends readings in the protocol that one of the drivers reads.

An encoder quantises and saturates like the instrument, counts its readings, and answers the driver's
commands, so that a program behind a pty cannot distinguish it from the real instrument. Other packages add
encoders by an entry point in the group ``magbridge.encoders``: the driver's name, and a class like
:class:`Encoder`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from fractions import Fraction
from math import inf, isnan
from pathlib import Path
from struct import error, pack
from typing import Any, ClassVar
from zlib import crc32

from magbridge.columns import NT_PER_UNIT
from magbridge.errors import ConfigError
from magbridge.plugins import load, plugins
from magbridge.records import Reading
from magbridge.sensors import ascii as ascii_wire
from magbridge.sensors import digitizer as wire
from magbridge.sensors import hmr2300, rm3100, tio
from magbridge.sensors.digitizer import FULL_SCALE, DigitizerOptions
from magbridge.sensors.framing import Framer, cobs_encode
from magbridge.sensors.twinleaf import TwinleafOptions
from magbridge.toml import convert

__all__ = ["ENCODERS", "Encoder", "open_encoder"]


class Encoder(ABC):
    """Emulated instrument that is switched on; `options` are those of the driver that reads it.

    `rate` is the rate of the readings (Hz), for instruments that send a reading's number and not its time.
    `streaming` is True while the instrument sends readings; some instruments wait for a command.
    `power_cycle` is the number of times that it was switched on.
    """

    Options: ClassVar[Any]
    streaming = True

    def __init__(self, options: Any, rate: float = 1.0) -> None:
        self.options = options
        self.rate = rate
        self.power_cycle = 0
        self.power_on()

    def power_on(self) -> None:
        """Power-cycle the instrument: add a power cycle, and count readings from 0."""
        self.power_cycle += 1
        self.sequence = 0

    @abstractmethod
    def encode(self, reading: Reading) -> bytes:
        """Return the bytes that the instrument sends for one reading; none while it is not streaming.

        The bytes contain the reading's field (nT, finite), and its `device_time` (s since power-on),
        `channel_delay`, `temperature` and `supply` if the instrument sends these. Counters are the encoder's.
        """

    def feed(self, data: bytes) -> bytes:  # noqa: ARG002 - most instruments ignore commands
        """Pass bytes to the instrument; return its answers."""
        return b""


def clip(value: float, limit: float) -> float:
    """Return `value` clipped to the range from -`limit` to `limit`."""
    return max(-limit, min(value, limit))


# ---- line protocol, as the configuration describes it ------------------------------------------------------


class AsciiEncoder(Encoder):
    """Emulated instrument that sends each reading as a line of text."""

    Options = ascii_wire.AsciiOptions

    def encode(self, reading: Reading) -> bytes:
        """Return one line; before the first line, end any incomplete line that was sent earlier."""
        options = self.options
        end = b"\r\n" if options.terminator == "\n" else b"\r"
        before = b"" if self.sequence else end
        time = reading.device_time % options.time_modulo if options.time_modulo else reading.device_time
        values = {
            "time": time / ascii_wire.SECONDS[options.time_unit],
            "temperature": reading.temperature,
            "supply": reading.supply,
            "sequence": self.sequence % (options.sequence_modulo or inf),
            "power_cycle": self.power_cycle,
            "-": 0,
        }
        for axis, value in zip("xyz", reading.field, strict=True):
            scaled = clip(value, options.range or inf) / (options.scale * NT_PER_UNIT.get(options.unit, 1.0))
            values[axis] = round(scaled) if options.unit == "counts" else scaled
        self.sequence += 1
        cells = [f"{values[name]:.13g}" for name in options.columns if name != "*"]
        if options.keys:
            pairs = zip(options.keys, cells, strict=True)
            line = "{" + ", ".join(f'"{key}": {cell}' for key, cell in pairs) + "}"
        else:
            line = (options.separator or " ").join(cells)
        text: bytes = (options.prefix + line).encode(ascii_wire.ENCODING)
        if options.checksum:
            digits, function = ascii_wire.CHECKSUMS[options.checksum]
            text += f"*{function(text):0{digits}X}".encode()
        return before + text + end


# ---- the digitizer: its frames as its driver describes them ------------------------------------------------


WRAP = 1 << 16


class DigitizerEncoder(Encoder):
    """Emulated digitizer of three channels with one converter."""

    Options = DigitizerOptions

    def encode(self, reading: Reading) -> bytes:
        """Return the frame of one reading."""
        top, limit = FULL_SCALE - 1, self.options.full_scale or inf
        flags, counts = 0, []
        for channel, value in enumerate(reading.field):
            ideal = round(clip(value, limit) / self.options.nt_per_count)
            count = max(-top - 1, min(ideal, top))
            flags |= (count != ideal) << channel
            counts += [count & 0xFFFF, count >> 16]
        temperature, supply = reading.temperature, reading.supply
        message = wire.BODY.pack(
            wire.READING,
            wire.LENGTH,
            self.sequence % WRAP,
            self.power_cycle % WRAP,
            *(round((reading.device_time + delay) * 1e6) % wire.WRAP_US for delay in reading.channel_delay),
            wire.NO_TEMPERATURE if isnan(temperature) else round(clip(temperature, 327.0) * 100),
            wire.NO_SUPPLY if isnan(supply) else round(clip(supply, 65.0) * 1000),
            flags,
            *counts,
        )
        self.sequence += 1
        return cobs_encode(message + crc32(message).to_bytes(4, "little")) + b"\0"


# ---- HMR2300: as delivered, it sends ASCII, and only on command --------------------------------------------


STOP = b"\x1b"


class Hmr2300Encoder(Encoder):
    """Emulated HMR2300: three magnetoresistive channels, commands, ASCII or binary output."""

    Options = hmr2300.Hmr2300Options

    def power_on(self) -> None:
        """Power-cycle the instrument, which then waits for commands."""
        super().power_on()
        self.streaming = self.binary = self._enabled = False
        self._latest = (0, 0, 0)
        self._lines = Framer(b"\r", 64)

    def encode(self, reading: Reading) -> bytes:
        """Return one frame or line, or nothing if the instrument is not streaming."""
        x, y, z = (round(clip(value / hmr2300.NT_PER_COUNT, hmr2300.MAX_COUNTS)) for value in reading.field)
        self._latest = x, y, z
        return self._sample() if self.streaming else b""

    def _sample(self) -> bytes:
        if self.binary:
            return hmr2300.COUNTS_LAYOUT.pack(*self._latest) + b"\r"
        return ("  ".join(map(_comma, self._latest)) + "  \r").encode()

    def feed(self, data: bytes) -> bytes:
        """Execute commands; return the instrument's answers."""
        if STOP in data:
            self.streaming = False
            data = data.replace(STOP, b"")
        return b"".join(self._obey(line.decode("latin-1").upper()) for line in self._lines.split(data))

    def _obey(self, line: str) -> bytes:
        own, command = f"*{self.options.device:02d}", line[3:]
        if line[:3] not in (own, "*99"):
            return b"Re-enter\r"
        if command == "C":
            self.streaming = True
            return b""
        if command == "P":
            return self._sample()
        return self._set(command)

    def _set(self, command: str) -> bytes:
        """Execute a command that needs a preceding write enable; return the answer."""
        enabled, self._enabled = self._enabled, command == "WE"
        if command in ("A", "B") and enabled:
            self.binary = command == "B"
            return b"BINARY ON\r" if self.binary else b"ASCII ON\r"
        if command == "WE" or (command.startswith("R=") and enabled):
            return b"OK\r"
        known = command in ("A", "B") or command.startswith("R=")
        return b"WE_OFF\r" if known else b"Re-enter\r"


def _comma(count: int) -> str:
    """Format a count like the instrument: sign, two digits, comma, three digits, leading zeros blank."""
    return ("-" if count < 0 else " ") + f"{abs(count):,}".rjust(6)


# ---- RM3100: the lines of its readings ---------------------------------------------------------------------


class Rm3100Encoder(Encoder):
    """Emulated RM3100 with the program that polls it and prints lines."""

    Options = rm3100.Rm3100Options

    def encode(self, reading: Reading) -> bytes:
        """Return the line of one reading."""
        return rm3100.Rm3100.encode_line(results(reading, self.options.nt_per_count), reading.device_time)


def results(reading: Reading, nt_per_count: float) -> bytes:
    """Return the nine bytes of the RM3100's result registers for a reading's field."""
    counts = (round(clip(value / nt_per_count, rm3100.MAX_COUNT)) for value in reading.field)
    return b"".join(count.to_bytes(3, "big", signed=True) for count in counts)


# ---- TIO device with samples of 32-bit floats like the VMR's -----------------------------------------------


FLOAT32 = 0x42


class TwinleafEncoder(Encoder):
    """Emulated TIO device with the protocol of the second generation."""

    Options = TwinleafOptions
    stream = 1
    """Number of the stream that has the field."""

    def power_on(self) -> None:
        """Begin a new session, which the device describes before its first reading."""
        super().power_on()
        options = self.options
        self._rate = Fraction(self.rate).limit_denominator(1000)
        self._routing = bytes(reversed(options.hops()))
        self._columns = [*options.columns, *([options.temperature] if options.temperature else [])]
        self._unit = options.unit or "nT"
        self._frames = Framer(tio.END, tio.MAX_FRAME_BYTES)
        self._described = False

    def encode(self, reading: Reading) -> bytes:
        """Return one packet of one sample; the sample's number is its time multiplied by the rate."""
        number = round(reading.device_time * self._rate)
        limit = self.options.range
        values = [clip(value, limit) / NT_PER_UNIT[self._unit] for value in reading.field]
        if self.options.temperature:
            values.append(reading.temperature)
        samples = self._header(number) + b"".join(pack("<f", value) for value in values)
        packet = self._slip(tio.STREAM_TYPE + self.stream, samples)
        if self._described:
            return packet
        self._described = True
        heartbeat = self._slip(tio.HEARTBEAT, self.power_cycle.to_bytes(4, "little"))
        return tio.END + heartbeat + self._describe() + packet

    def feed(self, data: bytes) -> bytes:
        """Execute requests; return the device's replies."""
        answers = b""
        for frame in self._frames.split(data):
            try:
                kind, payload, routing = tio.unpack(frame)
            except (ValueError, error):
                continue
            if kind != tio.RPC_REQUEST or routing != self._routing or len(payload) < tio.RPC_HEADER.size:
                continue
            number, size = tio.RPC_HEADER.unpack_from(payload)
            method = payload[4 : 4 + size % 0x8000]
            reply = number.to_bytes(2, "little")
            not_found = self._slip(tio.RPC_ERROR, reply + (2).to_bytes(2, "little"))
            answers += self._answer(method, reply) or not_found
        return answers

    def _answer(self, method: bytes, reply: bytes) -> bytes:
        """Return the answer to a request, whose payload begins with `reply`; empty for an unknown request."""
        if method != b"dev.metadata":
            return b""
        records = b"".join(bytes([kind, len(record)]) + record for kind, record in self._records())
        return self._slip(tio.RPC_REPLY, reply + records)

    def _header(self, number: int) -> bytes:
        """Return the header of the sample `number`."""
        return (number % tio.WRAP_2).to_bytes(3, "little") + bytes([self.power_cycle % 256])

    def _slip(self, kind: int, payload: bytes) -> bytes:
        return tio.slip(tio.pack(kind, payload, self._routing))

    def _describe(self) -> bytes:
        """Return the packets that describe the contents of a sample."""
        return b"".join(
            self._slip(tio.METADATA, bytes([kind, 0]) + record) for kind, record in self._records()
        )

    def _records(self) -> list[tuple[int, bytes]]:
        """Return the metadata records, each with its type."""
        session, stream = self.power_cycle, self.stream
        rate, decimation = self._rate.numerator, self._rate.denominator
        segment = tio.SEGMENT_HEADER.pack(stream, session % 256, 0, rate, decimation)
        records = [
            (tio.DEVICE_RECORD, tio.DEVICE_HEADER.pack(session)),
            (tio.STREAM_RECORD, tio.STREAM_RECORD_HEADER.pack(stream, len(self._columns))),
            (tio.SEGMENT_RECORD, segment),
        ]
        for index, name in enumerate(self._columns):
            unit = self._unit if index < 3 else "C"
            header = tio.COLUMN_HEADER.pack(
                tio.COLUMN_HEADER.size, stream, index, FLOAT32, len(name), len(unit)
            )
            records.append((tio.COLUMN_RECORD, header + name.encode() + unit.encode()))
        return records


# ---- all instruments ---------------------------------------------------------------------------------------


ENCODERS: dict[str, type[Encoder]] = {
    "ascii": AsciiEncoder,
    "digitizer": DigitizerEncoder,
    "hmr2300": Hmr2300Encoder,
    "rm3100": Rm3100Encoder,
    "twinleaf": TwinleafEncoder,
}
"""Emulated instrument of each driver, by the driver's name."""


def open_encoder(
    name: str, options: Mapping[str, Any], rate: float = 1.0, source: str | Path = "bridge.toml"
) -> Encoder:
    """Return the emulated instrument that the driver called `name` reads.

    The other arguments are those of :func:`magbridge.sensors.open_driver`; `rate` is the rate of the readings
    (Hz), for instruments that send a reading's number and not its time.

    Raises
    ------
    ConfigError
        There is no such instrument, or an option is wrong.
    """
    others = {} if name in ENCODERS else plugins("magbridge.encoders")
    if name not in ENCODERS and name not in others:
        raise ConfigError(source, "sensor.driver", f"can emulate {', '.join(sorted({*ENCODERS, *others}))}")
    encoder: type[Encoder] = ENCODERS[name] if name in ENCODERS else load(others[name])
    return encoder(convert(dict(options), encoder.Options, source, "sensor.options."), rate)
