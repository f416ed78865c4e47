"""The parameter protocol: a station lists, reads and writes parameters."""

from __future__ import annotations

from magbridge.link.authority import Authority
from magbridge.link.output import Announcer, Outbox, Timers
from magbridge.link.parameters import Parameters
from magbridge.mavlink import Message
from magbridge.mavlink.enums import MAV_PARAM_TYPE, MAV_SEVERITY

__all__ = ["ParameterService"]

PACE_US = 20_000
"""µs between the values of a list: 50 a second, which a slow radio can carry."""
LIST_INTERVAL_US = 10_000_000
"""µs between two lists that no station requested."""
FORGOTTEN_US = 60_000_000
"""µs without a heartbeat after which a station is new again."""
STATIONS = 16
"""Stations that are remembered."""


class ParameterService:
    """Answer PARAM_REQUEST_LIST, PARAM_REQUEST_READ and PARAM_SET; all values are REAL32.

    Parameters
    ----------
    parameters : Parameters
    outbox, timers, announcer
    authority : Authority
        Knows who may set a parameter.
    """

    def __init__(
        self,
        parameters: Parameters,
        outbox: Outbox,
        timers: Timers,
        announcer: Announcer,
        authority: Authority,
    ) -> None:
        self._parameters, self._outbox, self._timers = parameters, outbox, timers
        self._announcer, self._authority = announcer, authority
        self._listed = self._rounds = self._unasked = 0
        self._stations: dict[tuple[int, int], int] = {}

    def send(self, name: str) -> None:
        """Send the value of a parameter."""
        self._outbox.send(
            "PARAM_VALUE",
            param_id=name,
            param_value=self._parameters[name],
            param_type=MAV_PARAM_TYPE.REAL32,
            param_count=len(self._parameters.names),
            param_index=self._parameters.names.index(name),
        )

    def greet(self, station: tuple[int, int]) -> None:
        """Send all parameters to a new station, and again `REPEAT_US` later.

        QGroundControl with an autopilot never asks another component for its parameters, and it forgets those
        that it receives before it has the autopilot's.
        """
        now_us = self._outbox.codec.now_us
        before_us = self._stations.pop(station, None)
        self._stations[station] = now_us
        if len(self._stations) > STATIONS:
            del self._stations[next(iter(self._stations))]
        if before_us is None or now_us - before_us > FORGOTTEN_US:
            under_way, self._unasked = self._unasked, 3
            if not under_way:
                self._list_unasked(now_us)

    def _list_unasked(self, time_us: int) -> None:
        self._unasked -= 1
        if self._unasked:
            self._begin()
            self._timers.run_once("parameters unasked", time_us + LIST_INTERVAL_US, self._list_unasked)

    def list(self, message: Message) -> None:  # noqa: ARG002 - every handler takes its message
        """Begin to send all parameters, one every `PACE_US`, after the rest of a list that is being sent."""
        self._begin()

    def _begin(self) -> None:
        if not self._rounds:
            self._listed = 0
            self._timers.every("parameters", PACE_US, self._send_next, self._outbox.codec.now_us)
        self._rounds = 2 if self._listed else 1

    def _send_next(self, _: int) -> None:
        self.send(self._parameters.names[self._listed])
        self._listed += 1
        if self._listed == len(self._parameters.names):
            self._listed = 0
            self._rounds -= 1
        if not self._rounds:
            self._timers.cancel("parameters")

    def read(self, message: Message) -> None:
        """Send the parameter of an index or a name; ignore a request for a parameter that does not exist."""
        index = message["param_index"]
        names = self._parameters.names
        if index != -1 and message["target_component"] == 0:
            return  # an index means another parameter in every component
        name = message["param_id"] if index == -1 else names[index] if 0 <= index < len(names) else ""
        if name in self._parameters.table:
            self.send(name)

    def write(self, message: Message) -> None:
        """Set a parameter, and answer with the value that it has afterwards."""
        name, value = message["param_id"], message["param_value"]
        row = self._parameters.table.get(name)
        if row is None:
            return
        if message["param_type"] != MAV_PARAM_TYPE.REAL32:
            self._refuse(name, "only REAL32 is taken")
        elif not self._authority.may_change(message):
            who = f"{message.system}:{message.component}"
            self._refuse(name, f"only a station or the autopilot sets it, not {who}")
        elif not self._parameters.set(name, value):
            self._refuse(
                name, f"{value:.6g} is not within {row.low:.6g} to {row.high:.6g} {row.unit}".rstrip()
            )
        else:
            text = f"{name} = {value:.6g}, set by {message.system}:{message.component}"
            self._announcer.state(f"set {name}", text, MAV_SEVERITY.NOTICE)
        self.send(name)

    def _refuse(self, name: str, reason: str) -> None:
        self._announcer.state(f"refused {name}", f"{name}: {reason}", MAV_SEVERITY.WARNING, recurring=True)
