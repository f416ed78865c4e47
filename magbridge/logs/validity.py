"""Values of a file that are not valid: by a column that states it, or by a code for "not known".

A column ``Valid`` is 0 in rows that are not valid, ``MagValid`` where the field is not. A column ``X_QC`` has
the quality flags of column ``X``, of which 3, 4 and 9 are bad or missing. A column ``Flag`` with the values 0
and 1 marks the rarer of the two.

Programs without NaN write codes such as -999 for "not known"; :func:`unknown` finds them.

References
----------
Argo Quality Control Manual, reference table 2, https://doi.org/10.13155/33951
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr

from magbridge.arrays import BoolArray, FloatArray
from magbridge.columns import CHANNELS
from magbridge.errors import FormatError
from magbridge.logs.deployment import with_losses
from magbridge.logs.mapping import bare

__all__ = ["EXPECTED_VALUE", "Validity", "invalid", "known", "states_validity", "unknown", "validity_of"]

VALID = re.compile("(is|data|row|sample)?valid(ity)?")
MAG_VALID = re.compile("(mag|field|tmi)(is)?valid(ity)?")
QUALITY_OF = re.compile(r"(.+?)[ _.]?(QC|qc|quality_flag)")
FLAG = re.compile("(mag|qc|quality|data)?flag")
BAD_QUALITY = frozenset({3.0, 4.0, 9.0})
MAX_FLAGGED = 0.2
"""Largest fraction of rows that a column Flag may mark."""


class Validity(NamedTuple):
    """Statement of a column about other columns."""

    column: str
    targets: tuple[str, ...]
    """Columns whose values are not valid where `column` is bad; empty: the whole row."""
    bad: frozenset[float]
    """Values of `column` that mean so."""

    @property
    def text(self) -> str:
        """The rule, for the user."""
        what = " ".join(self.targets) or "rows"
        bad = " or ".join(f"{value:g}" for value in sorted(self.bad))
        return f"{what} not valid where {self.column} is {bad}"


def states_validity(name: str) -> bool:
    """Return True if a column of this name is about the validity of others."""
    word = bare(name)
    return any(pattern.fullmatch(word) for pattern in (VALID, MAG_VALID, FLAG)) or bool(
        QUALITY_OF.fullmatch(name)
    )


def validity_of(names: Sequence[str], rows: Sequence[Sequence[str]]) -> list[Validity]:
    """Return the rules by which columns state which values are valid.

    Parameters
    ----------
    names : sequence of str
        Of the columns, '' for one that is not read.
    rows : sequence of sequence of str
        Cells of the first rows.
    """
    found = []
    for k, name in enumerate(names):
        word = bare(name)
        if VALID.fullmatch(word):
            found.append(Validity(name, (), frozenset({0.0})))
        elif MAG_VALID.fullmatch(word):
            targets = ("total_field",) if "total_field" in names else CHANNELS
            found.append(Validity(name, targets, frozenset({0.0})))
        elif (match := QUALITY_OF.fullmatch(name)) and (target := _column(match[1], names)):
            found.append(Validity(name, (target,), BAD_QUALITY))
        elif FLAG.fullmatch(word):
            cells = [row[k] for row in rows if k < len(row) and row[k]]
            marked = sum(cell in {"1", "1.0"} for cell in cells)
            binary = bool(cells) and all(cell in {"0", "0.0", "1", "1.0"} for cell in cells)
            if binary and marked <= MAX_FLAGGED * len(cells):
                found.append(Validity(name, (), frozenset({1.0})))
            elif binary and len(cells) - marked <= MAX_FLAGGED * len(cells):
                found.append(Validity(name, (), frozenset({0.0})))
    return found


def invalid(
    rules: Sequence[Validity], columns: Mapping[str, FloatArray]
) -> Iterator[tuple[str, BoolArray, str]]:
    """Yield what rules mark as not valid: column ("" for whole rows), values (n,), and the rule's column."""
    for rule in rules:
        bad = np.isin(columns[rule.column], list(rule.bad))
        if bad.any() and not rule.targets:
            yield "", bad, rule.column
        for name in rule.targets:
            if name in columns and (there := bad & np.isfinite(columns[name])).any():
                yield name, there, rule.column


def _column(name: str, names: Sequence[str]) -> str:
    """Return the column with a name, ignoring case; '' without one."""
    return next((other for other in names if other and bare(other) == bare(name)), "")


EXPECTED_VALUE = "expected a value, or nothing where it is not known, not "

CODES = np.outer([-1.0, 1.0], [
    9999.0, 99999.0, 999999.0, 9999.9, 99999.9, 99999.99, 999.25, 88888.0, 88888.88, 32767.0, 32768.0,
    2_147_483_647.0, 69_696_969.0, 999.0, 999.9, 999.99,
])  # fmt: skip
"""As they are met, with either sign."""
ONLY_AMONG_OTHERS = 1_000.0
"""Smaller codes count only where the column has other values, too."""
MIN_FILL_VALUE = 1e30
"""A larger number is one, too, whatever it measures: 1e31, 1e34, 9.97e36."""


def unknown(columns: dict[str, FloatArray]) -> dict[str, BoolArray]:
    """Return the undeclared missing-value codes among columns (n,) as masks.

    They are huge, or one of :data:`CODES` that lies beyond all others by half their range. A field whose
    three axes are 0, or the same code, is none, nor is a place at 0, 0: a receiver without a fix writes it.
    """
    found = {name: _is_code(values) for name, values in columns.items() if name not in {"time", "quality"}}
    for together in (CHANNELS, ("latitude", "longitude")):
        if set(together) <= set(columns):
            first, *others = (columns[name] for name in together)
            alike = np.all([first == other for other in others], axis=0)
            alike &= (first == 0.0) | np.isin(first, CODES)
            found |= {name: found[name] | alike for name in together}
    return {name: wrong for name, wrong in found.items() if wrong.any()}


def _is_code(values: FloatArray) -> BoolArray:
    wrong: BoolArray = np.abs(values) > MIN_FILL_VALUE
    codes = np.isin(values, CODES)
    others = values[np.isfinite(values) & ~codes & ~wrong]
    if not len(others):
        codes &= np.abs(values) >= ONLY_AMONG_OTHERS
    if codes.any():
        low, high = (others.min(), others.max()) if len(others) else (0.0, 0.0)
        wrong |= codes & (np.maximum(low - values, values - high) > max(0.5 * (high - low), 1.0))
    return wrong


def known(path: Path, dataset: xr.Dataset, numbers: Sequence[int]) -> tuple[xr.Dataset, Sequence[int]]:
    """Return a deployment of another program and the numbers of its rows without what is not valid.

    Missing-value codes, and what a column such as ``Valid`` marks, are counted and named.
    """
    columns = {str(name): column.to_numpy().copy() for name, column in dataset.data_vars.items()}
    lines, values_dropped, keep = [], 0, np.ones(dataset.sizes["time"], bool)
    for name, codes in unknown(columns).items():
        expected = f"{EXPECTED_VALUE}{float(columns[name][codes][0])!r}"
        lines.append(str(FormatError(path, expected, column=name)))
        values_dropped += int(codes.sum())
        columns[name][codes] = np.nan
    for name, bad, column in invalid(validity_of([*columns], ()), columns):
        row = numbers[int(bad.argmax())]
        lines.append(str(FormatError(path, f"not valid by {column!r}", row=row, column=name or None)))
        if name:
            values_dropped += int(bad.sum())
            columns[name][bad] = np.nan
        else:
            keep &= ~bad
    if lines:
        dataset = dataset.assign({name: dataset[name].copy(data=columns[name]) for name in columns})
    if not keep.all():
        dataset = dataset.isel(time=keep)
        numbers = [number for number, is_valid in zip(numbers, keep.tolist(), strict=True) if is_valid]
    counts = {"values_dropped": values_dropped, "rows_dropped": int((~keep).sum())}
    return with_losses(dataset, counts, lines), numbers
