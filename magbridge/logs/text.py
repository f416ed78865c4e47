"""Read and write CSV and other text: a header row, one row per sample, empty fields for missing values.

A heading is ``name``, ``name [unit]`` or ``name (unit)``: ``battpos [in]``. Columns of
:data:`magbridge.columns.COLUMNS` need no unit; those in another known unit (``mag_x [uT]``, ``roll [rad]``)
are converted. Before the header there may be lines such as ``# heading_reference = magnetic``, and
``# fill_value = -9999`` where that number stands for a missing value. ``quality`` holds the names of the
flags, separated by spaces. Numbers are written with as many digits as it takes to read back the same float64.

A written file begins with the header, as other programs expect. Its attributes are in
``NAME.csv-metadata.json``, as W3C's *Metadata Vocabulary for Tabular Data* specifies. A magnetic heading is
also stated in the file itself: ``heading [deg magnetic]``.

For files of other programs, :mod:`.layout` finds separator, decimal commas, headings and units, and
:mod:`.clocks` the times. The attributes ``guessed`` and ``history`` state the assumptions. The user can
replace them by declarations (:class:`~magbridge.logs.mapping.Options`).

Captures without headings become a table with headings. A line for MotionCal (PJRC) is ``Raw:`` and nine
counts: accelerometer, gyroscope and magnetometer (0.1 uT). Adafruit's sketches add ``Uni:`` lines in m/s2,
rad/s and uT, which have more digits and are preferred. Neither line has a time; the senders write a hundred
lines a second. Other captures are JSON lines (an object a line) and the sentences of a Marine Magnetics
Explorer: ``*26.331/10:00:00.0 F:50000.123 S:150 D:+003.0m ...``.

References
----------
https://www.pjrc.com/store/prop_shield.html; Adafruit_AHRS, examples/calibration.
"""

from __future__ import annotations

import codecs
import csv
import io
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import chain, groupby, islice
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import msgspec
import numpy as np
import pandas as pd
import xarray as xr
from msgspec.structs import replace

from magbridge.columns import CHANNELS, COLUMNS, NT_PER_UNIT
from magbridge.datasets import with_guesses
from magbridge.errors import FormatError
from magbridge.logs.deployment import HISTORY_ATTRIBUTE, deployment, lasting, with_losses
from magbridge.logs.layout import LAYOUT_LINES, cells, header_of, is_remark, rows_among
from magbridge.logs.mapping import ColumnSource, Options, makers
from magbridge.logs.naming import name_columns, units_of_angles
from magbridge.logs.registry import metadata_path, opened
from magbridge.logs.table import TableReader, line_number
from magbridge.records import Quality

DEFAULTS = Options()
FURTHER = 3_000
"""Number of further lines, after the first ones, whose values help to find units."""
MAX_LINE_CHARACTERS = 1 << 20
"""Characters of the longest line that is read whole."""
MAX_QUOTED_CHARACTERS = 1000
"""Characters that are kept of a longer line, which is then dropped and counted as a row."""
LOOKED_AT, LINE = 1 << 16, 256
"""Bytes that are read to find the encoding, and bytes of the first line that are searched for zeros."""


class TableNotes(msgspec.Struct):
    """Metadata of a table in W3C's vocabulary: the part that the reader uses."""

    notes: list[dict[str, str | float]]


def chunks(path: Path, rows: int, options: Options = DEFAULTS) -> Iterator[tuple[xr.Dataset, Sequence[int]]]:
    """Yield the file in pieces of at most `rows` rows, each with the line numbers of its rows."""
    encoding, guess = _encoding(path)
    with io.TextIOWrapper(opened(path), encoding) as file:
        try:
            yield from _chunks(path, file, rows, options, guess)
        except UnicodeDecodeError:
            raise FormatError(path, f"expected text in {encoding.upper().removesuffix('-SIG')}") from None


def _encoding(path: Path) -> tuple[str, list[str]]:
    """Return the encoding of a text file, and the assumption about it, if any; FormatError: it is binary."""
    with opened(path) as file:
        start = file.read(LOOKED_AT)
    if start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16", []
    line = start.partition(b"\n")[0][:LINE]
    zeros = [not any(line[k::2]) for k in (1, 0)]
    if len(line) > 1 and any(zeros) and not all(zeros):
        return f"utf-16-{'le' if zeros[0] else 'be'}", []
    if b"\0" in line:
        raise FormatError(path, "expected text, the file is binary")
    try:
        codecs.getincrementaldecoder("utf-8")().decode(start)
    except UnicodeDecodeError:
        if not any(byte < 32 and byte not in b"\t\r\n\f" for byte in start):
            return "cp1252", ["text in Windows' Western alphabet, cp1252"]
    return "utf-8-sig", []


def _chunks(
    path: Path, file: TextIO, rows: int, options: Options, guess: list[str]
) -> Iterator[tuple[xr.Dataset, Sequence[int]]]:
    """Yield the rows of an open file in pieces, each with the line numbers of its rows."""
    lines = _lines(file)
    header = list(islice(lines, LAYOUT_LINES))
    declared, added = options.declared, 0
    if capture := _capture(header):
        lines, added = capture.as_csv(chain(header, lines)), 1
        header, guess = list(islice(lines, LAYOUT_LINES)), [*guess, *capture.guess]
        declared = replace(declared, columns={**capture.declared, **declared.columns})
    further = list(islice(lines, FURTHER))
    foreign = not metadata_path(path).is_file()
    layout, units, first_rows = header_of(path, header, declared, foreign=foreign)
    layout = name_columns(path, layout, units, first_rows)
    first_rows += [cells(line, layout.separator) for line in rows_among(further)]
    layout = units_of_angles(layout, first_rows) if foreign else layout
    table = TableReader(path, layout, first_rows, strict=options.strict)
    attrs = {**_attributes(path), **layout.attrs, **table.attrs}
    attrs = with_guesses(path.name, attrs, [*guess, *layout.guesses, *table.guesses])
    numbered = enumerate(chain(header, further, lines), 1 - added)
    wanted = _marked(numbered, layout.first + 1 - added)
    while block := list(islice(wanted, rows)):
        time, columns, numbers = table.read_lines([line for _, line, _ in block], [row for row, *_ in block])
        if block[-1][2] is not None and "line" not in columns:
            labels = {row: label for row, _, label in block}
            columns["line"] = np.array([labels[row] for row in numbers], np.float64)
        piece = deployment(path, time, columns, layout.column_units, attrs)
        yield with_losses(piece, *table.faults.since_last()), numbers
    table.faults.finish()
    if not table.faults.rows:
        raise FormatError(path, "expected rows after the header", row=layout.first + 1)


def _lines(file: TextIO) -> Iterator[str]:
    """Yield the lines of a file; of a very long line, such as zeros after a crash, only the beginning."""
    while line := file.readline(MAX_LINE_CHARACTERS):
        if len(line) == MAX_LINE_CHARACTERS:
            rest = line
            while rest and not rest.endswith("\n"):
                rest = file.readline(MAX_LINE_CHARACTERS)
            line = line[:MAX_QUOTED_CHARACTERS]
        yield line if line.endswith("\n") else f"{line}\n"


def _marked(lines: Iterable[tuple[int, str]], first: int) -> Iterator[tuple[int, str, float | None]]:
    """Yield line number, text and survey line of each row from line number `first` on.

    Geosoft writes marks such as ``LINE 100`` and ``TIE 9000`` before the rows of a survey line; None: no mark
    has come yet.
    """
    names: dict[str, float] = {}
    label = None
    for number, line in lines:
        if is_remark(line):
            if line[0] not in "#%/":
                label = line_number(line, names)
        elif number >= first and line.strip():
            yield number, line, label


class Capture(NamedTuple):
    """Table in a capture without headings."""

    headings: Sequence[str]
    row: Callable[[str], Sequence[object]]
    """Function that returns the cells of a line: no cell for a line to skip, one cell for a damaged line."""
    declared: Mapping[str, ColumnSource] = {}
    guess: tuple[str, ...] = ()

    def as_csv(self, lines: Iterable[str]) -> Iterator[str]:
        """Yield the lines of the capture as lines of CSV, the headings first."""
        rows = (self.row(line.strip()) for line in lines if line.strip())
        for cells_of_row in chain([self.headings], filter(None, rows)):
            text = io.StringIO()
            csv.writer(text, lineterminator="\n").writerow(cells_of_row)
            yield text.getvalue()


MOTIONCAL = {
    kind: re.compile(kind + r":\s*" + r",\s*".join([r"(-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?)"] * 9) + r"\s*")
    for kind in ("Uni", "Raw")
}
"""Kind of the lines for MotionCal, the preferred one first -> pattern of a line."""
COUNT_NT = {"Uni": NT_PER_UNIT["uT"], "Raw": 0.1 * NT_PER_UNIT["uT"]}
"""Kind -> size of the unit of the field, nT."""
EXPLORER = re.compile(
    r"\*(?P<year>\d\d)\.(?P<day>\d{3})/(?P<clock>[\d:.]+) F:(?P<field>[\d.]+)"
    r"(?: S:(?P<signal>[-+\d.]+))?(?: D:(?P<depth>[-+\d.]+)m)?(?: A:(?P<altitude>[-+\d.]+)m)?.*"
)
EXPLORER_CELLS = {
    "time": r"20\g<year>-\g<day>T\g<clock>",
    "total_field [nT]": r"\g<field>",
    "signal": r"\g<signal>",
    "depth [m]": r"\g<depth>",
    "altitude [m]": r"\g<altitude>",
}
"""Heading -> template (:meth:`re.Match.expand`) of the cell."""
MIN_LINE_FRACTION = 0.5
"""Fraction of the first lines above which a form of lines is recognised."""


def _capture(header: Sequence[str]) -> Capture | None:
    """Return the table of a capture that begins with these lines; None for other text."""
    lines = [line.strip() for line in header if line.strip()]
    counts = {kind: sum(map(bool, map(pattern.fullmatch, lines))) for kind, pattern in MOTIONCAL.items()}
    if sum(counts.values()) >= max(1, len(header) / 4):
        kind = next(kind for kind, count in counts.items() if count)
        cells_of = {f"{name} [nT]": rf"\{k}" for k, name in enumerate(CHANNELS, 7)}
        skipped = tuple({"Raw:", "Uni:", "Ori:", "Cal1:", "Cal2:"} - {f"{kind}:"})
        # the senders write a hundred lines a second, without times
        declared = {"time": ColumnSource(heading="row [100 Hz]")}
        declared |= {name: ColumnSource(scale=COUNT_NT[kind]) for name in CHANNELS}
        guess = f"MotionCal's {kind}: lines, {COUNT_NT[kind]:g} nT a count"
        return Capture([*cells_of], partial(_matched, MOTIONCAL[kind], cells_of, skipped), declared, (guess,))
    if sum(map(bool, map(EXPLORER.fullmatch, lines))) > MIN_LINE_FRACTION * len(lines):
        return Capture([*EXPLORER_CELLS], partial(_matched, EXPLORER, EXPLORER_CELLS, ()))
    objects = [one for line in lines if (one := _json(line)) is not None]
    if len(objects) > MIN_LINE_FRACTION * len(lines):
        names = list(dict.fromkeys(name for one in objects for name in one))
        return Capture(names, partial(_json_row, names))
    return None


def _matched(
    pattern: re.Pattern[str], templates: Mapping[str, str], skipped: tuple[str, ...], line: str
) -> list[str]:
    """Return the cells of a line; `skipped` are the beginnings of lines from the same senders to skip."""
    if match := pattern.fullmatch(line):
        return [match.expand(template) for template in templates.values()]
    return [] if line.startswith(skipped) else [line]


def _json(line: str) -> dict[str, object] | None:
    """Return the JSON object of a line, or None."""
    try:
        found = json.loads(line) if line.startswith("{") else None
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def _json_row(names: Sequence[str], line: str) -> list[object]:
    one = _json(line)
    return [line] if one is None else ["" if one.get(name) is None else one[name] for name in names]


class FileWriter:
    """Writer of successive deployments with the columns of the first; `metadata` is its metadata file."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w", encoding="utf-8", newline="")
        self.metadata = b""

    def append(self, dataset: xr.Dataset, *, first: bool) -> None:
        """Write the rows; if `first`, write the header before."""
        headings = ["time"]
        for name in map(str, dataset.data_vars):
            unit = dataset[name].attrs.get("units", "1")
            heading = name if name in COLUMNS or unit == "1" else f"{name} [{unit}]"
            if name == "heading" and dataset.attrs.get("heading_reference") == "magnetic":
                heading = f"heading [{unit} magnetic]"
            headings.append(heading)
        if first:
            self.metadata = _metadata(dataset, headings)
        self.write(_frame(dataset), headings if first else False)

    def write(self, frame: pd.DataFrame, header: list[str] | bool, **options: Any) -> None:
        """Write a data frame as lines of CSV; `options` are those of ``to_csv``."""
        frame.to_csv(self._file, header=header, index=False, lineterminator="\n", **options)

    def close(self) -> None:
        """Write everything to the file and close it."""
        self._file.close()


def _metadata(dataset: xr.Dataset, headings: Sequence[str]) -> bytes:
    attrs: dict[str, str | float] = lasting(dataset.attrs)
    if history := dataset.attrs.get(HISTORY_ATTRIBUTE):
        attrs[HISTORY_ATTRIBUTE] = str(history)
    document = {
        "@context": "http://www.w3.org/ns/csvw",
        "notes": [attrs],
        "tableSchema": {"columns": [{"titles": heading} for heading in headings]},
    }
    return msgspec.json.format(msgspec.json.encode(document), indent=2) + b"\n"


def _attributes(path: Path) -> dict[str, str | float]:
    """Return the attributes in the metadata file of a table; empty without this file."""
    sidecar = metadata_path(path)
    if not sidecar.is_file():
        return {}
    try:
        return msgspec.json.decode(sidecar.read_bytes(), type=TableNotes).notes[0]
    except (msgspec.MsgspecError, IndexError):
        raise FormatError(sidecar, "expected the metadata of a CSV file, with one note") from None


def _frame(dataset: xr.Dataset) -> pd.DataFrame:
    """Return the rows as a data frame, with the names of the flags."""
    frame = pd.DataFrame({name: dataset[name].to_numpy() for name in ("time", *dataset.data_vars)})
    if "quality" in frame:  # no flags: the row was not corrected
        flags = frame["quality"].map(lambda value: Quality(int(value)).names(), na_action="ignore")
        frame["quality"] = flags.fillna("uncalibrated").replace("", None)
    return frame


class GeosoftWriter(FileWriter):
    """Writer of Geosoft's XYZ: headings in a comment, ``LINE 100`` before a survey line, ``*`` for NaN."""

    def append(self, dataset: xr.Dataset, *, first: bool) -> None:
        """Write the rows, with a mark before each survey line; if `first`, write the headings before."""
        lines = dataset["line"].to_numpy().tolist() if "line" in dataset else []
        table = dataset.drop_vars("line", errors="ignore")
        if first:
            self._file.write("/ ")
            super().append(table.isel(time=slice(0)), first=True)
        frame = _frame(table)
        # without survey lines, all rows belong together
        for line, part in groupby(range(len(frame)), key=lambda row: lines[row] if lines else None):
            if line is not None:
                self._file.write(f"LINE {line:.12g}\n")
            self.write(frame.iloc[list(part)], header=False, na_rep="*")


MAGARROW_HEADINGS = [
    "Counter", "Date", "Time", "Latitude", "Longitude", "Mag", "MagValid", "CompassX", "CompassY", "CompassZ",
    "GyroscopeX", "GyroscopeY", "GyroscopeZ", "AccelerometerX", "AccelerometerY", "AccelerometerZ",
    "ImuTemperature", "Track", "LocationSource", "Hdop", "FixQuality", "SatellitesUsed", "Altitude", "Line",
]  # fmt: skip
"""Headings of Geometrics' MagArrow, in its order. GeoHammer finds them by name, MagComPy by their number."""
MAGARROW_FORMS = {"Latitude": "%.8f", "Longitude": "%.8f", "Mag": "%.5f"}
"""Heading of a column that a log must have -> form of its numbers; ``NaN`` stands for an unknown value."""


class MagArrowWriter(FileWriter):
    """Writer of the CSV of Geometrics' MagArrow, which GeoHammer and MagComPy open.

    ``Mag`` is the compensated scalar field if there is one, else the total field, nT. ``MagValid`` is 0 for
    an unknown field and for a sample with a flag.
    """

    _rows = 0

    def append(self, dataset: xr.Dataset, *, first: bool) -> None:
        """Write the rows; if `first`, write the headings before. FormatError: no field or no position."""
        field = "scalar_field" if "scalar_field" in dataset else "total_field"
        declared = makers()["MagArrow"].columns.items()
        columns = {source.heading or "": (name, source.scale) for name, source in declared}
        columns |= {
            "Latitude": ("latitude", 1.0),
            "Longitude": ("longitude", 1.0),
            "Mag": (field, 1.0),
            "Altitude": ("depth", -1.0),
            "Line": ("line", 1.0),
        }
        for heading in MAGARROW_FORMS:
            if (name := columns[heading][0]) not in dataset:
                raise FormatError(Path(self._file.name), "expected this column in the log", column=name)
        valid = np.isfinite(dataset[field].to_numpy())
        if "quality" in dataset:
            valid &= dataset["quality"].to_numpy() == 0
        rows = len(valid)
        moments = pd.to_datetime(np.rint(dataset["time"].to_numpy() * 1e3), unit="ms")
        table = pd.DataFrame("", index=range(rows), columns=MAGARROW_HEADINGS)
        table["Counter"] = np.arange(self._rows, self._rows + rows)
        table["Date"] = moments.strftime("%Y/%m/%d")
        table["Time"] = moments.strftime("%H:%M:%S.%f").str[:-3]
        table["MagValid"] = valid.astype(int)
        for heading, (name, sign) in columns.items():
            if heading in table and name in dataset:
                table[heading] = sign * dataset[name].to_numpy()
                if form := MAGARROW_FORMS.get(heading):
                    table[heading] = table[heading].map(form.__mod__).replace("nan", "NaN")
        self._rows += rows
        self.write(table, first, float_format="%.3f")
