"""Parquet: one float64 column per variable, its unit and meaning in the field's metadata."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.errors import FormatError, MissingExtra
from magbridge.logs.deployment import deployment, plain_attrs

try:
    import pyarrow as pa
    import pyarrow.parquet as pq
except ImportError:
    raise MissingExtra("pyarrow", "formats") from None

__all__ = ["FileWriter", "chunks"]


def chunks(path: Path, rows: int) -> Iterator[tuple[xr.Dataset, Sequence[int]]]:
    """Yield the file as deployments of at most `rows` rows, each with their numbers.

    ``time`` may be numbers or timestamps.

    FormatError: not Parquet or cut short, no column ``time``, a column that does not hold numbers.
    """
    try:
        with pq.ParquetFile(path) as file:
            yield from _chunks(path, file, rows)
    except (pa.ArrowException, OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise FormatError(path, f"expected a whole Parquet file: {str(error).splitlines()[0]}") from None


def _chunks(path: Path, file: Any, rows: int) -> Iterator[tuple[xr.Dataset, Sequence[int]]]:
    """Yield the rows, each piece with their numbers."""
    schema = file.schema_arrow
    units = {field.name: _text(field.metadata, b"units") for field in schema}
    meanings = {field.name: _text(field.metadata, b"long_name") for field in schema}
    attrs = json.loads(_text(schema.metadata, b"magbridge") or "{}")
    if "time" not in schema.names:
        raise FormatError(path, f"expected this column; there are: {' '.join(schema.names)}", column="time")
    if not file.metadata.num_rows:
        raise FormatError(path, "expected rows, there are none")
    row = 1
    for batch in file.iter_batches(batch_size=min(rows, 1 << 20)):
        columns = {field.name: _floats(path, field, batch.column(k)) for k, field in enumerate(schema)}
        numbers = range(row, row + batch.num_rows)
        yield deployment(path, columns.pop("time"), columns, units, attrs, meanings), numbers
        row = numbers.stop


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
    """Writes deployments one after the other; the columns are those of the first."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._writer: Any = None

    def append(self, dataset: xr.Dataset, *, first: bool) -> None:
        """Write the rows as one row group, and before the first ones the schema."""
        columns = [dataset["time"], *(dataset[name] for name in dataset.data_vars)]
        if first:
            fields = [
                pa.field(
                    str(column.name), pa.float64(), metadata={k: str(v) for k, v in column.attrs.items()}
                )
                for column in columns
            ]
            schema = pa.schema(fields, metadata={"magbridge": json.dumps(plain_attrs(dataset.attrs))})
            self._writer = pq.ParquetWriter(self._path, schema)
        arrays = [pa.array(np.asarray(column.values, dtype=np.float64)) for column in columns]
        self._writer.write_table(pa.Table.from_arrays(arrays, schema=self._writer.schema))

    def close(self) -> None:
        """Write everything to the file and close it."""
        if self._writer is not None:
            self._writer.close()
