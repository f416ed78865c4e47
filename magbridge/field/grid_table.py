"""Anomaly grids in text, one node per row; columns are identified by name and values."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np

from magbridge.arrays import RealArray
from magbridge.errors import FormatError
from magbridge.field.coordinates import LATITUDE, LONGITUDE, PROJECTED, Axes, stated
from magbridge.field.grid_formats import TEXT_OPTIONS
from magbridge.field.grid_netcdf import ANOMALY_VARIABLES, Parts
from magbridge.wording import counted

__all__ = ["table"]

REMARK = re.compile(r"\s*([#%/]|(line|tie)[\s:]*[\w.:]+\s*$|$)", re.IGNORECASE)
"""A comment, or what Geosoft writes above the rows of a line."""
NUMBER_PATTERN = re.compile(r"[-+.\deinfa]+")
UNIT_SUFFIXES = ("nt", "ut", "µt", "deg", "m", "km")
"""What a column's name may end in, after an underscore, to tell its unit."""
OTHERS = (
    "sigma",
    "error",
    "std",
    "line",
    "flight",
    "date",
    "time",
    "fid",
    "alt",
    "altitude",
    "height",
    "depth",
    "elev",
)
"""Columns that are not an anomaly, whatever other columns there are."""
HEADER_HINT = "name the columns in the first row: longitude,latitude,anomaly"


class GridColumn(NamedTuple):
    """A column's place, its name in small letters without unit, and the unit."""

    place: int
    name: str
    unit: str


def table(path: Path) -> Parts:
    """Read a grid from columns, named or not; any order of rows; gaps are holes.

    FormatError: no such columns, columns that may be this or that, or nodes that form no grid.
    """
    words, delimiter, skip = _beginning(path)
    header = not all(NUMBER_PATTERN.fullmatch(word) for word in words)
    unit, axes = "", Axes()
    if header:
        x, y, z = _named(path, words)
        unit, axes = z.unit, Axes(stated(x.unit, x.name))
        places = x.place, y.place, z.place
    elif len(words) == 3:
        places = 0, 1, 2
    else:
        raise FormatError(path, f"{counted(len(words), 'column')} without names: {HEADER_HINT}", row=1)
    rows = _numbers(path, delimiter, skip, places)
    if not header:
        rows = rows[:, _order(path, rows)]
    (x_levels, column), (y_levels, row) = (
        np.unique(np.round(rows[:, k], 9), return_inverse=True) for k in (0, 1)
    )
    if x_levels.size * y_levels.size > 4 * len(rows):
        raise FormatError(path, f"expected a grid, found {len(rows)} scattered points: grid them first")
    values = np.full((y_levels.size, x_levels.size), np.nan)
    if np.unique(row * x_levels.size + column).size < len(rows):
        raise FormatError(path, "expected one row for each node, some are there twice")
    values[row, column] = rows[:, 2]
    return x_levels, y_levels, values, {"unit": unit, "axes": axes}


def _beginning(path: Path) -> tuple[list[str], str | None, int]:
    """Return the words of the headings or of the first row, the separator, and how many lines to skip."""
    remarks: list[str] = []
    with path.open(**TEXT_OPTIONS) as file:
        first = next((line for line in file if not _is_remark(line, remarks)), "")
    delimiter = next((mark for mark in ",;\t" if mark in first), None)
    candidates = [first, *(line.strip().lstrip("#%/") for line in reversed(remarks))]
    rows = [[word.strip() for word in line.strip().lower().split(delimiter)] for line in candidates]
    eastward = {*LONGITUDE, *PROJECTED[0]}
    alike = (row for row in rows[1:] if len(row) == len(rows[0]))
    named = (row for row in alike if any(_column(0, word).name in eastward for word in row))
    words = rows[0]
    if all(NUMBER_PATTERN.fullmatch(word) for word in words):
        return next(named, words), delimiter, len(remarks)
    return words, delimiter, len(remarks) + 1


def _is_remark(line: str, remarks: list[str]) -> bool:
    """Return True and keep the line if it is neither a row nor headings."""
    found = REMARK.match(line) is not None
    if found:
        remarks.append(line)
    return found


def _named(path: Path, words: list[str]) -> tuple[GridColumn, GridColumn, GridColumn]:
    """Return the columns of x, y and anomaly by their names."""
    columns = [_column(place, word) for place, word in enumerate(words)]
    x, y, z = (
        next((c for name in names for c in columns if c.name == name), None)
        for names in ((*LONGITUDE, *PROJECTED[0]), (*LATITUDE, *PROJECTED[1]), ANOMALY_VARIABLES)
    )
    if x is None or y is None:
        raise FormatError(path, "expected the columns longitude, latitude, anomaly", row=1)
    unknown = [c.name for c in columns if c not in (x, y, z) and c.name not in OTHERS]
    if z is None or (z.name in ("z", "value") and unknown):  # z may be a height
        listed = " or ".join([*([z.name] if z else []), *unknown])
        which = f": which of {listed} is it?" if listed else ""
        raise FormatError(
            path, f"expected the columns longitude, latitude, anomaly{which} call it anomaly", row=1
        )
    return x, y, z


def _column(place: int, word: str) -> GridColumn:
    """Return the column of a word in the header: ``mag``, ``mag [uT]``, ``mag (uT)`` or ``mag_uT``."""
    name, *inside = re.split(r"\s*[\[(]\s*", word.strip("\"' "), maxsplit=1)
    name = re.sub(r"_(dd|wgs84|decimal_degrees)$", "", name.strip().replace(" ", "_"))
    unit = inside[0].rstrip("]) ") if inside else ""
    stem, _, ending = name.rpartition("_")
    if not unit and stem and ending in UNIT_SUFFIXES:
        name, unit = stem, ending
    return GridColumn(place, name, unit)


def _order(path: Path, rows: RealArray) -> list[int]:
    """Return the columns of longitude, latitude and anomaly without names: beyond 90 cannot be a latitude."""
    first, second = np.abs(rows[:, :2]).max(axis=0)
    if second > 90.0 >= first:
        return [1, 0, 2]
    if first > 90.0 >= second:
        return [0, 1, 2]
    raise FormatError(path, f"longitude or latitude first? {HEADER_HINT}", row=1)


def _numbers(path: Path, delimiter: str | None, skip: int, places: tuple[int, int, int]) -> RealArray:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of a file without rows, which is seen below
            with path.open(**TEXT_OPTIONS) as file:  # not numpy's: it takes a byte order mark for a number
                rows = np.loadtxt(file, delimiter=delimiter, skiprows=skip, usecols=places, ndmin=2)
    except ValueError as error:
        # numpy counts rows from 0 below the header
        place = re.search(r"at row (\d+), column (\d+)", str(error))
        line, number = (int(place[1]) + 1 + skip, place[2]) if place else (None, None)
        raise FormatError(path, "expected numbers", row=line, column=number) from error
    if not np.isfinite(rows[:, :2]).all() or not len(rows):
        raise FormatError(path, "expected rows of longitude, latitude, anomaly")
    return np.asarray(rows)
