"""CSV and other text: a header row, one row per sample, an empty field for a missing value.

A heading is ``name``, ``name [unit]`` or ``name (unit)``: ``battpos [in]``. Columns of
:data:`magbridge.columns.COLUMNS` need no unit; those in another known unit (``mag_x [uT]``, ``roll [rad]``)
are converted. Before the header there may be lines such as ``# heading_reference = magnetic``, and
``# fill_value = -9999`` where that number stands for a missing value; from a bridge's log, also the settings
by which it corrected. ``quality`` holds the names of the flags, separated by spaces. Numbers are written with
as many digits as it takes to read back the same float64.

Files of others are read by :mod:`.layout` (separator, decimal commas, headings, units) and :mod:`.clocks`
(times); what other programs capture without headings by :mod:`.captures`. What was guessed is told by the
attributes ``guessed`` and ``history``; :class:`~magbridge.logs.options.Options` declare instead.
"""

from __future__ import annotations

import codecs
import csv
from collections.abc import Iterator, Sequence
from itertools import chain, islice
from math import isnan
from pathlib import Path
from typing import TextIO

import numpy as np
import xarray as xr

from magbridge.columns import COLUMNS
from magbridge.errors import FormatError
from magbridge.logs import captures
from magbridge.logs.deployment import GUESSED, HISTORY, deployment, lasting, with_losses
from magbridge.logs.layout import HEAD, layout_of
from magbridge.logs.options import Options
from magbridge.logs.table import Table
from magbridge.records import Quality

__all__ = ["FileWriter", "chunks"]

DEFAULTS = Options()
LONGEST = 1 << 20
"""Characters of the longest line that is read whole."""
KEPT = 1000
"""Characters that are kept of a longer one: a row that is dropped, and counted."""
LOOKED_AT = 1 << 16
"""Bytes by which the encoding is found."""


def chunks(path: Path, rows: int, options: Options = DEFAULTS) -> Iterator[tuple[xr.Dataset, Sequence[int]]]:
    """Yield the file as deployments of at most `rows` rows, each with their numbers.

    Raises
    ------
    FormatError
        No header, a row of another length, a field that is not a number, or a declared column that is not
        there.
    """
    encoding, guess = _encoding(path)
    with path.open(encoding=encoding) as file:
        try:
            yield from _chunks(path, file, rows, options, guess)
        except UnicodeDecodeError:
            raise FormatError(path, "expected text in UTF-8") from None


def _encoding(path: Path) -> tuple[str, list[str]]:
    """Return the encoding of a text file, and what had to be guessed."""
    with path.open("rb") as file:
        start = file.read(LOOKED_AT)
    if start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16", []
    try:
        codecs.getincrementaldecoder("utf-8")().decode(start)
    except UnicodeDecodeError:
        if not any(byte < 32 and byte not in b"\t\r\n\f" for byte in start):
            return "cp1252", ["text in Windows' Western alphabet, cp1252"]
    return "utf-8-sig", []


def _chunks(
    path: Path, file: TextIO, rows: int, options: Options, guess: list[str]
) -> Iterator[tuple[xr.Dataset, Sequence[int]]]:
    """Yield the rows, each piece with the numbers of its lines."""
    lines = _lines(file)
    head = list(islice(lines, HEAD))
    if reader := captures.reader(head):
        yield from reader(path, chain(head, lines), rows)
        return
    layout = layout_of(path, head, options.declared)
    table = Table(path, layout, head, strict=options.strict)
    attrs = {**layout.attrs, **table.attrs}
    if guesses := [*guess, *layout.guesses, *table.guesses]:
        told = "; ".join(guesses)
        before = [str(attrs[HISTORY])] if HISTORY in attrs else []
        attrs |= {GUESSED: told, HISTORY: "\n".join([*before, f"{path.name} was read with: {told}"])}
    numbered = enumerate(chain(head[layout.first :], lines), layout.first + 1)
    wanted = ((row, line) for row, line in numbered if line.strip() and not line.startswith("#"))
    while block := list(islice(wanted, rows)):
        time, columns, numbers = table.read([line for _, line in block], [row for row, _ in block])
        piece = deployment(path, time, columns, layout.units, attrs)
        yield with_losses(piece, *table.faults.since_last()), numbers
    table.faults.finish()
    if not table.faults.rows:
        raise FormatError(path, "expected rows after the header", row=layout.first + 1)


def _lines(file: TextIO) -> Iterator[str]:
    """Yield the lines; of an endless one, as of the zeros that a crash leaves, the beginning."""
    while line := file.readline(LONGEST):
        if len(line) == LONGEST:
            rest = line
            while rest and not rest.endswith("\n"):
                rest = file.readline(LONGEST)
            line = line[:KEPT]
        yield line if line.endswith("\n") else f"{line}\n"


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
            for line in str(dataset.attrs.get(HISTORY, "")).splitlines():
                self._file.write(f"# {HISTORY} = {line}\n")
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
