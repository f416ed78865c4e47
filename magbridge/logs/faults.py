"""Count the faults of a file: counted, the first of each column named, and when there is too much of it."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from magbridge.errors import FormatError

__all__ = ["Faults"]

MAX_WRONG_FRACTION = 0.5
"""Share of the rows, or of a column's values, that are wrong in a file that is refused."""


class Faults:
    """The faults of a file so far.

    Attributes
    ----------
    rows : int
        Rows seen, also the wrong ones.
    """

    def __init__(self, file: str | Path, *, strict: bool) -> None:
        self._file, self._strict = file, strict
        self.rows = 0
        # by column; "" and time: rows, the others: values
        self._wrong: Counter[str] = Counter()
        self._known: Counter[str] = Counter()
        self._first: dict[str, FormatError] = {}
        # since they were last asked for
        self._counts: Counter[str] = Counter()
        self._lines: list[str] = []

    def note(
        self, column: str, count: int, row: int, expected: str, counter: str = "", *, wrong: bool = True
    ) -> None:
        """Count the faults in a column, also in `counter`; `row` and `expected` are of the first.

        Unknown values are not `wrong`, and may be most of a column. FormatError: `strict`.
        """
        error = FormatError(self._file, expected, row=row, column=column or None)
        if self._strict:
            raise error
        self._wrong[column] += count * wrong
        if counter:
            self._counts[counter] += count
        if column not in self._first:
            self._first[column] = error
            self._lines.append(str(error))

    def remark(self, line: str) -> None:
        """Add a line to those that name the losses."""
        self._lines.append(line)

    def count(self, column: str, known: int) -> None:
        """Count the values that a column has."""
        self._known[column] += known

    def lost(self, **counts: int) -> None:
        """Count losses, by the counters of a deployment."""
        self._counts.update(counts)

    def since_last(self) -> tuple[Counter[str], list[str]]:
        """Return the losses since the last call: how much, and the lines that name it."""
        last = self._counts, self._lines
        self._counts, self._lines = Counter(), []
        return last

    def finish(self) -> None:
        """FormatError: half of the rows, or of a column's values, are wrong."""
        for column, error in self._first.items():
            if self._wrong[column] >= MAX_WRONG_FRACTION * (self._known[column] or self.rows):
                raise error
