"""Receive MAVLink messages of bridges in a thread, and send the requests of the page."""

from __future__ import annotations

import select
import time
from math import inf
from threading import Lock, Thread
from typing import Any

from magbridge.bridge.port import Port
from magbridge.errors import PortError
from magbridge.mavlink import Codec, Message, Signing, spec
from magbridge.mavlink.enums import MAV_AUTOPILOT, MAV_STATE, MAV_TYPE
from magbridge.monitor.state import BridgeState
from magbridge.monitor.words import conditions

BRIDGES = {spec(name).id for name in ("MAG_RAW", "MAG_FIELD", "MAG_STATUS")}
"""Messages that identify their sender as a bridge, by id."""
MAX_BRIDGES, BRIDGE_TIMEOUT_S = 8, 30.0
"""Largest number of bridges, and silence after which a new bridge replaces the most silent bridge, s."""
CHECK_INTERVAL_S = 0.5
"""Time between two checks of the conditions that raise alarms, s."""


class ReceivedBridges:
    """States of all received bridges, by (system, component), in the order of their first messages."""

    def __init__(self) -> None:
        self.states: dict[tuple[int, int], BridgeState] = {}
        self._beat = self._checked = -inf

    def receive(self, message: Message, now_s: float) -> None:
        """Process a message received at `now_s`, s of a monotonic clock."""
        if not message.known:
            return
        sender = message.system, message.component
        if sender not in self.states and message.id in BRIDGES and self._room(now_s):
            self.states[sender] = BridgeState(sender, message.sequence - 1)
        if sender in self.states:
            self.states[sender].receive(message, now_s)
            return
        for state in self.states.values():
            if state.bridge is not None and state.bridge[0] == message.system:
                state.receive_other(message, now_s)

    def _room(self, now_s: float) -> bool:
        """Return True if another bridge can be stored; if necessary, remove a bridge that no longer sends."""
        if len(self.states) < MAX_BRIDGES:
            return True
        silent, state = min(self.states.items(), key=lambda item: item[1].received_at)
        if now_s - state.received_at <= BRIDGE_TIMEOUT_S:
            return False
        del self.states[silent]
        return True

    def due(self, now_s: float) -> list[tuple[str, dict[str, Any]]]:
        """Return the messages to send at `now_s`: the heartbeat of the station, and unanswered requests."""
        requests: list[tuple[str, dict[str, Any]]] = []
        if now_s - self._beat >= 1.0:
            self._beat = now_s
            kind = {"type": MAV_TYPE.GCS, "autopilot": MAV_AUTOPILOT.INVALID, "mavlink_version": 3}
            requests.append(("HEARTBEAT", {**kind, "system_status": MAV_STATE.ACTIVE}))
        if now_s - self._checked >= CHECK_INTERVAL_S:
            self._checked = now_s
            for state in self.states.values():
                state.alarms.update(conditions(state, now_s), now_s)
        return requests + [request for state in self.states.values() for request in state.due(now_s)]


ASLEEP = getattr(time, "CLOCK_BOOTTIME", None)
"""Clock that also advances while the computer sleeps; None if the system does not have one."""


def monotonic_s() -> float:
    """Return the time of a monotonic clock, s; where possible it includes the sleep of the computer."""
    return time.monotonic() if ASLEEP is None else time.clock_gettime(ASLEEP)


class StationLink:
    """Link of the ground station 255:190 that reads and writes `port` until the process ends.

    With a `key` of 32 bytes, the link signs its frames and rejects frames without a valid signature. Hold
    `lock` to access `fleet`. `trouble` is the fault of the port, empty if there is none.
    """

    def __init__(self, port: Port, key: bytes | None = None) -> None:
        self.port, self.fleet, self.lock, self.trouble = port, ReceivedBridges(), Lock(), ""
        self._signing = Signing(key) if key else None
        self._codec = Codec(255, 190, self._signing)

    @property
    def refused(self) -> int:
        """Number of frames that were rejected for lack of a valid signature."""
        return self._signing.refused if self._signing else 0

    def start(self) -> None:
        """Open the port and start the thread; PortError: the port cannot be opened."""
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
