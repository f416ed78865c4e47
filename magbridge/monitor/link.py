"""The link, on a thread of its own: it feeds the state with messages and sends the state's requests."""

from __future__ import annotations

import select
import time
from threading import Lock, Thread

from magbridge.bridge.port import Port
from magbridge.errors import PortError
from magbridge.mavlink import Codec, Signing
from magbridge.monitor.fleet import ReceivedBridges

__all__ = ["StationLink", "monotonic_s"]

ASLEEP = getattr(time, "CLOCK_BOOTTIME", None)
"""A clock that goes on while the computer sleeps, where there is one."""


def monotonic_s() -> float:
    """Return s of a monotonic clock."""
    return time.monotonic() if ASLEEP is None else time.clock_gettime(ASLEEP)


class StationLink:
    """Listens to `port`, as ground station 255:190, until the process ends.

    Parameters
    ----------
    port : Port
    key : bytes or None
        32 bytes: sent frames are signed, and frames not signed with it are refused.

    Attributes
    ----------
    fleet : Fleet
        To be used with `lock` held.
    trouble : str
        Why the port is not open; empty while it is.
    """

    def __init__(self, port: Port, key: bytes | None = None) -> None:
        self.port, self.fleet, self.lock, self.trouble = port, ReceivedBridges(), Lock(), ""
        self._signing = Signing(key) if key else None
        self._codec = Codec(255, 190, self._signing)

    @property
    def refused(self) -> int:
        """Number of frames without a valid signature."""
        return self._signing.refused if self._signing else 0

    def start(self) -> None:
        """Open the port and begin; raises :class:`PortError`."""
        self.port.open()
        Thread(target=self._listen, name="link", daemon=True).start()

    def _listen(self) -> None:
        while True:
            try:
                if not self.port.is_open:
                    self.port.open()
                self._turn()
                self.trouble = ""
            except PortError as error:
                self.trouble = error.reason
                time.sleep(1.0)

    def _turn(self) -> None:
        ready, _, _ = select.select(self.port.fds(), [], [], 0.1)
        self._codec.now_us = time.time_ns() // 1000
        messages = self._codec.parse(self.port.read()) if ready else []
        moment = monotonic_s()
        with self.lock:
            for message in messages:
                self.fleet.receive(message, moment)
            requests = self.fleet.due(moment)
        for name, fields in requests:
            self.port.write(self._codec.pack(name, **fields))
        self.port.flush()
