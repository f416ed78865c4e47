"""The table of a format: which field of its records becomes which column, in which unit.

``fields.csv`` lists the fields of each format: the record (message, topic, kind) that holds one, its column
and the column's unit, the value in this unit of one unit of the field, and the numbers that stand for a
missing value. If several fields fill one column, the first that a log has is read. Telemetry with
times of its own is brought to the rows by :func:`latest`, as known live, or by :func:`linear`.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from magbridge.arrays import FloatArray

FIELDS_FILE = Path(__file__).with_name("fields.csv")
DEG_PER_RAD = 180.0 / np.pi
MAX_AGE = 30.0
"""Age from which on a value is not carried to a row, s."""
CIRCLES = {
    "heading": (360.0, 0.0),
    "roll": (360.0, -180.0),
    "longitude": (360.0, -180.0),
    "dr_longitude": (360.0, -180.0),
}
"""Columns on a circle: its circumference and its lowest value, in deg."""
Track = tuple[FloatArray, FloatArray]
"""Times (m,), s, and values (m,) of a field."""


class FieldMap(NamedTuple):
    """A field of a format, and the column that it becomes."""

    record: str
    """Message, topic or kind of record that holds the field; empty where a format has one kind."""
    field: str
    """Name of the field in the record."""
    column: str
    """Name of the column; ``#`` stands for the number of the record's instance, if it is not the first."""
    unit: str
    """Unit of the column's values."""
    factor: float = 1.0
    """Value in `unit` of one unit of the field."""
    missing: tuple[float, ...] = ()
    """Numbers that the field holds where the value is not known."""

    def values(self, raw: ArrayLike) -> FloatArray:
        """Return the values (n,) of the column from those of the field; NaN where they are missing."""
        values = np.asarray(raw, np.float64)
        if self.missing:
            values = np.where(np.isin(values, self.missing), np.nan, values)
        return values * self.factor


def field_maps(name: str) -> dict[str, list[FieldMap]]:
    """Return the fields of each record of a format, in the order of ``fields.csv``."""
    found: dict[str, list[FieldMap]] = {}
    with FIELDS_FILE.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            if row.pop("format") == name:
                factor, missing = float(row.pop("factor")), map(float, row.pop("missing").split())
                one = FieldMap(**row, factor=factor, missing=tuple(missing))
                found.setdefault(one.record, []).append(one)
    return found


def fields_of(
    fields: Iterable[FieldMap], table: Mapping[str, FloatArray], instance: int = 0
) -> Iterator[tuple[str, str, FloatArray]]:
    """Yield column, unit and values (n,) of each of the fields that a table, field to numbers (n,), holds.

    `instance` is the number of the table among those of its record, from 0.
    """
    number = str(instance + 1) if instance else ""
    for one in fields:
        if one.field in table:
            yield one.column.replace("#", number), one.unit, one.values(table[one.field])


def interpolated(
    fields: Iterable[FieldMap], tracks: Mapping[str, Track], time: FloatArray, max_gap_s: float
) -> tuple[dict[str, FloatArray], dict[str, str]]:
    """Return columns (n,) and units of fields with `tracks` of their own, at the rows' `time` (n,), s.

    Nothing is interpolated across more than `max_gap_s` between two values.
    """
    columns: dict[str, FloatArray] = {}
    units: dict[str, str] = {}
    for one in fields:
        if one.field in tracks and len(tracks[one.field][0]):
            sampled, raw = tracks[one.field]
            columns[one.column] = linear(time, sampled, one.values(raw), max_gap_s, one.column)
            units[one.column] = one.unit
    return columns, units


def latest(target: FloatArray, time: FloatArray, values: FloatArray, max_age: float = MAX_AGE) -> FloatArray:
    """Return the last value at or before each time `target` (n,), s, as known live, (n,).

    `time` (m,), s, does not decrease; NaN among the `values` (m,) is a missing value. The result is NaN
    before the first value, and once the last is older than `max_age`, s.
    """
    known = np.isfinite(values)
    time, values = time[known], values[known]
    if not len(time):
        return np.full(len(target), np.nan)
    k = np.searchsorted(time, target, side="right") - 1
    fresh = (k >= 0) & (target - time[k] <= max_age)
    return np.where(fresh, values[k], np.nan)


def linear(
    target: FloatArray, time: FloatArray, values: FloatArray, max_gap: float, column: str
) -> FloatArray:
    """Return the values (m,) of a column at `time` (m,), s, interpolated linearly to `target` (n,), s.

    A column in :data:`CIRCLES` goes along the shorter arc. NaN is a missing value. The result is NaN in
    intervals longer than `max_gap`, s, and farther than that beyond an end; nearer, the end is held.
    """
    known = np.isfinite(values) & np.isfinite(time)
    time, values = time[known], values[known]
    if not len(time):
        return np.full(len(target), np.nan)
    circle = CIRCLES.get(column)
    if circle is not None:
        values = np.unwrap(values, period=circle[0])
    result = np.interp(target, time, values)
    right = np.searchsorted(time, target)
    before, after = time[np.maximum(right - 1, 0)], time[np.minimum(right, len(time) - 1)]
    in_gap = (after - before > max_gap) & (target != after) & (target != before)
    result[in_gap | (target - time[-1] > max_gap) | (time[0] - target > max_gap)] = np.nan
    if circle is None:
        return result
    period, start = circle
    return result - period * np.floor((result - start) / period)


def degrees(written: ArrayLike) -> FloatArray:
    """Return degrees (n,) from numbers of degrees and minutes (n,), as ``-13036.442``."""
    values = np.asarray(written, np.float64)
    whole = np.trunc(values / 100.0)
    return np.asarray(whole + (values - 100.0 * whole) / 60.0)
