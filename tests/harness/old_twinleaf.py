"""Emulate a TIO device with the protocol of the first generation."""

from __future__ import annotations

from typing import Any

from magbridge.sensors import tio
from sitl.fluxgate import FLOAT32, TwinleafEncoder, open_encoder

__all__ = ["open_old_twinleaf"]


class OldTwinleafEncoder(TwinleafEncoder):
    """Emulated TIO device whose stream 0 has the field, and which describes its samples on request."""

    stream = 0

    def _header(self, number: int) -> bytes:
        return (number % tio.WRAP_1).to_bytes(4, "little")

    def _answer(self, method: bytes, reply: bytes) -> bytes:
        return self._describe() + self._slip(tio.RPC_REPLY, reply) if method == b"data.send_all" else b""

    def _describe(self) -> bytes:
        numerator, denominator = self._rate.denominator * 1_000_000, self._rate.numerator
        name = self._columns[0].partition(".")[0]
        axes = ",".join(column.rpartition(".")[2] for column in self._columns[:3])
        sources = [(f"{name}\t{axes}\t{name}\t{self._unit}", 3)]
        sources += [(f"{column}\t\t{column}\tC", 1) for column in self._columns[3:]]
        packets = self._slip(tio.TIMEBASE, tio.TIMEBASE_HEADER.pack(0, numerator, denominator) + bytes(16))
        components = b""
        for number, (text, channels) in enumerate(sources):
            header = tio.SOURCE_HEADER.pack(number, channels, FLOAT32)
            packets += self._slip(tio.SOURCE, header + text.encode())
            components += tio.COMPONENT.pack(number)
        return packets + self._slip(tio.STREAM, tio.STREAM_HEADER.pack(0, 0, 1, len(sources)) + components)


def open_old_twinleaf(options: dict[str, Any], rate: float) -> TwinleafEncoder:
    """Return the emulated device, with the options of the driver ``twinleaf``."""
    return OldTwinleafEncoder(open_encoder("twinleaf", options).options, rate)
