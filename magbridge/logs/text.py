"""CSV: a header row, one row per sample, an empty field for a missing value.

A heading is ``name`` or ``name [unit]``: ``battpos [in]``. Columns of :data:`magbridge.columns.COLUMNS` need
no unit; those in another known unit (``mag_x [uT]``, ``roll [rad]``) are converted. Before the header there
may be lines such as ``# heading_reference = magnetic``, and ``# fill_value = -9999`` where that number stands
for a missing value; from a bridge's log, also the settings by which it corrected. ``quality`` holds the names
of the flags, separated by spaces. Numbers are written with as many digits as it takes to read back the same
float64.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Sequence
from itertools import islice
from math import isnan, nan
from pathlib import Path
from typing import NamedTuple, TextIO

import numpy as np
import xarray as xr

from magbridge.columns import COLUMNS
from magbridge.errors import FormatError
from magbridge.logs.deployment import SETTINGS, deployment, lasting
from magbridge.records import Quality

__all__ = ["FileWriter", "chunks"]

HEADING = re.compile(r"(?P<name>.*?)\s*(?:\[(?P<unit>[^\]]*)\])?")
LONGEST = 1 << 20
"""Characters of the longest line that is read."""
ATTRIBUTE = re.compile(r"#\s*([\w.-]+)\s*=\s*(.*?)\s*")


def chunks(path: Path, rows: int) -> Iterator[tuple[xr.Dataset, Sequence[int]]]:
    """Yield the file as deployments of at most `rows` rows, each with their numbers.

    Raises
    ------
    FormatError
        No header, a row of another length, a field that is not a number.
    """
    with path.open(encoding="utf-8-sig", newline="") as file:
        try:
            yield from _chunks(path, file, rows)
        except UnicodeDecodeError:
            raise FormatError(path, "expected text in UTF-8") from None
        except csv.Error as error:
            raise FormatError(path, f"expected comma-separated values: {error}") from None


class _Header(NamedTuple):
    """What precedes the rows, and the number of the header's line."""

    attrs: dict[str, str | float]
    fill: float
    names: list[str]
    units: dict[str, str]
    row: int


def _header(path: Path, lines: Iterator[str]) -> _Header:
    """Read the comments and the names of the columns from the first lines."""
    attrs: dict[str, str | float] = {}
    fill = nan
    line, row = next(lines, ""), 1
    while line.startswith("#"):
        if match := ATTRIBUTE.fullmatch(line.rstrip("\r\n")):
            name, text = match.groups()
            if name == "fill_value":
                (fill,) = _numbers(path, name, [text], [row])
            else:
                attrs[name] = _numbers(path, name, [text], [row])[0] if name.startswith(SETTINGS) else text
        line, row = next(lines, ""), row + 1
    if not line.strip():
        raise FormatError(path, "expected a header row, the file is empty", row=row)
    headings = next(csv.reader([line]))
    if len(headings) == 1 and {";", "\t"} & set(line.strip()):
        raise FormatError(path, "expected columns separated by commas, and points in decimals", row=row)
    matches = [HEADING.fullmatch(heading.strip()) for heading in headings]
    names = [match["name"] if match else "" for match in matches]
    units = {match["name"]: match["unit"] for match in matches if match and match["unit"]}
    for k, name in enumerate(names):
        if not name or name in names[:k]:
            raise FormatError(path, f"expected a name of its own for column {k + 1}, not {name!r}", row=row)
    if "time" not in names:
        there = " ".join(names)
        raise FormatError(path, f"expected this column; there are: {there}", row=row, column="time")
    return _Header(attrs, fill, names, units, row)


def _chunks(path: Path, file: TextIO, rows: int) -> Iterator[tuple[xr.Dataset, Sequence[int]]]:
    """Yield the rows, each piece with the numbers of its lines."""
    text = _lines(file)
    attrs, fill, names, units, row = _header(path, text)
    reader, nothing = csv.reader(text), True
    lines = ((row + reader.line_num, fields) for fields in reader if fields)
    while block := list(islice(lines, rows)):
        numbers, texts = zip(*block, strict=True)
        for number, fields in block:
            if len(fields) != len(names):
                raise FormatError(path, f"expected {len(names)} fields, not {len(fields)}", row=number)
        columns = {
            name: np.array(_numbers(path, name, column, numbers))
            for name, column in zip(names, zip(*texts, strict=True), strict=True)
        }
        for column in columns.values():
            column[column == fill] = nan
        nothing = False
        yield deployment(path, columns.pop("time"), columns, units, attrs), numbers
    if nothing:
        raise FormatError(path, "expected rows after the header", row=row + 1)


def _lines(file: TextIO) -> Iterator[str]:
    """Yield the lines; an endless one, as of the zeros that a crash leaves, must not fill the memory."""
    while line := file.readline(LONGEST):
        if len(line) == LONGEST:
            raise csv.Error(f"a line has more than {LONGEST:,} characters")
        yield line


def _numbers(path: Path, name: str, texts: Sequence[str], rows: Sequence[int]) -> list[float]:
    number = _flags if name == "quality" else _float
    try:
        return [number(text) for text in texts]
    except ValueError:
        pass
    for row, text in zip(rows, texts, strict=True):
        try:
            number(text)
        except ValueError as error:
            expected = "seconds since 1970" if name == "time" else error
            raise FormatError(path, f"expected {expected}, not {text!r}", row=row, column=name) from None
    raise AssertionError


def _float(text: str) -> float:
    try:
        return float(text) if text else nan
    except ValueError:
        raise ValueError("a number") from None


def _flags(text: str) -> float:
    try:
        return float(Quality.parse(text))
    except KeyError:
        raise ValueError("the names of flags") from None


class FileWriter:
    """Writes deployments one after the other; the columns are those of the first."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w", encoding="utf-8", newline="")
        self._csv = csv.writer(self._file, lineterminator="\n")

    def append(self, dataset: xr.Dataset, *, first: bool) -> None:
        """Write the rows, and before the first ones the header."""
        if first:
            for key, value in lasting(dataset.attrs).items():
                self._file.write(f"# {key} = {value}\n")
            self._csv.writerow(["time", *(_heading(dataset[name]) for name in dataset.data_vars)])
        columns = [_texts("time", dataset["time"].values)]
        columns += [_texts(str(name), dataset[name].values) for name in dataset.data_vars]
        self._csv.writerows(zip(*columns, strict=True))

    def close(self) -> None:
        """Write everything to the file and close it."""
        self._file.close()


def _heading(column: xr.DataArray) -> str:
    unit = column.attrs.get("units", "1")
    return str(column.name) if column.name in COLUMNS or unit == "1" else f"{column.name} [{unit}]"


def _texts(name: str, values: np.ndarray[tuple[int], np.dtype[np.float64]]) -> list[str]:
    if name == "quality":  # a row that was not corrected is never taken for a good one
        return ["uncalibrated" if isnan(v) else Quality(int(v)).names() for v in values.tolist()]
    return ["" if isnan(v) else repr(v) for v in values.tolist()]
