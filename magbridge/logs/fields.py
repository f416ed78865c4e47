"""The table of a format: which field of its records becomes which column, in which unit.

Each format lists its fields as :class:`FieldMap` records. Of several fields with one column, the first that a
log has is read.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from magbridge.arrays import FloatArray
from magbridge.logs.resample import linear

__all__ = ["DEG_PER_RAD", "FieldMap", "Track", "by_record", "fields_of", "interpolated"]

DEG_PER_RAD = 180.0 / np.pi
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


def by_record(fields: Iterable[FieldMap]) -> dict[str, list[FieldMap]]:
    """Return the fields of each record, in their order."""
    found: dict[str, list[FieldMap]] = {}
    for one in fields:
        found.setdefault(one.record, []).append(one)
    return found


def fields_of(
    fields: Iterable[FieldMap], table: Mapping[str, FloatArray], instance: int = 0
) -> Iterator[tuple[str, str, FloatArray]]:
    """Yield column, unit and values (n,) of each of the fields that a table holds.

    Parameters
    ----------
    fields : iterable of FieldMap
        Those of the table's record.
    table : mapping of str to (n,) array
        Field to its numbers.
    instance : int
        Number of the table among those of its record, from 0.
    """
    number = str(instance + 1) if instance else ""
    for one in fields:
        if one.field in table:
            yield one.column.replace("#", number), one.unit, one.values(table[one.field])


def interpolated(
    fields: Iterable[FieldMap], tracks: Mapping[str, Track], time: FloatArray, max_gap_s: float
) -> tuple[dict[str, FloatArray], dict[str, str]]:
    """Return columns (n,) and their units of fields with times of their own, interpolated linearly.

    Parameters
    ----------
    fields : iterable of FieldMap
        Fields to read.
    tracks : mapping of str to (times, values)
        Field to its times (m,), s, and values (m,).
    time : (n,) array
        s, of the rows.
    max_gap_s : float
        s between two values across which nothing is interpolated.
    """
    columns: dict[str, FloatArray] = {}
    units: dict[str, str] = {}
    for one in fields:
        if one.field in tracks and len(tracks[one.field][0]):
            sampled, raw = tracks[one.field]
            columns[one.column] = linear(time, sampled, one.values(raw), max_gap_s, one.column)
            units[one.column] = one.unit
    return columns, units
