"""Columns that state which values of a text file are valid: ``Valid``, ``MagValid``, ``TEMP_QC``, ``Flag``.

A column ``Valid`` is 0 in rows that are not valid, ``MagValid`` where the field is not. A column ``X_QC`` has
the quality flags of column ``X``, of which 3, 4 and 9 are bad or missing. A column ``Flag`` with the values 0
and 1 marks the rarer of the two.

References
----------
Argo Quality Control Manual, reference table 2, https://doi.org/10.13155/33951
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

from magbridge.columns import CHANNELS
from magbridge.logs.headings import bare

__all__ = ["Validity", "validity_of"]

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
            binary = all(cell in {"0", "0.0", "1", "1.0"} for cell in cells)
            if binary and marked <= MAX_FLAGGED * len(cells):
                found.append(Validity(name, (), frozenset({1.0})))
            elif binary and len(cells) - marked <= MAX_FLAGGED * len(cells):
                found.append(Validity(name, (), frozenset({0.0})))
    return found


def _column(name: str, names: Sequence[str]) -> str:
    """Return the column that a name means, also in other letters; '' where there is none."""
    return next((other for other in names if other and bare(other) == bare(name)), "")
