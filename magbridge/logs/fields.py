"""Convert the fields of a format's records to columns, and bring their values to the times of the rows.

Each line of ``fields.csv`` describes one field of a format: its record (message, topic or kind), its column
with unit, the factor to this unit, and the numbers that stand for a missing value. If several fields fill one
column, the first that a log has is read. :func:`latest` holds values until the next, as a live bridge does;
:func:`linear` interpolates them.
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
"""Age beyond which a value is not carried to a row, s."""
CIRCLES = {
    "heading": (360.0, 0.0),
    "roll": (360.0, -180.0),
    "longitude": (360.0, -180.0),
    "dr_longitude": (360.0, -180.0),
}
"""Column on a circle -> circumference and lowest value, deg."""
Track = tuple[FloatArray, FloatArray]
"""Times (m,), s, and values (m,) of a field."""


class FieldMap(NamedTuple):
    """Field of a record, and the column that it becomes."""

    record: str
    """Message, topic or kind of record that holds the field; empty for a format with one kind of record."""
    field: str
    """Name of the field in the record."""
    column: str
    """Name of the column; ``#`` stands for the number of the record's instance, if it is not the first."""
    unit: str
    """Unit of the column's values."""
    factor: float = 1.0
    """Factor from the field's number to a value in `unit`."""
    missing: tuple[float, ...] = ()
    """Numbers of the field that stand for a missing value."""

    def values(self, raw: ArrayLike) -> FloatArray:
        """Return the column's values (n,), in `unit`, from the field's numbers (n,); NaN where missing."""
        values = np.asarray(raw, np.float64)
        if self.missing:
            values = np.where(np.isin(values, self.missing), np.nan, values)
        return values * self.factor + 0.0  # without the negative zero of a negative factor


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
    """Yield column, unit and values (n,) of each of the `fields` that `table` (field -> numbers (n,)) holds.

    `instance`: number of the record's instance from which the table comes, from 0.
    """
    number = str(instance + 1) if instance else ""
    for one in fields:
        if one.field in table:
            yield one.column.replace("#", number), one.unit, one.values(table[one.field])


def interpolated(
    fields: Iterable[FieldMap], tracks: Mapping[str, Track], time: FloatArray, max_gap_s: float
) -> tuple[dict[str, FloatArray], dict[str, str]]:
    """Return columns (n,) and units of `fields`, interpolated from their `tracks` to `time` (n,), s.

    Values are NaN in intervals longer than `max_gap_s`.
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
    """Return the last value (n,) at or before each time in `target` (n,), s, as a live bridge knows it.

    `time` (m,), s, must not decrease; NaN among the `values` (m,) is a missing value. The result is NaN
    before the first value, and where the last value is older than `max_age`, s.
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
    """Return a column (n,) at `target` (n,), s, interpolated linearly from `values` (m,) at `time` (m,), s.

    A column in :data:`CIRCLES` follows the shorter arc. NaN is a missing value. The result is NaN in
    intervals longer than `max_gap`, s. Beyond an end, the end value is held for `max_gap`.
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


def number_of(text: str) -> float:
    """Return the number in a text; NaN for a damaged text."""
    try:
        return float(text)
    except ValueError:
        return float("nan")


def degrees(written: ArrayLike) -> FloatArray:
    """Return degrees (n,) from degrees and minutes written together (n,): -13036.442 is -130 deg 36.442'."""
    values = np.asarray(written, np.float64)
    whole = np.trunc(values / 100.0)
    return np.asarray(whole + (values - 100.0 * whole) / 60.0)


def euler_deg(
    w: FloatArray, x: FloatArray, y: FloatArray, z: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return roll, pitch and yaw (n,), deg, of the quaternions (n,) from body to world (3-2-1)."""
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.degrees(roll), np.degrees(pitch), np.degrees(yaw)
