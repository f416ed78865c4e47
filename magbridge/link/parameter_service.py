"""The parameter protocol: a station lists, reads and writes what can be tuned."""

from __future__ import annotations

from collections.abc import Callable

from magbridge.link.announcer import Announcer
from magbridge.link.outbox import Outbox
from magbridge.link.parameters import Parameters
from magbridge.link.timers import Timers
from magbridge.mavlink import Message
from magbridge.mavlink.dialect import MAV_PARAM_TYPE, MAV_SEVERITY

__all__ = ["ParameterService"]

PACE_US = 20_000
"""µs between the values of a list: 50 a second, which a slow radio can carry."""


class ParameterService:
    """Answers PARAM_REQUEST_LIST, PARAM_REQUEST_READ and PARAM_SET, all values REAL32.

    Parameters
    ----------
    parameters : Parameters
    outbox, timers, announcer
    on_change : callable
        Called with the name of a parameter that a station changed.
    """

    def __init__(
        self,
        parameters: Parameters,
        outbox: Outbox,
        timers: Timers,
        announcer: Announcer,
        on_change: Callable[[str], None],
    ) -> None:
        self._parameters, self._outbox, self._timers = parameters, outbox, timers
        self._announcer, self._on_change = announcer, on_change
        self._listed = 0

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

    def list(self, message: Message) -> None:  # noqa: ARG002 - every handler takes its message
        """Begin to send all parameters, one every `PACE_US`; a list already under way is begun again."""
        self._listed = 0
        self._timers.every("parameters", PACE_US, self._send_next, self._outbox.codec.now_us)

    def _send_next(self, _: int) -> None:
        self.send(self._parameters.names[self._listed])
        self._listed += 1
        if self._listed == len(self._parameters.names):
            self._timers.cancel("parameters")

    def read(self, message: Message) -> None:
        """Send the parameter asked for by index or name; a request for one that does not exist is ignored."""
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
        elif not self._parameters.set(name, value):
            self._refuse(
                name, f"{value:.6g} is not within {row.low:.6g} to {row.high:.6g} {row.unit}".rstrip()
            )
        else:
            self._on_change(name)
        self.send(name)

    def _refuse(self, name: str, why: str) -> None:
        self._announcer.state(f"refused {name}", f"{name}: {why}", MAV_SEVERITY.WARNING, again=True)
