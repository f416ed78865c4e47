"""Simulated devices at the ends of a bridge: a fluxgate on a pty, an autopilot, and a ground station."""

import fcntl
import os
import pty
import socket
import termios
import time
import tty
from array import array
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from magbridge.link.files import FTP_HEADER
from magbridge.mavlink import Codec, Message, Signing
from magbridge.records import Reading
from sitl.fluxgate import open_encoder

SENSOR_HZ, TELEMETRY_HZ, BEAT_HZ = 50, 20, 2
TRUTH = (20_000.0, 1_000.0, 40_000.0)
"""Field at the fluxgate, nT in sensor axes."""
TURN = 0.002
"""Time between two polls of the sensor and the autopilot, s."""


def open_line(name: Path) -> tuple[int, int]:
    """Make a pty and link its far end as the device `name`; return the descriptors of both ends."""
    near, far = pty.openpty()
    tty.setraw(far)
    os.set_blocking(near, False)
    name.symlink_to(os.ttyname(far))
    return near, far


@contextmanager
def serial_line() -> Iterator[tuple[int, str]]:
    """Yield the descriptor of one end of a raw pty, and the device name of the other; close both ends."""
    near, far = pty.openpty()
    tty.setraw(far)
    yield near, os.ttyname(far)
    os.close(near)
    os.close(far)


def udp_socket(timeout_s: float | None = None, host: str = "127.0.0.1", port: int = 0) -> socket.socket:
    """Return a bound UDP socket; with a timeout of 0 it does not block."""
    one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    one.bind((host, port))
    one.settimeout(timeout_s)
    return one


class Fluxgate:
    """Simulated fluxgate on a pty whose device name can change, as that of a USB adapter does.

    Attributes
    ----------
    field : callable
        The field in nT at a time (s, monotonic).
    """

    def __init__(
        self, folder: Path, options: dict[str, object], driver: str = "digitizer", hz: float = SENSOR_HZ
    ) -> None:
        self.folder = folder
        self.encoder = open_encoder(driver, options)
        self.field: Callable[[float], tuple[float, float, float]] = lambda _: TRUTH
        self._hz = hz
        self.speaks = True
        self._master = self._slave = -1
        self._name = folder
        self._on = time.monotonic()
        self._sent = 0

    def plug(self, name: str = "ttyUSB0", *, powered_anew: bool = False) -> None:
        """Connect the fluxgate as the device `name`; restart its clock if it is `powered_anew`."""
        self._name = self.folder / name
        self._master, self._slave = open_line(self._name)
        if powered_anew:
            self.encoder.power_on()
            self._on, self._sent = time.monotonic(), 0

    def unplug(self, *, after: int = 0) -> None:
        """Disconnect the fluxgate after it sent the first `after` bytes of a frame."""
        self.write(self._frame()[:after])
        deadline = time.monotonic() + 5.0
        # a pty forwards with a delay, and FIONREAD does not count its buffer
        time.sleep(0.05 if after else 0.0)
        while after and array("i", fcntl.ioctl(self._slave, termios.FIONREAD, bytes(4)))[0]:
            assert time.monotonic() < deadline, "no process reads the line"
            time.sleep(TURN)
        self._name.unlink()
        os.close(self._slave)
        os.close(self._master)
        self._master = -1

    def write(self, data: bytes) -> None:
        """Write bytes to the pty; drop them if its buffer is full or the fluxgate is disconnected."""
        if self._master >= 0:
            with suppress(BlockingIOError):
                os.write(self._master, data)

    def turn(self) -> None:
        """Send the readings that are due; drop them if `speaks` is False."""
        due = int((time.monotonic() - self._on) * self._hz)
        while self._sent < due:
            frame = self._frame()
            if self.speaks:
                self.write(frame)

    def _frame(self) -> bytes:
        self._sent += 1
        elapsed = self._sent / self._hz
        field = self.field(self._on + elapsed)
        reading = Reading(field, device_time=elapsed, temperature=4.0, supply=3.7)
        return self.encoder.encode(reading)


class SerialEnd:
    """One end of a serial line, with the methods of a socket; the other end is the device `name`."""

    def __init__(self, name: Path) -> None:
        self._name = name
        self._master, self._slave = open_line(name)

    def sendall(self, data: bytes) -> None:
        """Write bytes to the line."""
        os.write(self._master, data)

    def recvfrom(self, size: int) -> tuple[bytes, None]:
        """Read at most `size` bytes from the line; the sender's address is always None."""
        return os.read(self._master, size), None

    def close(self) -> None:
        """Remove the device and close both ends."""
        self._name.unlink()
        os.close(self._slave)
        os.close(self._master)


class Autopilot:
    """Simulated autopilot (system 1, component 1) at the far end of the bridge's link."""

    def __init__(self, url: str, codec: Codec) -> None:
        self.codec = codec
        self.position: Callable[[float], float] = lambda _: 0.5
        """Position of the battery (in) as a function of the time (s, monotonic)."""
        self.answers = True
        """True if the autopilot replies to TIMESYNC."""
        self.reported: list[float] = []
        """Times at which the autopilot sent telemetry, s, monotonic."""
        self._retell: Callable[[bytes], list[bytes]] = lambda frame: [frame]
        """Function that returns the frames that the link delivers for a telemetry frame."""
        self._kind, _, self._at = url.partition(":")
        self._ear = Codec(0, 0)
        self._booted = self._beat = self._due = time.monotonic()
        self._boot_ms = 5000
        self._listener: socket.socket | None = None
        self._line: socket.socket | SerialEnd | None = None
        self._peer: tuple[str, int] | None = None

    @contextmanager
    def retelling(self, retell: Callable[[bytes], list[bytes]]) -> Iterator[None]:
        """Replace each telemetry frame on the link by the frames that `retell` returns."""
        plain, self._retell = self._retell, retell
        try:
            yield
        finally:
            self._retell = plain

    @property
    def address(self) -> tuple[str, int]:
        """Host and port of the link's URL."""
        host, _, port = self._at.rpartition(":")
        return host, int(port)

    def up(self) -> None:
        """Open the autopilot's end of the link."""
        if self._kind == "serial":
            self._line = SerialEnd(Path(self._at))
            return
        if self._kind == "tcpin":  # the bridge listens; it may not yet
            return
        if self._kind == "tcp":
            self._listener = socket.create_server(self.address)
            self._listener.setblocking(False)
            return
        self._line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._line.setblocking(False)
        self._line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        if self._kind == "udpout":
            self._line.bind(self.address)
        else:
            self._peer = self.address

    def down(self) -> None:
        """Close the autopilot's end of the link."""
        for one in (self._line, self._listener):
            if one is not None:
                one.close()
        self._line = self._listener = None

    def reboot(self) -> None:
        """Set the autopilot's clock to zero."""
        self._booted, self._boot_ms = time.monotonic(), 0

    @property
    def boot_us(self) -> int:
        """Time since boot by the autopilot's clock, µs."""
        return self._boot_ms * 1000 + int((time.monotonic() - self._booted) * 1e6)

    def send(self, data: bytes) -> None:
        """Send bytes; drop them if the link is closed or its buffer is full."""
        if self._line is None:
            return
        with suppress(BlockingIOError, ConnectionRefusedError, BrokenPipeError, ConnectionResetError):
            if isinstance(self._line, SerialEnd) or self._kind in ("tcp", "tcpin"):
                self._line.sendall(data)
            elif self._peer is not None:
                self._line.sendto(data, self._peer)

    def pack(self, name: str, /, **fields: object) -> bytes:
        """Return the frame of a message, signed with the present time if the autopilot has a key."""
        self.codec.now_us = time.time_ns() // 1000
        return self.codec.pack(name, **fields)

    def send_message(self, name: str, /, **fields: object) -> None:
        """Send the message `name` with these fields."""
        self.send(self.pack(name, **fields))

    def telemetry(self, value: float | None = None, *, behind_us: int = 0) -> bytes:
        """Return the frame of the battery's position (in), with a timestamp `behind_us` before now."""
        value = self.position(time.monotonic()) if value is None else value
        return self.pack(
            "NAMED_VALUE_FLOAT", time_boot_ms=(self.boot_us - behind_us) // 1000, value=value, name="battpos"
        )

    def turn(self) -> Iterator[Message]:
        """Send the heartbeat and telemetry that are due; yield the received messages."""
        now = time.monotonic()
        if self._listener is not None and self._line is None:
            with suppress(BlockingIOError):
                self._line = self._listener.accept()[0]
                self._line.setblocking(False)
        if self._kind == "tcpin" and self._line is None:
            with suppress(OSError):
                self._line = socket.create_connection(self.address, timeout=0.5)
                self._line.setblocking(False)
        if now >= self._beat:
            self._beat = now + 1 / BEAT_HZ
            self.send_message("HEARTBEAT", type=12, autopilot=3, system_status=4, mavlink_version=3)
        if now >= self._due:
            self._due = now + 1 / TELEMETRY_HZ
            self.reported.append(now)
            for frame in self._retell(self.telemetry()):
                self.send(frame)
        for message in self._receive():
            if self.answers and message.known and message.name == "TIMESYNC" and message["tc1"] == 0:
                self.send_message("TIMESYNC", tc1=self.boot_us * 1000, ts1=message["ts1"])
            yield message

    def _receive(self) -> Iterator[Message]:
        while self._line is not None:
            try:
                data, peer = self._line.recvfrom(65536)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if not data:
                if self._kind in ("tcp", "tcpin"):
                    self._line.close()
                    self._line = None
                return
            self._peer = peer or self._peer
            yield from self._ear.parse(data)


def ftp(opcode: int, data: bytes, sequence: int, size: int = 0, offset: int = 0) -> dict[str, object]:
    """Return the fields of an FTP request to the bridge."""
    header = FTP_HEADER.pack(sequence, 0, opcode, size or len(data), 0, 0, offset)
    return {"target_system": 1, "target_component": 191, "payload": (header + data).ljust(251, b"\0")}


class Ear:
    """Ground station that stores what it receives; it sends to `peer`, or to the latest sender."""

    def __init__(self, system: int, key: bytes | None = None, peer: tuple[str, int] | None = None) -> None:
        self.codec, self.ear = Codec(system, 190, Signing(key) if key else None), Codec(0, 0)
        self.line, self.peer = udp_socket(0.0), peer
        self.received: list[Message] = []

    def send_message(self, name: str, **fields: object) -> None:
        """Send a message, if the peer is known."""
        self.codec.now_us = time.time_ns() // 1000
        if self.peer is not None:
            self.line.sendto(self.codec.pack(name, **fields), self.peer)

    def of(self, name: str, mark: int = 0) -> list[Message]:
        """Receive what has arrived; return the messages `name` received since `mark`."""
        with suppress(BlockingIOError):
            while True:
                data, self.peer = self.line.recvfrom(65536)
                self.received += self.ear.parse(data)
        return [one for one in self.received[mark:] if one.name == name]
