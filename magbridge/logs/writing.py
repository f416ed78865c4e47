"""Write deployments in any format that can be written."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from magbridge.columns import in_seconds
from magbridge.errors import FormatError
from magbridge.files import atomic_path
from magbridge.logs.registry import format_of, metadata_path

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Writer", "write"]


def write(dataset: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Write a deployment in the format of the suffix of `path`, which is complete or as it was before.

    Times are s since 1970, or datetime64.

    FormatError: the suffix is not that of a format that can be written. WriteError: the file cannot be
    written.
    """
    with Writer(path) as writer:
        writer.append(dataset)


class Writer:
    """A file to which successive deployments are appended; it appears when it is complete.

    The columns are those of the first deployment; a later one that lacks a column has NaN there. When the
    block raises, nothing is left behind. `finish` may add to the file once all rows are in it; `options` are
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
        """Write the rows of `dataset`, which begin after the last ones.

        FormatError: time does not increase, or a column was not in the first deployment.
        """
        from magbridge.logs.checks import increasing  # noqa: PLC0415 - xarray is for ashore
        from magbridge.logs.deployment import same_columns, uncounted  # noqa: PLC0415

        dataset = in_seconds(dataset)
        first = not self._columns
        if first:
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
        self._file.append(uncounted(dataset) if first else same_columns(dataset, self._columns), first=first)
