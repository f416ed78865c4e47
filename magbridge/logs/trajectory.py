"""Trajectories in netCDF by the CF conventions: attributes count, not names.

pyglider, the IOOS Glider DAC, EGO, OG1.0, seagliderOG1, VOTO and Argo differ in the names of dimensions and
variables; `standard_name`, units and flags are common to them. The time is the variable with the standard
name ``time`` (or in a unit ``... since ...``) along which most variables lie; a dimension of length 1, as of
a file with one trajectory, does not count.

Every numeric variable along that time becomes a column: by the attribute ``column`` (ours), by its standard
name, by a name that is known to mean the same, else under its own name in small letters. A value that a flag
of its own calls bad or missing is not known.

References
----------
CF Conventions 1.11, sections 3.3 (standard names), 3.5 (flags), 4.4 (time), https://cfconventions.org
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from magbridge.arrays import BoolArray, FloatArray
from magbridge.columns import COLUMNS, factor
from magbridge.errors import FormatError
from magbridge.logs.cf import epoch, floats
from magbridge.logs.deployment import deployment, with_losses
from magbridge.logs.fields import FieldMap
from magbridge.logs.headings import aliases

__all__ = ["chunks"]

NAMED_FIELDS = (
    FieldMap("standard_name", "latitude", "latitude", ""),
    FieldMap("standard_name", "longitude", "longitude", ""),
    FieldMap("standard_name", "depth", "depth", ""),
    FieldMap("standard_name", "platform_roll", "roll", ""),
    FieldMap("standard_name", "platform_roll_angle", "roll", ""),
    FieldMap("standard_name", "platform_roll_starboard_down", "roll", ""),
    FieldMap("standard_name", "platform_roll_starboard_up", "roll", "", -1.0),
    FieldMap("standard_name", "platform_pitch", "pitch", ""),
    FieldMap("standard_name", "platform_pitch_angle", "pitch", ""),
    FieldMap("standard_name", "platform_pitch_fore_up", "pitch", ""),
    FieldMap("standard_name", "platform_pitch_fore_down", "pitch", "", -1.0),
    FieldMap("standard_name", "platform_yaw", "heading", ""),
    FieldMap("standard_name", "platform_yaw_angle", "heading", ""),
    FieldMap("standard_name", "platform_yaw_fore_starboard", "heading", ""),
    FieldMap("standard_name", "platform_orientation", "heading", ""),
    FieldMap("standard_name", "platform_heading", "heading", ""),
    FieldMap("standard_name", "sea_water_temperature", "water_temperature", ""),
    FieldMap("standard_name", "sea_water_pressure", "water_pressure", ""),
    FieldMap("name", "temp", "water_temperature", ""),
    FieldMap("name", "pres", "water_pressure", ""),
)
"""Columns by the standard name of a variable, and by the names of OG1.0 that are not simply ours in capitals;
the unit is the variable's."""
FIELDS_BY_NAME = {(one.record, one.field): one for one in NAMED_FIELDS}
FLAG_VARIABLE = re.compile(r"(.+)_(?:qc|qartod_\w*|flag)", re.IGNORECASE)
"""Name of a variable with the flags of another."""
BAD = re.compile(r"bad|fail|missing|reject|erroneous|not_used")
BAD_CODES = (3, 4, 9)
"""Flags of a bad or missing value where the file does not say what they mean (OceanSITES, Argo, IODE)."""
GENERATED = ("Conventions", "featureType", "title", "start_date", "time_coverage_start", "time_coverage_end")
"""Attributes of a file that are written again for each."""


class _Column(NamedTuple):
    """A variable as a column; `flags` is the variable with its flags."""

    variable: Any
    name: str
    factor: float
    flags: Any | None


def chunks(path: Path, file: Any, rows: int) -> Iterator[tuple[xr.Dataset, Sequence[int]]]:
    """Yield the rows of an open file in pieces of at most `rows`, each with their numbers.

    FormatError: nothing in it is a time, or no rows.
    """
    clock = _clock(path, file)
    dimension = _along(clock)
    total = len(file.dimensions[dimension])
    if not total:
        raise FormatError(path, "expected rows, there are none")
    start, scale = epoch(path, clock)
    columns, left_out = _columns(path, file, dimension, clock)
    units = {one.name: _unit(one.variable) for one in columns}
    meanings = {one.name: str(getattr(one.variable, "long_name", "")) for one in columns}
    try:
        attrs = {key: _plain(value) for key, value in file.__dict__.items() if key not in GENERATED}
    except AttributeError as error:  # netCDF4's, of a damaged attribute
        raise FormatError(path, f"its attributes cannot be read: {error}") from None
    if "heading_reference" not in attrs and any(_is_magnetic(one) for one in columns):
        attrs["heading_reference"] = "magnetic"
    for row in range(0, total, rows):
        part = slice(row, row + rows)
        time = _values(clock, part) * scale + start
        values = {one.name: _sound(one, part) for one in columns}
        piece = deployment(path, time, values, units, attrs, meanings)
        yield with_losses(piece, {}, () if row else left_out), range(row + 1, row + 1 + len(time))


def _along(variable: Any) -> str | None:
    """Return the one dimension of a variable that is longer than 1, or its last; None: there are several."""
    sizes = dict(zip(variable.dimensions, variable.shape, strict=True))
    long = [name for name, size in sizes.items() if size != 1]
    return (
        long[0] if len(long) == 1 else variable.dimensions[-1] if variable.dimensions and not long else None
    )


def _is_number(variable: Any) -> bool:
    return variable.dtype != str and getattr(variable.dtype, "kind", "") in "iuf"


def _clock(path: Path, file: Any) -> Any:
    """Return the variable that is the time of the trajectory."""
    numbers = [one for one in file.variables.values() if _is_number(one) and _along(one) is not None]
    lying = Counter(_along(one) for one in numbers)
    candidates = [one for one in numbers if _is_time(one)]
    if not candidates:
        there = ", ".join(file.variables) or "none"
        raise FormatError(path, f"expected a variable with the standard_name time; there are: {there}"[:300])

    def rank(variable: Any) -> tuple[int, bool, bool, int]:
        named = variable.name.lower() == "time"
        standard = getattr(variable, "standard_name", "") == "time"
        return lying[_along(variable)], named, standard, variable.size

    return max(candidates, key=rank)


def _is_time(variable: Any) -> bool:
    standard, units = (str(getattr(variable, name, "")) for name in ("standard_name", "units"))
    return standard == "time" or " since " in units or variable.name.lower() == "time"


def _columns(path: Path, file: Any, dimension: str | None, clock: Any) -> tuple[list[_Column], list[str]]:
    """Return the columns along a dimension, and a line for each whose unit is not that of its meaning."""
    found: dict[str, _Column] = {}
    lying = {
        name: one
        for name, one in file.variables.items()
        if one is not clock and _is_number(one) and _along(one) == dimension
    }
    flags = {name: _flags(file, name) for name in lying}
    of_others = {one.name for one in flags.values() if one is not None}
    left_out = []
    names = [name for name in lying if name not in of_others]
    called = {names[k]: ours for k, ours in aliases(names).items()}
    # of several with one meaning, the one that has its name, or comes first, is it
    for name in sorted(names, key=lambda name: not _is_ours(lying[name])):
        variable = lying[name]
        column, sign = _meaning(variable, called.get(name, name.lower()))
        if column in found:
            column, sign = name.lower(), 1.0
        unit = str(getattr(variable, "units", ""))
        if factor(unit, column) is None:
            left_out.append(
                f"{path}: column {name!r}: expected {COLUMNS[column].units}, not {unit}: left out"
            )
            continue
        while column in found or column == "time":
            column += "_"
        found[column] = _Column(variable, column, sign, flags[name])
    order = {name: k for k, name in enumerate(file.variables)}
    return sorted(found.values(), key=lambda one: order[one.variable.name]), left_out


def _is_ours(variable: Any) -> bool:
    """Return True if a variable has the name of one of our columns, whatever its standard name."""
    return hasattr(variable, "column") or variable.name.lower() in COLUMNS


def _meaning(variable: Any, called: str) -> tuple[str, float]:
    """Return the column that a variable is, and the factor that its sign needs; `called` goes by its name."""
    if hasattr(variable, "column"):
        return str(variable.column), 1.0
    standard = "standard_name", str(getattr(variable, "standard_name", ""))
    field = FIELDS_BY_NAME.get(standard) or FIELDS_BY_NAME.get(("name", called))
    column, sign = (called, 1.0) if field is None else (field.column, field.factor)
    if _is_ours(variable):
        column = variable.name.lower()
    if column == "depth" and str(getattr(variable, "positive", "down")).lower() == "up":
        sign = -1.0
    return column, sign


def _is_magnetic(column: _Column) -> bool:
    """Return True if a heading is stated to be measured from magnetic north."""
    text = " ".join(str(column.variable.getncattr(name)) for name in column.variable.ncattrs())
    return column.name == "heading" and "magnetic" in text.lower()


def _flags(file: Any, name: str) -> Any | None:
    """Return the variable with the flags of another; None where there is none."""
    ancillary = str(getattr(file[name], "ancillary_variables", "")).split()
    for other in (*ancillary, f"{name}_QC", f"{name}_qc"):
        one = file.variables.get(other)
        if one is None or one.shape != file[name].shape:
            continue
        if FLAG_VARIABLE.fullmatch(other) or hasattr(one, "flag_meanings"):
            return one
    return None


def _sound(column: _Column, rows: slice) -> FloatArray:
    """Return rows of a column, NaN where its own flags call the value bad."""
    values = column.factor * _values(column.variable, rows)
    return values if column.flags is None else np.where(_bad(column.flags, rows), np.nan, values)


def _values(variable: Any, rows: slice) -> FloatArray:
    return floats(variable, tuple(rows if size != 1 else slice(None) for size in _sizes(variable))).ravel()


def _sizes(variable: Any) -> tuple[int, ...]:
    """Return the shape of a variable, in which only the dimension that it lies along is not 1."""
    along = _along(variable)
    return tuple(2 if name == along else 1 for name in variable.dimensions)


def _bad(flags: Any, rows: slice) -> BoolArray:
    """Return the rows that are flagged as bad or missing."""
    flags.set_auto_maskandscale(False)
    stored = np.asarray(flags[tuple(rows if size != 1 else slice(None) for size in _sizes(flags))]).ravel()
    if stored.dtype.kind in "SU":
        stored = np.array([int(one) if one.isdigit() else 0 for one in stored.astype("U1")])
    codes: Sequence[Any] = BAD_CODES
    if hasattr(flags, "flag_meanings") and hasattr(flags, "flag_values"):
        text = zip(np.atleast_1d(flags.flag_values), str(flags.flag_meanings).split(), strict=False)
        codes = [int(value) for value, meaning in text if BAD.search(meaning.lower())]
    return np.isin(stored, codes)


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def _unit(variable: Any) -> str:
    """Return the unit, which a file of ours spells as UDUNITS does where it is an angle's."""
    unit = str(getattr(variable, "units", "1"))
    return "deg" if unit == "degree" else unit
