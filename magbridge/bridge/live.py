"""Live edge: convert the input of the ports and the clock to events.

One thread reads, corrects and sends. Each port has a thread of its own that opens it when it is down, so that
an open that takes long (a host name that does not resolve) never holds up another port.
"""

from __future__ import annotations

import os
import queue
import select
import threading
import time
from collections.abc import Callable, Iterator, Mapping

from magbridge.bridge import events
from magbridge.bridge.events import Event, HostClock, source_of
from magbridge.bridge.port import Port
from magbridge.errors import PortError
from magbridge.records import Channel

__all__ = ["LiveEdge"]

PORT_RETRY_S = 0.25
"""s between attempts to open a port that is down."""
CLOSE_TIMEOUT_S = 2.0
"""s that :meth:`LiveEdge.close` waits for an attempt under way to open a port."""
SLOW_US = 10_000_000
"""µs between two reports that the link is too slow; repeated, because one may be lost as well."""
CLOCK_CHECK_INTERVAL_US = 100_000
"""µs between two checks for a step of the host's clock, and for a link that is too slow."""
BACKLOG = 1 << 20
"""Bytes of a link's backlog that are read at once after the process was held up."""
STANDSTILL_US = 400_000
"""µs that a turn takes only where the process was held up: none waits for longer than `LOOK_US`."""


class LiveEdge:
    """Convert the input of the ports to events in order.

    `ports`: by MAG_PORT_NAME: the link and the sensors; opened here, in their order.
    """

    def __init__(self, ports: Mapping[int, Port], clock: HostClock) -> None:
        self._ports = ports
        self._clock = clock
        self._changes: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._woken, self._waker = os.pipe()
        self._stopping = False
        self._overrun = self._slow_us = 0
        self._openers: dict[int, threading.Thread] = {}
        for number, port in ports.items():
            tried = threading.Event()
            opener = threading.Thread(
                target=self._keep_open, args=(number, port, tried), name="port opener", daemon=True
            )
            self._openers[number] = opener
            opener.start()
            tried.wait(PORT_RETRY_S)  # so that a report on the next port can go out over this one

    def events(self, deadline: Callable[[], int]) -> Iterator[Event]:
        """Yield events until :meth:`stop`, and an empty one whenever `deadline` (µs) has passed."""
        turned_us = self._clock.now_us()
        look_us = turned_us + CLOCK_CHECK_INTERVAL_US
        while not self._stopping:
            wait = (min(deadline(), look_us) - self._clock.now_us()) * 1e-6
            lines = {fd: number for number, port in self._ports.items() for fd in port.fds()}
            full = [number for number, port in self._ports.items() if port.waiting]
            blocked = [fd for number in full for fd in self._ports[number].blocked()]
            try:
                ready = select.select([*lines, self._woken], blocked, [], max(wait, 0.0))[0]
            except (OSError, ValueError):  # a descriptor was closed between asking for it and waiting
                continue
            now_us = self._clock.now_us()
            for number in full:
                self._flush(number)
            if self._woken in ready:
                os.read(self._woken, 4096)
            while not self._changes.empty():  # the news that a port opened comes before its data
                yield Event(now_us, Channel.STATE, self._changes.get())
            if held := now_us - turned_us > STANDSTILL_US:
                yield Event(now_us, Channel.STATE, events.standstill(now_us, now_us - turned_us))
            turned_us = now_us
            for fd in ready:
                if fd != self._woken and (data := self._waiting(lines[fd], fd, held)):
                    channel, sensor_id = source_of(lines[fd])
                    yield Event(now_us, channel, data, sensor_id)
            if now_us >= look_us:
                look_us = now_us + CLOCK_CHECK_INTERVAL_US
                for state in self._look(now_us):
                    yield Event(now_us, Channel.STATE, state)
            if now_us >= deadline():
                yield Event(now_us, Channel.STATE, b"")

    def _look(self, now_us: int) -> Iterator[bytes]:
        """Yield the state frames of the host's clock and of the link that are due."""
        if step_us := self._clock.step_us():
            yield events.clock_step(now_us, step_us)
        if text := self._ports[Channel.LINK].notice():
            yield events.notice(text)
        if self._too_slow(now_us):
            link = self._ports[Channel.LINK]
            reason = f"too slow, {link.overrun} bytes not sent so far"
            yield events.port_state(Channel.LINK, reason, link.dropped, is_open=True)

    def send(self, number: int, data: bytes) -> None:
        """Send to a port; while the port is down, data are dropped and counted."""
        port = self._ports[number]
        if not port.is_open:
            port.dropped += len(data)
            return
        try:
            port.write(data)
        except PortError as error:
            self._lost(number, error)

    def answer(self, sender: tuple[int, int], data: bytes) -> None:
        """Send data over the link to one system and component only."""
        link = self._ports[Channel.LINK]
        try:
            if link.is_open:
                link.write_to(sender, data)
        except PortError as error:
            self._lost(Channel.LINK, error)

    def credit(self, frames: list[bytes]) -> None:
        """Report to the link which frames that it read last are signed with the key."""
        self._ports[Channel.LINK].credit(frames)

    def _flush(self, number: int) -> None:
        """Continue to send pending data over a slow line."""
        try:
            self._ports[number].flush()
        except PortError as error:
            self._lost(number, error)

    def notify(self, state: bytes) -> None:
        """Add a state frame to the events; from any thread."""
        self._changes.put(state)
        os.write(self._waker, b"!")

    def stop(self) -> None:
        """End :meth:`events` at the next turn; from any thread or signal handler, as often as you like."""
        if not self._stopping:
            self._stopping = True
            os.write(self._waker, b"!")

    def close(self) -> None:
        """Close the ports; one that is still being opened is left to the end of the process."""
        self._stopping = True
        for number, opener in self._openers.items():
            opener.join(CLOSE_TIMEOUT_S)
            if not opener.is_alive():
                self._ports[number].close()
        if not any(opener.is_alive() for opener in self._openers.values()):
            os.close(self._woken)
            os.close(self._waker)

    def _read(self, number: int, fd: int) -> bytes:
        port = self._ports[number]
        if fd not in port.fds():  # send() has lost the port since select() returned
            return b""
        try:
            return port.read()
        except PortError as error:
            self._lost(number, error)
            return b""

    def _waiting(self, number: int, fd: int, held: bool) -> bytes:
        """Return the pending events; after a stall all of the link, because readings need the telemetry."""
        data = self._read(number, fd)
        while held and data and number == Channel.LINK and len(data) < BACKLOG:
            more = select.select([fd], [], [], 0)[0] if fd in self._ports[number].fds() else []
            piece = self._read(number, fd) if more else b""
            if not piece:
                break
            data += piece
        return data

    def _too_slow(self, now_us: int) -> bool:
        """Return True if it is due to report that the link has dropped data because its buffer was full."""
        overrun = self._ports[Channel.LINK].overrun
        if overrun == self._overrun or now_us < self._slow_us:
            return False
        self._overrun, self._slow_us = overrun, now_us + SLOW_US
        return True

    def _lost(self, number: int, error: PortError) -> None:
        self._report(number, error.reason)

    def _report(self, number: int, reason: str) -> None:
        """Report that a port is not open, or with no `reason` that it opened."""
        port = self._ports[number]
        # the name last, because the end of a long text is cut off
        self.notify(events.port_state(number, f"{reason}: {port.name}" if reason else "", port.dropped))

    def _keep_open(self, number: int, port: Port, tried: threading.Event) -> None:
        """Open the port whenever it is down, report each change once; set `tried` after the first attempt."""
        reported: str | None = None
        while not self._stopping:
            if port.is_open:
                port.tend()
            else:
                try:
                    port.open()
                    reason = ""
                except PortError as error:
                    reason = error.reason
                if not reason or reported != reason:
                    self._report(number, reason)
                reported = reason
            tried.set()
            time.sleep(PORT_RETRY_S)
