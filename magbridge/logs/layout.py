"""Find the layout of a text file from its first lines.

Comments (``#``, ``%``, ``//``) and lines of a preamble come first, then the headings, perhaps a row of units,
then the rows. A heading may itself be a comment. A file without headings is read where its columns are
declared by their numbers: ``column_1`` is the first. The separator is the one by which headings and rows have
the same number of fields; decimal commas are recognised by cells like ``-12,5``.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd
from msgspec import structs

from magbridge.arrays import FloatArray
from magbridge.errors import FormatError
from magbridge.logs.deployment import SETTINGS
from magbridge.logs.mapping import CELL_NUMBER, ColumnMapping, declared_by_maker, is_unit
from magbridge.wording import counted

Rows = Sequence[Sequence[str]]
"""Cells of rows, row by row."""
LAYOUT_LINES = 200
"""Number of lines at the start of a file from which its layout is found."""
PROJECTED_UNIT = "EPSG:"
"""Beginning of the unit of a latitude or longitude that holds northings or eastings of this EPSG code, m."""
MAX_COLUMNS = 4_096
"""Largest number of columns that is read."""
ATTRIBUTE_LINE = re.compile(r"[#%]\s*([\w.-]+)\s*=\s*(.*?)\s*")
is_remark = re.compile(r"[#%/]|\s*(?:line|tie)[\s:]*[\w.:]+\s*$", re.IGNORECASE).match
"""Function that returns a match if a line is a comment or a mark such as ``LINE 100``, and not a row."""
SEPARATORS = ";", "\t", "|", ","
BLANKS = " "
"""Separator that stands for any number of blanks between fields."""
EMPTY_CELLS = "-", "--", "*", "---"
"""Cells without a value, in addition to those of pandas (an empty field, NaN, NA, null ...)."""
NMEA_HEADING = "GgaSentence"
"""Heading of the first field whose content may include separators."""
DECIMAL_COMMA = re.compile(r"[-+]?(\d{1,3}(\.\d{3})+|\d+),\d+([eE][-+]?\d+)?")
THOUSANDS = re.compile(r"[-+]?\d{1,3}(,\d{3})+\.\d*")


@dataclass(frozen=True)
class Layout:
    """Layout of a text file: its separators, columns, times and assumptions."""

    separator: str = ","
    decimal: str = "."
    """`separator`, `decimal`: Sign between fields (:data:`BLANKS` for any number of blanks), decimal sign."""
    names: tuple[str, ...] = ()
    """Name of each field, the standard name if known; '' for a field that is not read."""
    units: Mapping[str, str] = field(default_factory=dict)
    """Name -> unit, for columns whose unit the file or a declaration states."""
    headings: tuple[str, ...] = ()
    """Headings as the file has them."""
    declared: ColumnMapping = field(default_factory=ColumnMapping)
    """Declarations of the user and of the instrument's maker."""
    stamp: tuple[int, ...] = ()
    """Indices of the fields that form the time, joined by blanks: one, or date and time of day ..."""
    hemispheres: Mapping[str, int] = field(default_factory=dict)
    """``latitude``, ``longitude`` -> index of the field with N or S, E or W."""
    open_ended: bool = False
    """True if rows may have further fields, which are not read."""
    row: int = 1
    """Number of the line with the headings, from 1."""
    first: int = 0
    """Index of the line with the first row, from 0."""
    rate: float | None = None
    """Rows per second, for a file without a column of times."""
    attrs: Mapping[str, str | float] = field(default_factory=dict)
    """Attributes that the comments declare."""
    foreign: bool = True
    """True if magbridge did not write the file: it has no metadata."""
    guesses: tuple[str, ...] = ()
    """Assumptions about facts that the file does not state."""

    @property
    def column_units(self) -> dict[str, str]:
        """Units of all columns except the time, whose unit is a format."""
        return {
            name: unit
            for name, unit in self.units.items()
            if name != "time" and not unit.startswith(PROJECTED_UNIT)
        }

    @property
    def projection(self) -> str:
        """Coordinate system ``EPSG:n`` of a position in easting and northing; "" for degrees."""
        systems = {self.units.get(name, "") for name in ("latitude", "longitude")}
        system = systems.pop()
        return system if not systems and system.startswith(PROJECTED_UNIT) else ""

    def guessing(self, *guesses: str) -> Layout:
        """Return the layout with further assumptions."""
        return replace(self, guesses=(*self.guesses, *guesses))

    def with_units(self, units: Mapping[str, str]) -> Layout:
        """Return the layout with the given units of some columns."""
        return replace(self, units={**self.units, **units})

    def renamed(self, names: Mapping[int, str]) -> Layout:
        """Return the layout with other names for the fields of some indices."""
        return replace(self, names=tuple(names.get(k, name) for k, name in enumerate(self.names)))

    def number(self, cell: str) -> str:
        """Return a cell with a decimal point instead of the layout's decimal sign."""
        return cell.replace(",", ".") if self.decimal == "," else cell


def cells(line: str, separator: str) -> list[str]:
    """Return the fields of a line, without the blanks around them."""
    if separator == BLANKS:
        return line.split()
    if '"' not in line:
        return [cell.strip() for cell in line.rstrip("\r\n").split(separator)] if line.strip("\r\n") else []
    return [cell.strip() for cell in next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])]


def numbers_of(cells: pd.Series) -> FloatArray:
    """Return the cells (n,) as numbers, also Fortran's 1.6D+09; NaN for others."""
    if not pd.api.types.is_numeric_dtype(cells):
        cells = cells.astype("str").str.replace(r"(?<=\d)[dD](?=[-+]?\d)", "e", regex=True)
    return np.asarray(pd.to_numeric(cells, errors="coerce"), np.float64)


def rows_among(lines: Sequence[str]) -> list[str]:
    """Return the lines that are rows: neither empty nor remarks."""
    return [line for line in lines if line.strip() and not is_remark(line)]


def header_of(
    path: Path, lines: Sequence[str], declared: ColumnMapping, *, foreign: bool
) -> tuple[Layout, list[str], list[list[str]]]:
    """Return the layout with its headings, the units in a row under them, and the cells of the first rows.

    FormatError: no headings, or too many columns.
    """
    comments, attrs = _comments(path, lines)
    if "fill_value" in attrs and declared.fill_value is None:
        declared = structs.replace(declared, fill_value=float(attrs["fill_value"]))
    attrs.pop("fill_value", None)
    body = rows_among(lines[comments:])
    if not body or not lines[comments].strip():
        raise FormatError(path, "expected a header row, the file is empty", row=comments + 1)
    separator = declared.separator or _separator(body)
    if (width := _count(body[0], separator)) > MAX_COLUMNS:
        expected = f"expected at most {MAX_COLUMNS} columns, got {width}"
        raise FormatError(path, expected, row=comments + 1)
    guesses = []
    if passed := _preamble(lines[comments:], separator):
        guesses.append(f"{counted(passed, 'line')} above the headings passed over")
    start = comments + passed
    headings, first = cells(lines[start].lstrip("#% "), separator), start + 1
    known = [cell for cell in headings if cell not in EMPTY_CELLS]
    if _are_values(headings) or (comments and _mostly_digits(known)):
        first = start
        start, headings = _headings_elsewhere(path, lines, comments, start, separator, declared)
        guesses += [f"headings from the comment in line {start + 1}"] if start < first else []
    units = _units_row(lines[first], separator) if first < len(lines) else []
    first += bool(units)
    rows = [cells(line, separator) for line in rows_among(lines[first:])]
    if rows and all(len(row) == len(headings) + 1 and not row[-1] for row in rows):
        headings = [*headings, "(nothing)"]  # each row ends in a separator
        units = [*units, ""] if units else units
    decimal = declared.decimal or _decimal(rows)
    if decimal == "," and not declared.decimal:
        guesses.append("decimal commas")
    # MagArrow appends sentences that contain commas to some rows
    open_ended = NMEA_HEADING in headings
    headings = headings[: headings.index(NMEA_HEADING)] if open_ended else headings
    maker, declared = declared_by_maker(headings, declared)
    guesses += [f"columns as {maker} writes them"] if maker else []
    layout = Layout(
        separator, decimal, headings=tuple(headings), declared=declared, open_ended=open_ended, row=start + 1,
        first=first, attrs=attrs, foreign=foreign, guesses=tuple(guesses),
    )  # fmt: skip
    return layout, units, rows


def _count(line: str, separator: str) -> int:
    """Return the number of fields of a line."""
    return len(cells(line, separator))


def _are_values(row: Sequence[str]) -> bool:
    """Return True if a row holds values: all cells are numbers, or most begin with a digit."""
    there = [cell for cell in row if cell and cell not in EMPTY_CELLS]
    return all(map(CELL_NUMBER.fullmatch, there)) or (there[0][0].isdigit() and _mostly_digits(there))


def _mostly_digits(row: Sequence[str]) -> bool:
    """Return True if most cells begin with a digit."""
    return sum(cell.lstrip("+-.")[:1].isdigit() for cell in row) > len(row) / 2


def _comments(path: Path, lines: Sequence[str]) -> tuple[int, dict[str, str | float]]:
    """Return the number of comment lines above the headings, and their attributes.

    FormatError: a setting, or the code of a missing value, that is not a number.
    """
    attrs: dict[str, str | float] = {}
    for k, line in enumerate(lines):
        if not is_remark(line):
            return k, attrs
        if match := ATTRIBUTE_LINE.fullmatch(line.strip()):
            name, text = match.groups()
            try:
                attrs[name] = float(text) if name.startswith(SETTINGS) or name == "fill_value" else text
            except ValueError:
                raise FormatError(path, f"expected a number, not {text!r}", row=k + 1, column=name) from None
    return len(lines) - 1, attrs


def _separator(body: Sequence[str]) -> str:
    """Return the separator by which most lines have the same number of fields, and more than one."""
    best, best_score = ",", 0.0
    for separator in (*SEPARATORS, BLANKS):
        counts = Counter(_count(line, separator) for line in body)
        most, often = max(counts.items(), key=lambda item: (item[1], item[0]))
        if most > 1 and (often > 1 or len(body) == 1):
            headed = _count(body[0], separator) == most
            share = often / len(body) + 0.5 * (separator != BLANKS and headed)
            # a comma may be the decimal sign: the headings must have as many fields as the rows
            if not headed and share < 0.5:
                share *= 0.1
            if share > best_score + 0.05:
                best, best_score = separator, share
    return best


def _preamble(lines: Sequence[str], separator: str) -> int:
    """Return the number of lines before the headings: lines with fewer fields than most rows."""
    counts = [_count(line, separator) if line.strip() else 0 for line in lines]
    usual, often = Counter(counts[1:] or counts).most_common(1)[0]
    if counts[0] >= usual or often < max(2, len(counts) // 2) or usual < 2:
        return 0
    first = next(k for k, count in enumerate(counts) if count >= usual)
    return 0 if first and _are_values(cells(lines[first], separator)) else first


def _headings_elsewhere(
    path: Path, lines: Sequence[str], comments: int, start: int, separator: str, declared: ColumnMapping
) -> tuple[int, list[str]]:
    """Return line index and cells of headings in a comment, or ``column_1 ...`` if so declared."""
    width = _count(lines[start], separator)
    for k in reversed(range(comments)):
        headings = cells(lines[k].lstrip("#%/ "), separator)
        named = all(any(map(str.isalpha, cell)) for cell in headings)
        if len(headings) == width and named and not ATTRIBUTE_LINE.fullmatch(lines[k].strip()):
            return k, headings
    if any((source.heading or "").startswith("column_") for source in declared.columns.values()):
        return start, [f"column_{k + 1}" for k in range(width)]
    there = lines[start].strip()[:40]
    otherwise = 'without one, say what each column is, as --column time="column_1 [s]"'
    expected = f"expected a header row with the columns' names, not {there!r}; {otherwise}"
    raise FormatError(path, expected, row=start + 1)


def _units_row(line: str, separator: str) -> list[str]:
    """Return the units in a line that has units and no numbers; an empty list for another line."""
    row = cells(line, separator)
    if any(cell and CELL_NUMBER.fullmatch(cell) for cell in row) or not any(map(is_unit, row)):
        return []
    return [cell.strip("[]()") for cell in row]


def _decimal(rows: Rows) -> str:
    """Return the decimal sign of the numbers in some rows."""
    written = [cell for row in rows for cell in row if "," in cell]
    if not any(map(DECIMAL_COMMA.fullmatch, written)) or any(map(THOUSANDS.fullmatch, written)):
        return "."
    return ","
