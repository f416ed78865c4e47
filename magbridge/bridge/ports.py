"""Recognition of the device on a serial line: a magnetometer, an autopilot, a GPS, or unknown."""

from __future__ import annotations

import errno
import os
import re
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import serial
from serial.tools import list_ports

from magbridge.bridge.check import access
from magbridge.bridge.sensor import NMEA_SENTENCE
from magbridge.errors import PortError
from magbridge.mavlink import BAD_DATA, Codec
from magbridge.sensors import DRIVERS, driver_class
from magbridge.sensors.framing import nmea_checksum

__all__ = ["BAUDRATES", "Recognised", "SerialDevice", "listen", "ports", "recognise"]

BAUDRATES = (115_200, 57_600, 9_600, 38_400, 230_400, 19_200, 921_600)
"""Baud rates at which the device is searched, the most common first, bit/s."""
TEXT_LINE = re.compile(rb"[^\r\n]+[\r\n]")
TEXT_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d+)?")
SHOWN = 60
"""Most characters of an unrecognised line that are printed."""
BUSY = {errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK}
"""Error numbers of a port that another program has opened exclusively."""
MIN_RECOGNISED = 3
"""Smallest number of readings or frames by which a sender is recognised."""


class Recognised(NamedTuple):
    """Sender that was recognised on a line."""

    who: str
    """Kind: ``mavlink``, ``nmea``, the name of a driver, ``text`` or ``bytes``; empty without any bytes."""
    text: str
    """Description for the user: rate, systems, or a line that cannot be parsed."""


class SerialDevice(NamedTuple):
    """Serial port of this computer."""

    device: str
    description: str
    """Manufacturer, product and serial number, as the USB device states them."""


def ports() -> list[SerialDevice]:
    """Return the serial ports of this computer to which hardware is attached."""
    found = [one for one in list_ports.comports() if one.hwid != "n/a" or one.vid is not None]
    return [SerialDevice(one.device, _described(one)) for one in sorted(found)]


def _described(device: Any) -> str:
    number = f"serial number {device.serial_number}" if device.serial_number else ""
    texts = device.manufacturer, device.product or device.description, number
    return ", ".join(filter(None, texts))


def listen(
    device: str, baudrates: Sequence[int] = BAUDRATES, seconds: float = 1.5
) -> tuple[Recognised, int | None, bytes]:
    """Return the sender on a device, its baud rate (None if unknown), and the received bytes; send nothing.

    `device`: a device or a pyserial URL.
    `baudrates`: baud rates to try in this order, until the sender is recognised.
    `seconds`: time for each baud rate, s.
    PortError: the device cannot be opened.
    """
    best, at, came = Recognised("", "silent"), None, b""
    for baudrate in baudrates:
        try:
            data = _read(device, baudrate, seconds)
        except (serial.SerialException, OSError, ValueError) as error:
            raise PortError(device, _refusal(device, error)) from error
        recognised = recognise(data, seconds)
        if recognised.who not in {"", "bytes", "text"}:
            return recognised, baudrate, data
        if (recognised.who == "text") > (best.who == "text") or (recognised.who and not best.who):
            best, at, came = recognised, baudrate, data
        if "://" in device:  # the baud rate has no effect on a line over the network
            break
    return best, at, came


def _refusal(device: str, error: Exception) -> str:
    """Return why a port cannot be opened, and the remedy."""
    if getattr(error, "errno", None) in BUSY:
        return "busy: another program has opened it; stop that program, then repeat"
    there = "://" in device or Path(device).exists()
    number = getattr(error, "errno", None)
    reason = os.strerror(number) if number else str(error)  # pyserial repeats the port and the number
    return (access(device) if there else "") or f"cannot be opened: {reason}"


def _read(device: str, baudrate: int, seconds: float) -> bytes:
    line = serial.serial_for_url(device, baudrate, timeout=0.1, do_not_open=True)
    line.exclusive = None if "://" in device else True
    # opening must not reset the device at the other end, as it does an Arduino
    line.dtr = line.rts = False
    data, end = b"", time.monotonic() + seconds
    with line:
        while time.monotonic() < end:
            data += line.read(4096)
    return data


def recognise(data: bytes, seconds: float) -> Recognised:
    """Return the sender of `data`, which were received within `seconds`."""
    if not data:
        return Recognised("", "silent")
    for known in (_mavlink(data), _nmea(data), *_drivers(data, seconds)):
        if known is not None:
            return known
    lines = TEXT_LINE.findall(data)
    printable = sum(32 <= byte < 127 or byte in b"\r\n\t" for byte in data) / len(data)
    if printable < 0.9 or not lines:
        return Recognised("bytes", f"not understood: {data[:24].hex(' ')}")
    line = lines[len(lines) // 2]
    shown = line.decode("ascii", "replace").strip()[:SHOWN]
    numbers = len(TEXT_NUMBER.findall(line))
    hint = " (driver ascii reads it, if x y z are among these)" if numbers >= 3 else ""
    return Recognised("text", f"not understood: {shown!r}{hint}")


def _mavlink(data: bytes) -> Recognised | None:
    codec = Codec(255, 190)
    frames = [one for one in codec.parse(data) if one.id != BAD_DATA and one.known]
    if len(frames) < MIN_RECOGNISED:
        return None
    senders = sorted({(one.system, one.component) for one in frames})
    texts = [f"system {system} component {component}" for system, component in senders]
    return Recognised("mavlink", ", ".join(texts))


def _nmea(data: bytes) -> Recognised | None:
    sentences = [line.rstrip().partition(b"*") for line in NMEA_SENTENCE.findall(data)]
    valid = [text for text, _, digits in sentences if int(digits, 16) == nmea_checksum(text)]
    if len(valid) < MIN_RECOGNISED:
        return None
    kinds = sorted({text[1:6].decode() for text in valid})
    return Recognised("nmea", f"NMEA 0183: {' '.join(kinds)}")


def _drivers(data: bytes, seconds: float) -> Iterator[Recognised | None]:
    """Yield each built-in driver that finds readings in `data`, received within `seconds`."""
    for name in DRIVERS:
        for options in OPTIONS.get(name, ({},)):
            kind = driver_class(name, "ports")
            driver = kind(kind.Options(**options))
            driver.start()
            readings = driver.feed(data)
            wasted = driver.bytes_skipped / len(data)
            if len(readings) >= MIN_RECOGNISED and wasted < 0.5:
                shown = {key: value for key, value in options.items() if key != "sensitivity"}
                texts = ", ".join(f"{key} = {value!r}" for key, value in shown.items())
                rate = f"{len(readings) / seconds:.0f} readings/s"
                yield Recognised(name, f"driver {name}, {rate}" + (f", with {texts}" if texts else ""))


OPTIONS: dict[str, tuple[dict[str, Any], ...]] = {
    "ascii": (),  # not tried, because any line of numbers would match
    "digitizer": ({"sensitivity": 1e-5},),
    "hmr2300": ({"output": "ascii"}, {"output": "binary"}),
}
"""Driver -> sets of options to try; the sensitivity has no effect on the recognition."""
