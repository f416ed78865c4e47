"""Parquet: one float64 column per variable, its unit and meaning in the field's metadata.

Columns of other programs are found as those of a text file (:mod:`.naming`).
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.columns import absent
from magbridge.errors import FormatError, MissingExtra
from magbridge.logs.checks import known
from magbridge.logs.clocks import TimeFormat, clock_of, seconds
from magbridge.logs.deployment import GUESSED_ATTRIBUTE, HISTORY_ATTRIBUTE, deployment, plain_attrs
from magbridge.logs.layout import LAYOUT_LINES, Layout
from magbridge.logs.naming import name_columns, on_side

try:
    import pyarrow as pa
    import pyarrow.parquet as pq
except ImportError:
    raise MissingExtra("pyarrow", "formats") from None

MAX_EXPANDED, MAX_EXPANSION = 100_000_000, 200
"""Bytes of values that are always read, and per byte of a larger file: times alone take one byte a row."""


def chunks(path: Path, rows: int) -> Iterator[tuple[xr.Dataset, Sequence[int]]]:
    """Yield the file in pieces, each with the numbers of its rows; times may be numbers or timestamps."""
    try:
        with pq.ParquetFile(path) as file:
            yield from _chunks(path, file, rows)
    except (pa.ArrowException, OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise FormatError(path, f"expected a whole Parquet file: {str(error).splitlines()[0]}") from None


def _chunks(path: Path, file: Any, rows: int) -> Iterator[tuple[xr.Dataset, Sequence[int]]]:
    """Yield the rows, each piece with their numbers."""
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
    layout, clock = _layout(path, file, foreign=b"magbridge" not in (schema.metadata or {}))
    row = 1
    for batch in file.iter_batches(batch_size=min(rows, 1 << 20)):
        time = _times(batch, layout, clock)
        columns = {
            name: _floats(path, schema.field(k), batch.column(k))
            for k, name in enumerate(layout.names)
            if name and name != "time"
        }
        for name, k in layout.hemispheres.items():
            columns[name] = on_side(name, columns[name], batch.column(k).to_pandas())
        numbers = range(row, row + batch.num_rows)
        piece = deployment(path, time, columns, layout.column_units, {**attrs, **layout.attrs}, meanings)
        yield known(path, piece, numbers) if layout.foreign else (piece, numbers)
        row = numbers.stop


def _layout(path: Path, file: Any, *, foreign: bool) -> tuple[Layout, TimeFormat | None]:
    """Return the columns by names and first rows, and the format of times that are not timestamps."""
    schema = file.schema_arrow
    first = next(file.iter_batches(batch_size=LAYOUT_LINES), None)
    if first is None:
        raise FormatError(path, "expected rows, there are none")
    cells = [["" if one is None else str(one) for one in column.to_pylist()] for column in first.columns]
    units = [_text(field.metadata, b"units") for field in schema]
    layout = Layout(foreign=foreign, headings=tuple(schema.names))
    layout = name_columns(path, layout, units, list(zip(*cells, strict=True)))
    if not layout.stamp:
        raise FormatError(path, absent("time", schema.names), column="time")
    time, unit = schema.field(layout.stamp[-1]), layout.units.get("time", "")
    clock = None
    if not pa.types.is_timestamp(time.type):
        texts = [" ".join(parts) for parts in zip(*(cells[k] for k in layout.stamp), strict=True)]
        try:
            clock = clock_of(time.name, unit, texts, None)
        except ValueError as error:
            raise FormatError(path, str(error), column=time.name) from None
        layout = layout.guessing(f"time: {clock.assumed}") if clock.assumed else layout
        attrs = {**layout.attrs, **({"time_reference": "boot"} if clock.boot else {})}
        layout = replace(layout, attrs=attrs)
    if foreign and layout.guesses:
        note = "; ".join(layout.guesses)
        notes = {GUESSED_ATTRIBUTE: note, HISTORY_ATTRIBUTE: f"{path.name} was read with: {note}"}
        layout = replace(layout, attrs={**layout.attrs, **notes})
    return layout, clock


def _times(batch: Any, layout: Layout, clock: TimeFormat | None) -> FloatArray:
    """Return the times (n,) of a batch, s since 1970."""
    columns = [batch.column(k) for k in layout.stamp]
    if clock is None:
        return _floats(Path(), batch.schema.field(layout.stamp[-1]), columns[-1])
    if len(columns) == 1:
        return seconds(clock, columns[0].to_pandas(), None)
    joined, *others = (column.to_pandas().astype("string") for column in columns)
    for one in others:
        joined = joined + " " + one
    return seconds(clock, joined, None)


def _text(metadata: dict[bytes, bytes] | None, key: bytes) -> str:
    return (metadata or {}).get(key, b"").decode()


def _floats(path: Path, field: Any, array: Any) -> FloatArray:
    scale = 1.0
    if pa.types.is_timestamp(field.type):
        scale = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[field.type.unit]
        array = array.cast(pa.int64())
    elif not (
        pa.types.is_integer(field.type) or pa.types.is_floating(field.type) or pa.types.is_boolean(field.type)
    ):
        raise FormatError(path, f"expected numbers, not {field.type}", column=field.name)
    values: FloatArray = array.cast(pa.float64()).to_numpy(zero_copy_only=False)
    return values * scale


class FileWriter:
    """Write successive deployments with the columns of the first one."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._writer: Any = None

    def append(self, dataset: xr.Dataset, *, first: bool) -> None:
        """Write the rows as one row group, and before the first ones the schema."""
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
