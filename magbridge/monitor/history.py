"""Store measurements, positions and alarms of minutes to a day in memory of limited size.

A series is stored at several resolutions. Each resolution (*tier*) covers a window of time with points of one
width. Each point stores the range of its samples, so that a spike of one sample remains visible for a day.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from math import inf, isfinite

TIERS = {"10 min": (600.0, 1.0), "2 h": (7_200.0, 10.0), "24 h": (86_400.0, 120.0)}
"""Name of a window on the page -> length of the window and width of its points, s."""
MAX_PLOTTED_VALUE = 1e12
"""Limit to which larger values are clipped, so that their sums do not overflow."""
LAST_YEAR = 4.1e9
"""Latest valid time (in 2100), s since 1970."""
TRAIL = 2000
"""Largest number of positions that a trail stores."""


@dataclass(slots=True)
class Point:
    """Statistics of the samples of one time interval.

    `time` is the start of the interval, s since 1970. `least` and `most` limit the samples, `low` and `high`
    their 2-sigma bands.
    """

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
        """Add a sample and its 2-sigma uncertainty, in the unit of the series."""
        self.sum, self.count = self.sum + value, self.count + 1
        self.least, self.most = min(self.least, value), max(self.most, value)
        self.low, self.high = min(self.low, value - two_sigma), max(self.high, value + two_sigma)


class Series:
    """Time series of a quantity at the resolutions of `TIERS`."""

    def __init__(self) -> None:
        points = {name: round(window / width) + 1 for name, (window, width) in TIERS.items()}
        self._tiers = {name: deque[Point](maxlen=count) for name, count in points.items()}

    def add(self, time: float, value: float, two_sigma: float = 0.0) -> None:
        """Add a value at `time`, s since 1970, with its 2-sigma if it is valid; remove all later points."""
        if not (isfinite(value + two_sigma) and 0.0 <= time < LAST_YEAR):
            return
        value = max(-MAX_PLOTTED_VALUE, min(value, MAX_PLOTTED_VALUE))
        two_sigma = min(abs(two_sigma), MAX_PLOTTED_VALUE)
        for name, tier in self._tiers.items():
            width = TIERS[name][1]
            begin = time // width * width
            while tier and tier[-1].time > begin:
                tier.pop()
            if not tier or tier[-1].time < begin:
                tier.append(Point(begin))
            tier[-1].add(value, two_sigma)

    def points(self, tier: str) -> list[Point]:
        """Return the points within the window of a tier, in the order of time."""
        kept = self._tiers[tier]
        return [one for one in kept if one.time >= kept[-1].time - TIERS[tier][0]] if kept else []


@dataclass(slots=True, frozen=True)
class TrackPoint:
    """Position of the vehicle, deg, and its covariance NN, NE, EE, m² (zero if unknown)."""

    latitude: float
    longitude: float
    covariance: tuple[float, float, float] = (0.0, 0.0, 0.0)


class Trail:
    """Track of a vehicle with at most `TRAIL` positions.

    A full trail removes every second position and then stores fewer of the new ones. `latest` is the last
    position, `added` the number of positions added.
    """

    def __init__(self) -> None:
        self._places: list[TrackPoint] = []
        self._every, self._skipped = 1, 0
        self.latest: TrackPoint | None = None
        self.added = 0

    def add(self, place: TrackPoint) -> None:
        """Add a position; ignore a latitude or longitude outside its range."""
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
        """Iterate over the stored positions, and then the latest position."""
        yield from self._places
        if self.latest is not None:
            yield self.latest


MAX_ALARMS = 100
"""Largest number of stored alarms; the oldest are removed first."""
ALARM_CAUSES = {
    "sensor": ("Sensor", "gap", "saturated", "offset_suspect", "lost:", "sensor"),
    "autopilot": ("Autopilot", "stale_telemetry", "link", "autopilot"),
    "log": ("Log", "log"),
    "bridge": ("silence",),
    "field": ("implausible", "unexplained", "field", "explained"),
    "calibration": ("uncalibrated", "extrapolated", "calibration"),
    "navigation": ("navigation", "position"),
}
"""Cause of alarms -> keys of the alarms, and words in STATUSTEXTs, that belong to the cause."""


@dataclass(slots=True)
class Alarm:
    """Alarm about one condition or message; times are s of the receiver's monotonic clock."""

    key: str
    text: str
    """`key`, `text`: Identifier of the alarm, and its text on the page."""
    since: float
    last: float = field(compare=False)
    """`since`, `last`: Time at which the condition last began, and at which it was last present, s."""
    active: bool = True
    """True while the condition is present."""
    count: int = 1
    """Number of times that the condition has begun."""
    acknowledged: bool = False
    """True if a user has acknowledged the alarm since it last began."""

    @property
    def cause(self) -> str:
        """Cause of the alarm: a key of :data:`ALARM_CAUSES`, else a text's first words, else its key."""
        kind, colon, text = self.key.partition(": ")
        words = text.split() if colon and kind == "text" else [self.key]
        for cause, names in ALARM_CAUSES.items():
            if any(word in names or word.rstrip(":") in names for word in words):
                return cause
        return text.partition(":")[0] if colon else self.key


class Alarms:
    """Alarms of one vehicle."""

    def __init__(self) -> None:
        self._alarms: dict[str, Alarm] = {}

    def __iter__(self) -> Iterator[Alarm]:
        """Iterate over the alarms, the newest first."""
        return iter(sorted(self._alarms.values(), key=lambda alarm: alarm.since, reverse=True))

    @property
    def groups(self) -> list[Alarm]:
        """Alarms of each cause as one alarm, the newest first; the texts of active alarms stand first."""
        found: dict[str, list[Alarm]] = {}
        for alarm in self:
            found.setdefault(alarm.cause, []).append(alarm)
        together = []
        for cause, alarms in found.items():
            texts = dict.fromkeys(one.text for one in sorted(alarms, key=lambda one: not one.active))
            active, seen = any(one.active for one in alarms), all(one.acknowledged for one in alarms)
            last, count = max(one.last for one in alarms), max(one.count for one in alarms)
            together.append(Alarm(cause, "; ".join(texts), alarms[0].since, last, active, count, seen))
        return together

    @property
    def unseen(self) -> int:
        """Number of causes that have an alarm without acknowledgement."""
        return len({alarm.cause for alarm in self._alarms.values() if not alarm.acknowledged})

    def update(self, conditions: Mapping[str, str], now_s: float) -> None:
        """Begin or update an alarm for each condition (key -> text) at `now_s`; end all other alarms."""
        for key, alarm in self._alarms.items():
            alarm.active = alarm.active and key in conditions
        for key, text in conditions.items():
            known = self._alarms.get(key)
            if known is None or not known.active:
                self.announce(key, text, now_s, active=True)
            else:
                known.text, known.last = text, now_s

    def announce(self, key: str, text: str, now_s: float, *, active: bool = False) -> None:
        """Begin or restart an alarm at `now_s`; without `active`, it is an event that is over at once."""
        count = self._alarms.pop(key).count + 1 if key in self._alarms else 1
        self._alarms[key] = Alarm(key, text, now_s, now_s, active, count)
        while len(self._alarms) > MAX_ALARMS:
            del self._alarms[next(iter(self._alarms))]

    def withdraw(self, key: str) -> None:
        """Remove an alarm, because its text was only the first part of a longer STATUSTEXT."""
        self._alarms.pop(key, None)

    def acknowledge(self, cause: str | None = None) -> None:
        """Record that a user has acknowledged the alarms of a cause, or all alarms if `cause` is None."""
        for one in self._alarms.values():
            one.acknowledged |= cause in {None, one.cause}
