"""Lines of a text file into columns of numbers; what is none is dropped, counted and named."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from magbridge.arrays import BoolArray, FloatArray
from magbridge.columns import absent
from magbridge.errors import FormatError
from magbridge.logs.clocks import Clock, clock_of, seconds
from magbridge.logs.faults import Faults
from magbridge.logs.layout import BLANKS, Layout, cells
from magbridge.logs.naming import HEMISPHERES, on_side
from magbridge.logs.stamps import DAY
from magbridge.logs.unknown import EXPECTED, unknown
from magbridge.records import Quality

__all__ = ["Table"]

NOTHING = "-", "--", "*", "---"
"""What means 'no value', beside what pandas knows (an empty field, NaN, NA, null ...)."""


class Table:
    """Reads lines of one layout into columns.

    Attributes
    ----------
    guesses : list of str
        What was taken for granted of the times.
    attrs : dict
        What that means for the deployment.
    faults : Faults
        What was dropped.
    """

    def __init__(self, path: Path, layout: Layout, first_lines: Sequence[str], *, strict: bool) -> None:
        self._path, self._layout, self._declared = path, layout, layout.declared
        self.faults = Faults(path, strict=strict)
        self._fill = layout.fill if self._declared.fill_value is None else self._declared.fill_value
        self.guesses: list[str] = []
        self._midnights, self._last = 0.0, 0.0
        if layout.rate:
            self._clock = Clock("s", f"{layout.rate:g} rows a second", boot=True)
        elif layout.stamp:
            self._clock = self._clock_by(first_lines)
        else:
            missing = f'{absent("time", layout.headings)}; if none is: --column time="row [20 Hz]", its rate'
            raise FormatError(path, missing, row=layout.row, column="time")
        if self._clock.assumed:
            self.guesses.insert(0, f"time: {self._clock.assumed}")
        self.attrs: dict[str, Any] = {"time_reference": "boot"} if self._clock.boot else {}
        if self._declared.heading_reference:
            self.attrs["heading_reference"] = self._declared.heading_reference

    def _clock_by(self, first_lines: Sequence[str]) -> Clock:
        """Return how the column of times is read, by its heading, its unit and its first cells."""
        layout = self._layout
        heading, unit = layout.headings[layout.stamp[-1]].strip(), layout.units.pop("time", "")
        first = [cells(line, layout.separator) for line in first_lines[layout.first :] if line.strip()]
        texts = [" ".join(row[k] for k in layout.stamp) for row in first if max(layout.stamp) < len(row)]
        texts = [text.replace(layout.decimal, ".") for text in texts]
        try:
            return clock_of(heading, unit, texts, self._declared.zone)
        except ValueError as error:
            raise FormatError(self._path, str(error), column="time") from None

    def read(
        self, lines: list[str], numbers: Sequence[int]
    ) -> tuple[FloatArray, dict[str, FloatArray], list[int]]:
        """Return the times (n,), the values (n,) of each column, and the numbers of the rows' lines."""
        self.faults.rows += len(lines)
        lines, kept = self._whole(lines, numbers)
        frame = self._frame(lines, kept)
        times, wrong = self._times(frame, kept)
        if wrong.any():
            frame, times = frame[~wrong], times[~wrong]
            kept = [number for number, bad in zip(kept, wrong.tolist(), strict=True) if not bad]
        columns = {
            name: self._floats(name, frame[k], kept)
            for k, name in enumerate(self._layout.names)
            if name and name != "time"
        }
        for name, k in self._layout.hemispheres.items():
            values, columns[name] = columns[name], on_side(name, columns[name], frame[k])
            if (unsure := np.isnan(columns[name]) & np.isfinite(values)).any():
                expected = f"expected {' or '.join(HEMISPHERES[name])} beside it"
                self._note(name, unsure, kept, expected, wrong=False)
        for name, codes in (unknown(columns) if self._layout.foreign else {}).items():
            value = float(columns[name][int(codes.argmax())])
            self._note(name, codes, kept, f"{EXPECTED}{value!r}", wrong=False)
            columns[name][codes] = np.nan
        for name, source in self._declared.columns.items():
            if name in columns and source.valid in columns:
                columns[name][columns[source.valid] == 0.0] = np.nan
        return times, columns, kept

    def _whole(self, lines: list[str], numbers: Sequence[int]) -> tuple[list[str], list[int]]:
        """Return the lines that have as many fields as there are headings, and their numbers."""
        open_quotes = [line.count('"') % 2 == 1 for line in lines]
        lines, numbers = self._without(
            open_quotes, lines, numbers, "expected every quote to be closed in its line"
        )
        separator, width = self._layout.separator, len(self._layout.headings)
        counts = [
            len(cells(line, separator)) if separator == BLANKS or '"' in line else line.count(separator) + 1
            for line in lines
        ]
        if self._layout.open_ended:
            lines = [separator.join(line.split(separator, width)[:width]) + "\n" for line in lines]
            counts = [min(count, width) for count in counts]
        wrong = [count != width for count in counts]
        other = next((count for count in counts if count != width), width)
        return self._without(wrong, lines, numbers, f"expected {width} fields, not {other}")

    def _without(
        self, wrong: list[bool], lines: list[str], numbers: Sequence[int], text: str
    ) -> tuple[list[str], list[int]]:
        """Return the lines that are not wrong, and their numbers; the others are noted."""
        if not any(wrong):
            return lines, list(numbers)
        self._note("", np.array(wrong), numbers, text)
        rows = [(line, n) for line, n, bad in zip(lines, numbers, wrong, strict=True) if not bad]
        return [line for line, _ in rows], [number for _, number in rows]

    def _note(
        self, column: str, at: BoolArray, numbers: Sequence[int], expected: str, *, wrong: bool = True
    ) -> None:
        """Count the values `at` (n,) of a column ("" and ``time``: rows); `expected` is of the first."""
        counter = "rows_dropped" if column in {"", "time"} else "values_dropped"
        self.faults.note(column, int(at.sum()), numbers[int(at.argmax())], expected, counter, wrong=wrong)

    def _frame(self, lines: list[str], numbers: Sequence[int]) -> pd.DataFrame:
        layout = self._layout
        texts = {k for k, name in enumerate(layout.names) if name == "quality"} | {
            *layout.hemispheres.values()
        }
        texts |= {*layout.stamp} if self._clock.is_text or len(layout.stamp) > 1 else set()
        kept = [k for k, name in enumerate(layout.names) if name or k in texts]
        if not lines:
            return pd.DataFrame({k: pd.Series(dtype="str" if k in texts else float) for k in kept})
        frame = pd.read_csv(
            io.StringIO("".join(lines)),
            sep=r"\s+" if layout.separator == BLANKS else layout.separator,
            decimal=layout.decimal,
            header=None,
            names=range(len(layout.headings)),
            usecols=kept,
            index_col=False,
            dtype=dict.fromkeys(texts, "str"),
            na_values=list(NOTHING),
            skipinitialspace=True,
            skip_blank_lines=False,
            low_memory=False,
        )
        if len(frame) != len(lines):
            raise FormatError(self._path, "expected every quote to be closed in its line", row=numbers[0])
        return frame

    def _times(self, frame: pd.DataFrame, numbers: Sequence[int]) -> tuple[FloatArray, BoolArray]:
        """Return the times, and which of the rows have something else there."""
        if self._layout.rate:  # a row that was left out keeps its time
            lines = np.asarray(numbers, np.float64) - 1.0 - self._layout.first
            return lines / self._layout.rate, np.zeros(len(lines), bool)
        first, *others = self._layout.stamp
        column = frame[first]
        for k in others:
            column = column.str.strip() + " " + frame[k].str.strip()
        if self._layout.decimal == "," and not pd.api.types.is_numeric_dtype(column):
            column = column.str.replace(",", ".")
        times = seconds(self._clock, column, self._declared.zone)
        if self._clock.is_text and self._clock.boot:
            times = self._unwound(times)
        wrong = np.isnan(times) & column.notna().to_numpy()
        times[times == self._fill] = np.nan
        self.faults.count("time", len(times))
        if wrong.any():
            text = str(column.iloc[int(wrong.argmax())]).strip()
            self._note("time", wrong, numbers, f"expected {self._clock.expected}, not {text!r}")
        return times, wrong

    def _unwound(self, times: FloatArray) -> FloatArray:
        """Return times of day (n,) that go on after midnight."""
        known = np.isfinite(times)
        steps = np.diff(times[known], prepend=self._last)
        days = self._midnights + DAY * np.cumsum(steps < -DAY / 2)
        if known.any():
            self._midnights, self._last = float(days[-1]), float(times[known][-1])
            times[known] += days
        return times

    def _floats(self, name: str, column: pd.Series, numbers: Sequence[int]) -> FloatArray:
        if name == "quality":
            return self._flags(column, numbers)
        if pd.api.types.is_numeric_dtype(column) or pd.api.types.is_bool_dtype(column):
            values = column.to_numpy(np.float64, copy=True)
        else:
            texts = column.astype("str").str.strip()
            values = _numbers(name, texts, self._layout.decimal)
            wrong = np.isnan(values) & column.notna().to_numpy() & (texts.str.lower() != "nan").to_numpy()
            if wrong.any():
                text = str(column.iloc[int(wrong.argmax())]).strip()
                self._note(name, wrong, numbers, f"expected a number, not {text!r}")
        self.faults.count(name, int(column.notna().sum()))
        values[values == self._fill] = np.nan
        source = self._declared.columns.get(name)
        return values if source is None else np.asarray(values * source.scale + source.offset, np.float64)

    def _flags(self, column: pd.Series, numbers: Sequence[int]) -> FloatArray:
        """Return the bits of named flags; FormatError: a name that is none, for a doubt is never dropped."""
        known: dict[str, float] = {}
        texts = column.fillna("").tolist()
        for row, text in zip(numbers, texts, strict=True):
            try:
                if text not in known:
                    known[text] = float(Quality.parse(text))
            except KeyError:
                expected = f"expected the names of flags, not {text!r}"
                raise FormatError(self._path, expected, row=row, column="quality") from None
        return np.array([known[text] for text in texts])


def _numbers(name: str, texts: pd.Series, decimal: str) -> FloatArray:
    """Return what texts (n,) mean, also 1.5D+03, 18.300,25 and 52.7 W; NaN for what is no number."""
    group = re.escape("." if decimal == "," else ",")
    grouped = rf"^([-+]?\d{{1,3}}(?:{group}\d{{3}})+)(?=\D|$)"
    texts = texts.str.replace(grouped, lambda match: re.sub(r"[.,]", "", match[1]), regex=True)
    texts = texts.str.replace(",", ".") if decimal == "," else texts
    texts = texts.str.replace(r"(?<=\d)[dD](?=[-+]?\d)", "e", regex=True)
    if name in HEMISPHERES:
        opposite = texts.str.contains("[SW]", regex=True, case=False).to_numpy(bool)
        # only at the ends: the E of 1.2E-05 is an exponent's
        texts = texts.str.replace("^[NSEW]|[NSEW]$|\u00b0", "", regex=True, flags=re.IGNORECASE)
        values = np.asarray(pd.to_numeric(texts, errors="coerce"), np.float64)
        return np.asarray(np.where(opposite, -np.abs(values), values))
    return np.array(pd.to_numeric(texts, errors="coerce"), np.float64)
