"""The RM3100: its registers behind the bus interface, and the lines of its readings."""

from __future__ import annotations

from magbridge.records import Reading
from magbridge.sensors import rm3100 as wire
from sitl.fluxgate.encoder import Encoder, clip

__all__ = ["Rm3100Encoder", "Rm3100Registers"]


class Rm3100Encoder(Encoder):
    """An RM3100 with the program that polls it."""

    Options = wire.Rm3100Options

    def encode(self, reading: Reading) -> bytes:
        """Return the line of one reading."""
        return wire.encode_line(results(reading, self.options.cycle_count), reading.device_time)


def results(reading: Reading, cycle_count: int) -> bytes:
    """Return the nine bytes of the result registers for a reading's field."""
    step = wire.nt_per_count(cycle_count)
    counts = (round(clip(value / step, wire.MAX_COUNT)) for value in reading.field)
    return b"".join(count.to_bytes(3, "big", signed=True) for count in counts)


class Rm3100Registers:
    """The part's register map, which answers as the part does in a `field` (nT) at its coils.

    If it `is_frozen`, no measurement completes until the registers are written again. If it `has_failed`, the
    bus does not answer; if it `is_absent`, an SPI bus reads zeros. `broken_axes` (bits 4 to 6) are the coils
    that fail the self-test.
    """

    def __init__(self) -> None:
        self.field = (20_000.0, -1_000.0, 45_000.0)
        self.is_frozen = self.has_failed = self.is_absent = False
        self.broken_axes = 0
        self.configured = 0
        self._registers = bytearray(0x37)
        self._registers[0x36] = wire.REVISION
        self._ready = False

    def read(self, register: int, count: int) -> bytes:
        """Return `count` bytes from `register` on."""
        self._fail()
        if self.is_absent:
            return bytes(count)
        if register == wire.STATUS:
            is_measuring = self._registers[wire.CMM] & 1 or self._ready
            self._registers[wire.STATUS] = 0x80 if is_measuring and not self.is_frozen else 0
        if register == wire.RESULTS:
            cycles = int.from_bytes(self._registers[4:6], "big")
            self._registers[0x24:0x2D] = results(Reading(self.field), cycles)
            self._ready = False
        return bytes(self._registers[register : register + count])

    def write(self, register: int, data: bytes) -> None:
        """Write bytes from `register` on, and do as the part does."""
        self._fail()
        self._registers[register : register + len(data)] = data
        if register == wire.POLL:
            self._ready = True
            if self._registers[wire.BIST] & 0x80:
                self._registers[wire.BIST] = 0x80 | (0x70 & ~self.broken_axes)
        elif register == wire.CYCLE_COUNTS:
            self.is_frozen = False
            self.configured += 1

    def close(self) -> None:
        """Release the bus."""

    def _fail(self) -> None:
        if self.has_failed:
            raise OSError(121, "Remote I/O error")
