"""The layout of a text file: from its first lines, or guessed from them.

Comments (``#``, ``%``, ``//``) and lines of a preamble come first, then the headings, perhaps a row of units,
then the rows. A heading may itself be a comment. A file without headings is read where its columns are
declared by their numbers: ``column_1`` is the first. The separator is the one by which headings and rows have
the same number of fields; decimal commas are known by cells like ``-12,5``. Assumptions are kept for the
user.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import nan
from pathlib import Path

from magbridge.errors import FormatError
from magbridge.logs.deployment import SETTINGS
from magbridge.logs.headings import CELL_NUMBER, is_unit
from magbridge.logs.mapping import ColumnMapping, declared_by_maker
from magbridge.logs.naming import name_columns, units_of_angles
from magbridge.logs.validity import Validity, validity_of
from magbridge.wording import counted

__all__ = ["BLANKS", "LAYOUT_LINES", "Layout", "cells", "is_remark", "layout_of"]

LAYOUT_LINES = 200
"""Lines at the start of a file by which its layout is found."""
MAX_COLUMNS = 4_096
"""Largest number of columns that is read."""
ATTRIBUTE_LINE = re.compile(r"[#%]\s*([\w.-]+)\s*=\s*(.*?)\s*")
is_remark = re.compile(r"[#%/]|\s*(?:line|tie)[\s:]*[\w.:]+\s*$", re.IGNORECASE).match
"""Return a match if a line is not a row: a comment, or what Geosoft and others write between the lines of a
survey."""
SEPARATORS = ";", "\t", "|", ","
BLANKS = " "
"""Stands for any number of blanks between fields."""
NMEA_HEADING = "GgaSentence"
"""Heading of the first field that may hold separators of its own."""
DECIMAL_COMMA = re.compile(r"[-+]?(\d{1,3}(\.\d{3})+|\d+),\d+([eE][-+]?\d+)?")
THOUSANDS = re.compile(r"[-+]?\d{1,3}(,\d{3})+\.\d*")


@dataclass
class Layout:
    """The layout of a file."""

    separator: str = ","
    decimal: str = "."
    """`separator`, `decimal`: Between fields (:data:`BLANKS` for any number of blanks), and in a number."""
    names: list[str] = field(default_factory=list)
    """One for each field, ours where it is known; '' for a field that is not read."""
    units: dict[str, str] = field(default_factory=dict)
    """Name -> unit, where one is declared."""
    headings: list[str] = field(default_factory=list)
    """As the file has them."""
    declared: ColumnMapping = field(default_factory=ColumnMapping)
    """What the user says of the columns, or their maker."""
    stamp: list[int] = field(default_factory=list)
    """Which fields are the time, joined by blanks: one, or date and time of day ..."""
    by_hour: bool = False
    """The time of day is written as HHMM.mmm."""
    calendar: list[int] = field(default_factory=list)
    """Fields that give date and time of day next to a time that may count from a boot."""
    validity: list[Validity] = field(default_factory=list)
    """Columns that state which values are valid."""
    hemispheres: dict[str, int] = field(default_factory=dict)
    """``latitude``, ``longitude`` -> which field has N or S, E or W."""
    open_ended: bool = False
    """Rows may have more fields, which are not read."""
    row: int = 1
    """Number of the line with the headings, from 1."""
    first: int = 0
    """Which of the lines is the first row, counted from 0."""
    rate: float | None = None
    """Rows a second, of a file that has no column of times."""
    attrs: dict[str, str | float] = field(default_factory=dict)
    """What the comments declare."""
    fill: float = nan
    """The number that stands for a missing value."""
    foreign: bool = True
    """Not written by this program: without metadata next to it."""
    guesses: list[str] = field(default_factory=list)
    """What the file does not say and was taken for granted."""


def cells(line: str, separator: str) -> list[str]:
    """Return the fields of a line, without the blanks around them."""
    if separator == BLANKS:
        return line.split()
    if '"' not in line:
        return [cell.strip() for cell in line.rstrip("\r\n").split(separator)] if line.strip("\r\n") else []
    return [cell.strip() for cell in next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])]


def layout_of(
    path: Path,
    lines: Sequence[str],
    declared: ColumnMapping,
    *,
    foreign: bool = True,
    further: Sequence[str] = (),
) -> Layout:
    """Return the layout of the file that begins with these lines; `foreign`: without metadata next to it.

    `further` are lines behind them, by whose values units are found.

    FormatError: no headings, two of one name, or a declared column that is not there.
    """
    found = Layout(foreign=foreign)
    comments = _comments(path, lines, found)
    body = [line for line in lines[comments:] if line.strip() and not is_remark(line)]
    if not body or not lines[comments].strip():
        raise FormatError(path, "expected a header row, the file is empty", row=comments + 1)
    found.separator = declared.separator or _separator(body)
    if (width := _count(body[0], found.separator)) > MAX_COLUMNS:
        raise FormatError(path, f"expected at most {MAX_COLUMNS} columns, got {width}", row=comments + 1)
    start = comments + _preamble(lines[comments:], found)
    headings = cells(lines[start].lstrip("#% "), found.separator)
    found.first = start + 1
    if _are_values(headings) or (comments and _mostly_digits(headings)):
        start, headings = _headings_elsewhere(path, lines, comments, start, declared, found)
    found.row = start + 1
    units = _units_row(lines, found)
    remaining = (line for line in lines[found.first :] if line.strip() and not is_remark(line))
    rows = [cells(line, found.separator) for line in remaining]
    if rows and all(len(cell) == len(headings) + 1 and not cell[-1] for cell in rows):
        headings = [*headings, "(nothing)"]  # each row ends in a separator
        units = [*units, ""] if units else units
    found.decimal = declared.decimal or _decimal(rows, found)
    if NMEA_HEADING in headings:  # MagArrow: sentences with commas of their own, at the end of some rows
        found.open_ended, headings = True, headings[: headings.index(NMEA_HEADING)]
    maker, found.declared = declared_by_maker(headings, declared)
    if maker:
        found.guesses.append(f"columns as {maker} writes them")
    name_columns(path, found, headings, units, rows)
    if foreign:
        rows += [cells(line, found.separator) for line in further if line.strip() and not is_remark(line)]
        units_of_angles(found, rows)
        found.validity = validity_of(found.names, rows)
        for rule in found.validity:
            found.guesses.append(rule.text)
    return found


def _are_values(row: Sequence[str]) -> bool:
    """Return True if a row holds values: all cells are numbers, or most begin with a digit."""
    there = [cell for cell in row if cell]
    return all(map(CELL_NUMBER.fullmatch, there)) or (there[0][0].isdigit() and _mostly_digits(there))


def _mostly_digits(row: Sequence[str]) -> bool:
    return sum(cell.lstrip("+-.")[:1].isdigit() for cell in row) > len(row) / 2


def _comments(path: Path, lines: Sequence[str], found: Layout) -> int:
    """Read the comments above the headings; return how many lines they take."""
    for k, line in enumerate(lines):
        if not is_remark(line):
            return k
        if match := ATTRIBUTE_LINE.fullmatch(line.strip()):
            name, text = match.groups()
            if name == "fill_value":
                found.fill = _declared_number(path, name, text, k + 1)
            else:
                number = name.startswith(SETTINGS)
                found.attrs[name] = _declared_number(path, name, text, k + 1) if number else text
    return len(lines) - 1


def _declared_number(path: Path, name: str, text: str, row: int) -> float:
    try:
        return float(text)
    except ValueError:
        raise FormatError(path, f"expected a number, not {text!r}", row=row, column=name) from None


def _count(line: str, separator: str) -> int:
    return len(cells(line, separator))


def _separator(body: Sequence[str]) -> str:
    """Return the separator by which most lines have the same number of fields, and more than one."""
    best, best_score = ",", 0.0
    for separator in (*SEPARATORS, BLANKS):
        counts = Counter(_count(line, separator) for line in body)
        most, often = max(counts.items(), key=lambda item: (item[1], item[0]))
        if most > 1 and (often > 1 or len(body) == 1):
            share = often / len(body) + 0.5 * (separator != BLANKS and _count(body[0], separator) == most)
            # a comma may be a decimal's: the headings must have as many fields as the rows
            if _count(body[0], separator) != most and share < 0.5:
                share *= 0.1
            if share > best_score + 0.05:
                best, best_score = separator, share
    return best


def _preamble(lines: Sequence[str], found: Layout) -> int:
    """Return the number of lines before the headings: lines with fewer fields than most rows."""
    counts = [_count(line, found.separator) if line.strip() else 0 for line in lines]
    usual, often = Counter(counts[1:] or counts).most_common(1)[0]
    if counts[0] >= usual or often < max(2, len(counts) // 2) or usual < 2:
        return 0
    first = next(k for k, count in enumerate(counts) if count >= usual)
    if first and _are_values(cells(lines[first], found.separator)):
        return 0
    found.guesses.append(f"{counted(first, 'line')} above the headings passed over")
    return first


def _headings_elsewhere(
    path: Path, lines: Sequence[str], comments: int, start: int, declared: ColumnMapping, found: Layout
) -> tuple[int, list[str]]:
    """Return position and text of headings in a comment above the rows, or as declared."""
    width = _count(lines[start], found.separator)
    for k in reversed(range(comments)):
        headings = cells(lines[k].lstrip("#%/ "), found.separator)
        named = all(any(map(str.isalpha, cell)) for cell in headings)
        if len(headings) == width and named and not ATTRIBUTE_LINE.fullmatch(lines[k].strip()):
            found.first = start
            found.guesses.append(f"headings from the comment in line {k + 1}")
            return k, headings
    if any((source.heading or "").startswith("column_") for source in declared.columns.values()):
        found.first = start
        return start, [f"column_{k + 1}" for k in range(width)]
    there = lines[start].strip()[:40]
    otherwise = 'without one, say what each column is, as --column time="column_1 [s]"'
    expected = f"expected a header row with the columns' names, not {there!r}; {otherwise}"
    raise FormatError(path, expected, row=start + 1)


def _units_row(lines: Sequence[str], found: Layout) -> list[str]:
    """Return the units if the first row has units and no numbers, and skip that row."""
    if found.first >= len(lines):
        return []
    row = cells(lines[found.first], found.separator)
    if any(cell and CELL_NUMBER.fullmatch(cell) for cell in row) or not any(map(is_unit, row)):
        return []
    found.first += 1
    return [cell.strip("[]()") for cell in row]


def _decimal(rows: Sequence[Sequence[str]], found: Layout) -> str:
    written = [cell for row in rows for cell in row if "," in cell]
    if not any(map(DECIMAL_COMMA.fullmatch, written)) or any(map(THOUSANDS.fullmatch, written)):
        return "."
    found.guesses.append("decimal commas")
    return ","
