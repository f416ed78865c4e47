"""A catalogue in a folder of Parquet files.

::

    catalogue/
      catalogue.json            {"format": 1}
      vehicles/*.parquet        one file for each batch of rows
      files/  logs/  sensors/  calibrations/  corrected/  findings/  maps/  failures/  done/
      results/VEHICLE/DEPLOYMENT/     corrected logs and maps

A file's name is the hash of its rows' keys. So the same rows are the same file, different writers never write
to one file, and a reader takes each row once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from hashlib import sha256
from io import BytesIO
from pathlib import Path

import msgspec
import polars as pl

from magbridge.errors import FormatError
from magbridge.files import atomic_path
from magbridge.fleet.catalogue import CATALOGUE_FORMAT, CATALOGUE_TABLES, TEXT, Catalogue, Row

__all__ = ["FolderCatalogue"]

MARK = "catalogue.json"
MANY, SMALL = 64, 1000
"""Files of a table, of fewer rows than that, from which on they are made one."""


class FolderCatalogue(Catalogue):
    """A folder of Parquet files; safe with several writers on a shared disk, without a server."""

    def __init__(self, folder: Path, results: Path | None = None, *, create: bool = False) -> None:
        self.folder, self.name, self.results = folder, str(folder), results or folder / "results"
        self._keys_of: dict[Path, frozenset[str]] = {}  # a file's content never changes
        mark = folder / MARK
        if create and not mark.exists():
            with atomic_path(mark) as temporary:
                folder.mkdir(parents=True, exist_ok=True)
                temporary.write_bytes(msgspec.json.encode({"format": CATALOGUE_FORMAT}))
        if not mark.is_file():
            raise FormatError(folder, "expected a fleet's catalogue (magbridge fleet add makes one)")
        try:
            self._check_format(msgspec.json.decode(mark.read_bytes(), type=dict[str, int])["format"])
        except (msgspec.DecodeError, KeyError) as error:
            raise FormatError(mark, f'expected {{"format": {CATALOGUE_FORMAT}}}') from error

    def _rows(self, table: str, columns: Sequence[str]) -> list[Row]:
        return self._read(table, columns).drop("key").to_dicts()

    def compact(self) -> None:
        """Make one file of each table's many small ones.

        The removed rows are in the file just written, so rows are never lost, even if others do so.
        """
        for table in CATALOGUE_TABLES:
            with suppress(FileNotFoundError):  # another writer does the same
                files = [path for path in self._files(table) if len(self._keys(path)) < SMALL]
                if len(files) < MANY:
                    continue
                written = self._write(table, self._joined(table, files, tuple(CATALOGUE_TABLES[table])))
                for path in files:
                    if path != written:
                        path.unlink(missing_ok=True)

    def _insert(self, table: str, keyed: Mapping[str, Row]) -> int:
        known = set[str]()
        for path in self._files(table):
            with suppress(FileNotFoundError):  # its rows are in another one now, or are written again
                known |= keyed.keys() & self._keys(path)
        fresh = [{"key": key, **row} for key, row in keyed.items() if key not in known]
        if fresh:
            self._write(table, pl.DataFrame(fresh, schema={"key": TEXT, **CATALOGUE_TABLES[table]}))
        return len(fresh)

    def _keys(self, path: Path) -> frozenset[str]:
        if path not in self._keys_of:
            self._keys_of[path] = frozenset(self._joined(path.parent.name, [path], ())["key"])
        return self._keys_of[path]

    def _read(self, table: str, columns: Sequence[str]) -> pl.DataFrame:
        while True:
            with suppress(FileNotFoundError):  # another writer has just made several files one
                return self._joined(table, self._files(table), columns)

    def _joined(self, table: str, files: Sequence[Path], columns: Sequence[str]) -> pl.DataFrame:
        """Return the rows of files, each once, in the order of their keys."""
        schema = {"key": TEXT, **{name: CATALOGUE_TABLES[table][name] for name in columns}}
        parts = [pl.DataFrame(schema=schema)]
        for path in files:
            try:
                part = pl.read_parquet(path, columns=list(schema))
            except pl.exceptions.PolarsError as error:
                raise FormatError(path, f"expected a catalogue's Parquet: {error}") from error
            for name, kind in schema.items():
                if part.schema[name] != kind:
                    expected = f"expected a column of {kind}, got {part.schema[name]}"
                    raise FormatError(path, expected, column=name)
            parts.append(part)
        return pl.concat(parts).unique(subset="key").sort("key")

    def _files(self, table: str) -> list[Path]:
        return sorted((self.folder / table).glob("[!.]*.parquet"))

    def _write(self, table: str, frame: pl.DataFrame) -> Path:
        name = sha256("".join(frame["key"]).encode()).hexdigest()[:40]
        path = self.folder / table / f"{name}.parquet"
        if not path.exists():
            whole = BytesIO()  # polars hides why it cannot write to a file
            frame.write_parquet(whole, compression="zstd")
            with atomic_path(path) as temporary:
                temporary.parent.mkdir(exist_ok=True)
                temporary.write_bytes(whole.getbuffer())
        return path
