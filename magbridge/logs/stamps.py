"""Dates and times of day in text files: the pattern that fits all of them, and their values.

A pattern is one of :meth:`datetime.strptime`, or ends in `` s``, for the seconds of the day. A second's
fraction is not part of it: behind the seconds, after a point, a comma or a colon, it is read whatever the
pattern. GPS time has no leap seconds: it is ahead of UTC by :func:`leap_seconds`.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from itertools import product

import numpy as np
import pandas as pd

from magbridge.arrays import FloatArray

__all__ = ["DAY", "GPS_EPOCH", "HOURS", "SECONDS_SUFFIX", "WEEK", "epoch", "leap_seconds", "patterns"]

DAY = 86_400.0
HOURS = ("%H:%M:%S", "%H:%M", "%I:%M:%S %p", "%I:%M %p", "%H%M%S")
DATES = (
    *("%d.%m.%Y", "%d.%m.%y"),  # with dots, the day comes first
    *(f"%{day}{sign}%{month}{sign}%{year}" for year in "Yy" for sign in "/-" for day, month in ("dm", "md")),
    *("%Y-%m-%d", "%Y/%m/%d", "%Y.%m.%d", "%Y-%j", "%d-%b-%Y", "%d %b %Y"),
    *("%Y%m%d", "%d%m%y", "%y%m%d", "%m%d%y"),
)
WHOLE_MOMENTS = ("%a %b %d %H:%M:%S %Y", "%Y%m%d%H%M%S", "%Y %m %d %H %M %S", "%Y %j %H %M %S")
"""Patterns of date and time together; the last are columns of numbers, joined."""
SECONDS_SUFFIX = " s"
YEAR_1900 = -2_208_988_800.0
"""s since 1970 of the year that times of day without a date are given; no log is older."""
FRACTION = r"(?:(?P<clock>\d:\d\d:\d\d)[.,:]|(?P<digits>\d{6}| \d\d?)\.)(?P<fraction>\d+)(?=(?: ?[AP]M)?$)"


def patterns(texts: Sequence[str]) -> list[str]:
    """Return the patterns that fit all of these texts, one of each set of equivalent patterns."""
    whole, _ = _plain(pd.Series(list(texts), dtype="string"))
    candidates = [
        *WHOLE_MOMENTS,
        *map(" ".join, product(DATES, (*HOURS, SECONDS_SUFFIX.strip()))),
        *DATES,
        *HOURS,
    ]
    found: dict[tuple[float, ...], str] = {}
    for pattern in candidates:
        if _fits(whole.iloc[0], pattern):
            times = epoch(whole, pattern)
            if (times >= YEAR_1900).all():
                found.setdefault(tuple(times.tolist()), pattern)
    return list(found.values())


def _fits(text: str, pattern: str) -> bool:
    """Return True if a pattern may have written a text; much faster than parsing all texts."""
    if pattern.endswith(SECONDS_SUFFIX):
        text, pattern = text.rpartition(" ")[0], pattern.removesuffix(SECONDS_SUFFIX)
    try:
        datetime.strptime(text, pattern)
    except ValueError:
        return False
    return True


def _plain(texts: pd.Series) -> tuple[pd.Series, FloatArray]:
    """Return the texts (n,), a blank between date and time, without fractions of a second, and these (n,)."""
    texts = texts.astype("string").str.strip().str.replace(r"(?<=\d)[T_](?=\d)", " ", regex=True)
    digits = texts.str.extract(FRACTION)["fraction"]
    fraction = pd.to_numeric("0." + digits, errors="coerce").to_numpy(np.float64, na_value=0.0)
    return texts.str.replace(FRACTION, r"\g<clock>\g<digits>", regex=True), fraction


def epoch(texts: pd.Series, pattern: str, zone: str | None = None) -> FloatArray:
    """Return the texts in s since 1970-01-01 UTC, (n,); NaN where one is empty or cannot be read.

    Parameters
    ----------
    texts : (n,) Series
        As they are written.
    pattern : str
        One of :func:`patterns`, ``iso``, or one with a fraction of its own, ``%f``.
    zone : str or None
        Zone of times that do not say theirs; UTC if None.
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
    whole = counts.astype("datetime64[s]")  # separately, so that no digit is lost
    times = whole.astype(np.int64) + ((counts - whole).astype(np.int64) * 1e-6 + seconds)
    return np.asarray(np.where(np.isnat(counts), np.nan, times), np.float64)


GPS_EPOCH = 315_964_800.0
"""s since 1970 of 1980-01-06, where GPS weeks begin."""
WEEK = 604_800.0
"""Length of a GPS week, s."""
LEAPS = (
    (1_483_228_800, 18),
    (1_435_708_800, 17),
    (1_341_100_800, 16),
    (1_230_768_000, 15),
    (1_136_073_600, 14),
    (0, 13),
)
"""From when on (s since 1970) GPS time is ahead of UTC by how many s; IERS Bulletin C 52, from 1999 on."""


def leap_seconds(gps: FloatArray) -> FloatArray:
    """Return by how many s GPS time is ahead of UTC, (n,).

    Parameters
    ----------
    gps : (n,) array
        GPS time, in s since 1970.
    """
    leap = np.zeros(len(gps))
    for since, ahead in reversed(LEAPS):
        leap[gps - ahead >= since] = ahead
    return leap
