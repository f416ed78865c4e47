"""All vehicles that a ground station receives, each with its own state."""

from __future__ import annotations

from math import inf
from typing import Any

from magbridge.mavlink import Message, spec
from magbridge.mavlink.enums import MAV_AUTOPILOT, MAV_STATE, MAV_TYPE
from magbridge.monitor.state import BridgeState
from magbridge.monitor.words import conditions

__all__ = ["ReceivedBridges"]

BRIDGES = {spec(name).id for name in ("MAG_RAW", "MAG_FIELD", "MAG_STATUS")}
"""A component that sends one of these is a bridge."""
MOST, AWAY = 8, 30.0
"""Bridges that are kept at most, and s of silence after which one makes room for another."""
CHECK = 0.5
"""s between checks for faults."""


class ReceivedBridges:
    """The bridges received, and the data to send to them.

    Attributes
    ----------
    states : dict of tuple of 2 int to BridgeState
        By system and component, in the order in which they were first heard.
    """

    def __init__(self) -> None:
        self.states: dict[tuple[int, int], BridgeState] = {}
        self._beat = self._checked = -inf

    def receive(self, message: Message, now_s: float) -> None:
        """Take a message that came at `now_s`, s of a monotonic clock."""
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
        """Make room for one more bridge; False where all known ones still send."""
        if len(self.states) < MOST:
            return True
        silent, state = min(self.states.items(), key=lambda item: item[1].received_at)
        if now_s - state.received_at <= AWAY:
            return False
        del self.states[silent]
        return True

    def due(self, now_s: float) -> list[tuple[str, dict[str, Any]]]:
        """Return the messages to send at `now_s`: our heartbeat, and requests not yet answered."""
        requests: list[tuple[str, dict[str, Any]]] = []
        if now_s - self._beat >= 1.0:
            self._beat = now_s
            kind = {"type": MAV_TYPE.GCS, "autopilot": MAV_AUTOPILOT.INVALID, "mavlink_version": 3}
            requests.append(("HEARTBEAT", {**kind, "system_status": MAV_STATE.ACTIVE}))
        if now_s - self._checked >= CHECK:
            self._checked = now_s
            for state in self.states.values():
                state.alarms.update(conditions(state, now_s), now_s)
        return requests + [request for state in self.states.values() for request in state.due(now_s)]
