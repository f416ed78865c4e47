"""Reader of ``.survey``, an invented log format: one record per line, with the battery's position in mm.

For example::

    # tow 12
    2026-05-01T10:00:00Z; 48.31; -57.93; 16204.1; -5013.0; 49187.5; 12.4

A format is a module with a function ``chunks``. The module need not check for impossible values and times:
magbridge drops and reports them. A line that cannot be parsed raises a ``FormatError`` with its row.
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path

import xarray as xr

from magbridge.errors import FormatError
from magbridge.logs.deployment import deployment

__all__ = ["chunks"]

COLUMNS = ("latitude", "longitude", "mag_x", "mag_y", "mag_z", "battpos")
UNITS = {"latitude": "deg", "longitude": "deg", "mag_x": "nT", "mag_y": "nT", "mag_z": "nT", "battpos": "mm"}


def chunks(path: Path, rows: int) -> Iterator[xr.Dataset]:
    """Yield the file as deployments of at most `rows` rows.

    Raises
    ------
    FormatError
        A record that is not a time and six numbers.
    """
    with path.open(encoding="utf-8") as file:
        records = (
            _record(path, row, line) for row, line in enumerate(file, 1) if line.strip() and line[0] != "#"
        )
        while piece := list(islice(records, rows)):
            time, *columns = zip(*piece, strict=True)
            yield deployment(path, time, dict(zip(COLUMNS, columns, strict=True)), UNITS)


def _record(path: Path, row: int, line: str) -> tuple[float, ...]:
    """Return the time (s since 1970 UTC) and the six values of a line, in the units of `UNITS`."""
    when, *cells = line.split(";")
    try:
        time = datetime.fromisoformat(when.strip())
        time = time if time.tzinfo else time.replace(tzinfo=UTC)  # not the computer's time zone
        numbers = [time.timestamp(), *map(float, cells)]
    except ValueError:
        numbers = []
    if len(numbers) != 1 + len(COLUMNS):
        raise FormatError(path, f"expected a time and {len(COLUMNS)} numbers between semicolons", row=row)
    return tuple(numbers)
