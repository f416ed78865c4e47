"""Read and write netCDF files of one trajectory.

The writer uses the dimension ``time`` and the documented names of the columns. With the vocabulary of
OceanGliders OG1.0 it uses ``N_MEASUREMENTS`` and names in capitals. ``TIME LATITUDE LONGITUDE DEPTH ROLL
PITCH HEADING TEMP PRES`` are OG1.0 names; the others are documented names in capitals (``MAG_X``). The
attribute ``column`` holds the documented name in both cases.

The reader accepts trajectories of pyglider, the IOOS Glider DAC, EGO, OG1.0, seagliderOG1, VOTO, Argo and
others. The time is the variable with the standard name ``time`` (or a unit ``... since ...``) along whose
dimension most variables lie. Every numeric variable along this dimension becomes a column. Its name is the
attribute ``column``, else the column of its standard name or of a known synonym, else its own name in small
letters. A value whose flag means bad or missing becomes NaN. :mod:`.seaglider` interprets a basestation's
file, which is recognised by its dimensions.

References
----------
CF Conventions 1.11, sections 2.5.1 (missing data), 3.3 (standard names), 3.5 (flags), 4.4 (time) and 8.1
(packed data), https://cfconventions.org
OceanGliders format 1.0, https://oceangliderscommunity.github.io/OG-format-user-manual/OG_Format.html
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from magbridge.arrays import BoolArray, FloatArray
from magbridge.columns import COLUMNS, factor, usual
from magbridge.errors import FormatError, MissingExtra
from magbridge.files import systems_reason
from magbridge.logs import seaglider
from magbridge.logs.checks import Faults, validity_of, without_invalid
from magbridge.logs.deployment import deployment, sliced, with_losses
from magbridge.logs.fields import field_maps
from magbridge.logs.naming import aliases
from magbridge.records import Quality
from magbridge.version import __version__

try:
    import netCDF4
except ImportError:
    raise MissingExtra("netCDF4", "analysis") from None

EPOCH = "seconds since 1970-01-01T00:00:00Z"
NANOSECONDS = re.compile(r"(nanosecond|nanosec|nsec|ns)s?(?= since)")
WHOLE_AXIS = slice(None)
OG1_DIMENSION = "N_MEASUREMENTS"
OG1_NAMES = {"water_temperature": "TEMP", "water_pressure": "PRES"}
"""Column -> OG1.0 name, where it is not the documented name in capitals."""
CF_ATTRIBUTES: dict[str, dict[str, Any]] = {
    "time": {"standard_name": "time", "calendar": "gregorian", "units": EPOCH},
    "latitude": {"standard_name": "latitude", "units": "degrees_north"},
    "longitude": {"standard_name": "longitude", "units": "degrees_east"},
    "depth": {"standard_name": "depth", "units": "m", "positive": "down"},
    "roll": {"standard_name": "platform_roll"},
    "pitch": {"standard_name": "platform_pitch"},
    "heading": {"standard_name": "platform_yaw"},
    "water_temperature": {"standard_name": "sea_water_temperature"},
    "water_pressure": {"standard_name": "sea_water_pressure"},
}
COORDINATES = "time", "latitude", "longitude", "depth"
NO_FLAGS = -1
"""Integer stored for unknown quality flags."""
STORED_ROWS = 8192
"""Rows in one chunk of the file."""
STANDARD_NAMES = {one.field: one for one in field_maps("cf")[""]}
"""Standard name -> column and sign (`factor`); the unit is the variable's own."""
KNOWN_NAMES = {name.lower(): column for column, name in OG1_NAMES.items()}
FLAG_VARIABLE = re.compile(r"(.+)_(?:qc|qartod_\w*|flag)", re.IGNORECASE)
"""Name of a variable that holds the quality flags of another variable."""
BAD = re.compile(r"bad|fail|missing|reject|erroneous|not_used")
BAD_CODES = (3, 4, 9)
"""Flags of a bad or missing value, if the file does not define its flags (OceanSITES, Argo, IODE)."""
GENERATED = ("Conventions", "featureType", "title", "start_date", "time_coverage_start", "time_coverage_end")
"""Attributes that the writer generates for each file."""


def chunks(path: Path, rows: int) -> Iterator[xr.Dataset | tuple[xr.Dataset, Sequence[int]]]:
    """Yield the file in pieces of at most `rows` rows; pieces of a trajectory come with their row numbers."""
    try:
        with netCDF4.Dataset(path) as file:
            if seaglider.DIMENSION in file.dimensions:
                yield from sliced(seaglider.dive(path, _seaglider(path, file)), rows)
            else:
                yield from _trajectory(path, file, rows)
    except (OSError, RuntimeError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise FormatError(path, f"expected a whole netCDF file: {reason}") from None


class CfColumn(NamedTuple):
    """Variable, its column, the factor of its sign, and the variable with its quality flags."""

    variable: Any
    name: str
    factor: float
    flags: Any | None


def _trajectory(path: Path, file: Any, rows: int) -> Iterator[tuple[xr.Dataset, Sequence[int]]]:
    """Yield the rows of an open file in pieces of at most `rows`, each with its row numbers."""
    clock = _clock(path, file)
    dimension = _along(clock)
    total = len(file.dimensions[dimension])
    if not total:
        raise FormatError(path, "expected rows, there are none")
    start, scale = _epoch(path, clock)
    columns, left_out = _columns(path, file, dimension, clock)
    units = {one.name: str(getattr(one.variable, "units", "1")) for one in columns}
    # UDUNITS, and so a file of this writer, calls the unit of an angle degree
    units = {name: "deg" if unit == "degree" else unit for name, unit in units.items()}
    meanings = {one.name: str(getattr(one.variable, "long_name", "")) for one in columns}
    standards = {
        one.name: str(one.variable.standard_name)
        for one in columns
        if one.name not in COLUMNS and hasattr(one.variable, "standard_name")
    }
    try:
        attrs = {key: value for key, value in file.__dict__.items() if key not in GENERATED}
    except AttributeError as error:  # netCDF4 raises it for a damaged attribute
        raise FormatError(path, f"its attributes cannot be read: {error}") from None
    attrs = {key: value.item() if isinstance(value, np.generic) else value for key, value in attrs.items()}
    heading = next((one.variable for one in columns if one.name == "heading"), None)
    stated = [str(heading.getncattr(name)).lower() for name in heading.ncattrs()] if heading else []
    if any("magnetic" in text for text in stated):
        attrs.setdefault("heading_reference", "magnetic")
    ours = any("column" in variable.ncattrs() for variable in file.variables.values())
    if " since " in str(getattr(clock, "units", "")):
        attrs.setdefault("time_reference", "utc")
    rules = [] if ours else validity_of([one.name for one in columns], ())
    faults = Faults(path, strict=False)
    for row in range(0, total, rows):
        part = slice(row, row + rows)
        time = _values(clock, part) * scale + start
        values = {one.name: one.factor * _values(one.variable, part) for one in columns}
        for one in columns:
            if one.flags is not None:
                values[one.name][_bad(one.flags, part)] = np.nan
        numbers = range(row + 1, row + 1 + len(time))
        time, values, kept = without_invalid(faults, time, values, numbers, rules, codes=not ours)
        counts, lines = faults.since_last()
        piece = deployment(path, time, values, units, attrs, meanings)
        for name, standard in standards.items():
            piece[name].attrs["standard_name"] = standard
        yield with_losses(piece, counts, [*lines, *(() if row else left_out)]), kept


def _along(variable: Any) -> str | None:
    """Return the dimension along which a variable lies: the only one not of length 1; None if ambiguous."""
    sizes = dict(zip(variable.dimensions, variable.shape, strict=True))
    long = [name for name, size in sizes.items() if size != 1] or [*variable.dimensions[-1:]]
    return long[0] if len(long) == 1 else None


def _is_number(variable: Any) -> bool:
    return variable.dtype != str and getattr(variable.dtype, "kind", "") in "iuf"


def _clock(path: Path, file: Any) -> Any:
    """Return the variable that is the time of the trajectory."""
    numbers = [one for one in file.variables.values() if _is_number(one) and _along(one) is not None]
    lying = Counter(_along(one) for one in numbers)
    candidates = []
    for one in numbers:
        standard, units = (str(getattr(one, name, "")) for name in ("standard_name", "units"))
        if standard == "time" or " since " in units or one.name.lower() == "time":
            candidates.append(one)
    if not candidates:
        there = ", ".join(file.variables) or "none"
        raise FormatError(path, f"expected a variable with the standard_name time; there are: {there}"[:300])

    def rank(variable: Any) -> tuple[int, bool, bool, int]:
        named = variable.name.lower() == "time"
        standard = getattr(variable, "standard_name", "") == "time"
        return lying[_along(variable)], named, standard, variable.size

    return max(candidates, key=rank)


def _columns(path: Path, file: Any, dimension: str | None, clock: Any) -> tuple[list[CfColumn], list[str]]:
    """Return the columns along a dimension, and a message for each variable whose unit does not fit."""
    found: dict[str, CfColumn] = {}
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
    # of several variables that mean one column, read the one with the column's name, else the first
    for name in sorted(names, key=lambda name: not _is_ours(lying[name])):
        variable = lying[name]
        column, sign = _meaning(variable, called.get(name, name.lower()))
        if column in found:
            column, sign = name.lower(), 1.0
        unit = str(getattr(variable, "units", ""))
        if factor(unit, column) is None:
            expected = f"expected {COLUMNS[column].units}, not {unit}"
            left_out.append(f"{path}: column {name!r}: {expected}: left out")
            continue
        while column in found or column == "time":
            column += "_"
        found[column] = CfColumn(variable, column, sign, flags[name])
    order = {name: k for k, name in enumerate(file.variables)}
    return sorted(found.values(), key=lambda one: order[one.variable.name]), left_out


def _is_ours(variable: Any) -> bool:
    """Return True if a variable names a standard column, by its attribute ``column`` or by its own name."""
    return hasattr(variable, "column") or variable.name.lower() in COLUMNS


def _meaning(variable: Any, called: str) -> tuple[str, float]:
    """Return the column of a variable and the factor of its sign; `called` is the column by its name."""
    if hasattr(variable, "column"):
        return str(variable.column), 1.0
    known = STANDARD_NAMES.get(str(getattr(variable, "standard_name", "")))
    column, sign = (known.column, known.factor) if known else (KNOWN_NAMES.get(called, called), 1.0)
    if _is_ours(variable):
        column = variable.name.lower()
    if column == "depth" and str(getattr(variable, "positive", "down")).lower() == "up":
        sign = -1.0
    return column, sign


def _flags(file: Any, name: str) -> Any | None:
    """Return the variable that holds the quality flags of variable `name`; None without flags."""
    ancillary = str(getattr(file[name], "ancillary_variables", "")).split()
    for other in (*ancillary, f"{name}_QC", f"{name}_qc"):
        one = file.variables.get(other)
        if one is None or one.shape != file[name].shape:
            continue
        if FLAG_VARIABLE.fullmatch(other) or hasattr(one, "flag_meanings"):
            return one
    return None


def _values(variable: Any, rows: slice) -> FloatArray:
    return floats(variable, _index(variable, rows)).ravel()


def _index(variable: Any, rows: slice) -> tuple[slice, ...]:
    """Return the index that selects rows along a variable's dimension (:func:`_along`)."""
    along = _along(variable)
    return tuple(rows if name == along else WHOLE_AXIS for name in variable.dimensions)


def _bad(flags: Any, rows: slice) -> BoolArray:
    """Return a mask (n,) of the rows that are flagged as bad or missing."""
    flags.set_auto_maskandscale(False)
    stored = np.asarray(flags[_index(flags, rows)]).ravel()
    if stored.dtype.kind in "SU":
        stored = np.array([int(one) if one.isdigit() else 0 for one in stored.astype("U1")])
    codes: Sequence[Any] = BAD_CODES
    if hasattr(flags, "flag_meanings") and hasattr(flags, "flag_values"):
        text = zip(np.atleast_1d(flags.flag_values), str(flags.flag_meanings).split(), strict=False)
        codes = [int(value) for value, meaning in text if BAD.search(meaning.lower())]
    return np.isin(stored, codes)


def _seaglider(path: Path, file: Any) -> seaglider.Dive:
    """Return the dive in a basestation's file, without variables that differ in length from their times."""
    rows = file.dimensions[seaglider.DIMENSION].size
    if (time := _numbers(file, "time", rows)) is None:
        raise FormatError(path, "expected this variable, as of a Seaglider", column="time")
    sampled = {
        name.removeprefix("eng_"): values
        for name in file.variables
        if (name.startswith("eng_") and name != "eng_depth") or name == "depth"
        if (values := _numbers(file, name, rows)) is not None
    }
    names = [name for name in file.variables if name.startswith("gc_")]
    size = file["gc_end_secs"].size if "gc_end_secs" in names else 0
    manoeuvres = {
        name.removeprefix("gc_"): values
        for name in names
        if (values := _numbers(file, name, size)) is not None
    }
    settings = {
        name.removeprefix("log_"): float(floats(variable))
        for name, variable in file.variables.items()
        if (name.startswith("log_") or name == "magnetic_variation")
        if variable.shape == () and _is_number(variable)
    }
    elsewhere = {}
    if "ctd_time" in file.variables:
        ctd_time = floats(file["ctd_time"])
        elsewhere = {
            one.field: (ctd_time, values)
            for one in seaglider.CTD_FIELDS
            if (values := _numbers(file, one.field, ctd_time.size)) is not None
        }
    return seaglider.Dive(time, sampled, settings, manoeuvres, elsewhere)


def _numbers(file: Any, name: str, size: int) -> FloatArray | None:
    """Return the values (size,) of a variable; None if it is missing, not numeric or of another size."""
    there = name in file.variables and file[name].shape == (size,) and _is_number(file[name])
    return floats(file[name]) if there else None


def _epoch(path: Path, variable: Any) -> tuple[float, float]:
    """Return the zero of a time variable, s since 1970, and the length of its unit, s."""
    units, calendar = (str(getattr(variable, name, "")) for name in ("units", "calendar"))
    unit = 1.0
    if usual(units) == "s" and getattr(variable, "long_name", "") == COLUMNS["time"].long_name:
        return 0.0, 1.0  # xarray wrote a Dataset of magbridge
    if nano := NANOSECONDS.match(units):  # netCDF4 does not know nanoseconds
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
    """Return rows of a variable as unpacked numbers in its shape; a missing value is NaN.

    A value is missing if it equals a number that the variable declares as missing, or netCDF's fill value.
    Both are compared with the stored values before unpacking, in the variable's type. ``valid_range`` is
    ignored: a range from 0 would discard a depth of -2 cm.
    FormatError: ``scale_factor`` or ``add_offset`` is not a number.
    """
    variable.set_auto_maskandscale(False)
    stored = np.asarray(variable[rows])
    attributes = variable.ncattrs()
    nothing = [variable.getncattr("missing_value")] if "missing_value" in attributes else []
    fill = variable.get_fill_value()
    # every byte can be a value: for bytes, only a declared fill value counts
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
    """Return the numbers of an attribute in a variable's type, without numbers that the type cannot hold."""
    try:
        numbers = np.atleast_1d(np.asarray(declared)).astype(np.float64)  # also converts text
    except ValueError:
        return []
    with np.errstate(all="ignore"):
        stored = numbers.astype(kind)
    exact = stored.astype(np.float64) == numbers
    return [one for one, same in zip(stored, exact, strict=True) if same or kind.kind == "f"]


class FileWriter:
    """Writer of successive deployments with the columns of the first, and with OG1.0 names if `og1`."""

    def __init__(self, path: Path, *, og1: bool = False) -> None:
        self._path, self._og1 = path, og1
        self._dimension = OG1_DIMENSION if og1 else "time"
        with systems_reason(path):
            self._file = netCDF4.Dataset(path, "w", format="NETCDF4")
        self._variables: dict[str, Any] = {}
        self._rows = 0

    def append(self, dataset: xr.Dataset, *, first: bool) -> None:
        """Write the rows; if `first`, define dimensions, variables and attributes before."""
        with systems_reason(self._path):
            if first:
                self._define(dataset)
            n = dataset.sizes["time"]
            for name, variable in self._variables.items():
                values = dataset[name].values
                if name == "quality":
                    values = np.where(np.isnan(values), NO_FLAGS, values).astype(np.int32)
                variable[self._rows : self._rows + n] = values
            self._rows += n
            if n:
                self._file.time_coverage_end = _iso(float(dataset["time"][-1]))

    def _define(self, dataset: xr.Dataset) -> None:
        file = self._file
        file.set_auto_mask(False)
        file.createDimension(self._dimension, None)
        first = float(dataset["time"][0]) if dataset.sizes["time"] else 0.0
        history = str(dataset.attrs.get("history", "")).splitlines()
        written = f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ} written by magbridge {__version__}"
        file.setncatts(
            {
                key: value
                for key, value in dataset.attrs.items()
                if isinstance(value, (str, int, float)) and "/" not in key  # netCDF forbids slashes
            }
            | {
                "title": "magnetometer deployment",
                "featureType": "trajectory",
                "Conventions": "CF-1.11, ACDD-1.3",
                "start_date": _iso(first),
                "time_coverage_start": _iso(first),
                "history": "\n".join(line for line in (*history, written) if line),
            }
        )
        trajectory = file.createVariable(self._written("trajectory"), str)
        trajectory.setncatts({"cf_role": "trajectory_id", "long_name": "trajectory name"})
        trajectory[...] = str(dataset.attrs.get("source", ""))
        there = [name for name in COORDINATES if name == "time" or name in dataset]
        coordinates = " ".join(self._written(name) for name in there)
        taken = {self._written("trajectory")}
        for name in ("time", *(str(name) for name in dataset.data_vars)):
            written = self._written(name)
            while written in taken:
                written += "_"
            taken.add(written)
            attrs = dict(dataset[name].attrs) | CF_ATTRIBUTES.get(name, {})
            flags = name == "quality"  # CF: flags have the type of their masks
            # a coordinate of CF has no fill value: a time is never missing
            fill = {"time": None, "quality": NO_FLAGS}.get(name, np.nan)
            variable = file.createVariable(
                written, "i4" if flags else "f8", (self._dimension,), fill_value=fill, zlib=True, complevel=1,
                chunksizes=(STORED_ROWS,),
            )  # fmt: skip
            if flags:
                attrs["flag_masks"] = np.array([int(flag) for flag in Quality], np.int32)
                attrs["flag_meanings"] = " ".join(str(flag.name).lower() for flag in Quality)
            if name not in COORDINATES and coordinates:
                attrs["coordinates"] = coordinates
            if flags:
                attrs.pop("units", None)
            elif attrs.get("units") == "deg":
                attrs["units"] = "degree"  # UDUNITS does not define deg
            variable.setncatts(attrs)
            variable.setncatts({"column": name})
            self._variables[name] = variable

    def _written(self, name: str) -> str:
        """Return the name of a column's variable, without the slashes that netCDF forbids."""
        return (OG1_NAMES.get(name, name.upper()) if self._og1 else name).replace("/", "_")

    def close(self) -> None:
        """Write everything to the file and close it."""
        with systems_reason(self._path):
            self._file.close()


def _iso(time: float) -> str:
    return datetime.fromtimestamp(time, UTC).strftime("%Y%m%dT%H%M%S")
