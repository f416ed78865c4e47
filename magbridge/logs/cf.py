"""Numbers of a netCDF variable by the CF conventions.

References
----------
CF Conventions 1.10, sections 2.5.1 (missing data) and 8.1 (packed data), https://cfconventions.org
"""

from __future__ import annotations

import re
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.errors import FormatError, MissingExtra

try:
    import netCDF4
except ImportError:
    raise MissingExtra("netCDF4", "analysis") from None

__all__ = ["EPOCH", "epoch", "floats"]

WHOLE_AXIS = slice(None)
EPOCH = "seconds since 1970-01-01T00:00:00Z"
NANOSECONDS = re.compile(r"(nanosecond|nanosec|nsec|ns)s?(?= since)")


def epoch(path: Path, variable: Any) -> tuple[float, float]:
    """Return the s since 1970 at which a time variable is 0, and the s in one of its units.

    FormatError: its unit is not a time since a date.
    """
    units, calendar = (str(getattr(variable, name, "")) for name in ("units", "calendar"))
    unit = 1.0
    if nano := NANOSECONDS.match(units):  # which the library does not know
        units, unit = f"seconds{units[nano.end() :]}", 1e-9
    days = [datetime(1970, 1, 1), datetime(1970, 1, 2)]
    try:
        numbers: Any = netCDF4.date2num(days, units, calendar or "standard")
    except ValueError:
        raise FormatError(path, f"expected {EPOCH!r}, not {units!r}", column=variable.name) from None
    zero, day = numbers
    scale = 86_400.0 / (day - zero)
    return float(-zero * scale), float(scale) * unit


def floats(variable: Any, rows: slice | tuple[slice, ...] = WHOLE_AXIS) -> FloatArray:
    """Return rows of a variable in its shape; a missing value is NaN.

    Missing are the values that the variable declares as missing, compared as stored, before unpacking, and
    rounded to the variable's type where they are of another; and those never written, which the library fills
    with a number of its own. ``valid_range`` is ignored: one that begins at 0 would discard a depth of -2 cm.
    FormatError: packed by something other than a number.
    """
    variable.set_auto_maskandscale(False)
    stored = np.asarray(variable[rows])
    attributes = variable.ncattrs()
    nothing = [variable.getncattr("missing_value")] if "missing_value" in attributes else []
    fill = variable.get_fill_value()
    # any byte may be meant: of bytes, only a fill value that is declared counts
    if "_FillValue" in attributes or (fill is not None and stored.dtype.itemsize > 1):
        nothing.append(fill)
    try:
        scale, offset = float(getattr(variable, "scale_factor", 1)), float(getattr(variable, "add_offset", 0))
    except (TypeError, ValueError):
        expected = "expected numbers as scale_factor and add_offset"
        raise FormatError(variable.group().filepath(), expected, column=variable.name) from None
    values = stored.astype(np.float64) * scale + offset
    missing = [number for one in nothing for number in _as_stored(one, stored.dtype)]
    return np.where(np.isin(stored, missing), np.nan, values)


def _as_stored(declared: Any, kind: np.dtype[Any]) -> list[Any]:
    """Return the numbers that an attribute declares, in a variable's type; none that this cannot hold."""
    try:
        numbers = np.atleast_1d(np.asarray(declared)).astype(np.float64)  # also from text
    except ValueError:
        return []
    with np.errstate(all="ignore"):
        stored = numbers.astype(kind)
    exact = stored.astype(np.float64) == numbers
    return [one for one, same in zip(stored, exact, strict=True) if same or kind.kind == "f"]
