"""Measurements, over minutes and over a day, in memory that does not grow.

A series is kept at several resolutions at once: each *tier* covers a window with points of one width, and
each point keeps the outline of what fell into it, so that a spike of one sample is still there a day later.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import inf, isfinite

TIERS = {"10 min": (600.0, 1.0), "2 h": (7_200.0, 10.0), "24 h": (86_400.0, 120.0)}
"""Window and width of a point, in s, by the name that the page gives the window."""
MAX_PLOTTED_VALUE = 1e12
"""Larger values are kept as this: no field, and no sum of them overflows."""
LAST_YEAR = 4.1e9
"""Latest valid time (in 2100), s since 1970."""
TRAIL = 2000
"""Places that a trail keeps at most."""


@dataclass(slots=True)
class Point:
    """The samples of one width from `time` (s): sum, number, their range, and that of their 2-sigma bands."""

    time: float
    sum: float = 0.0
    count: int = 0
    low: float = inf
    high: float = -inf
    least: float = inf
    most: float = -inf

    @property
    def mean(self) -> float:
        """Mean of the samples."""
        return self.sum / self.count

    def add(self, value: float, two_sigma: float) -> None:
        """Add a sample with its 2-sigma."""
        self.sum, self.count = self.sum + value, self.count + 1
        self.least, self.most = min(self.least, value), max(self.most, value)
        self.low, self.high = min(self.low, value - two_sigma), max(self.high, value + two_sigma)


class Series:
    """A quantity over time, at the resolutions of `TIERS`, with its latest value (NaN before the first)."""

    def __init__(self) -> None:
        self.latest, self.added = float("nan"), 0
        self._tiers = {
            name: deque[Point](maxlen=round(window / width) + 1) for name, (window, width) in TIERS.items()
        }

    def add(self, time: float, value: float, two_sigma: float = 0.0) -> None:
        """Add a value at `time`, s since 1970, with its 2-sigma; invalid numbers and times are ignored.

        Where the clock was set back, later times are dropped.
        """
        if not (isfinite(value + two_sigma) and 0.0 <= time < LAST_YEAR):
            return
        value, two_sigma = (
            max(-MAX_PLOTTED_VALUE, min(value, MAX_PLOTTED_VALUE)),
            min(abs(two_sigma), MAX_PLOTTED_VALUE),
        )
        self.latest, self.added = value, self.added + 1
        for name, tier in self._tiers.items():
            width = TIERS[name][1]
            begin = time // width * width
            while tier and tier[-1].time > begin:
                tier.pop()
            if not tier or tier[-1].time < begin:
                tier.append(Point(begin))
            tier[-1].add(value, two_sigma)

    def points(self, tier: str) -> list[Point]:
        """Return the points of a tier within its window, in order of time."""
        kept = self._tiers[tier]
        return [one for one in kept if one.time >= kept[-1].time - TIERS[tier][0]] if kept else []


@dataclass(slots=True, frozen=True)
class TrackPoint:
    """A place, deg, and its covariance north-north, north-east, east-east, m² (zero where not known)."""

    latitude: float
    longitude: float
    covariance: tuple[float, float, float] = (0.0, 0.0, 0.0)


class Trail:
    """Positions of a vehicle: at most `TRAIL`; a full trail drops every second position."""

    def __init__(self) -> None:
        self._places: list[TrackPoint] = []
        self._every, self._skipped = 1, 0
        self.latest: TrackPoint | None = None
        self.added = 0

    def add(self, place: TrackPoint) -> None:
        """Add a place; invalid places are ignored."""
        if not (abs(place.latitude) <= 90.0 and abs(place.longitude) <= 180.0):
            return
        self.latest, self.added = place, self.added + 1
        self._skipped += 1
        if self._skipped >= self._every:
            self._skipped = 0
            self._places.append(place)
            if len(self._places) > TRAIL:
                self._places, self._every = self._places[::2], 2 * self._every

    def __iter__(self) -> Iterator[TrackPoint]:
        """Iterate over the places that are kept, and the latest."""
        yield from self._places
        if self.latest is not None:
            yield self.latest


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
    """`since`, `last`: When the condition last began, and when it last held."""
    active: bool = True
    """The condition holds at present."""
    count: int = 1
    """Number of times that the condition has begun."""
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
        """Texts of the alarms, those of active alarms first."""
        ordered = sorted(self.alarms, key=lambda alarm: not alarm.active)
        return "; ".join(dict.fromkeys(alarm.text for alarm in ordered))

    @property
    def active(self) -> bool:
        """At least one of them is active."""
        return any(alarm.active for alarm in self.alarms)

    @property
    def acknowledged(self) -> bool:
        """Somebody has seen all of them."""
        return all(alarm.acknowledged for alarm in self.alarms)

    @property
    def started_s(self) -> float:
        """Time at which the last of them began, s of the receiver's clock."""
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
