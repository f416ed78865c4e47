"""Convert times in text files to seconds since 1970-01-01 UTC.

A number counts from an epoch (Unix, Excel, Julian, GPS ...); a text is a calendar date. If the heading does
not state the kind of number, its magnitude decides: an Excel serial of today is 46,000, a Julian date 2.46
million, a Unix time 1.8e9. GPS time, ahead of UTC by :func:`leap_seconds`, is as large as Unix time and must
be declared or named in the heading. If several columns form the time, their cells are joined by blanks.

The pattern of a date is that of :meth:`datetime.strptime`; the ending `` s`` stands for seconds of the day. A
fraction of a second after a point, a comma or a colon is read with any pattern.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import datetime
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from magbridge.arrays import FloatArray
from magbridge.columns import YEAR_1980, usual
from magbridge.logs.checks import MEDIAN_ROWS, boots
from magbridge.logs.layout import numbers_of

DAY = 86_400.0
HOURS = ("%H:%M:%S", "%H:%M", "%I:%M:%S %p", "%I:%M %p", "%H%M%S")
DATES = (
    *("%d.%m.%Y", "%d.%m.%y"),  # with dots, the day comes first
    *(f"%{day}{sign}%{month}{sign}%{year}" for year in "Yy" for sign in "/-" for day, month in ("dm", "md")),
    *("%Y-%m-%d", "%Y/%m/%d", "%Y.%m.%d", "%Y-%j", "%d-%b-%Y", "%d %b %Y"),
    *("%Y%m%d", "%d%m%y", "%y%m%d", "%m%d%y"),
)
WHOLE_MOMENTS = ("%a %b %d %H:%M:%S %Y", "%Y%m%d%H%M%S", "%Y %m %d %H %M %S", "%Y %j %H %M %S")
"""Patterns of date and time together; the last two are for columns of numbers, joined by blanks."""
SECONDS_SUFFIX = " s"
YEAR_1900 = -2_208_988_800.0
"""Start of 1900, s since 1970: date of a time of day without a date, and earliest date of a log."""
FRACTION = r"(?:(?P<clock>\d:\d\d:\d\d)[.,:]|(?P<digits>\d{6}| \d\d?)\.)(?P<fraction>\d+)(?=(?: ?[AP]M)?$)"
GPS_EPOCH = 315_964_800.0
"""s since 1970 of 1980-01-06, where GPS weeks begin."""
WEEK = 604_800.0
"""Length of a GPS week, s."""
LEAPS = (
    *((0, 13), (1_136_073_600, 14), (1_230_768_000, 15)),
    *((1_341_100_800, 16), (1_435_708_800, 17), (1_483_228_800, 18)),
)
"""Start (s since 1970) of each lead of GPS time over UTC, and the lead (s); IERS Bulletin C 52."""
EPOCHS = {
    "s": (0.0, 1.0),
    "unix": (0.0, 1.0),  # s since 1970, also before 1980
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
COUNTS = frozenset({"s", "ms", "us", "ns", "min", "h"})
"""Kinds without an epoch: small numbers count from a boot, large ones from 1970."""
SUMS = {"seconds and nanoseconds": (0.0, 1.0, 1e-9), "GPS week and seconds": (GPS_EPOCH, WEEK, 1.0)}
"""Kind of a pair of numbers, joined by a blank -> s since 1970 of its zero, and s in the unit of each."""
SECONDS_OF_DAY, BY_HOUR = "date and seconds of the day", "date and HHMM.mmm"
"""Kinds of a date in one column and a time of day in another."""
HEADING_WORDS = {
    "ms": r"milli|[_ .]ms$", "us": r"micro|[_ .]us$|time_?us$", "ns": r"nano|[_ .]ns$", "excel": "excel",
    "mjd": "mjd|modified", "julian": "julian|^jd$",
}  # fmt: skip
"""Kind of number -> pattern of the words in a heading that state it."""
DAY_COUNT_RANGES = (
    ("excel", 3e4, 5.1e4),
    ("mjd", 5.1e4, 6.6e4),
    ("matlab", 7.1e5, 7.6e5),
    ("julian", 2.44e6, 2.48e6),
)
"""Kinds that count days, with the range of their numbers (1982, 1998 to 2039, 1943 to 2080, 1968 to 2077)."""
STEP, CERTAIN = 5e-4, 1e-4
"""Largest median step, days, with which a number counts days and not seconds since a boot: 43 s, or 9 s in a
column named ``time``."""
UNIX_TIME_RANGE_S = 3e8, 4.2e9
"""Range in which a count is recognised as Unix time by its size, s since 1970: 1979 to 2103."""
MIN_CLOCK_STEP = 10.0
"""Median step from which whole numbers probably count a finer unit than seconds since a boot."""
DATE_ORDER = re.compile(r"\b(yyyy|yy|mm|dd)\W?(mm|dd)\W?(yyyy|yy|dd)\b", re.IGNORECASE)
"""Part of a heading that states the order of day, month and year."""
MIN_RUN_ROWS = 3
"""Fewest rows after a backward step of a count that make it a restart of the clock, not a wrong value."""
BETWEEN_RUNS_S = 60.0
"""Assumed pause between the runs of a restarted logger, s, since its clock does not measure the pause."""
OF_A_DAY = "times of day, of a day that the file does not tell"


class TimeFormat(NamedTuple):
    """Format of the times in a column."""

    kind: str
    """A key of :data:`EPOCHS`, ``iso``, or a pattern of :meth:`datetime.strptime`."""
    assumed: str = ""
    """The assumption that was made; empty if the file states the format."""
    boot: bool = False
    """True if times count from an unknown start."""
    by_hour: bool = False
    """True if the time of day is written as HHMM.mmm."""
    zone: str | None = None
    """Time zone of cells that do not state theirs; UTC if None."""

    @property
    def is_text(self) -> bool:
        """Return True if the cells are texts."""
        return self.kind not in EPOCHS

    @property
    def is_dated(self) -> bool:
        """Return True if the format states the date: a text with a date, or a count since an epoch."""
        return not self.boot and self.kind not in COUNTS

    @property
    def expected(self) -> str:
        """Return the expected content of a cell, for an error."""
        if self.kind in {"s", "unix"}:
            return "seconds since 1970"
        return f"a time as {self.kind}" if self.is_text and self.kind != "iso" else "a time"

    @property
    def unambiguous(self) -> str:
        """Return the expected content of a cell whose local time is at a change of summer time."""
        change = f"a time that {self.zone} has once, not one at a change of summer time"
        return f"{change} (write the times in UTC, or with their offset, as +01:00)"


class CountState(NamedTuple):
    """State of times from an unknown start while a file is read, with the shift for wraps and restarts."""

    shift_s: float = 0.0
    """Shift that is added to the times for wraps, such as midnights, and for earlier runs, s."""
    last: FloatArray = np.empty(0)
    """(n,): Last times before the shift, s."""

    def go_on(self, times: FloatArray, clock: TimeFormat) -> tuple[FloatArray, CountState, int]:
        """Return the next times (n,), s, with the shift, the new state, and the number of boots.

        After a wrap of a 32-bit count and after midnight the times continue. After a restart of a count they
        continue :data:`BETWEEN_RUNS_S` after the last time.
        """
        unit = EPOCHS.get(clock.kind, (0.0, 1.0))[1] if clock.kind in {"ms", "us", "ns"} else np.inf
        period, wrap = (DAY, DAY / 2) if clock.is_text else ((1 << 32) * unit, 0.9 * (1 << 32) * unit)
        before = len(self.last)
        whole = np.concatenate([self.last, times])
        known = np.flatnonzero(np.isfinite(whole))
        shift, boots_found = self.shift_s, 0
        shifts = np.full(len(times), shift)
        for k in boots(whole[known])[1:].tolist():
            row, last = int(known[k]), float(whole[known[k - 1]])
            has_wrapped = last - whole[row] > wrap
            # a restart that was too near to the end of the previous rows to be certain is found now
            seen = before if has_wrapped else before - MIN_RUN_ROWS + 1
            is_restart = not clock.is_text and len(known) - k >= MIN_RUN_ROWS
            if row < seen or not (has_wrapped or is_restart):
                continue
            shift += period if has_wrapped else last + BETWEEN_RUNS_S - whole[row]
            boots_found += not has_wrapped
            shifts[max(row - before, 0) :] = shift
        last_times = whole[known[-MEDIAN_ROWS:]] if len(known) else self.last
        return times + shifts, CountState(shift, last_times), boots_found


def date_order(headings: Sequence[str]) -> str:
    """Return the heading that states the order of a date, as mm/dd/yyyy; "" if no heading does."""
    return next((heading for heading in headings if DATE_ORDER.search(heading)), "")


def clock_of(heading: str, unit: str, texts: Sequence[str], zone: str | None) -> TimeFormat:
    """Return the format of a column of times, from its heading, its unit and its first cells.

    ValueError: dates can be read in two ways; the message states the possible declarations.
    """
    unit = usual(unit) if "%" not in unit else unit
    unit = "unix" if re.match("s(ec|econds)? since 1970", unit) else unit
    if "%" in unit:
        return TimeFormat(unit, zone=zone, boot="%d" not in unit and "%j" not in unit)
    if unit == "iso" or unit in SUMS:
        return TimeFormat(unit, unit if unit in SUMS else "", zone=zone)
    of_day, by_hour, unit = unit in {SECONDS_OF_DAY, BY_HOUR}, unit == BY_HOUR, unit if unit in EPOCHS else ""
    present = [_seconds_of_day(text) if by_hour else text.strip() for text in texts if text.strip()]
    numbers = numbers_of(pd.Series(present, dtype="str"))
    if not unit and _on_a_clock(heading, present):
        return TimeFormat("%H%M%S", OF_A_DAY, boot=True)
    date_digits = re.compile(r"(19|20)\d{12}(\.\d+)?")
    digits = not unit and bool(present) and all(map(date_digits.fullmatch, present))
    if not digits and (not present or np.isfinite(numbers).any()):
        whole = all(re.fullmatch(r"\d+", one) for one in present)
        return _counted(heading, unit, numbers[np.isfinite(numbers)], integers=whole)
    return _written(heading, present, zone, of_day=of_day)._replace(by_hour=by_hour, zone=zone)


def _on_a_clock(heading: str, texts: Sequence[str]) -> bool:
    """Return True if six digits are hours, minutes and seconds, as 120059 before 120100, and not a count."""
    if not texts or not all(re.fullmatch(r"[0-2]\d[0-5]\d[0-5]\d(\.\d+)?", text) for text in texts):
        return False
    named = re.search("utc|gmt|hhmmss|of.?day|zeit", heading.lower())
    return bool(named) or texts[0].startswith("0") or len({text[2:4] for text in texts}) > 1


def _counted(heading: str, unit: str, numbers: FloatArray, *, integers: bool) -> TimeFormat:
    if unit and unit != "s":
        kind, assumed = unit, ""
    else:
        kind, assumed = _kind(heading, numbers, declared=unit == "s")
    start, scale = EPOCHS[kind]
    since = start + scale * float(np.median(numbers)) if len(numbers) else 0.0
    step = float(np.median(np.diff(numbers))) if len(numbers) > 1 else 0.0
    is_unix_time = YEAR_1980 <= since < UNIX_TIME_RANGE_S[1] and step < DAY
    if kind == "s" and not unit and integers and step >= MIN_CLOCK_STEP and not is_unix_time:
        ways = " or ".join(f'--column time="{heading} [{one}]"' for one in ("ms", "us", "ns", "s"))
        raise ValueError(f"a count with steps of {step:g}, in a unit that the file does not tell: {ways}")
    boot = bool(len(numbers)) and kind in COUNTS and abs(since) < YEAR_1980 and heading != "time"
    if boot:
        assumed = f"{assumed or f'in {kind}'}, from a start that the file does not tell"
    return TimeFormat(kind, assumed, boot)


def _kind(heading: str, numbers: FloatArray, *, declared: bool) -> tuple[str, str]:
    """Return the kind of a count, and the reason; `declared` is True if its unit is declared as seconds.

    A count in a column named ``time`` is in seconds, unless it is too large for seconds since 1970.
    """
    ours = declared or heading == "time"
    for kind, words in HEADING_WORDS.items():
        if re.search(words, heading.lower()) and not declared:
            return kind, f"{kind}, by its heading"
    if re.search("gps|gnss", heading.lower()) and len(numbers) and 1e8 < numbers.max() < 2e9:
        return "gps", "GPS time, by its heading"
    if not len(numbers):
        return "s", ""
    middle = float(np.median(numbers))
    for kind in ("ms", "us", "ns"):
        if UNIX_TIME_RANGE_S[0] <= middle * EPOCHS[kind][1] < UNIX_TIME_RANGE_S[1] and not declared:
            return kind, f"{kind} since 1970, by its size"
    step = float(np.median(np.diff(numbers))) if len(numbers) > 1 else 0.0
    for kind, low, high in DAY_COUNT_RANGES:
        if low <= middle < high and 0.0 < step < (CERTAIN if ours else STEP) and not declared:
            return kind, f"{kind} days, by its size"
    return "s", "" if ours else "seconds"


def _written(heading: str, texts: Sequence[str], zone: str | None, *, of_day: bool) -> TimeFormat:
    times = pd.Series(list(texts), dtype=object)
    zoned = all(re.search(r"(Z|UTC|GMT|[+-]\d\d:?\d\d)$", text) for text in texts)
    zone_note = "" if zoned else f"times in {zone}" if zone else "times in UTC"
    dated = all(re.match(r"\d{4}\D|\d{8}\D", text) for text in texts)
    if dated and pd.to_datetime(times, format="ISO8601", utc=True, errors="coerce").notna().all():
        return TimeFormat("iso", zone_note)
    fit = [pattern for pattern in patterns(texts) if pattern.endswith(SECONDS_SUFFIX) == of_day]
    if order := DATE_ORDER.search(heading):
        letters = [part[0].lower() for part in order.groups()]
        fit = [pattern for pattern in fit if re.findall("%([ymd])", pattern.lower())[:3] == letters] or fit
    if not fit:
        return TimeFormat("iso")  # later, an error names the row of each cell
    if len(fit) > 1:
        which = " or ".join(f'--column time="{heading} [{pattern}]"' for pattern in fit)
        first = "day or month" if len({pattern.lower().find("%y") for pattern in fit}) == 1 else "day or year"
        raise ValueError(f"{first} first? {texts[0]!r} can be both: {which}")
    if fit[0] in HOURS:
        return TimeFormat(fit[0], OF_A_DAY, boot=True)
    return TimeFormat(fit[0], f"{fit[0]}, {zone_note}" if zone_note else fit[0])


def seconds(clock: TimeFormat, cells: pd.Series) -> FloatArray:
    """Return the times (n,) in the cells (n,), s since 1970-01-01 UTC; NaN for empty or unreadable cells."""
    if clock.by_hour:
        cells = cells.map(_seconds_of_day, na_action="ignore")
    if clock.kind in EPOCHS:
        start, scale = EPOCHS[clock.kind]
        times = numbers_of(cells) * scale + start
    elif clock.kind in SUMS:
        start, *scales = SUMS[clock.kind]
        parts = cells.astype("string").str.split(n=1, expand=True).reindex(columns=[0, 1])
        parts = parts.apply(pd.to_numeric, errors="coerce")
        large, small = parts.to_numpy(np.float64).T
        if scales[0] == WEEK and np.nanmax(small, initial=0.0) > WEEK:
            small = small * 1e-3  # the second number is in milliseconds of the week
        times = start + large * scales[0] + small * scales[1]
    else:
        times = epoch(cells, clock.kind, None if clock.boot else clock.zone)
        return times % DAY if clock.boot else times
    return times - leap_seconds(times) if clock.kind.lower().startswith("gps") else times


def patterns(texts: Sequence[str]) -> list[str]:
    """Return the patterns that fit all texts, without patterns that give the same times as an earlier one."""
    whole, _ = _plain(pd.Series(list(texts), dtype="string"))
    dates_with_times = map(" ".join, product(DATES, (*HOURS, SECONDS_SUFFIX.strip())))
    candidates = [*WHOLE_MOMENTS, *dates_with_times, *DATES, *HOURS]
    found: dict[tuple[float, ...], str] = {}
    for pattern in candidates:
        if _fits(whole.iloc[0], pattern):
            times = epoch(whole, pattern)
            if (times >= YEAR_1900).all():
                found.setdefault(tuple(times.tolist()), pattern)
    return list(found.values())


def _fits(text: str, pattern: str) -> bool:
    """Return True if a text fits a pattern: a fast test of one text before all texts are parsed."""
    if pattern.endswith(SECONDS_SUFFIX):
        text, pattern = text.rpartition(" ")[0], pattern.removesuffix(SECONDS_SUFFIX)
    try:
        datetime.strptime(text, pattern)
    except ValueError:
        return False
    return True


def _plain(texts: pd.Series) -> tuple[pd.Series, FloatArray]:
    """Return texts (n,) with a blank between date and time and no fraction, and the fractions (n,), s."""
    texts = texts.astype("string").str.strip().str.replace(r"(?<=\d)[T_](?=\d)", " ", regex=True)
    digits = texts.str.extract(FRACTION)["fraction"]
    fraction = pd.to_numeric("0." + digits, errors="coerce").to_numpy(np.float64, na_value=0.0)
    return texts.str.replace(FRACTION, r"\g<clock>\g<digits>", regex=True), fraction


def epoch(texts: pd.Series, pattern: str, zone: str | None = None) -> FloatArray:
    """Return the times (n,) of texts (n,), s since 1970-01-01 UTC; NaN for empty or unreadable texts.

    `pattern`: one of :func:`patterns`, ``iso``, or a pattern with ``%f``. `zone`: time zone of texts that do
    not state theirs; UTC if None.
    """
    seconds: FloatArray = np.zeros(len(texts))
    texts = texts.astype("string").str.strip()
    if pattern != "iso" and "%f" not in pattern:
        texts, seconds = _plain(texts)
    if pattern.endswith(SECONDS_SUFFIX):
        parts = texts.str.rpartition(" ")
        texts, pattern = parts[0], pattern.removesuffix(SECONDS_SUFFIX)
        seconds = seconds + pd.to_numeric(parts[2], errors="coerce").to_numpy(np.float64, na_value=np.nan)
    form = "ISO8601" if pattern == "iso" else pattern
    stamps = pd.to_datetime(texts, format=form, errors="coerce", utc=zone is None)
    if zone is not None and stamps.dt.tz is None:
        stamps = stamps.dt.tz_localize(zone, ambiguous="NaT", nonexistent="NaT")
    counts = stamps.dt.tz_convert("UTC").dt.tz_localize(None).to_numpy("datetime64[us]")
    return since_1970(counts) + seconds


def since_1970(moments: Any) -> FloatArray:
    """Return datetime64 (n,) of any unit as s since 1970-01-01; NaN for NaT."""
    whole = moments.astype("datetime64[s]")  # converted separately, so that no digit is lost
    times = whole.astype(np.int64) + (moments - whole) / np.timedelta64(1, "s")
    return np.asarray(np.where(np.isnat(moments), np.nan, times), np.float64)


def leap_seconds(gps: FloatArray) -> FloatArray:
    """Return the lead of GPS time over UTC (n,), s, at GPS times `gps` (n,), s since 1970."""
    leap = np.zeros(len(gps))
    for since, ahead in LEAPS:
        leap[gps - ahead >= since] = ahead
    return leap


def _seconds_of_day(text: str) -> str:
    """Return a text with its time of day, HHMM.mmm, replaced by seconds of the day; other texts unchanged."""
    date, _, clock = text.strip().rpartition(" ")
    try:
        hours, minutes = divmod(float(clock), 100.0)
    except ValueError:
        return text
    return f"{date} {3600.0 * hours + 60.0 * minutes!r}"
