"""Driver ``rm3100``: PNI's magneto-inductive magnetometer on I2C or SPI.

Facts from PNI's user manual (r07):

* Registers 0x04 to 0x09 hold the cycle counts, 0x24 to 0x2C the results; X first, high byte first.
* The gain is ``0.3671 cycle_count + 1.5`` counts per microtesla.
* Data are ready if bit 7 of 0x34 is set. Register 0x36 always reads 0x22.
* The part has no reset command. So the bridge stops the part and writes all registers again.
"""

from __future__ import annotations

from math import log2
from typing import Annotated, ClassVar, Literal

from msgspec import Meta, Struct

from magbridge.records import Reading
from magbridge.sensors import Bus
from magbridge.sensors.framing import BusDriver, wait_until

POLL, CMM, CYCLE_COUNTS, TMRC, RESULTS, BIST, STATUS = 0x00, 0x01, 0x04, 0x0B, 0x24, 0x33, 0x34
REVISION = 0x22
MEASURE_ONCE, MEASURE_ALWAYS, SELF_TEST = (POLL, b"\x70"), (CMM, b"\x71"), (BIST, b"\x8f")
FASTEST_TMRC, FASTEST_HZ, SELF_TEST_S, MAX_COUNT = 0x92, 600.0, 0.5, 0x7FFFFF
CYCLES_PER_SECOND = 29_400
"""Cycles of all three axes in 1 s: a cycle count of 200 allows 147 readings/s."""


class Rm3100Options(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[sensor.options]`` of the RM3100."""

    cycle_count: Annotated[int, Meta(ge=30, le=400)] = 200
    """Cycles of each axis; more cycles give a finer step (13.3 nT at 200) and a lower highest rate."""
    rate: Annotated[float, Meta(ge=0.1, le=600)] = 37.0
    """Readings per second; the part has 600 Hz divided by powers of two, and the nearest rate is used."""
    mode: Literal["continuous", "single"] = "continuous"
    """With ``single``, the bridge starts each measurement, so that the part uses less power."""
    self_test: bool = True
    """True to test the three coils whenever the part is configured."""

    @property
    def nt_per_count(self) -> float:
        """Field of one count, nT."""
        return 1e3 / (0.3671 * self.cycle_count + 1.5)

    def __post_init__(self) -> None:
        if self.rate > (fastest := CYCLES_PER_SECOND / self.cycle_count):
            raise ValueError(f"rate: expected at most {fastest:.0f} with cycle_count {self.cycle_count}")


class Rm3100(BusDriver):
    """Reader of the RM3100's registers, and parser of the lines in which its readings are logged."""

    Options: ClassVar = Rm3100Options
    name, results_size = b"RM3100", 9

    def __init__(self, options: Rm3100Options) -> None:
        super().__init__()
        self._options = options
        self._step = max(0, round(log2(FASTEST_HZ / options.rate)))
        self.period = 2**self._step / FASTEST_HZ
        self.nt_per_count = options.nt_per_count
        self.range_nt = MAX_COUNT * self.nt_per_count

    def configure(self, bus: Bus) -> None:
        """Stop, configure, test and start the part; OSError: it is not an RM3100, or the self-test fails."""
        _is_ready(bus)
        bus.write(CMM, bytes(1))
        bus.write(CYCLE_COUNTS, self._options.cycle_count.to_bytes(2, "big") * 3)
        bus.write(TMRC, bytes([FASTEST_TMRC + self._step]))
        if self._options.self_test:
            bus.write(*SELF_TEST)
            bus.write(*MEASURE_ONCE)
            wait_until(lambda: _is_ready(bus), SELF_TEST_S, "self-test: no measurement completes")
            passed = bus.read(BIST, 1)[0]
            bus.write(BIST, bytes(1))
            if failed := [axis for bit, axis in enumerate("xyz", 4) if not passed >> bit & 1]:
                raise OSError(f"self-test failed: {' '.join(failed)}")
        bus.write(*(MEASURE_ONCE if self._options.mode == "single" else MEASURE_ALWAYS))

    def read_results(self, bus: Bus) -> bytes:
        """Return the result registers if a measurement is complete; start the next single measurement."""
        results = bus.read(RESULTS, self.results_size) if _is_ready(bus) else b""
        if results and self._options.mode == "single":
            bus.write(*MEASURE_ONCE)
        return results

    def to_reading(self, results: bytes, time: float) -> Reading:
        """Return the reading in the nine result registers, read at `time` (s)."""
        counts = [int.from_bytes(results[i : i + 3], "big", signed=True) for i in (0, 3, 6)]
        return self.from_counts(counts, MAX_COUNT, time)


def _is_ready(bus: Bus) -> bool:
    """Return True if a measurement is complete; OSError: no RM3100 responds (0x36 does not read 0x22)."""
    status = bus.read(STATUS, 3)
    if len(status) != 3 or status[2] != REVISION:
        raise OSError(f"no RM3100 answers: expected {REVISION:#x} in register 0x36, got 0x{status[2:].hex()}")
    return bool(status[0] & 0x80)
