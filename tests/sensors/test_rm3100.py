"""Test the RM3100 driver on its registers, with the part's pitfalls and faults of the bus."""

import select
import time
from pathlib import Path

import pytest

from magbridge.bridge import devices
from magbridge.bridge.devices import BusPort, sensor_port
from magbridge.config import load
from magbridge.errors import ConfigError, PortError
from magbridge.records import Reading
from magbridge.sensors import rm3100
from magbridge.sensors.rm3100 import Rm3100, Rm3100Options
from sitl.fluxgate import results


class Rm3100Registers:
    """Emulated register map of an RM3100 in a `field` (nT) at its coils.

    If it `is_frozen`, no measurement completes until the registers are written again; if it `is_dead`, none
    completes at all. If it `has_failed`, the bus does not answer; if it `is_absent`, an SPI bus reads zeros.
    `broken_axes` (bits 4 to 6) are the coils that fail the self-test.
    """

    def __init__(self) -> None:
        self.field = (20_000.0, -1_000.0, 45_000.0)
        self.is_frozen = self.is_dead = self.has_failed = self.is_absent = False
        self.broken_axes = 0
        self.configured = 0
        self._registers = bytearray(0x37)
        self._registers[0x36] = rm3100.REVISION
        self._ready = False

    def read(self, register: int, count: int) -> bytes:
        """Return the `count` bytes that start at `register`."""
        self._fail()
        if self.is_absent:
            return bytes(count)
        if register == rm3100.STATUS:
            is_measuring = self._registers[rm3100.CMM] & 1 or self._ready
            is_stuck = self.is_frozen or self.is_dead
            self._registers[rm3100.STATUS] = 0x80 if is_measuring and not is_stuck else 0
        if register == rm3100.RESULTS:
            cycles = int.from_bytes(self._registers[4:6], "big")
            step = Rm3100Options(cycle_count=cycles).nt_per_count
            self._registers[0x24:0x2D] = results(Reading(self.field), step)
            self._ready = False
        return bytes(self._registers[register : register + count])

    def write(self, register: int, data: bytes) -> None:
        """Write bytes that start at `register`, and perform the action that they trigger."""
        self._fail()
        self._registers[register : register + len(data)] = data
        if register == rm3100.POLL:
            self._ready = True
            if self._registers[rm3100.BIST] & 0x80:
                self._registers[rm3100.BIST] = 0x80 | (0x70 & ~self.broken_axes)
        elif register == rm3100.CYCLE_COUNTS:
            self.is_frozen = False
            self.configured += 1

    def close(self) -> None:
        """Do nothing: there is no bus to release."""

    def _fail(self) -> None:
        if self.has_failed:
            raise OSError(121, "Remote I/O error")


def driver(**options: object) -> Rm3100:
    return Rm3100(Rm3100Options(**options))  # type: ignore[arg-type]


def read_one(part: Rm3100, bus: Rm3100Registers) -> Reading:
    (reading,) = part.feed(part.poll(bus, 1.5))
    return reading


@pytest.mark.parametrize(("cycles", "counts_per_ut"), [(50, 20.0), (100, 38.0), (200, 75.0), (400, 148.0)])
def test_the_gain_is_that_of_the_data_sheet(cycles: int, counts_per_ut: float) -> None:
    assert 1e3 / driver(cycle_count=cycles).nt_per_count == pytest.approx(counts_per_ut, rel=0.01)


@pytest.mark.parametrize("mode", ["continuous", "single"])
@pytest.mark.parametrize("cycles", [50, 200, 400])
def test_field_axes_and_sign_come_back(mode: str, cycles: int) -> None:
    bus, part = Rm3100Registers(), driver(cycle_count=cycles, rate=37.0, mode=mode)
    part.configure(bus)
    for _ in range(3):
        reading = read_one(part, bus)
        assert reading.field == pytest.approx(bus.field, abs=part.nt_per_count / 2)
    assert reading.device_time == 1.5


def test_a_wait_without_data_gives_no_reading() -> None:
    bus, part = Rm3100Registers(), driver(self_test=False, mode="single")
    part.configure(bus)
    assert part.poll(bus, 0.0)
    bus.is_frozen = True
    assert part.poll(bus, 0.1) == b""


@pytest.mark.parametrize(
    ("fault", "text"),
    [
        ({"is_dead": True}, "self-test: no measurement completes"),
        ({"broken_axes": 0x20}, "self-test failed: y"),
        ({"is_absent": True}, "no RM3100 answers: expected 0x22"),
    ],
)
def test_a_part_with_a_fault_is_not_started(fault: dict[str, int], text: str) -> None:
    bus = Rm3100Registers()
    vars(bus).update(fault)
    with pytest.raises(OSError, match=text):
        driver().configure(bus)


def test_a_rate_that_the_cycle_count_does_not_allow_is_refused() -> None:
    with pytest.raises(ValueError, match="expected at most 74"):
        driver(cycle_count=400, rate=150.0)


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> Rm3100Registers:
    made = Rm3100Registers()
    monkeypatch.setattr(devices, "open_bus", lambda _: made)
    return made


def wait_for(port: BusPort, part: Rm3100, seconds: float = 5.0) -> Reading:
    """Return the next reading of a port that comes after those that wait."""
    end, waiting = time.monotonic() + seconds, True
    while time.monotonic() < end:
        waiting &= bool(select.select(port.fds(), [], [], 0.0)[0])
        if select.select(port.fds(), [], [], 0.1)[0]:
            readings = part.feed(port.read())
            if readings and not waiting:
                return readings[-1]
    raise TimeoutError


def test_a_frozen_part_is_configured_again(bus: Rm3100Registers, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "MIN_SILENCE_S", 0.05)
    port, part = BusPort("i2c:1:0x20", driver(rate=150.0, cycle_count=100)), driver(cycle_count=100)
    port.open()
    try:
        wait_for(port, part)
        bus.is_frozen = True
        while bus.is_frozen:
            time.sleep(0.01)
        bus.field = (1_000.0, 2_000.0, -3_000.0)
        time.sleep(0.1)
        assert wait_for(port, part).field == pytest.approx(bus.field, abs=30.0)
        assert bus.configured == 2
    finally:
        port.close()


def test_a_bus_that_fails_is_a_lost_port_and_comes_back(bus: Rm3100Registers) -> None:
    port, part = BusPort("i2c:1:0x20", driver(rate=75.0)), driver()
    port.open()
    wait_for(port, part)
    bus.has_failed = True
    with pytest.raises(PortError, match="Remote I/O error"):
        wait_for(port, part)
    with pytest.raises(PortError, match="Remote I/O error"):
        port.open()
    bus.has_failed = False
    port.open()
    assert wait_for(port, part).field == pytest.approx(bus.field, abs=30.0)
    port.close()


@pytest.mark.parametrize(
    ("port", "name", "text"),
    [
        ("i2c:one", "rm3100", "expected i2c:BUS:ADDRESS"),
        ("spi:0", "rm3100", "or spi:BUS.DEVICE"),
        ("i2c:1:0x20", "ascii", "expected rm3100 on a bus"),
        ("/dev/ttyUSB0", "rm3100", "sensor.port: expected i2c:BUS:ADDRESS"),
    ],
)
def test_a_wrong_bus_is_named(tmp_path: Path, port: str, name: str, text: str) -> None:
    path = tmp_path / "bridge.toml"
    source = f'[sensor]\ndriver = "{name}"\nport = "{port}"\n[link]\nurl = "udpout:127.0.0.1:1"\n'
    path.write_text(source, encoding="utf-8")
    with pytest.raises(ConfigError, match=text):
        sensor_port(load(path).sensor, path)
