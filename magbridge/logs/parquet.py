"""Read and write Parquet: a float64 column per variable, with unit and meaning in the field's metadata.

:mod:`.naming` identifies the columns of other programs, as in a text file.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from magbridge.columns import absent
from magbridge.datasets import with_guesses
from magbridge.errors import FormatError, MissingExtra
from magbridge.logs.clocks import TimeFormat, since_1970
from magbridge.logs.deployment import deployment, plain_attrs, with_losses
from magbridge.logs.layout import LAYOUT_LINES, Layout
from magbridge.logs.naming import name_columns
from magbridge.logs.table import TableReader

try:
    import pyarrow as pa
    import pyarrow.parquet as pq
except ImportError:
    raise MissingExtra("pyarrow", "formats") from None

MAX_EXPANDED, MAX_EXPANSION = 100_000_000, 200
"""Largest size of the values, bytes, and per byte of the file; if both are exceeded, it is damaged."""


def chunks(path: Path, rows: int) -> Iterator[tuple[xr.Dataset, Sequence[int]]]:
    """Yield the file in pieces, each with its row numbers; times may be numbers or timestamps."""
    try:
        with pq.ParquetFile(path) as file:
            yield from _chunks(path, file, rows)
    except (pa.ArrowException, OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise FormatError(path, f"expected a whole Parquet file: {str(error).splitlines()[0]}") from None


def _chunks(path: Path, file: Any, rows: int) -> Iterator[tuple[xr.Dataset, Sequence[int]]]:
    """Yield the rows of an open file in pieces, each with its row numbers."""
    schema = file.schema_arrow
    meanings = {field.name: _text(field.metadata, b"long_name") for field in schema}
    attrs = json.loads(_text(schema.metadata, b"magbridge") or "{}")
    if not file.metadata.num_rows:
        raise FormatError(path, "expected rows, there are none")
    size = file.metadata.num_rows * file.metadata.num_columns * 8
    if size > max(MAX_EXPANDED, MAX_EXPANSION * path.stat().st_size):
        claimed = f"{file.metadata.num_rows} rows of {file.metadata.num_columns} columns"
        claimed += f" in {path.stat().st_size} bytes"
        raise FormatError(path, f"{claimed}: expected a file that is not damaged")
    foreign = b"magbridge" not in (schema.metadata or {})
    layout, table = _layout(path, file, foreign=foreign)
    if pa.types.is_timestamp(schema.field(layout.stamp[-1]).type):
        attrs = {"time_reference": "utc"} | attrs
    attrs = {**attrs, **layout.attrs, **table.attrs}
    if foreign:
        attrs = with_guesses(path.name, attrs, [*layout.guesses, *table.guesses])
    row = 1
    for batch in file.iter_batches(batch_size=min(rows, 1 << 20)):
        numbers = range(row, row + batch.num_rows)
        kept = {*layout.stamp, *layout.hemispheres.values()}
        frame = pd.DataFrame(
            {
                k: _cells(path, schema.field(k), batch.column(k), as_text=k in kept)
                for k, name in enumerate(layout.names)
                if name or k in kept
            }
        )
        time, columns, there = table.read(frame, [*numbers])
        piece = deployment(path, time, columns, layout.column_units, attrs, meanings)
        yield with_losses(piece, *table.faults.since_last()), there
        row = numbers.stop


def _layout(path: Path, file: Any, *, foreign: bool) -> tuple[Layout, TableReader]:
    """Return the layout of the columns by their names and first rows, and their reader."""
    schema = file.schema_arrow
    first = next(file.iter_batches(batch_size=LAYOUT_LINES), None)
    if first is None:
        raise FormatError(path, "expected rows, there are none")
    cells = [["" if one is None else str(one) for one in column.to_pylist()] for column in first.columns]
    rows = list(zip(*cells, strict=True))
    units = [_text(field.metadata, b"units") for field in schema]
    layout = name_columns(path, Layout(foreign=foreign, headings=tuple(schema.names)), units, rows)
    if not layout.stamp:
        raise FormatError(path, absent("time", schema.names), column="time")
    is_timestamp = pa.types.is_timestamp(schema.field(layout.stamp[-1]).type)
    return layout, TableReader(path, layout, rows, clock=TimeFormat("s") if is_timestamp else None)


def _text(metadata: dict[bytes, bytes] | None, key: bytes) -> str:
    return (metadata or {}).get(key, b"").decode()


def _cells(path: Path, field: Any, array: Any, *, as_text: bool) -> Any:
    """Return the cells (n,) of a column, timestamps as s since 1970; FormatError: texts, unless `as_text`."""
    if pa.types.is_timestamp(field.type):
        return since_1970(array.to_numpy(zero_copy_only=False))
    kinds = pa.types.is_integer, pa.types.is_floating, pa.types.is_boolean
    if any(is_kind(field.type) for is_kind in kinds):
        # unsafe: a count of ns since 1970 has more digits than float64, which keeps 0.3 us of it
        return array.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False)
    if as_text:
        return array.to_pandas()
    raise FormatError(path, f"expected numbers, not {field.type}", column=field.name)


class FileWriter:
    """Writer of successive deployments with the columns of the first."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._writer: Any = None

    def append(self, dataset: xr.Dataset, *, first: bool) -> None:
        """Write the rows as one row group; if `first`, write the schema before."""
        columns = [dataset["time"], *(dataset[name] for name in dataset.data_vars)]
        if first:
            fields = []
            for column in columns:
                described = {key: str(value) for key, value in column.attrs.items()}
                fields.append(pa.field(str(column.name), pa.float64(), metadata=described))
            schema = pa.schema(fields, metadata={"magbridge": json.dumps(plain_attrs(dataset.attrs))})
            self._writer = pq.ParquetWriter(self._path, schema)
        arrays = [pa.array(np.asarray(column.values, dtype=np.float64)) for column in columns]
        self._writer.write_table(pa.Table.from_arrays(arrays, schema=self._writer.schema))

    def close(self) -> None:
        """Write everything to the file and close it."""
        if self._writer is not None:
            self._writer.close()
