"""Read IAGA-2002: the field at an observatory or base station, one row per minute or second.

Each element becomes a column ``observatory_x`` (``_h``, ``_d`` ...), in nT or minutes of arc. ``total_field``
is F or S, else the vector's magnitude. Latitude and longitude are the observatory's. Source:
https://www.ncei.noaa.gov/services/world-data-system/v-dat-working-group/iaga-2002-data-exchange-format
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.errors import FormatError
from magbridge.logs.deployment import deployment, sliced, with_losses
from magbridge.logs.registry import opened

MIN_CODE_NT = 88_888.0
"""Lowest code of a missing value, nT: 88,888 means not recorded, 99,999 not observed."""
TOTALS = (("f",), ("s",), ("x", "y", "z"), ("h", "z"))
"""Elements whose root sum of squares is the total field, the most reliable first."""


def chunks(path: Path, rows: int) -> Iterator[xr.Dataset]:
    """Yield the file in pieces of at most `rows` rows; the whole file is in memory."""
    with opened(path) as file:
        lines = file.read().decode("ascii", "replace").splitlines()
    first = next((k for k, line in enumerate(lines) if line.startswith("DATE ")), None)
    if first is None:
        raise FormatError(path, "expected the line DATE TIME DOY ... of IAGA-2002")
    header = {line[1:24].strip().lower(): line[24:69].strip() for line in lines[:first]}
    elements = [name[-1].lower() for name in lines[first].split()[3:7]]
    fields = [line.split() for line in lines[first + 1 :] if line.strip()]
    whole = [parsed for one in fields if (parsed := _row(one, len(elements))) is not None]
    if not whole:
        raise FormatError(path, "expected rows, there are none", row=first + 2)
    time, *values = np.array(whole).T
    by_element = {
        name: np.where(np.abs(value) >= MIN_CODE_NT, np.nan, value)
        for name, value in zip(elements, values, strict=True)
    }
    columns = {f"observatory_{name}": value for name, value in by_element.items()}
    units = {name: "arcmin" if name[-1] in "di" else "nT" for name in columns}
    if (total := _total(by_element)) is not None:
        columns["total_field"] = total
    for name in ("latitude", "longitude"):
        try:
            place = float(header.get(f"geodetic {name}") or "nan")
        except ValueError:
            raise FormatError(path, "expected a number of degrees", column=f"Geodetic {name}") from None
        columns[name] = np.full(len(time), (place + 180.0) % 360.0 - 180.0 if name == "longitude" else place)
    attrs = {"observatory": header.get("iaga code", ""), "time_reference": "utc"}
    read = deployment(path, time, columns, units, attrs)
    yield from sliced(with_losses(read, {"rows_dropped": len(fields) - len(whole)}), rows)


def _row(fields: list[str], elements: int) -> list[float] | None:
    """Return time (s since 1970) and values of a row; None if the row is damaged."""
    try:
        date, clock, _, *values = fields
        when = datetime.fromisoformat(f"{date}T{clock}").replace(tzinfo=UTC).timestamp()
        numbers = [float(value) for value in values[:elements]]
    except ValueError:
        return None
    return [when, *numbers] if len(numbers) == elements else None


def _total(elements: dict[str, FloatArray]) -> FloatArray | None:
    """Return the total field (n,), nT, from elements (n,) by name; None if they do not determine it."""
    lengths = [
        np.asarray(np.sqrt(sum(np.square(elements[name]) for name in names)))
        for names in TOTALS
        if set(names) <= elements.keys()
    ]
    # the same elements for the whole file: two instruments differ by some nT
    known = [int(np.isfinite(length).sum()) for length in lengths]
    return next((one for one, count in zip(lengths, known, strict=True) if 2 * count >= max(known)), None)
