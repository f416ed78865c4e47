"""How a text file is laid out: what its first lines say, and what has to be guessed from them.

Comments (``#``, ``%``, ``//``) and lines of a preamble come first, then the headings, perhaps a row of units,
then the rows. A heading may itself be a comment. A file without headings is read where its columns are
declared by their numbers: ``column_1`` is the first. The separator is the one by which headings and rows have
the same number of fields; decimal commas are known by cells like ``-12,5``. What was guessed is kept, to be
told.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import nan
from pathlib import Path

from magbridge.columns import COLUMNS
from magbridge.errors import FormatError
from magbridge.logs.deployment import SETTINGS
from magbridge.logs.headings import aliases, is_unit, split
from magbridge.logs.makers import declared_by_maker
from magbridge.logs.mapping import Declared
from magbridge.wording import counted

__all__ = ["BLANKS", "HEADER", "Layout", "cells", "layout_of"]

HEADER = 200
"""Lines at the start of a file by which its layout is found."""
ATTRIBUTE = re.compile(r"[#%]\s*([\w.-]+)\s*=\s*(.*?)\s*")
COMMENTS = "#", "%", "//"
SEPARATORS = ";", "\t", ",", "|"
BLANKS = " "
"""Stands for any number of blanks between fields."""
NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|[-+]?(nan|inf)|", re.IGNORECASE)
HOUR = re.compile(r"\d{1,2}:\d{2}(:\d{2}([.,]\d+)?)?( ?[AP]M)?", re.IGNORECASE)
COUNTED = re.compile(r"row \[(\d+\.?\d*|\.\d+) ?Hz\]")
"""What is declared to be the time where a file has none: the rows, so many a second."""
DATED = re.compile("date|datum|fecha|jour", re.IGNORECASE)
"""What in a heading says that the column holds dates."""
NMEA = "GgaSentence"
"""Heading of the first field that may hold separators of its own."""
DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+([eE][-+]?\d+)?")


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
    declared: Declared = field(default_factory=Declared)
    """What the user says of the columns, or their maker."""
    date: int | None = None
    """Which field has the date, where ``time`` is a time of day."""
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
    guesses: list[str] = field(default_factory=list)
    """What the file does not say and was taken for granted."""


def cells(line: str, separator: str) -> list[str]:
    """Return the fields of a line, without the blanks around them."""
    if separator == BLANKS:
        return line.split()
    return [cell.strip() for cell in next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])]


def layout_of(path: Path, lines: Sequence[str], declared: Declared) -> Layout:
    """Return the layout of the file that begins with these lines.

    FormatError: no headings, two of one name, or a declared column that is not there.
    """
    found = Layout()
    comments = _comments(path, lines, found)
    body = [line for line in lines[comments:] if line.strip()]
    if not body or not lines[comments].strip():
        raise FormatError(path, "expected a header row, the file is empty", row=comments + 1)
    found.separator = declared.separator or _separator(body)
    start = comments + _preamble(lines[comments:], found)
    headings = cells(lines[start], found.separator)
    found.first = start + 1
    if all(NUMBER.fullmatch(cell) for cell in headings):
        start, headings = _headings_elsewhere(path, lines, comments, start, declared, found)
    found.row = row = start + 1
    units = _units_row(lines, found)
    rows = [cells(line, found.separator) for line in lines[found.first :] if line.strip()]
    if rows and all(len(cell) == len(headings) + 1 and not cell[-1] for cell in rows):
        headings = [*headings, "(nothing)"]  # each row ends in a separator
        units = [*units, ""] if units else units
    found.decimal = declared.decimal or _decimal(rows, found)
    if NMEA in headings:  # MagArrow: sentences with commas of their own, at the end of some rows
        found.open_ended, headings = True, headings[: headings.index(NMEA)]
    maker, found.declared = declared_by_maker(headings, declared)
    if maker:
        found.guesses.append(f"columns as {maker} writes them")
    _name(path, found, headings, units, found.declared, row)
    _find_date(found, rows)
    _leave_texts(found, rows)
    return found


def _comments(path: Path, lines: Sequence[str], found: Layout) -> int:
    """Read the comments above the headings; return how many lines they take."""
    for k, line in enumerate(lines):
        if not line.startswith(COMMENTS):
            return k
        if match := ATTRIBUTE.fullmatch(line.strip()):
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
            share = often / len(body)
            # a comma may be a decimal's: the headings must have as many fields as the rows
            if _count(body[0], separator) != most and share < 0.5:
                share *= 0.1
            if share > best_score + 0.05:
                best, best_score = separator, share
    return best


def _preamble(lines: Sequence[str], found: Layout) -> int:
    """Return how many lines come before the headings: those with fewer fields than most rows have."""
    counts = [_count(line, found.separator) if line.strip() else 0 for line in lines]
    usual, often = Counter(counts[1:] or counts).most_common(1)[0]
    if counts[0] >= usual or often < max(2, len(counts) // 2) or usual < 2:
        return 0
    first = next(k for k, count in enumerate(counts) if count >= usual)
    if first and all(NUMBER.fullmatch(cell) for cell in cells(lines[first], found.separator)):
        return 0
    found.guesses.append(f"{counted(first, 'line')} above the headings passed over")
    return first


def _headings_elsewhere(
    path: Path, lines: Sequence[str], comments: int, start: int, declared: Declared, found: Layout
) -> tuple[int, list[str]]:
    """Return where the headings of rows without any are, and they: in a comment above, or as declared."""
    width = _count(lines[start], found.separator)
    for k in reversed(range(comments)):
        headings = cells(lines[k].lstrip("#%/ "), found.separator)
        if len(headings) == width and not ATTRIBUTE.fullmatch(lines[k].strip()):
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
    """Return the units, where the first row has them and no numbers; that row is then no longer one."""
    if found.first >= len(lines):
        return []
    row = cells(lines[found.first], found.separator)
    if any(cell and NUMBER.fullmatch(cell) for cell in row) or not any(map(is_unit, row)):
        return []
    found.first += 1
    return [cell.strip("[]()") for cell in row]


def _decimal(rows: Sequence[Sequence[str]], found: Layout) -> str:
    commas = sum(bool(DECIMAL_COMMA.fullmatch(cell)) for row in rows for cell in row)
    if not commas:
        return "."
    found.guesses.append("decimal commas")
    return ","


def _name(
    path: Path, found: Layout, headings: list[str], units: list[str], declared: Declared, row: int
) -> None:
    """Give each column its name and unit: as declared, as its heading says, as others call it."""
    found.headings = headings
    if found.separator != ",":
        signs = {"\t": "tabs", BLANKS: "blanks"}
        found.guesses.append(f"fields separated by {signs.get(found.separator, repr(found.separator))}")
    parts = [split(heading) for heading in headings]
    names = [name for name, _ in parts]
    # a name that stands twice, with different units: the second keeps them in its name
    names = [name if name not in names[:k] else headings[k] for k, name in enumerate(names)]
    # a foreign 'Quality' is not our set of flags
    lower = [name if name in COLUMNS or name.lower() == "quality" else name.lower() for name in names]
    names = [
        low if low in COLUMNS and lower.count(low) == 1 else name
        for name, low in zip(names, lower, strict=True)
    ]
    taken = _declared(path, found, names, declared, row)
    bare = ["" if k in taken else name for k, name in enumerate(names)]
    declares = [parts[k][1] or (units[k] if k < len(units) else "") for k in range(len(names))]
    known = {k: name for k, name in aliases(bare, declares).items() if name not in taken.values()}
    for k, name in known.items():
        found.guesses.append(f"{name} is {headings[k]!r}")
    chosen = taken | known
    unnamed = [name for k, name in enumerate(names) if k not in chosen and name in chosen.values()]
    final = [
        "" if names[k] in unnamed and k not in chosen else chosen.get(k, names[k]) for k in range(len(names))
    ]
    if headings[-1] == "(nothing)":
        final[-1] = ""
    for k, name in enumerate(final):
        if (not headings[k] and not name) or (name and name in final[:k]):
            raise FormatError(path, f"expected a name of its own for column {k + 1}, not {name!r}", row=row)
        unit = declares[k]
        if name in declared.columns and (declared_unit := declared.columns[name].unit) is not None:
            unit = declared_unit
        elif name in declared.columns and not unit and declared.columns[name].heading:
            unit = split(declared.columns[name].heading or "")[1]
        if name == "heading" and "magnetic" in f"{headings[k]} {unit}".lower():
            found.attrs.setdefault("heading_reference", "magnetic")
            unit = unit.replace("magnetic", "").strip(" ,")
        if name and unit:
            found.units[name] = unit
    found.names = final


def _declared(
    path: Path, found: Layout, names: Sequence[str], declared: Declared, row: int
) -> dict[int, str]:
    """Return position -> our name of the columns that the caller declares."""
    taken: dict[int, str] = {}
    for name, source in declared.columns.items():
        theirs = source.heading or name
        if name == "time" and (match := COUNTED.fullmatch(theirs)):
            found.rate = float(match[1])
            if not found.rate:
                raise FormatError(path, "expected a rate other than 0 Hz", column="time")
            continue
        for candidates in (found.headings, list(names)):
            for wanted in (theirs, split(theirs)[0]):
                if wanted in candidates:
                    taken.setdefault(candidates.index(wanted), name)
                    break
            if name in taken.values():
                break
        else:
            there = " ".join(repr(heading) if " " in heading else heading for heading in found.headings)
            raise FormatError(path, f"expected this column; there are: {there}", row=row, column=theirs)
    return taken


def _find_date(found: Layout, rows: Sequence[Sequence[str]]) -> None:
    """Find the column with the date, where ``time`` holds times of day."""
    dates = [k for k, heading in enumerate(found.headings) if DATED.search(split(heading)[0])]
    if "time" not in found.names or len(dates) != 1 or found.names[dates[0]] == "time":
        return
    place = found.names.index("time")
    if any(len(row) > place and HOUR.fullmatch(row[place]) for row in rows):
        found.date, found.names[dates[0]] = dates[0], ""


def _leave_texts(found: Layout, rows: Sequence[Sequence[str]]) -> None:
    """Leave out the columns of others that hold texts: nothing here can be done with them."""
    left = []
    for k, name in enumerate(found.names):
        values = [row[k] for row in rows if k < len(row) and row[k]]
        if not name or name in COLUMNS or not values:
            continue
        text = [cell.replace(",", ".") if found.decimal == "," else cell for cell in values]
        if not any(NUMBER.fullmatch(cell) or cell.lower() in {"true", "false"} for cell in text):
            found.names[k] = ""
            left.append(name)
    if left:
        found.guesses.append(f"left out, no numbers: {', '.join(left)}")
