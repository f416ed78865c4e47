"""A sensor on an I2C or SPI bus, polled by a thread, as a port."""

from __future__ import annotations

import os
import re
import threading
import time
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from magbridge.bridge.port import READ_BYTES, Port
from magbridge.bridge.serial_port import SerialPort, serial_line
from magbridge.config import Sensor
from magbridge.errors import ConfigError, PortError
from magbridge.sensors import open_driver
from magbridge.sensors.rm3100 import Bus, Rm3100

__all__ = ["BusPort", "open_bus", "sensor_port"]

BUS_ADDRESS = re.compile(r"i2c:(\d+):(0x[0-9a-fA-F]{1,2}|\d{1,3})|spi:(\d+)\.(\d+)")
SPI_HZ = 1_000_000
MAX_ERRORS = 5
"""Errors of the bus in a row after which the port is lost, and opened again."""
MIN_SILENCE_S, SILENT_PERIODS = 0.5, 8
"""A part that completes no measurement for that long is configured again."""
FROZEN_READINGS = 200
"""Equal readings in a row after which the part is configured again: noise changes the last bits."""


class I2cBus:
    """Registers of a part on an I2C bus."""

    def __init__(self, number: int, address: int) -> None:
        self._bus: Any = import_module("smbus2").SMBus(number)
        self._address = address

    def read(self, register: int, count: int) -> bytes:
        """Return `count` bytes from `register` on."""
        return bytes(self._bus.read_i2c_block_data(self._address, register, count))

    def write(self, register: int, data: bytes) -> None:
        """Write bytes from `register` on."""
        self._bus.write_i2c_block_data(self._address, register, list(data))

    def close(self) -> None:
        """Close the bus."""
        self._bus.close()


class SpiBus:
    """Registers of a part on an SPI bus; bit 7 of the address reads."""

    def __init__(self, number: int, select: int) -> None:
        self._bus: Any = import_module("spidev").SpiDev()
        self._bus.open(number, select)
        self._bus.max_speed_hz, self._bus.mode = SPI_HZ, 0

    def read(self, register: int, count: int) -> bytes:
        """Return `count` bytes from `register` on."""
        return bytes(self._bus.xfer2([register | 0x80, *[0] * count])[1:])

    def write(self, register: int, data: bytes) -> None:
        """Write bytes from `register` on."""
        self._bus.xfer2([register, *data])

    def close(self) -> None:
        """Close the bus."""
        self._bus.close()


def open_bus(name: str) -> Any:
    """Return the bus of ``i2c:BUS:ADDRESS`` or ``spi:BUS.DEVICE``; OSError: it cannot be opened."""
    match = BUS_ADDRESS.fullmatch(name)
    assert match is not None
    if match[1]:
        return I2cBus(int(match[1]), int(match[2], 0))
    return SpiBus(int(match[3]), int(match[4]))


class BusPort(Port):
    """Poll a part on a bus; return the readings as lines.

    Parameters
    ----------
    name : str
        As :func:`open_bus` takes it.
    driver : Rm3100
        Configures the part and reads its registers.
    """

    def __init__(self, name: str, driver: Rm3100) -> None:
        super().__init__(name)
        self._driver = driver
        self._bus: Any = None
        self._fd = self._waker = -1
        self._thread: threading.Thread | None = None
        self._running = False
        self._reason = "the part does not answer"

    @property
    def is_open(self) -> bool:
        """True while the part is polled."""
        return self._bus is not None

    def open(self) -> None:
        """Open the bus, configure the part and start to poll it; raises :class:`PortError`."""
        bus = None
        try:
            bus = open_bus(self.name)
            self._driver.configure(bus)
        except OSError as error:
            if bus is not None:
                bus.close()
            raise PortError(self.name, error.strerror or str(error)) from error
        self._fd, self._waker = os.pipe()
        os.set_blocking(self._fd, False)
        self._running = True
        self._thread = threading.Thread(target=self._run, args=(bus,), name="bus poll", daemon=True)
        self._bus = bus
        self._thread.start()

    def move_on(self) -> None:
        """Close the port; opening it configures a silent part again."""
        self.close()

    def fds(self) -> list[int]:
        """Return the one descriptor, if open."""
        return [self._fd] if self._bus is not None else []

    def read(self) -> bytes:
        """Return the lines that have come; an end of file is a lost bus."""
        try:
            data = os.read(self._fd, READ_BYTES)
        except BlockingIOError:
            return b""
        if not data:
            raise self.lost(self._reason)
        return data

    def write(self, data: bytes) -> None:
        """Drop the bytes: the part accepts no commands from the pipeline."""

    def close(self) -> None:
        """Stop polling and close the bus."""
        bus, self._bus, self._running = self._bus, None, False
        if bus is None:
            return
        if self._thread is not None:
            self._thread.join()
        bus.close()
        os.close(self._fd)

    def _run(self, bus: Bus) -> None:
        """Poll until the port is closed, or the bus fails `MAX_ERRORS` times in a row."""
        pause = min(self._driver.period / 4.0, 0.05)
        silence = max(MIN_SILENCE_S, SILENT_PERIODS * self._driver.period)
        errors = repeated = 0
        heard, last = time.monotonic(), b""
        try:
            while self._running and errors < MAX_ERRORS:
                now = time.monotonic()
                try:
                    if now - heard > silence or repeated > FROZEN_READINGS:
                        heard, repeated = now, 0
                        self._driver.configure(bus)
                    line = self._driver.poll(bus, now)
                    errors = 0
                except OSError as error:
                    errors, line = errors + 1, b""
                    self._reason = error.strerror or str(error)
                if line:
                    results = line.rpartition(b",")[2]
                    heard, repeated, last = now, repeated + 1 if results == last else 0, results
                    os.write(self._waker, line)
                time.sleep(pause)
        finally:
            with suppress(OSError):
                os.close(self._waker)  # the reader sees an end of file: the port is lost


def sensor_port(sensor: Sensor, path: Path) -> SerialPort | BusPort:
    """Return the (unopened) port of a sensor in the configuration `path`: a serial line, or a part on a bus.

    Raises
    ------
    ConfigError
        A name that is neither, a driver that does not read a bus, or a library that is not installed.
    """
    source, key = str(path), sensor.key
    if not sensor.port.startswith(("i2c:", "spi:")):
        return serial_line(sensor.port, sensor.baudrate, source, f"{key}.port")
    if not BUS_ADDRESS.fullmatch(sensor.port):
        expected = "expected i2c:BUS:ADDRESS such as i2c:1:0x20, or spi:BUS.DEVICE such as spi:0.0"
        raise ConfigError(source, f"{key}.port", f"{expected}, got {sensor.port!r}")
    driver = open_driver(sensor.driver, sensor.options, source, key)
    if not isinstance(driver, Rm3100):
        raise ConfigError(source, f"{key}.driver", f"expected rm3100 on a bus, got {sensor.driver!r}")
    library = "smbus2" if sensor.port.startswith("i2c:") else "spidev"
    if find_spec(library) is None:
        raise ConfigError(source, f"{key}.port", f"{library} is not installed: pip install 'magbridge[bus]'")
    return BusPort(sensor.port, driver)
