"""Serial lines, by device, pattern or pyserial URL."""

from __future__ import annotations

import errno
import glob
import os
import select
import threading
from contextlib import suppress
from typing import Any

import serial

from magbridge.bridge.port import CHUNK, Port
from magbridge.errors import PortError

__all__ = ["SerialPort"]

PIECE = 4095
"""Bytes that one read of a terminal device returns at most, however many are waiting."""
SOON = 0.02
"""s within which the next piece of a backlog can be read, even on a busy computer."""


class SerialPort(Port):
    """A serial line by device name, pattern (``/dev/ttyUSB*``) or pyserial URL."""

    def __init__(self, name: str, baudrate: int) -> None:
        super().__init__(name)
        self.baudrate = baudrate
        self._serial: Any = None
        self._fd = -1
        self._pump: _Pump | None = None
        self._begun = bytearray()

    @property
    def up(self) -> bool:
        """Whether the device is open."""
        return self._serial is not None

    def open(self) -> None:
        """Open the first device that the name or pattern finds; raises :class:`PortError`."""
        # a pattern may be absolute, which pathlib does not glob
        names = sorted(glob.glob(self.name)) if glob.has_magic(self.name) else [self.name]  # noqa: PTH207 - a pattern from the root
        reason: object = "no such device"
        for name in names:
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
                self._fd = opened.fileno()
            except (AttributeError, OSError):  # loop:// and rfc2217:// have no descriptor
                self._pump = _Pump(opened)
                self._fd = self._pump.fd
            self._serial = opened
            return
        raise PortError(self.name, str(reason))

    def fds(self) -> list[int]:
        """Return the one descriptor, if open."""
        return [self._fd] if self._serial is not None else []

    def read(self) -> bytes:
        """Return what has come; an end of file or an error on the line is a lost port.

        A backlog is returned as a whole: of an instrument without a clock, only the last reading's time of
        arrival says when it was sent.
        """
        try:
            data = os.read(self._fd, CHUNK)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise self.lost(error.strerror) from error
        if not data:
            raise self.lost("hung up")
        return data if len(data) < PIECE else data + self._backlog()

    def _backlog(self) -> bytes:
        """Return what is waiting after a first piece; the next :meth:`read` finds an end of file or error."""
        data = b""
        with suppress(OSError):
            for _ in range(CHUNK // PIECE):
                if not select.select([self._fd], [], [], SOON)[0]:
                    break
                data += os.read(self._fd, CHUNK)
        return data

    def write(self, data: bytes) -> None:
        """Write what the line's buffer takes; the rest of a message goes out before the next message.

        So a line that is too slow loses whole messages, which are counted, and never half of one.
        """
        try:
            if self._pump is not None:
                self._serial.write(data)
                return
            if self._begun:
                del self._begun[: os.write(self._fd, self._begun)]
            if self._begun:
                self.overran(data)
            else:
                self._begun += data[os.write(self._fd, data) :]
        except BlockingIOError:
            self.overran(data)
        except (serial.SerialException, OSError) as error:
            raise self.lost(_reason(error)) from error

    def close(self) -> None:
        """Close the device."""
        if self._pump is not None:
            self._pump.close()
        if self._serial is not None:
            self._serial.close()
        self._serial, self._fd, self._pump = None, -1, None
        self._begun.clear()


def _reason(error: Exception) -> str:
    """Return why a port did not open, short enough for a STATUSTEXT: pyserial's own words repeat its name."""
    beneath = error.__context__ if isinstance(error.__context__, OSError) else error
    if isinstance(beneath, OSError) and beneath.errno == errno.EAGAIN:
        return "in use by another program"
    return getattr(beneath, "strerror", None) or str(error)


class _Pump:
    """Moves bytes from a port that cannot be waited for into a pipe that can."""

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
