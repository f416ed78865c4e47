"""Convert lines of text to columns of numbers; drop, count and name cells that are not numbers."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from functools import partial
from math import isnan, nan
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from magbridge.arrays import BoolArray, FloatArray
from magbridge.columns import YEAR_1980, absent
from magbridge.errors import FormatError, MissingExtra
from magbridge.logs.checks import Faults, Validity, validity_of, without_invalid
from magbridge.logs.clocks import BY_HOUR, SUMS, CountState, TimeFormat, clock_of, date_order, seconds
from magbridge.logs.layout import BLANKS, EMPTY_CELLS, LAYOUT_LINES, Layout, Rows, cells, numbers_of
from magbridge.logs.naming import HEMISPHERES, calendar_of
from magbridge.records import Quality
from magbridge.wording import counted

UNCLOSED_QUOTE = "expected every quote to be closed in its line"


FIRST_NAMED_LINE = 1e6
"""Number given to the first survey line whose name is not a number."""


def line_number(name: str, known: dict[str, float]) -> float:
    """Return the number of a survey line; the same name always has the same number, kept in `known`.

    It is 100 for ``LINE 100``, ``L100`` or ``100``, and a number from a million on for other names. A second
    name with the same number, as ``TIE 100``, counts as another name.
    """
    text = " ".join(name.upper().split())
    digits = re.sub(r"^(LINE|TIE)?[\s:]*L?", "", text)
    label = float(digits) if re.fullmatch(r"\d+(\.\d*)?|NAN", digits) else nan
    taken = (isnan(label) and digits != "NAN") or label in known.values()
    return known.setdefault(text, FIRST_NAMED_LINE + len(known) if taken else label)


def geographic(path: Path, system: str, columns: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Return latitude and longitude (n,), deg of WGS 84, of northings and eastings (n,), m, by column.

    FormatError: pyproj does not know the coordinate system. MissingExtra: pyproj is not installed.
    """
    try:
        from pyproj import Transformer  # noqa: PLC0415 - an optional dependency
        from pyproj.exceptions import ProjError  # noqa: PLC0415
    except ImportError:
        raise MissingExtra("pyproj", "grids") from None
    try:
        there = Transformer.from_crs(system, "EPSG:4326", always_xy=True)
    except ProjError:
        expected = f"expected a projected coordinate system as EPSG:32633, got {system}"
        raise FormatError(path, expected, column="latitude") from None
    longitude, latitude = there.transform(columns["longitude"], columns["latitude"])
    known = np.isfinite(longitude) & np.isfinite(latitude)
    return {"longitude": np.where(known, longitude, np.nan), "latitude": np.where(known, latitude, np.nan)}


class TableReader:
    """Converter of the cells of a table to times and columns of numbers.

    `rows`: cells of the first rows. `clock`: format of the times, if the file states it. `guesses`:
    assumptions about the times. `attrs`: attributes of the deployment that state the reference of times and
    headings. `faults`: counts of the dropped rows and values.
    """

    def __init__(
        self, path: Path, layout: Layout, rows: Rows, *, strict: bool = False, clock: TimeFormat | None = None
    ) -> None:
        self._path, self._layout, self._declared = path, layout, layout.declared
        self.faults = Faults(path, strict=strict)
        self._fill = nan if self._declared.fill_value is None else self._declared.fill_value
        found = validity_of(layout.names, rows) if layout.foreign else []
        self.guesses = [rule.text for rule in found]
        self._rules = [
            Validity(source.valid, (name,), frozenset({0.0}))
            for name, source in self._declared.columns.items()
            if name in layout.names and source.valid in layout.names
        ]
        self._rules += found
        self._first_number, self._counter = 1, CountState()
        self._date, self._has_stayed = "", False
        self._lines: dict[str, float] = {}
        first = rows[: max(LAYOUT_LINES - layout.first, 1)]
        self._clock, notes = (clock, []) if clock else clock_by(path, layout, first)
        self._start, dated = start_by(layout, self._clock, rows)
        if self._clock.assumed and not dated:
            self.guesses.append(f"time: {self._clock.assumed}")
        self.guesses += [*notes, *dated]
        self._is_from_boot = self._clock.boot and not dated
        # seconds in a column ``time``, of which those before 1980 count from a boot
        self._is_plain = clock is None and self._clock == TimeFormat("s")
        self.attrs: dict[str, Any] = {}
        if self._is_from_boot or dated or self._clock.is_dated:
            self.attrs["time_reference"] = "boot" if self._is_from_boot else "utc"
        if self._declared.heading_reference:
            self.attrs["heading_reference"] = self._declared.heading_reference

    def read_lines(
        self, lines: list[str], numbers: Sequence[int]
    ) -> tuple[FloatArray, dict[str, FloatArray], list[int]]:
        """Return the times (n,), s, the values (n,) of each column, and the line numbers of the rows."""
        if not self.faults.rows:
            self._first_number = numbers[0]
        self.faults.rows += len(lines)
        open_quotes = [line.count('"') % 2 == 1 for line in lines]
        lines, numbers = self._dropping(open_quotes, lines, numbers, UNCLOSED_QUOTE)
        # a line that does not have as many fields as there are headings is dropped
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
        lines, kept = self._dropping(wrong, lines, numbers, f"expected {width} fields, not {other}")
        return self.read(self._frame(lines, kept), kept)

    def read(
        self, frame: pd.DataFrame, kept: list[int]
    ) -> tuple[FloatArray, dict[str, FloatArray], list[int]]:
        """Return times (n,), s, values (n,) by column, row numbers; `frame` has the cells by field index."""
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
            values, columns[name] = columns[name], _on_side(name, columns[name], frame[k])
            unsure = np.isnan(columns[name]) & np.isfinite(values)
            expected = f"expected {' or '.join(HEMISPHERES[name])} beside it"
            self.faults.note(name, unsure, kept, expected, wrong=False)
        if self._layout.projection:
            columns |= geographic(self._path, self._layout.projection, columns)
        codes = self._layout.foreign
        return without_invalid(self.faults, times, columns, kept, self._rules, codes=codes)

    def _dropping(
        self, wrong: list[bool], lines: list[str], numbers: Sequence[int], text: str
    ) -> tuple[list[str], list[int]]:
        """Return the lines that are not `wrong`, and their numbers; count the other lines as dropped."""
        if not any(wrong):
            return lines, list(numbers)
        self.faults.note("", np.array(wrong), numbers, text)
        rows = [(line, n) for line, n, bad in zip(lines, numbers, wrong, strict=True) if not bad]
        return [line for line, _ in rows], [number for _, number in rows]

    def _frame(self, lines: list[str], numbers: Sequence[int]) -> pd.DataFrame:
        layout = self._layout
        texts = {k for k, name in enumerate(layout.names) if name == "quality"}
        texts |= {*layout.hemispheres.values()}
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
            na_values=list(EMPTY_CELLS),
            skipinitialspace=True,
            skip_blank_lines=False,
            low_memory=False,
        )
        if len(frame) != len(lines):
            raise FormatError(self._path, UNCLOSED_QUOTE, row=numbers[0])
        return frame

    def _times(self, frame: pd.DataFrame, numbers: Sequence[int]) -> tuple[FloatArray, BoolArray]:
        """Return the times (n,), s, and a mask (n,) of the rows whose time cannot be read."""
        if self._layout.rate:  # a dropped row also takes up its interval
            rows = np.asarray(numbers, np.float64) - self._first_number
            return rows / self._layout.rate, np.zeros(len(rows), bool)
        column = _joined_cells(frame, self._layout.stamp)
        if self._layout.decimal == "," and not pd.api.types.is_numeric_dtype(column):
            column = column.str.replace(",", ".")
        times = seconds(self._clock, column)
        wrong = np.isnan(times) & column.notna().to_numpy()
        is_small = self._is_plain and not (times >= YEAR_1980).any()
        if self._is_from_boot or is_small or (self._clock.boot and self._clock.is_text):
            times, self._counter, boots = self._counter.go_on(times, self._clock)
            if boots:
                again = counted(boots, "time")
                self.faults.remark(f"{self._path}: the clock started again {again}: each part is a run")
        elif self._clock.is_dated and self._clock.kind not in SUMS and len(self._layout.stamp) > 1:
            times = self._past_midnights(frame, times)
        times[times == self._fill] = np.nan
        times += self._start
        self.faults.count("time", len(times))
        if self._clock.zone and wrong.any():  # is it the zone that leaves them open?
            twice = wrong & np.isfinite(seconds(self._clock._replace(zone=None), column))
            self.faults.note("time", twice, numbers, f"expected {self._clock.unambiguous}", column.to_numpy())
            unread = wrong & ~twice
        else:
            unread = wrong
        self.faults.note("time", unread, numbers, f"expected {self._clock.expected}", column.to_numpy())
        return times, wrong

    def _past_midnights(self, frame: pd.DataFrame, times: FloatArray) -> FloatArray:
        """Return the times (n,), s, continued past a midnight at which the date does not change.

        From the next change of the date on, the date counts again.
        """
        stamp = self._layout.stamp
        # the columns before hour, minute and second, or before the time of day
        dates = _joined_cells(frame, stamp[:-3] or stamp[:-1]).ffill().fillna("").to_numpy()
        starts = [0, *(np.flatnonzero(dates[1:] != dates[:-1]) + 1).tolist()] if len(times) else []
        continued = times.copy()
        for start, end in zip(starts, [*starts[1:], len(times)], strict=False):
            if dates[start] != self._date:
                self._date, self._counter = dates[start], CountState()
            continued[start:end], self._counter, _ = self._counter.go_on(times[start:end], self._clock)
            if self._counter.shift_s and not self._has_stayed:
                self._has_stayed = True
                why = f"the date stays {self._date} when the clock passes midnight"
                self.faults.remark(f"{self._path}: {why}: the next day is read")
        return continued

    def _floats(self, name: str, column: pd.Series, numbers: Sequence[int]) -> FloatArray:
        if name == "quality" and not pd.api.types.is_numeric_dtype(column):
            return self._flags(column, numbers)
        if name == "line" and not pd.api.types.is_numeric_dtype(column):
            labels = column.astype("str").map(partial(line_number, known=self._lines), na_action="ignore")
            values = labels.to_numpy(np.float64, copy=True)
        elif name == "line_type" and not pd.api.types.is_numeric_dtype(column):
            values = column.astype("str").str.strip().str.upper().eq("TIE").to_numpy(np.float64)
        elif pd.api.types.is_numeric_dtype(column) or pd.api.types.is_bool_dtype(column):
            values = column.to_numpy(np.float64, copy=True)
        else:
            texts = column.astype("str").str.strip()
            values = _numbers(name, texts, self._layout.decimal, self._layout.units.get(name, ""))
            nothing = texts.str.lower().isin(["", "nan"]).to_numpy()
            wrong = np.isnan(values) & column.notna().to_numpy() & ~nothing
            self.faults.note(name, wrong, numbers, "expected a number", column.to_numpy())
        self.faults.count(name, int(column.notna().sum()))
        values[values == self._fill] = np.nan
        source = self._declared.columns.get(name)
        return values if source is None else np.asarray(values * source.scale + source.offset, np.float64)

    def _flags(self, column: pd.Series, numbers: Sequence[int]) -> FloatArray:
        """Return the bits of named flags; FormatError: an unknown name, since a flag is never dropped."""
        texts = column.fillna("")
        known = {}
        for text in texts.unique():
            try:
                known[text] = float(Quality.parse(text))
            except KeyError:
                row = numbers[int((texts == text).to_numpy().argmax())]
                expected = f"expected the names of flags, not {text!r}"
                raise FormatError(self._path, expected, row=row, column="quality") from None
        return np.asarray(texts.map(known), np.float64)


def clock_by(path: Path, layout: Layout, rows: Rows) -> tuple[TimeFormat, list[str]]:
    """Return the format of the times, from the heading, the unit and the first cells, and assumptions.

    FormatError: the file has no time, or it can be read in two ways.
    """
    if layout.rate:
        return TimeFormat("s", f"{layout.rate:g} rows a second", boot=True), []
    if not layout.stamp:
        missing = f'{absent("time", layout.headings)}; if none is: --column time="row [20 Hz]", its rate'
        raise FormatError(path, missing, row=layout.row, column="time")
    ordered = date_order([layout.headings[k] for k in layout.stamp])
    heading = ordered or layout.headings[layout.stamp[-1]].strip()
    whole = [row for row in rows if len(row) == len(layout.headings)] or rows
    texts = [text.replace(layout.decimal, ".") for text in _joined(whole, layout.stamp)]
    unit = layout.units.get("time", "")
    try:
        clock = clock_of(heading, unit, texts, layout.declared.zone)
    except ValueError as error:
        raise FormatError(path, str(error), column="time") from None
    return clock, [f"{heading!r} as HHMM.mmm"] if unit == BY_HOUR else []


def start_by(layout: Layout, clock: TimeFormat, rows: Rows) -> tuple[float, list[str]]:
    """Return the start of a count, s since 1970, from columns with date and time, and the assumption.

    Without such columns they are 0 and empty.
    """
    places = calendar_of(layout, rows) if clock.boot and layout.stamp else ()
    if not places:
        return 0.0, []
    rows = [row for row in rows if max(*places, *layout.stamp) < len(row)]
    texts = pd.Series(_joined(rows, places), dtype="str")
    counts = pd.Series(_joined(rows, layout.stamp), dtype="str")
    headings = [layout.headings[k] for k in places]
    try:
        calendar = clock_of(" ".join(headings), "", texts.tolist(), layout.declared.zone)
    except ValueError:  # a date that can be read in two ways
        return 0.0, []
    moments = seconds(calendar, texts)
    ahead = moments - seconds(clock, counts)
    if calendar.boot or not np.isfinite(ahead).any():
        return 0.0, []
    # times cut to whole seconds are early by half a second on average, if several rows share a second
    cut = 0.5 if len(np.unique(moments)) < len(moments) and (moments % 1.0 == 0.0).all() else 0.0
    return float(np.nanmedian(ahead)) + cut, [f"dated by {' and '.join(map(repr, headings))}"]


def _joined_cells(frame: pd.DataFrame, places: Sequence[int]) -> pd.Series:
    """Return the cells (n,) of a column, or those of several columns joined by blanks."""
    first, *others = places
    column = frame[first]
    for k in others:
        column = column.str.strip() + " " + frame[k].str.strip()
    return column


def _joined(rows: Rows, places: Sequence[int]) -> list[str]:
    """Return the cells of some columns, joined by blanks, of each row that is long enough."""
    return [" ".join(row[k] for k in places) for row in rows if max(places) < len(row)]


def _numbers(name: str, texts: pd.Series, decimal: str, unit: str) -> FloatArray:
    """Return the numbers of texts (n,), such as 1.5D+03, 18.300,25 and 52.7 W; NaN for other texts."""
    group = re.escape("." if decimal == "," else ",")
    grouped = rf"^([-+]?\d{{1,3}}(?:{group}\d{{3}})+)(?=\D|$)"
    texts = texts.str.replace(grouped, lambda match: re.sub(r"[.,]", "", match[1]), regex=True)
    texts = texts.str.replace(",", ".") if decimal == "," else texts
    if unit:
        texts = texts.str.removesuffix(unit).str.strip()
    if name in HEMISPHERES:
        opposite = texts.str.contains("[SW]", regex=True, case=False).to_numpy(bool)
        # only at the ends: the E of 1.2E-05 is an exponent's
        texts = texts.str.replace("^[NSEW]|[NSEW]$|\u00b0", "", regex=True, flags=re.IGNORECASE)
        values = numbers_of(texts)
        return np.asarray(np.where(opposite, -np.abs(values), values))
    return np.array(numbers_of(texts))


def _on_side(name: str, values: FloatArray, letters: pd.Series) -> FloatArray:
    """Return latitudes or longitudes (n,), deg, signed by hemisphere `letters` (n,); NaN without a letter."""
    side = letters.astype("str").str.strip().str.upper()
    signed = np.where(side.isin(["S", "W"]), -np.abs(values), values)
    return np.asarray(np.where(side.isin([*HEMISPHERES[name]]), signed, np.nan))
