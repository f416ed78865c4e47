"""Drop and count impossible data, and values that a file marks as invalid.

The longest increasing series of times is kept. So a single wrong time costs one row, and a clock that was set
back costs the rows of the repeated interval. Rows with equal times become one. A physically impossible value
becomes NaN. A file is rejected if half of its rows, or of the values of a column, are wrong: it has other
units or another order.

A column ``Valid`` is 0 in invalid rows, and ``MagValid`` is 0 where the field is invalid. A column ``X_QC``
has the quality flags of column ``X``; 3, 4 and 9 mean bad or missing (Argo Quality Control Manual, reference
table 2, https://doi.org/10.13155/33951). In a column ``Flag`` with the values 0 and 1, the rarer value marks
invalid rows. Programs without NaN write codes such as -999 for "not known".
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magbridge.arrays import BoolArray, FloatArray, IndexArray
from magbridge.columns import CHANNEL_TIMES, CHANNELS, bare, usual
from magbridge.datasets import YEAR_10000, disorder, disordered, expected_time
from magbridge.errors import FormatError
from magbridge.logs.deployment import merged, with_losses
from magbridge.logs.mapping import PATTERNS, is_called
from magbridge.records import NULL_POSITION_DEG

Piece = tuple[xr.Dataset, Sequence[int]]
"""Rows of a deployment, and their numbers in the file."""
MAX_MAGNITUDE = {
    "latitude": 90.0,
    **dict.fromkeys(("longitude", "roll", "pitch", "heading"), 540.0),
    "depth": 1e5,
}
"""Largest magnitude of these columns, deg or m; a latitude of 4952.3 is in degrees and minutes."""
MIN_VALUE = {
    "degC": -273.15, "K": 0.0, "Pa": -101325.0, "hPa": -1013.25, "mbar": -1013.25, "kPa": -101.325,
    "bar": -1.01325, "dbar": -10.1325,
}  # fmt: skip
"""Unit -> lowest possible temperature or gauge pressure; a lower value such as -9999 means "not known"."""
REFERENCE_FIELD_RANGE_NT = 1e3, 1e6
"""Range of a possible reference field, nT: 5e-05 is in tesla, and -9999 means "not known"."""
MAX_CHANNEL_DELAY_S = 60.0
"""Largest difference between a channel's sampling time and its row's time, s."""
MIN_GROUP_ROWS, MAX_ISOLATION_S = 3, 30 * 86_400.0
"""A group of fewer rows that is farther (s) from all other rows has wrong times and is dropped."""
MIN_ROWS_FOR_ISOLATION = 10
"""Fewest rows of a piece from which isolated groups are dropped."""
LOOKAHEAD_ROWS = 64
"""Rows after a piece that are examined to decide whether its last times are too late."""


def checked(file: str | Path, pieces: Iterable[Piece], *, strict: bool = False) -> Iterator[xr.Dataset]:
    """Yield the pieces of a deployment without impossible data; `pieces` come with their row numbers.

    The attributes of a piece count and name its losses. FormatError: at least half of the rows, or of a
    column's values, are impossible (if `strict`: any). An error of `pieces` is raised after the last piece.
    """
    faults = Faults(file, strict=strict)
    previous = -np.inf
    last: xr.Dataset | None = None
    broken: list[FormatError] = []
    for piece, following in pairwise(chain(_up_to_error(pieces, broken), [None])):
        if piece is None:  # the end of the pieces
            break
        next_times = following[0]["time"].values if following else np.empty(0)
        part, rows = piece
        index, duplicates = _times(faults, part["time"].values, rows, previous, next_times)
        dropped = part.sizes["time"] - len(index)
        if dropped:
            part, rows = part.isel(time=index), [rows[k] for k in index.tolist()]
        part = _plausible(faults, part, rows)
        faults.lost(rows_dropped=dropped, duplicate_rows=duplicates)
        part = merged(part) if duplicates else part
        if part.sizes["time"]:
            previous = float(part["time"].values[-1])
            if last is not None:
                yield last
            last = with_losses(part, *faults.since_last())
    if not broken:
        faults.finish()
    if last is not None:
        yield with_losses(last, *faults.since_last())  # with the losses after it
    for error in broken:
        raise error


def _up_to_error(pieces: Iterable[Piece], broken: list[FormatError]) -> Iterator[Piece]:
    """Yield the pieces up to an error; append this error to `broken` instead of raising it."""
    try:
        yield from pieces
    except FormatError as error:
        broken.append(error)


def _times(
    faults: Faults, time: FloatArray, rows: Sequence[int], previous: float, next_times: FloatArray
) -> tuple[IndexArray, int]:
    """Return the indices of the rows to keep, and the number of kept rows that repeat the previous time."""
    faults.count("time", len(time))
    time = np.where(np.isfinite(time), time, np.nan)  # an infinite time has no difference from another
    whole = np.concatenate([time, next_times[:LOOKAHEAD_ROWS]])
    if not len(disordered(whole, previous)) and not (np.diff(whole) > MAX_ISOLATION_S).any():
        return np.arange(len(time)), 0
    index = _rows_to_keep(whole, previous)
    then = [*whole[index].tolist(), np.inf]
    index = index[index < len(time)]
    repeated = index[1:][np.diff(time[index]) == 0]
    wrong = ~np.isin(np.arange(len(time)), np.setdiff1d(index, repeated))
    if wrong.any():
        k = int(wrong.argmax())
        place = int(np.searchsorted(index, k))
        before = float(time[index[place - 1]]) if place else previous
        expected = disorder(time) or expected_time(float(time[k]), before, then[place])
        faults.note("time", wrong, rows, expected, counted=False)
    return index, len(repeated)


def _plausible(faults: Faults, dataset: xr.Dataset, rows: Sequence[int]) -> xr.Dataset:
    """Return the piece with NaN for impossible values."""
    time = dataset["time"].values
    for name, column in dataset.data_vars.items():
        values = column.values
        low, high, expected = _possible(str(name), column.attrs.get("units", ""))
        if not expected:
            continue
        compared = values - time if name in CHANNEL_TIMES else values
        wrong = (compared < low) | (compared > high)
        faults.count(str(name), int(np.isfinite(values).sum()))
        faults.note(str(name), wrong, rows, expected, values)
        if wrong.any():
            dataset = dataset.assign({name: column.copy(data=np.where(wrong, np.nan, values))})
    return dataset


def _possible(name: str, unit: str) -> tuple[float, float, str]:
    """Return the lowest and highest possible value of a column, and the expectation ("" for any value).

    The limits of a channel's time are relative to the time of its row.
    """
    unit = usual(unit)
    if most := MAX_MAGNITUDE.get(name):
        return -most, most, f"expected {unit}, at most {most:g}"
    if name == "reference_field":
        low, high = REFERENCE_FIELD_RANGE_NT
        return low, high, f"expected {low:g} to {high:g} nT, or nothing where it is not known"
    if name in CHANNEL_TIMES:
        expected = f"expected a time within {MAX_CHANNEL_DELAY_S:g} s of the row's"
        return -MAX_CHANNEL_DELAY_S, MAX_CHANNEL_DELAY_S, expected
    least = MIN_VALUE.get(unit)
    expected = (
        f"expected at least {least:g} {unit}, or nothing where it is not known" if least is not None else ""
    )
    return least or 0.0, np.inf, expected


def _rows_to_keep(time: FloatArray, previous: float) -> IndexArray:
    """Return the indices of the longest series of `time` (n,), s, that does not decrease, after `previous`.

    Small groups of rows that are far in time from all others are left out.
    """
    index = np.flatnonzero((time > previous) & (np.abs(time) < YEAR_10000))
    if (np.diff(time[index]) < 0).any():
        index = index[in_order(time[index], strictly=False)]
    apart = np.flatnonzero(np.diff(time[index]) > MAX_ISOLATION_S) + 1
    if len(index) >= MIN_ROWS_FOR_ISOLATION and len(apart):
        groups = [group for group in np.split(index, apart) if len(group) >= MIN_GROUP_ROWS]
        index = np.concatenate(groups) if groups else index
    return index


MAX_WRONG_FRACTION = 0.5
"""Fraction of wrong rows, or of a column's wrong values, from which a file is rejected."""


class Faults:
    """Counts of the faults found in a file so far; `rows` counts all its rows."""

    def __init__(self, file: str | Path, *, strict: bool) -> None:
        self._file, self._strict = file, strict
        self.rows = 0
        # by column; "" and time: rows, the others: values
        self._wrong: Counter[str] = Counter()
        self._known: Counter[str] = Counter()
        self._first: dict[str, FormatError] = {}
        # since the last call of since_last
        self._counts: Counter[str] = Counter()
        self._lines: list[str] = []

    def note(
        self,
        column: str,
        marked: BoolArray,
        rows: Sequence[int],
        expected: str,
        found: Sequence[Any] | FloatArray | None = None,
        *,
        counted: bool = True,
        wrong: bool = True,
    ) -> None:
        """Count the `marked` (n,) values of a column as faults, or the rows if it is "" or ``time``.

        `rows`: row numbers (n,). `expected`: expectation, and `found`: the values (n,), for the message about
        the first fault. `counted`: False for faults that :meth:`lost` counts. `wrong`: False for unknown
        values, of which a column may have any number. FormatError: reading is strict.
        """
        if not marked.any():
            return
        k, count = int(marked.argmax()), int(marked.sum())
        if found is not None:
            value = found[k]
            expected += f", not {float(value) if isinstance(value, float) else str(value).strip()!r}"
        error = FormatError(self._file, expected, row=rows[k], column=column or None)
        if self._strict:
            raise error
        self._wrong[column] += count * wrong
        if counted:
            self._counts["rows_dropped" if column in {"", "time"} else "values_dropped"] += count
        if column not in self._first:
            self._first[column] = error
            self._lines.append(str(error))

    def remark(self, line: str) -> None:
        """Add a line to the list of named losses."""
        self._lines.append(line)

    def count(self, column: str, known: int) -> None:
        """Add `known` to the number of values that a column has."""
        self._known[column] += known

    def lost(self, **counts: int) -> None:
        """Add `counts` to the losses; their names are the counters of a deployment."""
        self._counts.update(counts)

    def since_last(self) -> tuple[Counter[str], list[str]]:
        """Return the losses since the last call: counts, and lines that name them."""
        last = self._counts, self._lines
        self._counts, self._lines = Counter(), []
        return last

    def finish(self) -> None:
        """Raise FormatError if half of the rows, or of a column's values, are wrong."""
        for column, error in self._first.items():
            if self._wrong[column] >= MAX_WRONG_FRACTION * (self._known[column] or self.rows):
                raise error


MIN_SET_BACK_S = 1.0
"""Smallest backward step that is a boot, s; records that several tasks write at one time differ by less."""
MEDIAN_ROWS = 5
"""Times before and after a step whose medians are compared; fewer than half of them may be damaged."""


def in_order(time: FloatArray, *, strictly: bool = True) -> NDArray[np.bool_]:
    """Return a mask (n,) of the rows to keep so that `time` (n,), s, increases; drop the fewest rows.

    A single time that is too early or too late costs only its own row. NaN is never kept. If several rows
    have one time, `strictly` keeps only the first of them.

    Notes
    -----
    The longest increasing subsequence, by patience sorting from the end, so that the first of equal times is
    kept: C. Schensted (1961), Canad. J. Math. 13, 179.
    """
    known = np.isfinite(time)
    steps = np.diff(time[known])
    if (steps > 0 if strictly else steps >= 0).all():
        return known
    rows, place = np.flatnonzero(known)[::-1], bisect_left if strictly else bisect_right
    starts: list[float] = []  # starts[k]: minus the greatest first time of an increasing sequence of k + 1,
    first: list[int] = []  # and its row
    after: list[int] = [-1] * len(time)
    for row, one in zip(rows.tolist(), (-time[rows]).tolist(), strict=True):
        k = place(starts, one)
        if k == len(starts):
            starts.append(one)
            first.append(row)
        else:
            starts[k], first[k] = one, row
        after[row] = first[k - 1] if k else -1
    keep = np.zeros(len(time), dtype=bool)
    row = first[-1] if first else -1
    while row >= 0:
        keep[row] = True
        row = after[row]
    return keep


def boots(time: FloatArray) -> IndexArray:
    """Return the indices of rows at which a clock restarted, including 0; `time` (n,): s since the boot."""
    found = [0]
    for k in (1 + np.flatnonzero(np.diff(time) < -MIN_SET_BACK_S)).tolist():
        before, after = time[max(found[-1], k - MEDIAN_ROWS) : k], time[k : k + MEDIAN_ROWS]
        if np.median(after) < np.median(before) - MIN_SET_BACK_S:
            found.append(k)
    return np.array(found, dtype=np.intp)


BAD_QUALITY = frozenset({3.0, 4.0, 9.0})
MAX_FLAGGED = 0.2
"""Largest fraction of rows that a column Flag may mark."""


class Validity(NamedTuple):
    """Rule by which one column states which values of other columns are valid."""

    column: str
    targets: tuple[str, ...]
    """Columns whose values are not valid where `column` is bad; empty: the whole row."""
    bad: frozenset[float]
    """Values of `column` that mean "not valid"."""

    @property
    def text(self) -> str:
        """Return the rule in words, for the user."""
        what = " ".join(self.targets) or "rows"
        bad = " or ".join(f"{value:g}" for value in sorted(self.bad))
        return f"{what} not valid where {self.column} is {bad}"


def states_validity(name: str) -> bool:
    """Return True if a column of this name states the validity of other columns."""
    named = any(is_called(name, kind) for kind in ("valid", "valid field", "flag"))
    return named or bool(PATTERNS["quality"].fullmatch(name))


def validity_of(names: Sequence[str], rows: Sequence[Sequence[str]]) -> list[Validity]:
    """Return the rules by which columns state validity, from names and the cells of the first `rows`."""
    found = []
    words = [bare(name) if name else None for name in names]
    for k, name in enumerate(names):
        if is_called(name, "valid"):
            found.append(Validity(name, (), frozenset({0.0})))
        elif is_called(name, "valid field"):
            targets = ("total_field",) if "total_field" in names else CHANNELS
            found.append(Validity(name, targets, frozenset({0.0})))
        elif (match := PATTERNS["quality"].fullmatch(name)) and bare(match[1]) in words:
            found.append(Validity(name, (names[words.index(bare(match[1]))],), BAD_QUALITY))
        elif is_called(name, "flag"):
            marks = [row[k].removesuffix(".0") for row in rows if k < len(row) and row[k]]
            rare = min("10", key=marks.count)
            if marks and {*marks} <= {*"01"} and marks.count(rare) <= MAX_FLAGGED * len(marks):
                found.append(Validity(name, (), frozenset({float(rare)})))
    return found


CODES = np.outer([-1.0, 1.0], [
    9999.0, 99999.0, 999999.0, 9999.9, 99999.9, 99999.99, 999.25, 88888.0, 88888.88, 32767.0, 32768.0,
    2_147_483_647.0, 69_696_969.0, 999.0, 999.9, 999.99,
])  # fmt: skip
"""Common codes of missing values, with either sign."""
ONLY_AMONG_OTHERS = 1_000.0
"""Magnitude below which a code counts only if the column also has other values."""
MIN_FILL_VALUE = 1e30
"""Magnitude above which any number is the code of a missing value: 1e31, 1e34, 9.97e36."""


def unknown(columns: dict[str, FloatArray]) -> dict[str, BoolArray]:
    """Return a mask (n,) of undeclared missing-value codes for each column (n,) that has any.

    A code is huge, or one of :data:`CODES` beyond all other values by half their range. A field is missing
    if its axes are all 0 or the same code. A position near 0, 0 is missing: no fix.
    """
    found = {name: _is_code(values) for name, values in columns.items() if name not in {"time", "quality"}}
    for together in (CHANNELS, ("latitude", "longitude")):
        if set(together) <= set(columns):
            first, *others = (columns[name] for name in together)
            alike = np.all([first == other for other in others], axis=0)
            alike &= (first == 0.0) | np.isin(first, CODES)
            if together != CHANNELS:
                alike |= np.maximum(abs(first), abs(others[0])) < NULL_POSITION_DEG
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


def without_invalid(
    faults: Faults,
    time: FloatArray,
    columns: dict[str, FloatArray],
    numbers: Sequence[int],
    rules: Sequence[Validity],
    *,
    codes: bool,
) -> tuple[FloatArray, dict[str, FloatArray], list[int]]:
    """Return times (n,), columns (n,) and row numbers without data that the file marks as invalid.

    The `rules` mark rows, which are dropped, and values, which become NaN. If `codes`, missing-value codes
    become NaN as well. `faults` counts all of them.
    """
    for name, wrong in (unknown(columns) if codes else {}).items():
        expected = "expected a value, or nothing where it is not known"
        faults.note(name, wrong, numbers, expected, columns[name], wrong=False)
        columns[name][wrong] = np.nan
    keep = np.ones(len(time), bool)
    for rule in rules:
        bad = np.isin(columns[rule.column], list(rule.bad))
        expected = f"not valid by {rule.column!r}"
        if not rule.targets:
            faults.note("", bad, numbers, expected, wrong=False)
            keep &= ~bad
        for name in rule.targets:
            if name in columns:
                there = bad & np.isfinite(columns[name])
                faults.note(name, there, numbers, expected, wrong=False)
                columns[name][there] = np.nan
    rows = np.flatnonzero(keep)
    kept = {name: values[rows] for name, values in columns.items()}
    return time[rows], kept, [numbers[k] for k in rows.tolist()]
