"""Dives: the parts of a log that are left out in turn when a gain is measured."""

from __future__ import annotations

import numpy as np

from magbridge.arrays import BoolArray, FloatArray, IntArray

__all__ = ["days_of", "dives_of", "eighths", "held"]

DAY_S, NIGHT_S = 86400.0, 21600.0
"""Longest day, and the gap after which another day begins, s."""
MIN_SAMPLES_A_DAY = 100
"""Fewest samples of a day that is left out by itself."""

Table = dict[str, FloatArray]
"""Columns (n,) in order of time, each with a value somewhere; ``learned`` is 1 where it was learned from."""


def dives_of(table: Table) -> IntArray:
    """(n,) number of each sample's dive: as the log counts, else from surface to surface, else eighths.

    Of two logs, that which was learned from and that which is diagnosed, one may count its dives alone.
    """
    for name in ("dive", "run"):
        if name in table and np.unique(table[name]).size > 3:
            dive = np.unique(table[name], return_inverse=True)[1].astype(np.int64)
            for log in (table["learned"] > 0.5, table["learned"] < 0.5):
                if log.any() and not np.isfinite(table[name][log]).any():
                    dive[log] = dive.max() + 1 + dives_of(_part(table, log))
            return dive
    if "depth" in table and np.nanmax(table["depth"]) > 5.0:
        depth = held(table["depth"])
        shallow = depth < 0.15 * np.quantile(depth, 0.98)
        start = shallow & ~np.append(False, shallow[:-1])
        if 4 <= start.sum() <= 0.05 * len(depth):
            return np.cumsum(start)
    return eighths(len(table["time"]))


def days_of(time: FloatArray, learned: BoolArray) -> IntArray | None:
    """Return the number of each sample's day, or None where the diagnosed log is of fewer than two days.

    Parameters
    ----------
    time : (n,) array
        Times of the samples, s.
    learned : (n,) bool array
        Samples that serve only as a comparison; they have the number -1.

    Notes
    -----
    A day begins with the first sample, after :data:`DAY_S`, and after a gap of :data:`NIGHT_S`. Days of fewer
    than :data:`MIN_SAMPLES_A_DAY` samples count to the day before.
    """
    day, number, start, last = np.full(len(time), -1), -1, -np.inf, -np.inf
    fresh = np.flatnonzero(~learned)
    t = time[fresh]
    bounds = []
    for k, moment in enumerate(t.tolist()):
        if moment - start >= DAY_S or moment - last > NIGHT_S:
            start = moment
            bounds.append(k)
        last = moment
    for first, end in zip(bounds, [*bounds[1:], len(t)], strict=True):
        if end - first >= MIN_SAMPLES_A_DAY or number < 0:
            number += 1
        day[fresh[first:end]] = number
    return day if number > 0 else None


def held(values: FloatArray) -> FloatArray:
    """Fill the gaps of (n,) values with the last known one, and the beginning with the first."""
    known = np.flatnonzero(np.isfinite(values))
    last = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), known[0]))
    return np.asarray(values[np.maximum(last, known[0])])


def eighths(n: int) -> IntArray:
    """(n,) number of the eighth of a log that each sample is in."""
    return np.arange(n) * 8 // n


def _part(table: Table, rows: BoolArray) -> Table:
    """Return these rows of the columns that have any value there."""
    part = {name: column[rows] for name, column in table.items()}
    return {name: column for name, column in part.items() if np.isfinite(column).any()}
