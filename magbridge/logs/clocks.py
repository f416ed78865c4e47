"""Times as text files write them, in seconds since 1970-01-01 UTC.

A number counts from an epoch (Unix, Excel, Julian, GPS ...), a text is a calendar's date. What the heading
does not say is told by size: an Excel serial of today is 46,000, a Julian date 2.46 million, a Unix time
1.8e9. GPS time cannot be told from Unix time by its size: it must be named.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from magbridge.arrays import FloatArray
from magbridge.logs.gps_time import GPS_EPOCH, leap_seconds

__all__ = ["Clock", "clock_of", "seconds"]

DAY = 86_400.0
EPOCHS = {
    "s": (0.0, 1.0),
    "ms": (0.0, 1e-3),
    "us": (0.0, 1e-6),
    "ns": (0.0, 1e-9),
    "min": (0.0, 60.0),
    "h": (0.0, 3600.0),
    "excel": (-25_569.0 * DAY, DAY),  # days since 1899-12-30, as a spreadsheet counts them
    "julian": (-2_440_587.5 * DAY, DAY),
    "mjd": (-40_587.0 * DAY, DAY),
    "matlab": (-719_529.0 * DAY, DAY),
    "gps": (GPS_EPOCH, 1.0),
}
"""Kind of a number -> s since 1970 of its zero, and s in its unit."""
WORDS = {
    "ms": "millisec", "us": "microsec", "ns": "nanosec", "excel": "excel", "mjd": "mjd|modified",
    "julian": "julian|^jd$",
}  # fmt: skip
"""Kind -> what in a heading says so."""
SIZES = (("excel", 3e4, 6e4), ("matlab", 7.1e5, 7.6e5), ("julian", 2.44e6, 2.48e6))
"""Kinds that count days, and between which numbers their times lie (1982 to 2064, 1943 to 2080, 1968 to
2077)."""
STEP = 5e-4
"""Largest median step, in days (43 s), by which a count of days is known: the seconds since a boot have
larger ones."""
FRACTIONS = (("ns", 1e17, 1e19), ("us", 1e14, 1e17), ("ms", 1e11, 1e14))
YEAR_1980 = 315_532_800.0
DATES = (
    "%d.%m.%Y",  # nobody writes the month first with dots
    *(rf"%{day}{sign}%{month}{sign}%Y" for sign in "/-" for day, month in ("dm", "md")),
    *(rf"%Y{sign}%m{sign}%d" for sign in "./"),
)
OF_A_DAY = "times of day, of a day that the file does not tell"
HOURS = ("%H:%M:%S.%f", "%H:%M:%S", "%H:%M", "%I:%M:%S %p", "%I:%M %p")


class Clock(NamedTuple):
    """How a column's times are read."""

    kind: str
    """A key of :data:`EPOCHS`, ``iso``, or a pattern of :meth:`datetime.strptime`."""
    assumed: str = ""
    """What was taken for granted; empty where the file says it all."""
    boot: bool = False
    """Times count from a start that nobody knows."""

    @property
    def is_text(self) -> bool:
        """Whether the cells are texts."""
        return self.kind not in EPOCHS

    @property
    def expected(self) -> str:
        """What a cell should have been, for an error."""
        if self.kind == "s":
            return "seconds since 1970"
        return f"a time as {self.kind}" if self.is_text and self.kind != "iso" else "a time"


def clock_of(heading: str, unit: str, texts: Sequence[str], zone: str | None) -> Clock:
    """Return the clock of a column of times, from its heading, its unit and its first cells.

    ValueError: dates that can be read in two ways; says what to declare.
    """
    unit = {"seconds": "s", "sec": "s", "hours": "h", "UTC": ""}.get(unit, unit)
    if "%" in unit:
        return Clock(unit, boot="%d" not in unit and "%j" not in unit)
    if unit == "iso":
        return Clock(unit)
    present = [text.strip() for text in texts if text.strip()]
    numbers = pd.to_numeric(pd.Series(present, dtype=object), errors="coerce").to_numpy(float)
    if not unit and _on_a_clock(present):
        return Clock("%H%M%S.%f" if "." in present[0] else "%H%M%S", OF_A_DAY, boot=True)
    if not present or np.isfinite(numbers).any():
        return _counted(heading, unit, numbers[np.isfinite(numbers)])
    return _written(heading, present, zone)


def _on_a_clock(texts: Sequence[str]) -> bool:
    """Say whether six digits are hours, minutes and seconds, as 120059 before 120100, and no count."""
    if not texts or not all(re.fullmatch(r"[0-2]\d[0-5]\d[0-5]\d(\.\d+)?", text) for text in texts):
        return False
    return texts[0].startswith("0") or len({text[2:4] for text in texts}) > 1


def _counted(heading: str, unit: str, numbers: FloatArray) -> Clock:
    if unit in EPOCHS and unit != "s":
        kind, assumed = unit, ""
    else:
        kind, assumed = _kind(heading, numbers, declared=unit == "s")
    start, scale = EPOCHS[kind]
    since = start + scale * float(np.median(numbers)) if len(numbers) else 0.0
    boot = bool(len(numbers)) and abs(since) < YEAR_1980 and heading != "time"
    if boot:
        assumed = f"{assumed or f'in {kind}'}, from a start that the file does not tell"
    return Clock(kind, assumed, boot)


def _kind(heading: str, numbers: FloatArray, *, declared: bool) -> tuple[str, str]:
    """Return the kind of a count, and why it is thought to be that; seconds may be `declared`.

    Under our own name, ``time``, it is in seconds, unless these would be of another age of the Earth.
    """
    ours = declared or heading == "time"
    for kind, words in WORDS.items():
        if re.search(words, heading.lower()):
            return kind, f"{kind}, by its heading"
    if re.search("gps|gnss", heading.lower()) and len(numbers) and 1e8 < numbers.max() < 2e9:
        return "gps", "GPS time, by its heading"
    if not len(numbers):
        return "s", ""
    middle = float(np.median(numbers))
    for kind, low, high in FRACTIONS:
        if low <= middle < high and not declared:
            return kind, f"{kind} since 1970, by its size"
    step = float(np.median(np.diff(numbers))) if len(numbers) > 1 else 0.0
    for kind, low, high in SIZES:
        if low <= middle < high and 0.0 < step < STEP and not ours:
            return kind, f"{kind} days, by its size"
    return "s", "" if ours else "seconds"


def _written(heading: str, texts: Sequence[str], zone: str | None) -> Clock:
    times = pd.Series(list(texts), dtype=object)
    zoned = all(re.search(r"(Z|UTC|GMT|[+-]\d\d:?\d\d)$", text) for text in texts)
    zone_note = "" if zoned else f"times in {zone}" if zone else "times in UTC"
    if pd.to_datetime(times, format="ISO8601", utc=True, errors="coerce").notna().all():
        return Clock("iso", zone_note)
    fit = [f"{date} {hour}" for date in DATES for hour in HOURS if _fits(times, f"{date} {hour}")]
    if not fit:
        hours = next((hour for hour in HOURS if _fits(times, hour)), None)
        if hours is not None:
            return Clock(hours, OF_A_DAY, boot=True)
        return Clock("iso")  # each cell will be refused with its row
    if len(fit) > 1 and len({_order(pattern) for pattern in fit}) > 1:
        which = " or ".join(f'--column time="{heading} [{pattern}]"' for pattern in fit[:2])
        raise ValueError(f"day or month first? {texts[0]!r} can be both: {which}")
    return Clock(fit[0], f"{fit[0]}, {zone_note}" if zone_note else fit[0])


def _order(pattern: str) -> bool:
    return pattern.find("%d") < pattern.find("%m")


def _fits(times: pd.Series, pattern: str) -> bool:
    return bool(pd.to_datetime(times, format=pattern, errors="coerce").notna().all())


def seconds(clock: Clock, cells: pd.Series, zone: str | None) -> FloatArray:
    """Return the cells in s since 1970-01-01 UTC, (n,); NaN where one is empty or cannot be read.

    Parameters
    ----------
    clock : Clock
        As :func:`clock_of` returns it.
    cells : (n,) Series
        Numbers or texts.
    zone : str or None
        Zone of times that do not say theirs; UTC if None.
    """
    if clock.kind in EPOCHS:
        start, scale = EPOCHS[clock.kind]
        times: FloatArray = pd.to_numeric(cells, errors="coerce").to_numpy(np.float64) * scale + start
        return times - leap_seconds(times) if clock.kind == "gps" else times
    texts = cells.astype("string").str.strip()
    if clock.kind == "iso":
        stamps = pd.to_datetime(texts, format="ISO8601", errors="coerce", utc=zone is None)
    else:
        stamps = pd.to_datetime(texts, format=clock.kind, errors="coerce", utc=zone is None)
    if zone is not None:
        stamps = (
            stamps.dt.tz_convert("UTC")
            if stamps.dt.tz is not None
            else stamps.dt.tz_localize(zone, ambiguous="NaT", nonexistent="NaT")
        )
    return _epoch(stamps) % DAY if clock.boot else _epoch(stamps)


def _epoch(stamps: pd.Series) -> FloatArray:
    """Return s since 1970 of time stamps, NaN for none: whole seconds apart, so that no digit is lost."""
    plain = stamps.dt.tz_convert("UTC").dt.tz_localize(None) if stamps.dt.tz is not None else stamps
    counts = plain.astype("datetime64[ns]").to_numpy()
    whole = counts.astype("datetime64[s]")
    times = whole.astype(np.int64) + (counts - whole).astype(np.int64) * 1e-9
    return np.asarray(np.where(np.isnat(counts), np.nan, times), np.float64)
