"""Read SeaExplorer files: ``.gli`` (navigation) and ``.pld1`` (payload), raw or sub-sampled, also gzipped.

The files are text with semicolons, with names and units as pyglider reads them. Positions are degrees and
minutes written together; 9999 means "not known". ``LinPos`` (mm) and ``AngPos`` (deg) are the battery's
position, ``BallastPos`` (cc) is the ballast. Columns of a payload keep their names in small letters, except
the CTD's and a vector magnetometer's. The rows of a payload get attitude and mass positions from the
navigation file of the same dive, if it is in the same folder.

The file does not say whether ``Heading`` is true or magnetic. The reader uses it as true and adds a note. On
SEA063 it differed by 14 deg (quartiles 12 and 16) from the compass of an acoustic profiler, at a declination
of 6 deg.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.errors import FormatError
from magbridge.logs.clocks import epoch
from magbridge.logs.deployment import HISTORY_ATTRIBUTE, deployment, named_losses, sliced, with_losses
from magbridge.logs.fields import FieldMap, degrees, field_maps, linear
from magbridge.logs.naming import aliases
from magbridge.logs.registry import opened, seaexplorer_dive

MAX_NAVIGATION_GAP_S = 120.0
"""Longest interval between navigation samples that is interpolated, s; samples come every 10 to 30 s."""
CLOCK_COLUMNS = "Timestamp", "PLD_REALTIMECLOCK"
DATE = "%d/%m/%Y %H:%M:%S"
UNKNOWN_CODES = 9999.0, -9999.0
"""Codes for "not known"."""
DEGREE_MINUTE_COLUMNS = "Lat", "Lon", "NAV_LATITUDE", "NAV_LONGITUDE"
SEAEXPLORER_FIELDS = {one.field: one for one in field_maps("seaexplorer")[""]}
NAV_ONLY = {
    *("Altitude", "DesiredH", "BallastCmd", "LinCmd", "AngCmd", "NavState", "SecurityLevel", "Declination")
}
"""Columns of the navigation file that are not read, such as commands and states."""


def chunks(path: Path, rows: int) -> Iterator[xr.Dataset]:
    """Yield the file in pieces of at most `rows` rows; the whole file is in memory."""
    whole = _read(path)
    if dive := seaexplorer_dive(path.name, "pld"):
        siblings = [file for file in path.parent.iterdir() if seaexplorer_dive(file.name, "gli") == dive]
        if navigation := min(siblings, default=None):
            whole = _with_navigation(whole, _read(navigation), navigation)
    yield from sliced(whole, rows)


def _with_navigation(payload: xr.Dataset, navigation: xr.Dataset, path: Path) -> xr.Dataset:
    """Return the payload with the columns that only the navigation has, interpolated to its rows."""
    order = np.argsort(navigation["time"].to_numpy(), kind="stable")
    time, at = navigation["time"].to_numpy()[order], payload["time"].to_numpy()
    taken = {}
    for name, column in navigation.data_vars.items():
        if name not in payload:
            values = linear(at, time, column.to_numpy()[order], MAX_NAVIGATION_GAP_S, str(name))
            taken[str(name)] = ("time", values, column.attrs)
    note = f"{' '.join(taken)} between the samples of {path.name}"
    remarks = [line for line in named_losses(navigation.attrs) if "heading" in line]
    return with_losses(payload.assign(taken).assign_attrs({HISTORY_ATTRIBUTE: note}), {}, remarks)


def _read(path: Path) -> xr.Dataset:
    """Return one navigation or payload file as a deployment."""
    table, lost = _table(path)
    clock = next((name for name in CLOCK_COLUMNS if name in table), None)
    if clock is None:
        raise FormatError(path, f"expected a SeaExplorer's file, with a column {' or '.join(CLOCK_COLUMNS)}")
    time = epoch(table.pop(clock), DATE)
    numbers = table.apply(pd.to_numeric, errors="coerce").dropna(axis="columns", how="all")
    columns: dict[str, FloatArray] = {}
    units: dict[str, str] = {}
    known = aliases([str(name) for name in numbers])
    for k, theirs in enumerate(map(str, numbers)):
        if theirs in NAV_ONLY:
            continue
        own = FieldMap("", theirs, known.get(k, theirs.lower()), "", missing=UNKNOWN_CODES)
        one = SEAEXPLORER_FIELDS.get(theirs, own)
        values = one.values(numbers[theirs].to_numpy(float))
        columns.setdefault(one.column, degrees(values) if theirs in DEGREE_MINUTE_COLUMNS else values)
        units[one.column] = one.unit
    whole = deployment(path, time, columns, units)
    taken_as_true = f"{path}: headings are taken as true, which the file does not say"
    remarks = [taken_as_true] if "heading" in columns else []
    return with_losses(whole, {"rows_dropped": lost}, remarks)


def _table(path: Path) -> tuple[pd.DataFrame, int]:
    """Return the cells of a file as text, and the number of lines with more fields than its header."""
    with opened(path) as file:
        text = file.read().decode("utf-8", "replace")
    header, *lines = text.splitlines()
    names = [name.strip() for name in header.rstrip(";\r").split(";")]
    fields = [line.rstrip(";\r").split(";", len(names)) for line in lines if line.strip()]
    whole = [one + [""] * (len(names) - len(one)) for one in fields if len(one) <= len(names)]
    if not whole:
        raise FormatError(path, "expected rows after the header", row=2)
    return pd.DataFrame(whole, columns=names, dtype=str), len(fields) - len(whole)
