"""The digitizer: its frames as :mod:`magbridge.sensors.digitizer` describes them."""

from __future__ import annotations

from math import inf, isnan
from zlib import crc32

from magbridge.records import Reading
from magbridge.sensors import digitizer as wire
from magbridge.sensors.digitizer import FULL_SCALE, DigitizerOptions
from magbridge.sensors.framing import cobs_encode
from sitl.fluxgate.encoder import Encoder, clip

WRAP = 1 << 16


class DigitizerEncoder(Encoder):
    """Three channels, one converter."""

    Options = DigitizerOptions

    def encode(self, reading: Reading) -> bytes:
        """Return one frame."""
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
