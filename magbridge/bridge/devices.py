"""Ports to devices of this computer: serial lines, and parts on an I2C or SPI bus."""

from __future__ import annotations

import glob
import os
import re
import select
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from math import inf
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import serial

from magbridge.bridge.port import READ_BYTES, PacedPort, Port, reason_of
from magbridge.config import Sensor
from magbridge.errors import ConfigError
from magbridge.sensors import Bus, open_driver
from magbridge.sensors.framing import BusDriver

__all__ = ["BusPort", "SerialPort", "may_be_device", "sensor_port", "serial_line"]

MAX_READ_BYTES = 4095
"""Most bytes that one read of a terminal device returns, however many are waiting."""
BACKLOG_WAIT_S = 0.02
"""Time within which the next piece of a backlog is readable, even on a busy computer, s."""

LEAD = 0.05
"""Time on the line of the bytes that are written to the system at once, s."""
LINE_BUFFER_BYTES = 20_000
"""Bytes in the full buffer of a line that does not report its fill level, such as a pseudo-terminal."""


class SerialPort(PacedPort):
    """Port on a serial line, given by device name, pattern (``/dev/ttyUSB*``) or pyserial URL."""

    def __init__(self, name: str, baudrate: int) -> None:
        super().__init__(name, round(baudrate / 10 * LEAD))
        self.baudrate = baudrate
        self._last = self._passed = ""
        self._idle_at = -inf
        self._serial: Any = None
        self._pump: Pump | None = None

    def _open(self) -> int:
        """Open the first device of the name or pattern that can be opened."""
        failure: Exception = OSError("no such device")
        for name in self._names():
            try:
                opened = serial.serial_for_url(
                    name, self.baudrate, timeout=0, write_timeout=0, do_not_open=True
                )
                # two programs on one line would each read only some of the bytes
                opened.exclusive = None if "://" in name else True
                opened.open()
            except (OSError, ValueError) as error:
                failure = error
                continue
            self._serial, self._last = opened, name
            with suppress(AttributeError, OSError):  # loop:// and rfc2217:// have no descriptor
                return int(opened.fileno())
            opened.timeout, opened.write_timeout = 0.05, 1.0
            self._pump = Pump(lambda: self._serial.read(max(1, self._serial.in_waiting)))
            return self._pump.fd
        raise failure

    def move_on(self) -> None:
        """Close the device if the pattern matches further devices, so that the next one is opened."""
        if len(self._names()) > 1:
            self._passed = self._last
            self.close()

    def _names(self) -> list[str]:
        """Return the devices that match the name, beginning after the device that :meth:`move_on` left."""
        if not glob.has_magic(self.name):
            return [self.name]
        found = glob.glob(self.name)  # noqa: PTH207 - it may be absolute, which pathlib does not glob
        return sorted(found, key=lambda name: (name <= self._passed, name))

    def read(self) -> bytes:
        """Return the received bytes; raise :class:`PortError` at an end of file or an error on the line.

        A backlog is returned as a whole, because the time of arrival of its last reading dates all of them if
        the instrument has no clock.
        """
        data = super().read()
        return data if len(data) < MAX_READ_BYTES else data + self._backlog()

    def _backlog(self) -> bytes:
        """Return the bytes that wait after a first piece; the next :meth:`read` reports an error."""
        data = b""
        with suppress(OSError):
            while len(data) < READ_BYTES and select.select([self._fd], [], [], BACKLOG_WAIT_S)[0]:
                piece = os.read(self._fd, READ_BYTES)
                if not piece:
                    break
                data += piece
        return data

    def blocked(self) -> list[int]:
        """Return the descriptor; none for a line paced by its baud rate, which is always writable."""
        return super().blocked() if self._idle_at == -inf else []

    def _room(self) -> bool:
        """Return True if the system reports the line as writable, with less than 256 bytes waiting.

        A pseudo-terminal does not report waiting bytes and is writable until it is full. Once it was full, it
        gets no more bytes than its baud rate transmits.
        """
        if self._pump is not None:
            return True
        now = time.monotonic()
        if self._idle_at > now + LEAD:
            return False
        room = bool(select.select([], [self._fd], [], 0)[1])
        with suppress(OSError):  # the device was just unplugged: the next write fails
            if not room and getattr(self._serial, "out_waiting", -1) == 0:
                self._idle_at = now + LINE_BUFFER_BYTES * 10 / self.baudrate
        return room

    def _put(self, data: bytes | bytearray) -> int:
        if self._pump is not None:
            try:
                self._serial.write(data)
            except OSError as error:
                raise self.lost(reason_of(error)) from error
            return len(data)
        sent = super()._put(data)
        if self._idle_at > -inf:
            self._idle_at = max(self._idle_at, time.monotonic()) + sent * 10 / self.baudrate
        return sent

    def close(self) -> None:
        """Close the device."""
        if self._pump is not None:
            self._pump.close()
        if self._serial is not None:
            self._serial.close()
        self._serial, self._fd, self._pump, self._idle_at = None, -1, None, -inf
        self._forget()


def serial_line(name: str, baudrate: int, source: str, key: str) -> SerialPort:
    """Return the (unopened) port of a serial line.

    `name`: a device, a pattern or a pyserial URL.
    `baudrate`: bits per second.
    `source`, `key`: file and key that contain `name`, for the error.
    ConfigError: the name cannot be a device's, pyserial does not know the kind of URL, or the URL of a socket
        lacks HOST:PORT.
    """
    kind, url, _ = name.partition("://")
    known = kind.isalnum() and find_spec(f"serial.urlhandler.protocol_{kind.lower()}")
    if not (known if url else may_be_device(name)):
        expected = "expected a device (/dev/...), socket://, rfc2217:// or loop://"
        raise ConfigError(source, key, f"{expected}, got {name!r}")
    if kind in ("socket", "rfc2217"):
        try:
            whole = urlsplit(name).hostname and urlsplit(name).port
        except ValueError:
            whole = None
        if not whole:
            raise ConfigError(source, key, f"expected {kind}://HOST:PORT, got {name!r}")
    return SerialPort(name, baudrate)


def may_be_device(name: str) -> bool:
    """Return True if a serial device has this name, or if a device could get this name later."""
    path = Path(name)
    if path.exists():
        return not (path.is_file() or path.is_dir())
    return "/" in name or os.name == "nt"  # names on Windows, such as COM3, have no slash


class Pump:
    """Thread that writes received bytes to a pipe, for a port without a file descriptor.

    `read`: returns received bytes, or raises OSError when the port is lost.
    `failed`: function that is called with the reason of an OSError of `read`.
    `fd`: descriptor of the pipe's reading end, which reports an end of file after an OSError of `read`.
    """

    def __init__(self, read: Callable[[], bytes], failed: Callable[[str], object] = str) -> None:
        self._read, self._failed = read, failed
        self.fd, self._in = os.pipe()
        os.set_blocking(self.fd, False)
        self._running = True
        self._thread = threading.Thread(target=self._run, name="pump", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            while self._running:
                if data := self._read():
                    os.write(self._in, data)
        except OSError as error:  # includes pyserial's SerialException
            self._failed(error.strerror or str(error))
        finally:
            os.close(self._in)

    def close(self) -> None:
        """End the thread and close the pipe."""
        self._running = False
        self._thread.join()
        os.close(self.fd)


BUS_ADDRESS = re.compile(r"i2c:(\d+):(0x[0-9a-fA-F]{1,2}|\d{1,3})|spi:(\d+)\.(\d+)")
SPI_HZ = 1_000_000
MAX_ERRORS = 5
"""Number of bus errors in a row after which the port counts as lost and is opened again."""
MIN_SILENCE_S, SILENT_PERIODS = 0.5, 8
"""Time (s) and number of measurement periods without a reading after which the part is configured again. The
longer of the two counts."""
FROZEN_READINGS = 200
"""Most equal readings in a row before the part is configured again; noise normally changes the last bits."""


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
    """Registers of a part on an SPI bus; bit 7 of the register address selects reading."""

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
    """Return the opened bus of ``i2c:BUS:ADDRESS`` or ``spi:BUS.DEVICE``; OSError: it cannot be opened."""
    match = BUS_ADDRESS.fullmatch(name)
    assert match is not None
    if match[1]:
        return I2cBus(int(match[1]), int(match[2], 0))
    return SpiBus(int(match[3]), int(match[4]))


class BusPort(Port):
    """Port that polls a part on a bus and returns its readings as lines of text.

    `name`: ``i2c:BUS:ADDRESS`` or ``spi:BUS.DEVICE``.
    `driver`: configures the part and reads its registers.
    """

    def __init__(self, name: str, driver: BusDriver) -> None:
        super().__init__(name, ended="the part does not answer")
        self._driver = driver
        self._bus: Any = None
        self._pump: Pump | None = None
        self._pause_s = min(driver.period / 4.0, 0.05)
        self._silence_s = max(MIN_SILENCE_S, SILENT_PERIODS * driver.period)
        self._errors = self._repeated = 0
        self._heard, self._last = 0.0, b""

    def _open(self) -> int:
        """Open the bus, configure the part and start to poll it."""
        bus = open_bus(self.name)
        try:
            self._driver.configure(bus)
        except OSError:
            bus.close()
            raise
        self._bus, self._heard = bus, time.monotonic()
        self._errors = self._repeated = 0
        self._pump = Pump(partial(self._poll, bus), self._give_up)
        return self._pump.fd

    def _send(self, data: bytes, address: Any) -> None:
        """Drop `data`, because the part accepts no commands from the pipeline."""

    def close(self) -> None:
        """Stop polling and close the bus."""
        pump, bus, self._pump, self._bus, self._fd = self._pump, self._bus, None, None, -1
        if pump is not None and bus is not None:
            pump.close()
            bus.close()

    def _give_up(self, reason: str) -> None:
        """Set `reason`, for which the bus failed, as the reason of the port's loss."""
        self._ended = reason

    def _poll(self, bus: Bus) -> bytes:
        """Wait a short time, then return the line of a new reading, or nothing if none is complete.

        Configure a silent or frozen part again. Raise OSError if the bus fails `MAX_ERRORS` times in a row.
        """
        time.sleep(self._pause_s)
        now = time.monotonic()
        try:
            if now - self._heard > self._silence_s or self._repeated > FROZEN_READINGS:
                self._heard, self._repeated = now, 0
                self._driver.configure(bus)
            line = self._driver.poll(bus, now)
        except OSError:
            self._errors += 1
            if self._errors == MAX_ERRORS:
                raise
            return b""
        self._errors = 0
        if line:
            results = line.rpartition(b",")[2]
            self._repeated = self._repeated + 1 if results == self._last else 0
            self._heard, self._last = now, results
        return line


def sensor_port(sensor: Sensor, path: Path) -> SerialPort | BusPort:
    """Return the (unopened) port of a sensor in the configuration `path`: a serial line, or a part on a bus.

    ConfigError: the port's name is neither, the driver is not one for this kind of port or has a wrong
        option, or the bus library is not installed.
    """
    source, key = str(path), sensor.key
    driver = open_driver(sensor.driver, sensor.options, source, key)
    if not sensor.port.startswith(("i2c:", "spi:")) and not isinstance(driver, BusDriver):
        return serial_line(sensor.port, sensor.baudrate, source, f"{key}.port")
    if not BUS_ADDRESS.fullmatch(sensor.port):
        expected = "expected i2c:BUS:ADDRESS such as i2c:1:0x20, or spi:BUS.DEVICE such as spi:0.0"
        raise ConfigError(source, f"{key}.port", f"{expected}, got {sensor.port!r}")
    if not isinstance(driver, BusDriver):
        raise ConfigError(source, f"{key}.driver", f"expected rm3100 on a bus, got {sensor.driver!r}")
    library = "smbus2" if sensor.port.startswith("i2c:") else "spidev"
    if find_spec(library) is None:
        raise ConfigError(source, f"{key}.port", f"{library} is not installed: pip install 'magbridge[bus]'")
    return BusPort(sensor.port, driver)
