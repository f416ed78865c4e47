"""An autopilot's own log as a deployment: what ArduPilot's and PX4's have in common.

A row is a sample of the first magnetometer that the log has; every other column is the last value before it.
A log that does not tell UTC counts from the boot, and says so in the attribute ``time_reference = "boot"``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.logs.deployment import deployment, sliced
from magbridge.logs.resample import latest

__all__ = ["Fields", "FloatArray", "pieces", "values_of"]

Table = Mapping[str, FloatArray]
Fields = dict[str, tuple[tuple[str, str, str, float], ...]]
"""Record: (column, field, unit, factor); ``#`` is the number of the instance where it is not the first."""


def values_of(
    fields: Fields, record: str, number: int, table: Table
) -> Iterator[tuple[str, str, FloatArray]]:
    """Yield column, unit and values (m,) of each of `fields` that an instance (from 0) of a record holds."""
    for column, field, unit, factor in fields[record]:
        if field in table:
            yield column.replace("#", str(number + 1) if number else ""), unit, table[field] * factor


def pieces(
    path: Path,
    rows: int,
    offset: float,
    mags: Mapping[int, tuple[FloatArray, Table]],
    telemetry: Iterable[tuple[FloatArray, str, str, FloatArray]],
    attrs: Mapping[str, Any],
) -> Iterator[xr.Dataset]:
    """Yield the log in pieces of at most `rows` rows.

    Its own times, s, are `offset` s behind UTC, 0 where that is not known. `mags` holds each magnetometer's
    times (m,) and, by axis, its values (m,), nT; `telemetry` yields times (m,), column, unit and values (m,).
    """
    (_, (time, first)), *rest = sorted(mags.items())
    columns = {f"mag_{axis}": values for axis, values in first.items()}
    units: dict[str, str] = {}
    others = ((when, f"mag{k + 1}_{a}", "nT", field[a]) for k, (when, field) in rest for a in field)
    for when, column, unit, values in chain(others, telemetry):
        if column not in columns:
            columns[column], units[column] = latest(time, when, values), unit
    boot = {} if offset else {"time_reference": "boot"}
    yield from sliced(deployment(path, time + offset, columns, units, {**attrs, **boot}), rows)
