"""Dives: the parts of a log that are left out in turn when a gain is measured."""

from __future__ import annotations

import numpy as np

from magbridge.arrays import BoolArray, FloatArray, IntArray

__all__ = ["dives_of", "eighths", "held"]

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
