"""Connect a replay's emulated devices to the bridge by real ptys and a real socket.

An emulated fluxgate sends its real protocol to a pty, an emulated autopilot sends MAVLink to a socket. The
unmodified bridge runs in a process of its own and reads both.

A pty does not transmit the times of the bytes. A pipe therefore transmits a timetable, with an entry for each
event: time, channel and number of bytes. The bridge under replay reads its ports in this order, and its clock
follows these times. All code behind the ports is the same as at sea.
"""

from __future__ import annotations

import os
import pty
import select
import socket
import struct
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path

import msgspec

from magbridge.bridge.events import Event, StartEvent
from magbridge.config import load
from magbridge.errors import MagbridgeError, PortError, WrongUse
from magbridge.records import Channel

__all__ = ["Stage", "read_entries"]

Entry = struct.Struct("<QIB")
"""Layout of an entry: time (µs, with the channel in the low two bits), number of bytes, sensor id. The bytes
of a ``STATE`` event follow its entry."""
BATCH = 2048
"""Number of bytes that are sent at once, if there is no wait: less than the buffer of a pty."""
CONNECT_TIMEOUT = 30.0
"""Longest time for the bridge to start and connect, s."""
PATIENCE = 1.0
"""Longest time for a failed bridge to print its error and end, s."""


class Stage:
    """Bridge process with its ports, to which a replay sends events.

    The bridge runs with the ``bridge.toml`` of `config`, but with the sensor ports and the link of the stage.
    A separate thread passes the bytes that the bridge sends to the autopilot to `listener`. The bridge writes
    its log of the replay to the folder `log`.
    """

    def __init__(self, config: Path, listener: Callable[[bytes], None], log: Path | None = None) -> None:
        self._listener = listener
        self._times_due, self._link_due = bytearray(), bytearray()
        self._sensors_due: dict[int, bytearray] = {one.id or 0: bytearray() for one in load(config).sensors}
        with ExitStack() as opened, socket.create_server(("127.0.0.1", 0)) as server:
            self._masters: dict[int, int] = {}
            devices = []
            for sensor_id in self._sensors_due:
                self._masters[sensor_id], slave = pty.openpty()
                opened.callback(os.close, self._masters[sensor_id])
                opened.callback(os.close, slave)
                os.set_blocking(self._masters[sensor_id], False)
                # raw mode: a terminal would edit bytes written before the bridge opens the pty
                tty.setraw(slave)
                devices.append(os.ttyname(slave))
            times_out, times = os.pipe()
            command = [
                sys.executable, "-m", "sitl.replay.bridge", str(config),
                "--sensor", *devices,
                "--link", f"tcp:127.0.0.1:{server.getsockname()[1]}",
                "--timetable", str(times_out),
                *(("--log", str(log)) if log else ()),
            ]  # fmt: skip
            self._bridge = opened.enter_context(
                subprocess.Popen(command, pass_fds=(times_out,), stderr=subprocess.PIPE)  # noqa: S603 - our own
            )
            os.close(times_out)
            self._times = opened.enter_context(os.fdopen(times, "wb", buffering=0))
            if not self._wait(server.fileno(), select.POLLIN, CONNECT_TIMEOUT):
                raise self._failure(f"the bridge did not connect within {CONNECT_TIMEOUT:g} s")
            self._link = opened.enter_context(server.accept()[0])
            self._link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            ear = threading.Thread(target=self._listen, name="autopilot's ear", daemon=True)
            ear.start()
            opened.callback(ear.join, timeout=10.0)
            opened.enter_context(self._times)  # closed first: the bridge ends with its timetable
            self._opened = opened.pop_all()

    def _wait(self, fd: int, event: int, timeout: float | None = None) -> bool:
        """Return True if `event` comes within `timeout` s; raise an error if the bridge has ended."""
        waiting = select.poll()
        waiting.register(fd, event)
        waiting.register(self._times, 0)  # the pipe breaks when the bridge, its only reader, ends
        ready = [one for one, _ in waiting.poll(timeout and timeout * 1e3)]
        if ready and fd not in ready:
            raise self._failure()
        return bool(ready)

    def _listen(self) -> None:
        try:
            while data := self._link.recv(65536):
                self._listener(data)
        except ConnectionResetError:
            return  # the bridge ended early; :meth:`play` reports why

    def _failure(self, otherwise: str = "") -> MagbridgeError:
        """End the bridge; return the error for its exit code, with its last line on stderr as message."""
        try:
            _, texts = self._bridge.communicate(timeout=PATIENCE)
        except subprocess.TimeoutExpired:
            self._bridge.kill()
            _, texts = self._bridge.communicate()
        words = texts.decode(errors="replace").strip().rpartition("\n")[2]
        if words and self._bridge.returncode == WrongUse.exit_code:
            return WrongUse(words)
        return PortError("replay", words or otherwise or f"the bridge ended with {self._bridge.returncode}")

    def play(self, start: StartEvent, events: Iterable[Event], speed: float = float("inf")) -> None:
        """Send events in order, `speed` times faster than they happened, until the bridge has handled all.

        Raises
        ------
        WrongUse
            The bridge rejected its configuration.
        PortError
            The bridge ended early; the message is its last line of output.
        """
        try:
            self._send(start, events, speed)
            self._times.close()
            if self._bridge.wait() != 0:
                raise self._failure()
        finally:
            self._opened.close()

    def _send(self, start: StartEvent, events: Iterable[Event], speed: float) -> None:
        times = self._times_due
        begin = msgspec.json.encode(start)
        times += Entry.pack(start.time_us | Channel.STATE, len(begin), 0) + begin
        pending = 0
        for wait, event in pace(events, speed):
            if wait > 0.0:
                self._flush()
                pending = 0
                time.sleep(wait)
            size = len(event.data)
            times += Entry.pack(event.time_us | event.channel, size, event.sensor_id)
            if event.channel is Channel.SENSOR:
                self._sensors_due[event.sensor_id] += event.data
            else:
                (times if event.channel is Channel.STATE else self._link_due).extend(event.data)
            pending += size
            if pending >= BATCH:
                self._flush()
                pending = 0
        self._flush()

    def _flush(self) -> None:
        """Write the due bytes, the timetable first, so that the bridge empties the ptys meanwhile.

        The sensors' bytes come last, so that the bridge never waits for link bytes while a pty is full.
        """
        times, link = self._times_due, self._link_due
        try:
            while times:
                del times[: self._times.write(times)]
            self._link.sendall(link)
            link.clear()
            while any(self._sensors_due.values()):
                self._write_sensors()
        except (BrokenPipeError, ConnectionResetError) as error:
            raise self._failure() from error

    def _write_sensors(self) -> None:
        """Write as many bytes as the ptys accept now; the bridge reads them in the timetable's order."""
        waiting = select.poll()
        waiting.register(self._times, 0)  # the pipe breaks when the bridge, its only reader, ends
        masters = {self._masters[one]: due for one, due in self._sensors_due.items() if due}
        for master in masters:
            waiting.register(master, select.POLLOUT)
        ready = [fd for fd, _ in waiting.poll() if fd in masters]
        if not ready:
            raise self._failure()
        for fd in ready:
            del masters[fd][: os.write(fd, masters[fd])]


def read_entries(read: Callable[[], bytes]) -> Iterator[tuple[int, Channel, int, int, bytes]]:
    """Yield each entry: time (µs), channel, sensor id, number of bytes, and the bytes of a ``STATE`` entry.

    `read` returns the next bytes of the timetable, and ``b""`` at its end.
    """
    buffer = bytearray()
    channels = tuple(Channel)
    while True:
        position = 0
        while len(buffer) - position >= Entry.size:
            stamp, size, sensor_id = Entry.unpack_from(buffer, position)
            channel = channels[stamp & 3]
            inline = size if channel is Channel.STATE else 0
            if len(buffer) - position < Entry.size + inline:
                break
            position += Entry.size
            data = bytes(buffer[position : position + inline])
            position += inline
            yield stamp & ~3, channel, sensor_id, size, data
        del buffer[:position]
        chunk = read()
        if not chunk:
            return
        buffer += chunk


def pace(events: Iterable[Event], speed: float) -> Iterator[tuple[float, Event]]:
    """Yield the time to wait before each event (s; negative if the event is late), and the event.

    The events, in order of time, are sent `speed` times faster than they happened; ``inf`` means no waiting.
    """
    begun = time.monotonic()
    first_us: int | None = None
    for event in events:
        if first_us is None:
            first_us = event.time_us
        yield begun + (event.time_us - first_us) * 1e-6 / speed - time.monotonic(), event
