"""Read and write deployments in files of any format, whole or in pieces.

:mod:`magbridge.logs.checks` drops bad rows and values; this module skips unreadable files among several.
Attributes of the deployment count and name both losses.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from inspect import signature
from itertools import chain, pairwise
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import xarray as xr

from magbridge.columns import counts_from_boot, decoded, require, usual
from magbridge.datasets import in_standard_units, increasing, with_depth
from magbridge.errors import AbsentColumns, DataError, FormatError, WriteError, WrongUse
from magbridge.files import atomic_path, existing
from magbridge.guard import Guarded, GuardedJob, guarded
from magbridge.logs.checks import Piece, checked
from magbridge.logs.compasses import by_columns
from magbridge.logs.deployment import (
    FROM_BOOT,
    join,
    passed_over,
    refuse_repeated,
    renamed,
    same_columns,
    shifted,
    uncounted,
    with_losses,
    with_notes,
)  # fmt: skip
from magbridge.logs.mapping import Options
from magbridge.logs.merge import combine, merge, refuse_offset
from magbridge.logs.registry import (
    DECOMPRESSION_ERRORS,
    LEADS,
    Format,
    format_of,
    is_bag,
    metadata_path,
    seaexplorer_dive,
)

Paths = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]
ALL_ROWS = 1 << 40
"""Number of rows that is larger than any file has."""
MAX_SHARED_BYTES = 4_000_000
"""Size of files below which one child process reads several of them, bytes."""
WRITTEN_FROM = re.compile(r"[^(,]* \(((?:[^()]|\([^()]*\))*)\)")
"""Source of a file with the source that it was written from in brackets: ``b.nc (a.csv)``."""
DEFAULTS = Options()


def read(
    paths: Paths, *, required: Iterable[str] = (), options: Options = DEFAULTS, decode_times: bool = False
) -> xr.Dataset:
    """Return one deployment from one file or several, sorted in time.

    Parameters
    ----------
    paths : path or sequence of paths
        Files of any readable format, also of different ones.
    required : iterable of str
        Columns that the result must have, as :data:`magbridge.columns.CHANNELS`.
    options : Options
        Declarations of the user about the logs.
    decode_times : bool
        True for times as datetime64 (UTC), False for s since 1970.

    Returns
    -------
    xarray.Dataset
        On ``time``; each variable float64 with ``units`` and ``long_name``. Attributes: ``source`` (the
        file's name, and the source that it states), ``heading_reference`` where it is not true north,
        ``time_reference`` where time does not count from 1970, counts of losses (``rows_dropped`` ...), and
        ``losses``, a line for each loss.

    Raises
    ------
    FormatError
        No file can be read; the message names file, row, column and expectation. An unreadable file among
        several is skipped and counted, unless `options` are strict.
    MissingExtra
        The format needs a package that is not installed.
    """
    dataset = join(read_each(paths, options=options))
    if options.strict:
        refuse_repeated(dataset)
    require(dataset, required)
    return decoded(dataset) if decode_times else dataset


def read_each(paths: Paths, *, options: Options = DEFAULTS) -> list[xr.Dataset]:
    """Return one deployment for each file, and one for a Slocum's flight and science file together.

    A log of a sensor's own logger gets the telemetry of the vehicle's logs, which are then not returned.
    """
    files = _Files(_paths(paths, options), options)
    whole, named = [], []
    for k in range(len(files.paths)):
        parts = list(files.pieces(k, ALL_ROWS))
        whole += parts
        named += [files.is_sensor_log(k)] * len(parts)
    combined = combine(whole, named, options.clock_offset_s)
    return [files.counted(part) for part in combined]


def read_apart(
    paths: Sequence[Path], options: Options = DEFAULTS
) -> tuple[dict[Path, xr.Dataset], dict[Path, DataError]]:
    """Return the deployment of each readable file, none with telemetry of another, and the others' errors."""
    logs: dict[Path, xr.Dataset] = {}
    errors: dict[Path, DataError] = {}
    there: list[Path] = []
    for path in dict.fromkeys(paths):
        try:
            there += _paths(path, DEFAULTS)
        except DataError as error:
            errors[path] = error
    files = _Files(without_companions(there), options)
    for k, path in enumerate(files.paths):
        try:
            if pieces := [*files.pieces(k, ALL_ROWS)]:
                log = _without_depth(join(pieces))
                if options.strict:
                    refuse_repeated(log)
                logs[path] = log
        except DataError as error:
            errors[path] = error
    errors |= files.bad
    return logs, {path: errors[path] for path in paths if path in errors}


def read_chunks(
    paths: Paths, rows: int = 65536, *, required: Iterable[str] = (), options: Options = DEFAULTS
) -> Iterator[xr.Dataset]:
    """Yield the result of :func:`read` in pieces of about `rows` rows with the same columns.

    A single CSV, netCDF or Parquet file is streamed in bounded memory. A file of another format is in memory
    as a whole. Each of several files is in memory from its first time to its last.
    """
    files = _Files(_paths(paths, options), options)
    sources = [partial(files.pieces, k) for k in range(len(files.paths))]
    required = tuple(required)
    if len(sources) == 1:
        refuse_offset(options.clock_offset_s)
        stream = sources[0](rows)
    else:
        named = [files.is_sensor_log(k) for k in range(len(sources))]
        stream = merge(sources, rows, named, options.clock_offset_s)
    for dataset, _ in pairwise(chain(stream, [None])):  # one ahead: the last piece reports all skipped files
        if dataset is not None:
            if options.strict:
                refuse_repeated(dataset)
            require(dataset, required)
            yield files.counted(dataset)


class _Files:
    """Files to read, of which some may be unreadable."""

    def __init__(self, paths: Sequence[Path], options: Options) -> None:
        self.paths, self._options = paths, options
        self.bad: dict[Path, FormatError] = {}
        """Errors of the unreadable files."""
        self._lacking: dict[Path, set[str]] = {}
        self._reported = 0
        self._together: dict[int, Iterator[Piece]] | None = None

    def pieces(self, k: int, rows: int) -> Iterator[xr.Dataset]:
        """Yield the readable pieces of file `k`; FormatError: no file is readable, or options are strict.

        A declared column that this file lacks may be in another; AbsentColumns: it is in none.
        """
        path, options = self.paths[k], self._options
        if self._together is None:
            self._together = _read_together(self.paths, rows, self._options)
        try:
            try:
                yield from _chunks(path, rows, options, self._together.pop(k, None))
            except AbsentColumns as error:
                self._lacking[path] = set(error.names)
                is_last = len(self._lacking) == len(self.paths)
                nowhere = set.intersection(*self._lacking.values()) if is_last else set()
                elsewhere = tuple(self._lacking[path] - nowhere)
                yield from _chunks(path, rows, replace(options, elsewhere=elsewhere))
        except FormatError as error:
            self.bad[path] = error
            if options.strict or len(self.bad) == len(self.paths) or isinstance(error, AbsentColumns):
                raise

    def is_sensor_log(self, k: int) -> bool:
        """Return True if the user declares file `k` as the log of a sensor's own logger."""
        return self.paths[k] in self._options.sensor_log

    def counted(self, dataset: xr.Dataset) -> xr.Dataset:
        """Return the deployment with attributes that count and name the files skipped since the last call."""
        lines = [str(error) for error in self.bad.values()][self._reported :]
        self._reported += len(lines)
        dataset = _without_depth(dataset)
        return with_losses(dataset, {"files_skipped": len(lines)}, lines) if lines else dataset


def _paths(paths: Paths, options: Options) -> list[Path]:
    several: Any = [paths] if isinstance(paths, (str, os.PathLike)) else paths
    if not isinstance(several, Iterable) or not all(isinstance(one, (str, os.PathLike)) for one in several):
        raise WrongUse(f"paths: expected a path or a sequence of paths, got {paths!r}")
    if not several:
        raise WrongUse("paths: expected at least one file, got none")
    checked = list(dict.fromkeys([*map(Path, several), *options.sensor_log]))
    for path in checked:
        format_of(path if is_bag(path) else existing(path))
    return without_companions(checked)


def without_companions(paths: Sequence[Path]) -> list[Path]:
    """Return the files without those that are read together with another, as a Slocum's science file."""
    given = set(paths)
    payloads = {(path.parent, *dive) for path in paths if (dive := seaexplorer_dive(path.name, "pld"))}

    def is_companion(path: Path) -> bool:
        if dive := seaexplorer_dive(path.name, "gli"):
            return (path.parent, *dive) in payloads
        leads = LEADS.get(path.suffix.lower())
        return leads is not None and any(path.with_suffix(name) in given for name in (leads, leads.upper()))

    return [path for path in paths if not is_companion(path)]


def _read_together(paths: Sequence[Path], rows: int, options: Options) -> dict[int, Iterator[Piece]]:
    """Read the small files that need a child process in one child; return their pieces by index."""
    small = [
        k for k, path in enumerate(paths) if path.is_file() and 0 < path.stat().st_size < MAX_SHARED_BYTES
    ]
    formats = {k: form for k in small if (form := format_of(paths[k])).guarded}
    if len(formats) < 2:
        return {}
    for form in {form.module: form for form in formats.values()}.values():
        form.load()  # import each module once here, and not in every child
    jobs = [GuardedJob(paths[k], partial(_raw, paths[k], form, rows, options)) for k, form in formats.items()]
    child = Guarded(jobs)
    return {k: child.pieces(number) for number, k in enumerate(formats)}


def _raw(path: Path, form: Format, rows: int, options: Options) -> Iterator[Piece]:
    """Yield the pieces that the format's module reads, each with its row numbers, by default from 1 on.

    PluginError: another package's module fails.
    """
    chunks = form.load().chunks
    more = (options,) if "options" in signature(chunks).parameters else ()
    count = 0
    with form.blamed():
        for found in chunks(path, rows, *more):
            piece, numbers = found if isinstance(found, tuple) else (found, None)
            if form.plugin and not hasattr(piece, "sizes"):
                raise TypeError(f"chunks: expected deployments (xarray.Dataset), not {type(found).__name__}")
            first, count = count + 1, count + piece.sizes["time"]
            yield piece, range(first, count + 1) if numbers is None else numbers


def _chunks(
    path: Path, rows: int, options: Options, contents: Iterator[Piece] | None = None
) -> Iterator[xr.Dataset]:
    """Yield a file's pieces, checked and dated; `contents` are its pieces if a shared child reads them."""
    if not path.stat().st_size:
        raise FormatError(path, "expected a log, the file is empty")
    form = format_of(path)
    form.load()
    pieces = partial(_raw, path, form, rows, options)
    part = None
    try:
        numbered = contents or (guarded(path, pieces) if form.guarded else pieces())
        if options.compass is not None and not form.compasses:
            numbered = ((by_columns(piece, options.compass), rows) for piece, rows in numbered)
        if options.declared.columns and not form.maps_columns:
            numbered = ((renamed(piece, options.declared), rows) for piece, rows in numbered)
        numbered = ((with_depth(piece), rows) for piece, rows in numbered)
        for part in checked(path, numbered, strict=options.strict):
            if options.strict and (lost := passed_over(part.attrs)):
                raise FormatError(path, f"expected a log without {' '.join(lost)}, as --strict was given")
            source = str(part.attrs["source"])
            if source != path.name:
                origin = WRITTEN_FROM.fullmatch(source)
                source = f"{path.name} ({origin[1] if origin else source})"
            yield _dated(part.assign_attrs(source=source), options.date)
    except OSError as error:
        raise FormatError(path, f"cannot be read: {error.strerror or error}") from error
    except DECOMPRESSION_ERRORS as error:
        raise FormatError(path, f"expected a whole compressed file: {error}") from None
    if part is None:
        raise FormatError(path, "expected rows, there are none")


METRES_OF_WATER = {"dbar": 0.99, "bar": 9.9}
"""Depth in sea water, m, for each unit of pressure, within 0.5 % down to 2,000 m (UNESCO 1983)."""


def _without_depth(dataset: xr.Dataset) -> xr.Dataset:
    """Return the deployment with a note if it has positions and a pressure, but no depth."""
    if "depth" in dataset or "latitude" not in dataset:
        return dataset
    for name, column in dataset.data_vars.items():
        if (unit := usual(str(column.attrs.get("units", "")))) in METRES_OF_WATER:
            remedy = f'[columns.depth] of columns.toml, from = "{name}", unit = "m", '
            note = (
                f"{dataset.attrs['source']}: no depth: taken as 0 m; if {name} is the water's: "
                f"{remedy}scale = {METRES_OF_WATER[unit]:g}"
            )
            return with_notes(dataset, [note])
    return dataset


def _dated(part: xr.Dataset, date: float | None) -> xr.Dataset:
    """Return the deployment with `date` (s since 1970 UTC) added to times that count from a boot.

    Times with a date do not change; a note reports this.
    """
    if date is None:
        return part
    if not counts_from_boot(part):
        unused = f"{part.attrs['source']}: --date was not used, because the log's times have a date"
        return with_notes(part, [unused])
    return shifted(part, date).assign_attrs({"time_reference": "utc", FROM_BOOT: 1})


def write(dataset: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Write a deployment in the format of the suffix of `path`; times are s since 1970, or datetime64.

    FormatError: no format with this suffix can be written. WriteError: the file cannot be written and remains
    unchanged.
    """
    with Writer(path) as writer:
        writer.append(dataset)


class Writer:
    """Writer of successive deployments to one file, which appears when it is complete.

    The columns are those of the first deployment; a column that a later one lacks is NaN there. If the block
    raises, no file remains. `finish` is called with the path of the file after the last row. `options` are
    the format's own, as ``og1=True`` of netCDF. Times may be datetime64.

    >>> with Writer("out.nc") as writer:  # doctest: +SKIP
    ...     for dataset in read_chunks("in.tlog"):
    ...         writer.append(dataset)
    """

    def __init__(
        self, path: str | os.PathLike[str], finish: Callable[[Path], None] | None = None, **options: Any
    ) -> None:
        self._path, self._finish = Path(path), finish
        form = format_of(self._path, write=True)
        self._open = partial(getattr(form.load(), form.writer), **options)
        self._columns: dict[str, dict[str, Any]] = {}

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            path = stack.enter_context(atomic_path(self._path))
            stack.push(lambda kind, *_: self._finish(path) if self._finish and kind is None else None)
            self._file = self._open(path)
            stack.callback(self._file.close)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)
        if kind is None and (metadata := getattr(self._file, "metadata", b"")):
            with atomic_path(metadata_path(self._path)) as temporary:
                temporary.write_bytes(metadata)

    def append(self, dataset: xr.Dataset) -> None:
        """Write the rows of `dataset`, whose times follow those of all earlier rows.

        FormatError: time does not increase, or a column was not in the first deployment.
        """
        dataset = in_standard_units(dataset)
        first = not self._columns
        if first:
            if counts_from_boot(dataset):
                dataset = dataset.assign_attrs(time_reference="boot")
            self._columns = {str(name): dict(dataset[name].attrs) for name in dataset.data_vars}
            self._last = float("-inf")
        for name in dataset.data_vars:
            if name not in self._columns:
                expected = "expected only columns that the first rows had"
                raise FormatError(self._path, expected, column=str(name))
        time = dataset["time"].values
        increasing(self._path, time, previous=self._last)
        if len(time):
            self._last = float(time[-1])
        try:
            self._file.append(
                uncounted(dataset) if first else same_columns(dataset, self._columns), first=first
            )
        except FormatError as error:  # it names the temporary file
            raise FormatError(self._path, error.expected, column=error.column) from None
        except WriteError as error:
            raise WriteError(self._path, error.reason) from None
