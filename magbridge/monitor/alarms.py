"""What a person should look at: conditions that began, and whether somebody has seen them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

__all__ = ["MAX_ALARMS", "Alarm", "Alarms"]

MAX_ALARMS = 100
"""Alarms that are kept at most; the oldest go first."""


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


class Alarms:
    """The alarms of one vehicle, the newest first."""

    def __init__(self) -> None:
        self._alarms: dict[str, Alarm] = {}

    def __iter__(self) -> Iterator[Alarm]:
        """Iterate, the one that began last first."""
        return iter(sorted(self._alarms.values(), key=lambda alarm: alarm.since, reverse=True))

    @property
    def unseen(self) -> int:
        """Number of alarms that have not been acknowledged."""
        return sum(not alarm.acknowledged for alarm in self._alarms.values())

    def update(self, conditions: Mapping[str, str], now: float) -> None:
        """Update with all faults at `now`, its keys and its words; the other conditions are over."""
        for key, alarm in self._alarms.items():
            alarm.active = alarm.active and key in conditions
        for key, text in conditions.items():
            known = self._alarms.get(key)
            if known is None or not known.active:
                self.announce(key, text, now, active=True)
            else:
                known.text, known.last = text, now

    def announce(self, key: str, text: str, now: float, *, active: bool = False) -> None:
        """Begin an alarm, or restart it; one that is not `active` is an event, over at once."""
        count = self._alarms.pop(key).count + 1 if key in self._alarms else 1
        self._alarms[key] = Alarm(key, text, now, now, active, count)
        while len(self._alarms) > MAX_ALARMS:
            del self._alarms[next(iter(self._alarms))]

    def withdraw(self, key: str) -> None:
        """Remove an alarm whose text was only the beginning of a longer one."""
        self._alarms.pop(key, None)

    def acknowledge(self, key: str | None = None) -> None:
        """Note that somebody has seen an alarm; without a key, all of them."""
        for one in self._alarms.values():
            one.acknowledged |= key in {None, one.key}
