"""Serial lines, by device, pattern or pyserial URL."""

from __future__ import annotations

import errno
import glob
import os
import select
import threading
import time
from contextlib import suppress
from importlib.util import find_spec
from math import inf
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import serial

from magbridge.bridge.port import READ_BYTES, PacedPort
from magbridge.errors import ConfigError, PortError

__all__ = ["SerialPort", "may_be_device", "serial_line"]

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
        super().__init__(name, round(baudrate / 10 * LEAD), READ_BYTES, "hung up")
        self.baudrate = baudrate
        self._last = self._passed = ""
        self._idle_at = -inf
        self._serial: Any = None
        self._pump: _Pump | None = None

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
                self._pump = _Pump(opened)
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

    Parameters
    ----------
    name : str
        A device, a pattern or a pyserial URL.
    baudrate : int
        Bits per second.
    source, key : str
        The file and the key that `name` comes from, for the error.

    Raises
    ------
    ConfigError
        No device's name, a URL of a kind that pyserial does not know, or one of a socket without HOST:PORT.
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


class _Pump:
    """Move bytes from a port without a file descriptor into a pipe."""

    def __init__(self, source: Any) -> None:
        self._source = source
        source.timeout, source.write_timeout = 0.05, 1.0
        self.fd, self._in = os.pipe()
        os.set_blocking(self.fd, False)
        self._running = True
        self._thread = threading.Thread(target=self._run, name="serial pump", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            while self._running:
                data = self._source.read(max(1, self._source.in_waiting))
                if data:
                    os.write(self._in, data)
        except (serial.SerialException, OSError):
            self._running = False
        finally:
            os.close(self._in)  # the reader sees an end of file: the port is lost

    def close(self) -> None:
        self._running = False
        self._thread.join()
        os.close(self.fd)
