"""Deployments in and out: one module per format, and one table of them.

A deployment is an ``xarray.Dataset`` on ``time`` (:mod:`magbridge.columns`). A row is one time of the
magnetometer sample; every other column holds what was known at that time:

- logs of a live link (``.tlog``, ``.BIN``, ``.ulg``): the last value received at or before the row, NaN
  before the first and when it is older than 30 s. This is what the bridge itself would have known, so a
  calibration is fitted to the same kind of data as it will correct live;
- logs that were assembled ashore (Slocum, Seaglider): interpolated linearly, headings on the circle, NaN
  across gaps.

The formats are :mod:`.text` (CSV), :mod:`.netcdf` (with :mod:`.seaglider` and :mod:`.cf`), :mod:`.parquet`,
:mod:`.telemetry` (with its ``telemetry_*``), :mod:`.ardupilot`, :mod:`.px4` and :mod:`.slocum`. They
share :mod:`.resample` (telemetry brought to the rows; :mod:`.autopilot` does so for both autopilots),
:mod:`.deployment` (what they return) and :mod:`.checks`; :mod:`.merge` makes one stream of several.
:mod:`.tlog` stands apart: it writes the bridge's log.

Each format has ``chunks(path, rows)``, which yields deployments of at most `rows` rows in the order of the
file, and, where the format can be written, ``FileWriter(path)`` with ``append(dataset, first=...)`` and
``close()``. A package adds a format with an entry point in the group ``magbridge.formats``: the suffix
without its dot, and such a module.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from functools import cache, partial
from importlib import import_module
from importlib.metadata import entry_points
from itertools import accumulate
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from magbridge.columns import require
from magbridge.errors import FormatError
from magbridge.files import atomic_path
from magbridge.guard import guarded

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["FLIGHT", "FORMATS", "Writer", "read", "read_chunks", "read_each", "suffixes", "write"]

FLIGHT = {".ebd": ".dbd", ".nbd": ".mbd", ".tbd": ".sbd", ".ecd": ".dcd", ".ncd": ".mcd", ".tcd": ".scd"}
"""Suffix of a Slocum's science file to that of its flight file: where both are there, both are read."""

READ_ONLY = {
    ".bin": "magbridge.logs.ardupilot",
    ".ulg": "magbridge.logs.px4",
    **dict.fromkeys((*FLIGHT, *FLIGHT.values()), "magbridge.logs.slocum"),
}
FORMATS = {
    ".csv": "magbridge.logs.text",
    ".nc": "magbridge.logs.netcdf",
    ".parquet": "magbridge.logs.parquet",
    ".tlog": "magbridge.logs.telemetry",
    **READ_ONLY,
}
"""Suffix to module."""
GUARDED = {".nc", ".parquet", ".ulg", *FLIGHT, *FLIGHT.values()}
"""Formats that other libraries read, which damage may hang or crash: they are read in a child process."""

Paths = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]


@cache
def _formats() -> dict[str, str]:
    """Return :data:`FORMATS`, and the formats that packages add."""
    plugins = {f".{point.name.lower()}": point.value for point in entry_points(group="magbridge.formats")}
    return {**plugins, **FORMATS}


def suffixes(*, write: bool = False) -> list[str]:
    """Return the endings of the file names that can be read, or written."""
    return sorted(suffix for suffix in _formats() if not (write and suffix in READ_ONLY))


def _module(path: Path, *, write: bool = False) -> Any:
    """Return the module for the suffix of `path`."""
    suffix, known = path.suffix.lower(), suffixes(write=write)
    if suffix not in known:
        raise FormatError(path, f"expected a file name that ends in one of {' '.join(known)}")
    return import_module(_formats()[suffix])


def _paths(paths: Paths) -> list[Path]:
    several = [paths] if isinstance(paths, (str, os.PathLike)) else paths
    if not several:
        raise ValueError("expected at least one file")
    checked = [Path(path) for path in several]
    for path in checked:
        if path.is_dir():
            raise FormatError(path, "expected a file, not a directory")
        if not path.is_file():
            what = "not a pipe or a device" if path.exists() else "there is none"
            raise FormatError(path, f"expected a file, {what}")
        _module(path)
    return [path for path in checked if not _with_flight(path, checked)]


def _with_flight(path: Path, given: Sequence[Path]) -> bool:
    """Tell whether a science file's flight file is given, too."""
    flight = FLIGHT.get(path.suffix.lower())
    return flight is not None and any(path.with_suffix(name) in given for name in (flight, flight.upper()))


def _chunks(path: Path, rows: int) -> Iterator[xr.Dataset]:
    if not path.stat().st_size:
        raise FormatError(path, "expected a log, the file is empty")
    parts = partial(_module(path).chunks, path, rows)
    none = True
    try:
        for part in guarded(path, parts) if path.suffix.lower() in GUARDED else parts():
            none = False
            source = str(part.attrs["source"])
            if source != path.name:
                source = f"{path.name} ({_origin(source)})"
            yield part.assign_attrs(source=source)
        if none:
            raise FormatError(path, "expected rows, there are none")
    except OSError as error:
        raise FormatError(path, f"cannot be read: {error.strerror or error}") from error


def _origin(source: str) -> str:
    """Return what the file named in `source` was made from (of ``b.nc (a.csv)``: ``a.csv``), or `source`."""
    name, opened, inside = source.partition(" (")
    depths = accumulate((char == "(") - (char == ")") for char in inside)
    closed = next((k for k, depth in enumerate(depths) if depth < 0), None)
    one = opened and "," not in name and closed == len(inside) - 1  # not several files
    return inside[:-1] if one else source


def read(paths: Paths, *, required: Iterable[str] = ()) -> xr.Dataset:
    """Return one deployment from one file or several, sorted in time.

    Parameters
    ----------
    paths : path or sequence of paths
        Files of any readable format, also of different ones.
    required : iterable of str
        Columns that the result must have, as :data:`magbridge.columns.CHANNELS`.

    Returns
    -------
    xarray.Dataset
        On ``time``; each variable float64 with ``units`` and ``long_name``. Attributes: ``source`` (the
        file's name, and what it says of its own source), ``heading_reference`` where it is not true north,
        and counts of what was skipped (``duplicate_rows`` ...).

    Raises
    ------
    FormatError
        A file whose content is wrong: names file, row, column and what was expected.
    MissingExtra
        The format needs a package that is not installed.
    """
    from magbridge.logs.deployment import join  # noqa: PLC0415 - xarray is for ashore

    dataset = join(read_each(paths))
    require(dataset, required)
    return dataset


def read_each(paths: Paths) -> list[xr.Dataset]:
    """Return the deployment that each file holds, a Slocum's flight and science file as one.

    Raises
    ------
    FormatError, MissingExtra
        As :func:`read`.
    """
    return [part for path in _paths(paths) for part in _chunks(path, 1 << 40)]


def read_chunks(paths: Paths, rows: int = 65536, *, required: Iterable[str] = ()) -> Iterator[xr.Dataset]:
    """Yield what :func:`read` returns in pieces of about `rows` rows, in bounded memory.

    Every piece has the same columns. CSV, netCDF, Parquet and ``.tlog`` are streamed; files of the other
    formats are held in memory one at a time. Of files that overlap in time, one piece each is held.

    Raises
    ------
    FormatError, MissingExtra
        As :func:`read`.
    """
    from magbridge.logs.merge import merge  # noqa: PLC0415 - xarray is for ashore

    sources = [partial(_chunks, path) for path in _paths(paths)]
    required = tuple(required)
    for dataset in sources[0](rows) if len(sources) == 1 else merge(sources, rows):
        require(dataset, required)
        yield dataset


def write(dataset: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Write a deployment; `path` is complete or as it was before.

    Parameters
    ----------
    dataset : Dataset (time)
        With columns as :func:`read` returns them.
    path : path
        Its suffix chooses the format.

    Raises
    ------
    FormatError
        The suffix is not that of a format that can be written.
    WriteError
        The file cannot be written.
    """
    with Writer(path) as writer:
        writer.append(dataset)


class Writer:
    """A file that grows by deployments, one after the other in time, and appears when it is complete.

    The columns are those of the first deployment; a later one that lacks a column has NaN there. When the
    block raises, nothing is left behind.

    >>> with Writer("out.nc") as writer:  # doctest: +SKIP
    ...     for dataset in read_chunks("in.tlog"):
    ...         writer.append(dataset)
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._path = Path(path)
        self._open = _module(self._path, write=True).FileWriter
        self._columns: dict[str, dict[str, Any]] = {}

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self._file = self._open(stack.enter_context(atomic_path(self._path)))
            stack.callback(self._file.close)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def append(self, dataset: xr.Dataset) -> None:
        """Write the rows of `dataset`, which begin after the last ones.

        Raises
        ------
        FormatError
            Time does not increase, or a column was not in the first deployment.
        """
        from magbridge.logs.checks import increasing  # noqa: PLC0415 - xarray is for ashore
        from magbridge.logs.deployment import same_columns, uncounted  # noqa: PLC0415

        first = not self._columns
        if first:
            self._columns = {str(name): dict(dataset[name].attrs) for name in dataset.data_vars}
            self._last = float("-inf")
        for name in dataset.data_vars:
            if name not in self._columns:
                raise FormatError(
                    self._path, "expected only columns that the first rows had", column=str(name)
                )
        time = dataset["time"].values
        increasing(self._path, time, after=self._last)
        if len(time):
            self._last = float(time[-1])
        self._file.append(uncounted(dataset) if first else same_columns(dataset, self._columns), first=first)
