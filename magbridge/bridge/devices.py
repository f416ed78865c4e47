"""Ports that are devices of this computer: serial lines, and parts on an I2C or SPI bus."""

from __future__ import annotations

import errno
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

from magbridge.bridge.port import READ_BYTES, PacedPort, Port
from magbridge.config import Sensor
from magbridge.errors import ConfigError, PortError
from magbridge.sensors import Bus, open_driver
from magbridge.sensors.rm3100 import Rm3100

__all__ = ["BusPort", "SerialPort", "may_be_device", "sensor_port", "serial_line"]

MAX_READ_BYTES = 4095
"""Bytes that one read of a terminal device returns at most, however many are waiting."""
BACKLOG_WAIT_S = 0.02
"""s within which the next piece of a backlog can be read, even on a busy computer."""

LEAD = 0.05
"""s of the line's time that are handed to the system at once."""
LINE_BUFFER_BYTES = 20_000
"""Bytes that a line which does not say how much waits in it holds when it is full: a pseudo-terminal does."""


class SerialPort(PacedPort):
    """A serial line by device name, pattern (``/dev/ttyUSB*``) or pyserial URL."""

    def __init__(self, name: str, baudrate: int) -> None:
        super().__init__(name, round(baudrate / 10 * LEAD))
        self.baudrate = baudrate
        self._last = self._passed = ""
        self._idle_at = -inf
        self._serial: Any = None
        self._pump: Pump | None = None

    def open(self) -> None:
        """Open the first device that the name or pattern finds; raises :class:`PortError`."""
        reason: object = "no such device"
        for name in self._names():
            try:
                opened = serial.serial_for_url(
                    name, self.baudrate, timeout=0, write_timeout=0, do_not_open=True
                )
                # two programs on one line would each read only some of the bytes
                opened.exclusive = None if "://" in name else True
                opened.open()
            except (serial.SerialException, OSError, ValueError) as error:
                reason = _reason(error)
                continue
            try:
                descriptor = opened.fileno()
            except (AttributeError, OSError):  # loop:// and rfc2217:// have no descriptor
                opened.timeout, opened.write_timeout = 0.05, 1.0
                self._pump = Pump(partial(_wait_for_bytes, opened))
                descriptor = self._pump.fd
            self._serial, self._last, self._fd = opened, name, descriptor
            return
        raise PortError(self.name, str(reason))

    def move_on(self) -> None:
        """Close the device if the pattern finds others; the next one is opened then."""
        if len(self._names()) > 1:
            self._passed = self._last
            self.close()

    def _names(self) -> list[str]:
        """Return the devices that there are, beginning with the one after that which was passed over."""
        if not glob.has_magic(self.name):
            return [self.name]
        found = glob.glob(self.name)  # noqa: PTH207 - it may be absolute, which pathlib does not glob
        return sorted(found, key=lambda name: (name <= self._passed, name))

    def read(self) -> bytes:
        """Return the received bytes; an end of file or an error on the line is a lost port.

        A backlog is returned as a whole: for an instrument without a clock, only the last reading's time of
        arrival says when it was sent.
        """
        data = super().read()
        return data if len(data) < MAX_READ_BYTES else data + self._backlog()

    def _backlog(self) -> bytes:
        """Return the bytes after a first piece; the next :meth:`read` finds an end of file or error."""
        data = b""
        with suppress(OSError):
            while len(data) < READ_BYTES and select.select([self._fd], [], [], BACKLOG_WAIT_S)[0]:
                piece = os.read(self._fd, READ_BYTES)
                if not piece:
                    break
                data += piece
        return data

    def blocked(self) -> list[int]:
        """Return the descriptor, except that of a paced line, which is always writable."""
        return super().blocked() if self._idle_at == -inf else []

    def _room(self) -> bool:
        """Return True if less than 256 bytes wait in the system, for only then is a line writable.

        A pseudo-terminal does not say what waits in it and is writable until it is full. Once it was, it gets
        no more than its baud rate carries.
        """
        if self._pump is not None:
            return True
        now = time.monotonic()
        if self._idle_at > now + LEAD:
            return False
        room = bool(select.select([], [self._fd], [], 0)[1])
        with suppress(OSError):  # just unplugged: writing will tell
            if not room and getattr(self._serial, "out_waiting", -1) == 0:
                self._idle_at = now + LINE_BUFFER_BYTES * 10 / self.baudrate
        return room

    def _put(self, data: bytes | bytearray) -> int:
        if self._pump is not None:
            try:
                self._serial.write(data)
            except (serial.SerialException, OSError) as error:
                raise self.lost(_reason(error)) from error
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
    `source`, `key`: the file and the key that `name` comes from, for the error.
    ConfigError: no device's name, a URL of a kind that pyserial does not know, or one of a socket without
        HOST:PORT.
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
    """Return True if a serial device has this name or could get it later."""
    path = Path(name)
    if path.exists():
        return not (path.is_file() or path.is_dir())
    return "/" in name or os.name == "nt"  # where they are called COM3


def _reason(error: Exception) -> str:
    """Return why a port did not open, short enough for a STATUSTEXT: pyserial's own words repeat its name."""
    beneath = error.__context__ if isinstance(error.__context__, OSError) else error
    if isinstance(beneath, OSError) and beneath.errno == errno.EAGAIN:
        return "in use by another program"
    return getattr(beneath, "strerror", None) or str(error)


def _wait_for_bytes(line: Any) -> bytes:
    """Return the bytes of a pyserial port, or none after its timeout."""
    data: bytes = line.read(max(1, line.in_waiting))
    return data


class Pump:
    """A thread that moves what `read` returns into a pipe, for a port without a descriptor of its own.

    `fd`: the pipe's end to read from. It is at its end of file when `read` has raised OSError, whose reason
    `failed` then receives.
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
        except OSError as error:  # pyserial's errors are such, too
            self._failed(error.strerror or str(error))
        finally:
            os.close(self._in)

    def close(self) -> None:
        """End the thread."""
        self._running = False
        self._thread.join()
        os.close(self.fd)


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

    `name`: as :func:`open_bus` takes it.
    `driver`: configures the part and reads its registers.
    """

    def __init__(self, name: str, driver: Rm3100) -> None:
        super().__init__(name, ended="the part does not answer")
        self._driver = driver
        self._bus: Any = None
        self._pump: Pump | None = None
        self._pause_s = min(driver.period / 4.0, 0.05)
        self._silence_s = max(MIN_SILENCE_S, SILENT_PERIODS * driver.period)
        self._errors = self._repeated = 0
        self._heard, self._last = 0.0, b""

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
        self._bus, self._heard = bus, time.monotonic()
        self._errors = self._repeated = 0
        self._pump = Pump(partial(self._poll, bus), self._give_up)
        self._fd = self._pump.fd

    def move_on(self) -> None:
        """Close the port; opening it configures a silent part again."""
        self.close()

    def _send(self, data: bytes, address: Any) -> None:
        """Drop the bytes: the part accepts no commands from the pipeline."""

    def close(self) -> None:
        """Stop polling and close the bus."""
        pump, bus, self._pump, self._bus, self._fd = self._pump, self._bus, None, None, -1
        if pump is not None and bus is not None:
            pump.close()
            bus.close()

    def _give_up(self, reason: str) -> None:
        """Record why the bus failed."""
        self._ended = reason

    def _poll(self, bus: Bus) -> bytes:
        """Return the next reading, or none; raise OSError if the bus fails `MAX_ERRORS` times in a row."""
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

    ConfigError: a name that is neither, a driver that does not read a bus, or a library that is not
        installed.
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
