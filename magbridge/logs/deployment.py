"""Build, join and describe deployments in memory: ``xarray.Dataset`` objects on ``time``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import ArrayLike

from magbridge.columns import (
    CHANNEL_TIMES,
    COLUMNS,
    FURTHER_AXIS,
    NT_PER_UNIT,
    absent,
    counts_from_boot,
    usual,
)  # fmt: skip
from magbridge.datasets import conversion, in_standard_units, standard_log, with_guesses
from magbridge.errors import AbsentColumns, FormatError
from magbridge.logs.mapping import ColumnMapping, ColumnSource, guess_of_height, split, split_all
from magbridge.records import Quality

MEANING = {"heading_reference": "true", "time_reference": "utc"}
"""Attributes that change what values mean, and their defaults."""
SETTINGS = "align.", "telemetry."
"""Prefixes of the attributes with a bridge's settings, as its log declares them."""
CHANGES_SETTING = "align.changes"
"""Attribute that counts the changes of settings during a log; the other settings are those of its start."""
COUNTERS = {
    "bytes_skipped": ("byte skipped", "bytes skipped"),
    "contradictory_rows": ("row contradicts another file", "rows contradict another file"),
    "damages": ("damaged place", "damaged places"),
    "dropouts": ("dropout", "dropouts"),
    "duplicate_rows": ("duplicate row", "duplicate rows"),
    "files_skipped": ("file skipped", "files skipped"),
    "lines_skipped": ("line skipped", "lines skipped"),
    "rows_dropped": ("row dropped", "rows dropped"),
    "rows_in_gaps": ("row in a gap of the vehicle's logs", "rows in gaps of the vehicle's logs"),
    "rows_outside": ("row outside the vehicle's logs", "rows outside the vehicle's logs"),
    "values_dropped": ("impossible value dropped", "impossible values dropped"),
}
"""Attributes that count skipped data, with singular and plural. They are summed over pieces and not written
to files."""
GUESSED_ATTRIBUTE = "guessed"
"""Attribute with the assumptions under which a file was read; like the counts, it is not written to files."""
HISTORY_ATTRIBUTE = "history"
"""Attribute that keeps the assumptions in written files, a line for each."""
LOSSES_ATTRIBUTE = "losses"
"""Attribute that names the losses, a line for each file and column; it is not written to files."""
FROM_BOOT = "from_boot"
"""Attribute of a deployment whose times counted from a boot before the user dated them; it is not written to
files."""
SAME_VALUE = 1e-6, 1e-3
"""Relative and absolute difference up to which two values are the same, because some files round them."""
NOTES = "notes"
"""Attribute with a line for each choice of the reader: one of several compasses, a name, a unit."""


# xarray imports hundreds of modules with its first data set: do so here, and not in every child process
xr.Dataset({"first": ("time", np.zeros(1))})


def deployment(
    file: str | Path,
    time: ArrayLike,
    columns: Mapping[str, ArrayLike],
    units: Mapping[str, str] | None = None,
    attrs: Mapping[str, Any] | None = None,
    long_names: Mapping[str, str] | None = None,
) -> xr.Dataset:
    """Return the columns as a deployment, in the units of :data:`magbridge.columns.COLUMNS`.

    Parameters
    ----------
    file : path
        Named in errors and in the attribute ``source``.
    time : (n,) array of float
        s since 1970 UTC.
    columns : mapping of str to (n,) array of float
        NaN where a row lacks the value.
    units : mapping of str to str, optional
        Declared unit of a column; a column of the table is converted to the table's unit.
    attrs : mapping, optional
        Attributes of the deployment, as ``heading_reference``.
    long_names : mapping of str to str, optional
        Meaning of columns that are not in the table.

    Raises
    ------
    FormatError
        A declared unit that does not fit the column; an unknown ``heading_reference``.
    """
    units, attrs, long_names = units or {}, attrs or {}, long_names or {}
    if (reference := attrs.get("heading_reference", "true")) not in ("true", "magnetic", "inertial"):
        raise FormatError(file, f"heading_reference: expected true, magnetic or inertial, not {reference!r}")
    variables = {}
    for name, values in {"time": time, **columns}.items():
        unit = units.get(name, "")
        scale = conversion(file, name, unit)
        array = np.asarray(values, dtype=np.float64)
        described = _describe(name, unit, long_names.get(name))
        variables[name] = ("time", array if scale == 1.0 else array * scale, described)
    coords = {"time": variables.pop("time")}
    return xr.Dataset(variables, coords=coords, attrs={"source": Path(file).name, **attrs})


def _describe(name: str, unit: str, long_name: str | None) -> dict[str, Any]:
    known = COLUMNS.get(name)
    if FURTHER_AXIS.fullmatch(name) and usual(unit) in NT_PER_UNIT:
        unit = "nT"
    if known is None:
        return {"units": unit or "1", "long_name": long_name or name.replace("_", " ")}
    described: dict[str, Any] = known._asdict()
    if name == "quality":
        described |= {
            "flag_masks": [int(flag) for flag in Quality],
            "flag_meanings": " ".join(str(flag.name).lower() for flag in Quality),
        }
    return described


def sliced(dataset: xr.Dataset, rows: int) -> Iterator[xr.Dataset]:
    """Yield a deployment in memory in pieces of at most `rows` rows; only the first keeps the counts."""
    for start in range(0, dataset.sizes["time"], rows):
        part = dataset.isel(time=slice(start, start + rows))
        yield uncounted(part) if start else part


def shifted(dataset: xr.Dataset, seconds: float) -> xr.Dataset:
    """Return the deployment with `seconds` added to its times, also to the times of the channels."""
    moved = dataset.assign_coords(time=dataset["time"].copy(data=dataset["time"].values + seconds))
    channels = [name for name in CHANNEL_TIMES if name in moved]
    return moved.assign({name: moved[name].copy(data=moved[name].values + seconds) for name in channels})


def same_columns(dataset: xr.Dataset, like: Mapping[str, Mapping[str, Any]]) -> xr.Dataset:
    """Return the deployment with exactly the columns of `like` (name to attributes), missing ones all NaN."""
    empty = np.full(dataset.sizes["time"], np.nan)
    variables = {
        name: dataset[name] if name in dataset else ("time", empty, dict(attrs))
        for name, attrs in like.items()
    }
    return xr.Dataset(variables, coords={"time": dataset["time"]}, attrs=dataset.attrs)


def renamed(dataset: xr.Dataset, declaration: ColumnMapping) -> xr.Dataset:
    """Return the deployment with columns renamed and scaled as declared, for formats with fixed names.

    AbsentColumns: it lacks declared columns.
    """
    taken: dict[str, Any] = {}
    sources = {name: _column(dataset, name, source)[0] for name, source in declaration.columns.items()}
    if lacking := {name: theirs for name, theirs in sources.items() if theirs not in dataset}:
        first = next(iter(lacking.values()))
        expected = absent(first, map(str, dataset.data_vars))
        raise AbsentColumns(dataset.attrs["source"], expected, (*lacking,), column=first)
    for name, source in declaration.columns.items():
        theirs, unit = _column(dataset, name, source)
        values = source.scale * dataset[theirs].to_numpy() + source.offset
        unit = unit or str(dataset[theirs].attrs.get("units", ""))
        part = deployment(dataset.attrs["source"], dataset["time"].to_numpy(), {name: values}, {name: unit})
        taken[name] = part[name]
    named = dataset.drop_vars(set(sources.values()) - declaration.columns.keys()).assign(taken)
    named.attrs = with_guesses(named.attrs["source"], named.attrs, guess_of_height(declaration))
    reference = declaration.heading_reference
    return named.assign_attrs({"heading_reference": reference}) if reference else named


def _column(dataset: xr.Dataset, name: str, source: ColumnSource) -> tuple[str, str]:
    """Return the name that the source of column `name` has in the deployment, and its declared unit."""
    theirs = source.heading or name
    if theirs in dataset:
        return theirs, source.unit or ""
    theirs, unit = split(theirs)
    return theirs, source.unit or unit


def join(parts: Sequence[xr.Dataset]) -> xr.Dataset:
    """Return several deployments as one, sorted in time, with NaN where a part lacks a column.

    If rows have the same time, the values of the first part are kept, and the others fill its NaNs. Rows that
    repeat the first one's values are counted as duplicates; rows with other values are counted and named.
    FormatError: two parts disagree on a unit, or on the reference of headings or times.
    """
    if len(parts) == 1:
        return parts[0]
    described: dict[str, dict[str, Any]] = {}
    for part in parts:
        for name in part.data_vars:
            own = part.variables[name].attrs
            attrs = described.setdefault(str(name), own)
            if usual(attrs.get("units", "")) != usual(own.get("units", "")):
                expected = f"expected {attrs.get('units')!r} as in the files before, not {own.get('units')!r}"
                raise FormatError(part.attrs.get("source", ""), expected, column=str(name))
    alike = [same_columns(part, described) for part in parts]
    names = ["time", *described]
    whole = {name: np.concatenate([part.variables[name].values for part in alike]) for name in names}
    coords = {"time": ("time", whole.pop("time"), parts[0]["time"].attrs)}
    columns = {name: ("time", values, described[name]) for name, values in whole.items()}
    stacked = xr.Dataset(columns, coords, join_attrs(parts))
    return with_losses(merged(stacked), *_repeated(stacked, parts))


def _repeated(stacked: xr.Dataset, parts: Sequence[xr.Dataset]) -> tuple[dict[str, int], list[str]]:
    """Return the counts of the `parts` rows whose time occurs before, and a line for each two files."""
    time = stacked["time"].values
    order = np.argsort(time, kind="stable")
    ordered = time[order]
    again = np.flatnonzero(ordered[1:] == ordered[:-1]) + 1
    first, other = order[np.searchsorted(ordered, ordered[again])], order[again]
    repeats, differs = np.zeros(len(other), bool), np.zeros(len(other), bool)
    for column in stacked.data_vars.values():
        expected, found = column.values[first], column.values[other]
        repeats |= np.isfinite(expected) & np.isfinite(found)
        differs |= ~np.isclose(found, expected, *SAME_VALUE) & np.isfinite(found - expected)
    part = np.repeat(np.arange(len(parts)), [part.sizes["time"] for part in parts])
    pairs = np.stack([part[first[differs]], part[other[differs]]], axis=1)
    lines = []
    for (a, b), count in zip(*np.unique(pairs, axis=0, return_counts=True), strict=True):
        kept, source = (parts[k].attrs.get("source", "") for k in (a, b))
        lines.append(f"{source}: {count:,} of its rows have the times of {kept}, but other values: not used")
    counts = {"duplicate_rows": int((repeats & ~differs).sum()), "contradictory_rows": int(differs.sum())}
    return counts, lines


def refuse_repeated(joined: xr.Dataset) -> None:
    """Raise FormatError if files of a `joined` deployment have rows of equal times."""
    repeated = [name for name in ("duplicate_rows", "contradictory_rows") if name in joined.attrs]
    if repeated:
        expected = f"expected logs without {' '.join(repeated)}, as --strict was given"
        raise FormatError(joined.attrs["source"], "; ".join([expected, *named_losses(joined.attrs)]))


def merged(dataset: xr.Dataset) -> xr.Dataset:
    """Return the deployment sorted in time; rows with equal times become the first, its NaNs filled."""
    time = dataset["time"]
    times, group = np.unique(time.values, return_inverse=True)
    values = {name: column.values for name, column in dataset.data_vars.items()}
    table = pd.DataFrame(values, index=range(len(group)))
    known = table.groupby(group).first()  # the first value that is not NaN
    variables = {
        name: ("time", known[name].to_numpy(), column.attrs) for name, column in dataset.data_vars.items()
    }
    return xr.Dataset(variables, coords={"time": ("time", times, time.attrs)}, attrs=dataset.attrs)


def with_losses(dataset: xr.Dataset, counts: Mapping[str, int], lines: Sequence[str] = ()) -> xr.Dataset:
    """Return the deployment with :data:`COUNTERS` raised by `counts` and `lines` added to its losses."""
    raised: dict[str, int | str] = {}
    for name, count in counts.items():
        if count:
            raised[name] = int(dataset.attrs.get(name, 0)) + count
    if named := [*named_losses(dataset.attrs), *lines]:
        raised[LOSSES_ATTRIBUTE] = "\n".join(named)
    return dataset.assign_attrs(raised)


def with_notes(dataset: xr.Dataset, lines: Sequence[str]) -> xr.Dataset:
    """Return the deployment with further notes for the user."""
    return dataset.assign_attrs({NOTES: "\n".join([*noted(dataset.attrs), *lines])}) if lines else dataset


def lasting(attrs: Mapping[Any, Any]) -> dict[str, str | float]:
    """Return the attributes that every format must keep: those of :data:`MEANING`, and settings."""
    return {
        str(name): value
        for name, value in attrs.items()
        if name in MEANING or (isinstance(value, (int, float)) and str(name).startswith(SETTINGS))
    }


def plain_attrs(attrs: Mapping[Any, Any]) -> dict[str, str | int | float]:
    """Return the attributes that JSON can hold."""
    return {str(name): value for name, value in attrs.items() if isinstance(value, (str, int, float))}


def uncounted(dataset: xr.Dataset) -> xr.Dataset:
    """Return the deployment without the attributes of reading: counts, losses, guesses and notes."""
    bare = dataset.copy(deep=False)
    counted = {FROM_BOOT, GUESSED_ATTRIBUTE, LOSSES_ATTRIBUTE, NOTES, *COUNTERS}
    bare.attrs = {name: value for name, value in dataset.attrs.items() if name not in counted}
    return bare


def passed_over(*pieces: Mapping[str, Any]) -> dict[str, int]:
    """Return the :data:`COUNTERS` that are not 0, summed over the attributes of a deployment's `pieces`."""
    counts = {name: sum(int(attrs.get(name, 0)) for attrs in pieces) for name in COUNTERS}
    return {name: count for name, count in counts.items() if count}


def named_losses(*pieces: Mapping[str, Any]) -> list[str]:
    """Return the lines that name the losses, from the attributes of a deployment's `pieces`."""
    return [line for attrs in pieces for line in str(attrs.get(LOSSES_ATTRIBUTE, "")).splitlines()]


def noted(*pieces: Mapping[str, Any]) -> list[str]:
    """Return the reader's notes for the user, from the attributes of a deployment's `pieces`."""
    return [line for attrs in pieces for line in str(attrs.get(NOTES, "")).splitlines()]


def join_attrs(parts: Sequence[xr.Dataset]) -> dict[str, Any]:
    """Return the joined attributes of deployments; only parts with headings define ``heading_reference``.

    FormatError: two parts disagree on an attribute that changes what values mean.
    """
    headed = [part.attrs for part in parts if "heading" in part] or [part.attrs for part in parts]
    all_attrs: list[Mapping[Any, Any]] = [part.attrs for part in parts]
    for key, default in MEANING.items():
        declared = headed if key == "heading_reference" else all_attrs
        first = declared[0].get(key, default)
        for attrs in declared:
            if (other := attrs.get(key, default)) != first:
                raise FormatError(attrs.get("source", ""), f"expected {key} {first} as before, not {other}")
    joined: dict[str, Any] = {}
    sources: dict[str, None] = {}
    for attrs in all_attrs:
        sources[str(attrs.get("source", ""))] = None
        for key, value in attrs.items():
            if key in COUNTERS and key in joined:
                joined[key] += value
            else:
                joined.setdefault(key, value)
    for key in (GUESSED_ATTRIBUTE, HISTORY_ATTRIBUTE, LOSSES_ATTRIBUTE, NOTES):
        joined_lines = [line for attrs in all_attrs for line in str(attrs.get(key, "")).splitlines()]
        if joined_lines:
            joined[key] = "\n".join(dict.fromkeys(joined_lines))
    joined.pop("heading_reference", None)
    if "heading_reference" in headed[0]:
        joined["heading_reference"] = headed[0]["heading_reference"]
    return joined | {"source": ", ".join(sources)}


FRAME_NAME = "the data frame"


def from_frame(frame: pd.DataFrame, units: Mapping[str, str] | None = None, **attrs: Any) -> xr.Dataset:
    """Return a data frame as a deployment, for every function that accepts a log.

    Parameters
    ----------
    frame : DataFrame
        Columns outside :data:`magbridge.columns.COLUMNS` are telemetry. A heading may hold a unit, as
        ``mag_x [uT]``. Column ``time`` or the index holds timestamps (UTC if without zone) or s since 1970.
    units : mapping of str to str, optional
        Units of columns; standard columns are converted to their standard unit.
    **attrs
        Attributes of the deployment, as ``heading_reference="magnetic"``.

    Raises
    ------
    FormatError
        The frame has no time, times do not increase, a column does not hold numbers, or a unit does not fit.
    """
    named: dict[str, str] = {}
    headings = [str(name) for name in frame.columns]
    for heading, (name, unit) in zip(headings, split_all(headings), strict=True):
        named[heading if name in named else name] = unit
    frame = frame.set_axis(list(named), axis=1)
    if "time" not in frame and isinstance(frame.index, pd.RangeIndex):
        raise FormatError(FRAME_NAME, "expected a column or an index of times", column="time")
    time = frame.pop("time") if "time" in frame else frame.index.to_series()
    columns = {}
    for name in map(str, frame):
        if not pd.api.types.is_numeric_dtype(frame[name]):
            raise FormatError(FRAME_NAME, f"expected numbers, not {frame[name].dtype}", column=name)
        columns[name] = frame[name].to_numpy(float)
    if not pd.api.types.is_numeric_dtype(time):
        attrs.setdefault("time_reference", "utc")
    return standard_log(deployment(FRAME_NAME, _seconds(time), columns, {**named, **(units or {})}, attrs))


def to_frame(log: xr.Dataset) -> pd.DataFrame:
    """Return a deployment as a data frame, indexed by UTC timestamps; units are in ``frame.attrs``.

    Times that count from a boot remain s.
    """
    log = in_standard_units(log)
    frame = log.to_dataframe()
    if not counts_from_boot(log):
        frame.index = pd.to_datetime(log["time"].to_numpy(), unit="s", utc=True).rename("time")
    frame.attrs = {str(name): log[name].attrs.get("units", "") for name in log}
    return frame


def _seconds(time: pd.Series) -> Any:
    """Return timestamps (n,) as s since 1970 UTC, and numbers unchanged."""
    if pd.api.types.is_numeric_dtype(time):
        return time.to_numpy(float)
    moments = pd.to_datetime(time, utc=True)
    return ((moments - pd.Timestamp(0, tz="UTC")) / pd.Timedelta(seconds=1)).to_numpy(float)
