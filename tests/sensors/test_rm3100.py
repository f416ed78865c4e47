"""Test the RM3100 driver on its registers, with the part's pitfalls and faults of the bus."""

from __future__ import annotations

import select
import time
from pathlib import Path

import pytest

from magbridge.bridge import devices
from magbridge.bridge.devices import BusPort, sensor_port
from magbridge.config import load
from magbridge.errors import ConfigError, PortError
from magbridge.records import Reading
from magbridge.sensors.rm3100 import Rm3100, Rm3100Options
from sitl.fluxgate import Rm3100Registers


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


def test_a_part_that_measures_nothing_fails_the_self_test() -> None:
    class Dead(Rm3100Registers):
        def write(self, register: int, data: bytes) -> None:
            super().write(register, data)
            self.is_frozen = True

    with pytest.raises(OSError, match="self-test: no measurement completes"):
        driver().configure(Dead())


def test_a_coil_that_fails_the_self_test_is_named() -> None:
    bus = Rm3100Registers()
    bus.broken_axes = 0x20
    with pytest.raises(OSError, match="self-test failed: y"):
        driver().configure(bus)
    driver(self_test=False).configure(bus)


def test_zeros_of_an_empty_bus_are_not_a_field() -> None:
    bus, part = Rm3100Registers(), driver()
    part.configure(bus)
    bus.is_absent = True
    with pytest.raises(OSError, match="no RM3100 answers: expected 0x22"):
        part.poll(bus, 0.0)


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
    ],
)
def test_a_wrong_bus_is_named(tmp_path: Path, port: str, name: str, text: str) -> None:
    path = tmp_path / "bridge.toml"
    source = f'[sensor]\ndriver = "{name}"\nport = "{port}"\n[link]\nurl = "udpout:127.0.0.1:1"\n'
    path.write_text(source, encoding="utf-8")
    with pytest.raises(ConfigError, match=text):
        sensor_port(load(path).sensor, path)
