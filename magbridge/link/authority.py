"""Who may change what the bridge does, and whose telemetry counts where two send the same."""

from __future__ import annotations

from collections.abc import Mapping

from magbridge.config import Telemetry
from magbridge.link.announcer import Announcer
from magbridge.mavlink import Message
from magbridge.mavlink.dialect import MAV_SEVERITY, MAV_TYPE

__all__ = ["Authority", "Sources"]

REMEMBERED = 64
"""Components whose kind is remembered."""


class Authority:
    """Lets the autopilot and ground stations change parameters and rates, and nobody else.

    A station is whoever says so in its heartbeat. A sender of another system that has sent no heartbeat is
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
        """Note what a component is; return whether it is a ground station."""
        kind: int = message["type"]
        self._kinds.pop((message.system, message.component), None)
        self._kinds[message.system, message.component] = kind
        if len(self._kinds) > REMEMBERED:
            del self._kinds[next(iter(self._kinds))]
        return kind == MAV_TYPE.GCS

    def may_change(self, message: Message) -> bool:
        """Say whether its sender may change what the bridge does."""
        who = message.system, message.component
        ours = message.system == self._system
        kind = self._kinds.get(who, None if ours else MAV_TYPE.GCS)
        return kind == MAV_TYPE.GCS or who == (self._system, self._autopilot)


class Sources:
    """Lets each telemetry parameter come from one component at a time, and tells where two send it.

    Without a ``component`` in the configuration, that is the first heard, but the autopilot goes before all
    others; another takes its place when the parameter has become stale.

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
        self._system, self._autopilot, self._announcer = system, autopilot, announcer
        self._only = {name: one.component for name, one in telemetry.items()}
        self._patience_us = {name: round(one.max_age * 1e6) for name, one in telemetry.items()}
        self._now: dict[str, tuple[int, int]] = {}  # the component that counts, and when it was heard (µs)

    def admit(self, name: str, component: int, time_us: int) -> bool:
        """Say whether a value of the parameter `name` counts that came from `component`."""
        known, heard_us = self._now.get(name, (component, time_us))
        wanted = self._only[name]
        silent = time_us - heard_us > self._patience_us[name]
        if wanted is not None:
            counts = component == wanted
        else:
            counts = component in (known, self._autopilot) or silent
        if not counts:
            text = f"{name} also from {self._system}:{component}: not used"
            self._announcer.state(f"source {name} {component}", text, MAV_SEVERITY.WARNING)
            return False
        if known != component:
            text = f"{name} now from {self._system}:{component}, not {known}"
            self._announcer.state(f"source {name}", text, MAV_SEVERITY.WARNING)
        self._now[name] = component, time_us
        return True
