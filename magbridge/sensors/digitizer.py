"""Driver ``digitizer``: a 24-bit converter of three fluxgate outputs, with a frame for small firmware.

The frame format is defined here. One frame is one reading of all three channels::

    frame = COBS(message) 00        message = 36 bytes, little-endian, no padding

====== ===== ============= =============================================================================
offset type  name          meaning
====== ===== ============= =============================================================================
0      u8    kind          1: a reading. Other kinds are skipped unless their CRC is wrong.
1      u8    length        bytes of the whole message with its CRC: 36. A later firmware may insert
                           fields before the CRC and state a greater length, at most 253.
2      u16   sequence      number of the reading since power-on, wraps at 65536
4      u16   power_cycle   number of power-ons of the instrument; stored in non-volatile memory
6      u32   time_x        µs on the instrument's clock when channel x was sampled (the middle of the
                           conversion), wraps at 2^32 (71.6 min)
10     u32   time_y        the same for channel y
14     u32   time_z        the same for channel z
18     i16   temperature   0.01 degC at the fluxgate; -32768: not measured
20     u16   supply        mV; 65535: not measured
22     u8    flags         bits 0, 1, 2: the converter or its amplifier was overloaded on x, y, z
23     i24   counts_x      two's complement; ±2^23 is ± reference voltage / gain
26     i24   counts_y
29     i24   counts_z
32     u32   crc           CRC-32 (IEEE 802.3, reflected, as zlib and Ethernet) of bytes 0 to 31
====== ===== ============= =============================================================================

COBS (Cheshire & Baker 1999) removes the zeros from the message and makes it one byte longer. So a zero on the
line is always the end of a frame, and a receiver that lost bytes is synchronised again at the next zero. On
the line a reading takes 38 bytes; 100 Hz needs 38,400 bit/s. The first byte after power-on should be a zero.

Worked example: reading 7 after the third power-on, x sampled at 1.000000 s, y 0.1 s and z 0.2 s later,
4.25 degC, 3.712 V, counts 2796203, -1048576, 5592405. The message::

    01 24 07 00 03 00 40 42 0F 00 E0 C8 10 00 80 4F 12 00
    A9 01 80 0E 00 AB AA 2A 00 00 F0 55 55 55 CC 3B C2 3C

:data:`EXAMPLE` is the frame of this message. The voltage is ``V = counts / 2^23 * reference_voltage / gain``,
and the field ``B = V / sensitivity``.
"""

from __future__ import annotations

from math import nan
from struct import Struct
from typing import Annotated, ClassVar, Final
from zlib import crc32

import msgspec
from msgspec import Meta

from magbridge.records import Reading
from magbridge.sensors.framing import CRC32_RESIDUE, FramedDriver, cobs_decode, saturated

__all__ = ["EXAMPLE", "FULL_SCALE", "Digitizer", "DigitizerOptions"]

FULL_SCALE = 1 << 23
"""Counts at the converter's reference voltage."""
Positive = Annotated[float, Meta(ge=1e-12, le=1e9)]
"""Positive number with an upper limit, because TOML allows ``inf``, which has no integer count."""


class DigitizerOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[sensor.options]`` of the digitizer."""

    sensitivity: Positive
    """Sensitivity of the fluxgate's outputs, V/nT, from its certificate (50 mV/µT is 5e-5)."""
    reference_voltage: Positive = 2.5
    """Voltage at which the converter is at full scale, V."""
    gain: Positive = 1.0
    """Gain of the amplifier between fluxgate and converter; below 1 for a divider."""
    full_scale: Positive | None = None
    """Field at which the fluxgate saturates, nT, if it saturates before the converter."""

    @property
    def nt_per_count(self) -> float:
        """Field of one count, nT."""
        return self.reference_voltage / self.gain / FULL_SCALE / self.sensitivity


EXAMPLE: Final = bytes.fromhex(
    "04 01 24 07 02 03 04 40 42 0F 04 E0 C8 10 04 80 4F 12 05"
    "A9 01 80 0E 04 AB AA 2A 01 09 F0 55 55 55 CC 3B C2 3C 00"
)
"""Frame of the worked example above, with its delimiter."""

READING: Final = 1
LENGTH: Final = 36
WRAP_US: Final = 1 << 32
HALF_WRAP_US: Final = 1 << 31
NO_TEMPERATURE: Final = -32768
NO_SUPPLY: Final = 65535
BODY: Final = Struct("<BBHHIIIhHBHbHbHb")
"""Layout of a reading's message; the 24 bits of a channel are the lower 16, and the upper 8 with the sign."""


class Digitizer(FramedDriver):
    """Parser of the digitizer's frames."""

    Options: ClassVar = DigitizerOptions
    sequence_modulo = 1 << 16
    time_modulo = WRAP_US * 1e-6

    def __init__(self, options: DigitizerOptions) -> None:
        super().__init__(b"\0", 254)
        self.nt_per_count = options.nt_per_count
        self._limit = FULL_SCALE - 1
        if options.full_scale is not None:
            self._limit = min(self._limit, int(options.full_scale / self.nt_per_count))
        self.range_nt = self._limit * self.nt_per_count

    def start(self) -> tuple[bytes, ...]:
        """Return no commands, because the instrument sends without request; keep the parser's state."""
        return ()

    def read_frame(self, frame: bytes) -> Reading | None:
        """Return the reading in a frame, None for another kind of message; ValueError: a damaged frame."""
        message = cobs_decode(frame)
        if len(message) < LENGTH or message[1] != len(message) or crc32(message) != CRC32_RESIDUE:
            raise ValueError
        if message[0] != READING:
            return None
        (
            _, _, sequence, cycle, time_x, time_y, time_z, temperature, supply, flags,
            x_low, x_high, y_low, y_high, z_low, z_high,
        ) = BODY.unpack_from(message)  # fmt: skip
        # a channel's upper 8 bits carry the sign
        x, y, z = x_low | x_high << 16, y_low | y_high << 16, z_low | z_high << 16
        scale, limit = self.nt_per_count, self._limit
        return Reading(
            (x * scale, y * scale, z * scale),
            (x, y, z),
            sequence,
            time_x * 1e-6,
            # delays modulo 2^32 µs, as differences of less than half of that
            (
                0.0,
                ((time_y - time_x + HALF_WRAP_US) % WRAP_US - HALF_WRAP_US) * 1e-6,
                ((time_z - time_x + HALF_WRAP_US) % WRAP_US - HALF_WRAP_US) * 1e-6,
            ),
            nan if temperature == NO_TEMPERATURE else temperature * 0.01,
            nan if supply == NO_SUPPLY else supply * 1e-3,
            cycle,
            flags & 7 != 0 or saturated(x, y, z, limit),
        )
