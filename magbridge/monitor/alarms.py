"""Alarms: conditions with their start and whether they were acknowledged."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

__all__ = ["MAX_ALARMS", "Alarm", "AlarmGroup", "Alarms", "cause_of"]

MAX_ALARMS = 100
"""Alarms that are kept at most; the oldest go first."""
ALARM_CAUSES = {
    "sensor": ("Sensor", "gap", "saturated", "offset_suspect", "lost:", "sensor"),
    "autopilot": ("Autopilot", "stale_telemetry", "link", "autopilot"),
    "log": ("Log", "log"),
    "bridge": ("silence",),
    "field": ("implausible", "unexplained", "field", "explained"),
    "calibration": ("uncalibrated", "extrapolated", "calibration"),
    "navigation": ("navigation", "position"),
}
"""Cause of alarms to their keys, and to words in the STATUSTEXTs of the cause."""


def cause_of(key: str) -> str:
    """Return the cause of an alarm: a key of :data:`ALARM_CAUSES`, or a text's words before the colon."""
    kind, colon, text = key.partition(": ")
    words = text.split() if colon and kind == "text" else [key]
    for cause, names in ALARM_CAUSES.items():
        if any(word in names or word.rstrip(":") in names for word in words):
            return cause
    return text.partition(":")[0] if colon else key


@dataclass(slots=True)
class Alarm:
    """Something that began at `since` (s of the receiver's clock)."""

    key: str
    text: str
    """`key`, `text`: Identifier, and text for a reader."""
    since: float
    last: float
    """`since`, `last`: When it last began, and when it was last so."""
    active: bool = True
    """It is so at present."""
    count: int = 1
    """How often it has begun."""
    acknowledged: bool = False
    """Somebody has seen it since it last began."""

    @property
    def cause(self) -> str:
        """The cause, by which alarms are grouped."""
        return cause_of(self.key)


@dataclass(frozen=True, slots=True)
class AlarmGroup:
    """The alarms of one cause, the newest first."""

    cause: str
    alarms: tuple[Alarm, ...]

    @property
    def text(self) -> str:
        """The texts, those that are so at present first."""
        ordered = sorted(self.alarms, key=lambda alarm: not alarm.active)
        return "; ".join(dict.fromkeys(alarm.text for alarm in ordered))

    @property
    def active(self) -> bool:
        """At least one of them is so at present."""
        return any(alarm.active for alarm in self.alarms)

    @property
    def acknowledged(self) -> bool:
        """Somebody has seen all of them."""
        return all(alarm.acknowledged for alarm in self.alarms)

    @property
    def started_s(self) -> float:
        """When the last of them began, s of the receiver's clock."""
        return self.alarms[0].since

    @property
    def count(self) -> int:
        """The largest number of times that one of them has begun."""
        return max(alarm.count for alarm in self.alarms)


class Alarms:
    """The alarms of one vehicle, the newest first."""

    def __init__(self) -> None:
        self._alarms: dict[str, Alarm] = {}

    def __iter__(self) -> Iterator[Alarm]:
        """Iterate, the one that began last first."""
        return iter(sorted(self._alarms.values(), key=lambda alarm: alarm.since, reverse=True))

    @property
    def groups(self) -> list[AlarmGroup]:
        """The alarms by their causes; the cause whose alarm began last comes first."""
        found: dict[str, list[Alarm]] = {}
        for alarm in self:
            found.setdefault(alarm.cause, []).append(alarm)
        return [AlarmGroup(cause, tuple(alarms)) for cause, alarms in found.items()]

    @property
    def unseen(self) -> int:
        """Number of causes with an alarm that has not been acknowledged."""
        return len({alarm.cause for alarm in self._alarms.values() if not alarm.acknowledged})

    def update(self, conditions: Mapping[str, str], now_s: float) -> None:
        """Update with all faults at `now_s`, its keys and its words; the other conditions are over."""
        for key, alarm in self._alarms.items():
            alarm.active = alarm.active and key in conditions
        for key, text in conditions.items():
            known = self._alarms.get(key)
            if known is None or not known.active:
                self.announce(key, text, now_s, active=True)
            else:
                known.text, known.last = text, now_s

    def announce(self, key: str, text: str, now_s: float, *, active: bool = False) -> None:
        """Begin an alarm, or restart it; one that is not `active` is an event, over at once."""
        count = self._alarms.pop(key).count + 1 if key in self._alarms else 1
        self._alarms[key] = Alarm(key, text, now_s, now_s, active, count)
        while len(self._alarms) > MAX_ALARMS:
            del self._alarms[next(iter(self._alarms))]

    def withdraw(self, key: str) -> None:
        """Remove an alarm whose text was only the beginning of a longer one."""
        self._alarms.pop(key, None)

    def acknowledge(self, cause: str | None = None) -> None:
        """Record that somebody has seen the alarms of a cause; without one, all of them."""
        for one in self._alarms.values():
            one.acknowledged |= cause in {None, one.cause}
