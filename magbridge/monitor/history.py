"""Measurements, over minutes and over a day, in memory that does not grow.

A series is kept at several resolutions at once: each *tier* covers a window with points of one width, and
each point keeps the outline of what fell into it, so that a spike of one sample is still there a day later.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from math import inf, isfinite

__all__ = ["MAX_PLOTTED_VALUE", "TIERS", "Point", "Series", "TrackPoint", "Trail"]

TIERS = {"10 min": (600.0, 1.0), "2 h": (7_200.0, 10.0), "24 h": (86_400.0, 120.0)}
"""Window and width of a point, in s, by the name that the page gives the window."""
MAX_PLOTTED_VALUE = 1e12
"""Larger values are kept as this: no field, and no sum of them overflows."""
LAST_YEAR = 4.1e9
"""s since 1970: a later time (in 2100) is invalid."""
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
        """Take one more sample in."""
        self.sum, self.count = self.sum + value, self.count + 1
        self.least, self.most = min(self.least, value), max(self.most, value)
        self.low, self.high = min(self.low, value - two_sigma), max(self.high, value + two_sigma)


class Series:
    """A quantity over time, at the resolutions of `TIERS`.

    Attributes
    ----------
    latest : float
        The last value added; NaN before the first.
    added : int
        Number of values added.
    """

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
    """Where a vehicle was: at most `TRAIL` places, of which every second goes when they are full."""

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
