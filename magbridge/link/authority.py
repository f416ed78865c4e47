"""Authority to change the bridge, and the source of each telemetry parameter."""

from __future__ import annotations

from collections.abc import Mapping

from magbridge.config import Telemetry
from magbridge.link.output import Announcer
from magbridge.mavlink import Message, Source
from magbridge.mavlink.enums import MAV_SEVERITY, MAV_TYPE

__all__ = ["Authority", "Sources"]

MAX_COMPONENTS = 64
"""Components whose kind is remembered."""


class Authority:
    """Allow the autopilot and ground stations, and no other component, to change parameters and rates.

    A station is a sender with a heartbeat of that type. A sender of another system without a heartbeat is
    taken for one, because small programs send none; another component of our own vehicle is not.

    Parameters
    ----------
    system, autopilot : int
        Of our own vehicle.
    """

    def __init__(self, system: int, autopilot: int) -> None:
        self._system, self._autopilot = system, autopilot
        self._kinds: dict[tuple[int, int], int] = {}

    def heartbeat(self, message: Message) -> bool:
        """Record the type of a component; return True for a ground station."""
        kind: int = message["type"]
        self._kinds.pop((message.system, message.component), None)
        self._kinds[message.system, message.component] = kind
        if len(self._kinds) > MAX_COMPONENTS:
            del self._kinds[next(iter(self._kinds))]
        return kind == MAV_TYPE.GCS

    def may_change(self, message: Message) -> bool:
        """Return True if its sender may change the bridge's settings."""
        who = message.system, message.component
        ours = message.system == self._system
        kind = self._kinds.get(who, None if ours else MAV_TYPE.GCS)
        return kind == MAV_TYPE.GCS or who == (self._system, self._autopilot)


class Sources:
    """Select one component as the source of each telemetry parameter, and report conflicts.

    Parameters
    ----------
    telemetry : mapping of str to Telemetry
        ``[telemetry.NAME]`` of the configuration.
    system, autopilot : int
        Of our own vehicle.
    announcer : Announcer
    """

    def __init__(
        self, telemetry: Mapping[str, Telemetry], system: int, autopilot: int, announcer: Announcer
    ) -> None:
        self._system, self._announcer = system, announcer
        self._of = {
            name: Source(autopilot, round(one.max_age * 1e6), one.component)
            for name, one in telemetry.items()
        }

    def admit(self, name: str, component: int, time_us: int) -> bool:
        """Return True if a value of the parameter `name` from `component` counts."""
        source = self._of[name]
        before = source.component
        if not source.admit(component, time_us):
            text = f"{name} also from {self._system}:{component}: not used"
            self._announcer.state(f"source {name} {component}", text, MAV_SEVERITY.WARNING)
            return False
        if component != before and before is not None:
            text = f"{name} now from {self._system}:{component}, not {before}"
            self._announcer.state(f"source {name}", text, MAV_SEVERITY.WARNING)
        return True
