"""Store the tables of a fleet, in a folder or on a server; rows are added and never changed.

A row's key is the SHA-256 of its content, so that repeated additions store a row once. No
row holds the time of writing: an interrupted and repeated run gives the same catalogue.
:class:`FolderCatalogue` keeps the tables in a folder, :mod:`.postgres` in a database.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from typing import Any

import msgspec
import polars as pl

from magbridge.arrays import plain
from magbridge.errors import FormatError, MissingExtra
from magbridge.files import atomic_path

Row = dict[str, Any]
CATALOGUE_FORMAT = 1
"""Version of the written catalogues; newer catalogues are rejected."""
SERVERS = ("postgresql://", "postgres://")
MARK = "catalogue.json"
"""File that marks a folder as a catalogue, and holds the version of its format."""
MAX_SMALL_FILES, SMALL_FILE_ROWS = 64, 1000
"""Number of small files at which :meth:`Catalogue.compact` merges them; a small file has fewer rows than
`SMALL_FILE_ROWS`."""
TEXT, NUMBER, COUNT, TEXTS, NUMBERS, PACKED = (
    pl.String(), pl.Float64(), pl.Int64(), pl.List(pl.String()), pl.List(pl.Float64()), pl.Binary(),
)  # fmt: skip
CATALOGUE_TABLES: dict[str, dict[str, pl.DataType]] = {
    "vehicles": {
        "vehicle": TEXT, "serial": TEXT, "sensor": TEXT, "parameters": TEXTS, "order": COUNT, "mass": TEXT,
        "version": COUNT,
    },
    "files": {
        "vehicle": TEXT, "deployment": TEXT, "refit": TEXT, "path": TEXT, "sha256": TEXT, "size": COUNT,
        "version": COUNT, "sensor": TEXT,
    },
    "sensors": {"sensor": TEXT, "vehicle": TEXT, "deployment": TEXT},
    "logs": {
        "sha256": TEXT, "start": NUMBER, "end": NUMBER, "rows": COUNT, "samples": COUNT, "gaps": COUNT,
        "losses": COUNT, "sensor": TEXT, "latitude": NUMBER, "longitude": NUMBER,
    },
    "calibrations": {
        "job": TEXT, "attempt": COUNT, "vehicle": TEXT, "deployment": TEXT, "refit": TEXT, "start": NUMBER,
        "sensor": TEXT, "method": TEXT, "rms": NUMBER, "noise": NUMBER, "expected": NUMBER,
        "supported": pl.Boolean(), "warnings": TEXTS, "calibration": TEXT, "precision": PACKED,
        "vector": PACKED,
    },
    "corrected": {
        "job": TEXT, "attempt": COUNT, "sha256": TEXT, "path": TEXT, "samples": COUNT, "flagged": COUNT,
        "sigma": NUMBER,
    },
    "findings": {
        "job": TEXT, "attempt": COUNT, "verdict": TEXT, "cause": TEXT, "channel": TEXT,
        "signal_to_noise": NUMBER,
    },
    "improvements": {
        "job": TEXT, "attempt": COUNT, "cause": TEXT, "channel": TEXT, "ratio": NUMBER, "low": NUMBER,
        "high": NUMBER,
    },
    "maps": {"job": TEXT, "attempt": COUNT, "path": TEXT, "rms": NUMBER, "sigma": NUMBER},
    "done": {"job": TEXT, "attempt": COUNT, "diagnosed": pl.Boolean(), "mapped": pl.Boolean()},
    "populations": {"of": TEXT, "own": NUMBERS, "shaped": NUMBERS},
    "failures": {"job": TEXT, "attempt": COUNT, "vehicle": TEXT, "deployment": TEXT, "line": TEXT},
}  # fmt: skip
"""Table -> columns and their types, in nT, deg and s since 1970. `calibration` is the text of a cal.json.
`precision` and `vector` are the information from the data, without a prior (:func:`.packed`). `job` names the
inputs of a result; only the results of the job's last `attempt` are valid. A table that an older catalogue
lacks is treated as empty."""
COLUMN_TYPES: dict[pl.DataType, tuple[tuple[type, ...], str]] = {
    TEXT: ((str,), "text"), NUMBER: ((float, int, type(None)), "double precision"),
    COUNT: ((int,), "bigint"), TEXTS: ((list,), "text[]"), NUMBERS: ((list,), "double precision[]"),
    PACKED: ((bytes,), "bytea"), pl.Boolean(): ((bool,), "boolean"),
}  # fmt: skip
"""Type of a column -> allowed Python types of its values, and the type in PostgreSQL; only numbers may be
None (unknown)."""


class Catalogue(ABC):
    """Catalogue of a fleet: the interface that all kinds of storage share."""

    name: str
    """Location of the catalogue, as messages name it."""
    results: Path
    """Folder of corrected logs and maps."""

    def rows(self, table: str, columns: Sequence[str] = ()) -> list[Row]:
        """Return the rows of a table in the order of their keys, each once, with `columns` (by default all).

        FormatError: a file is damaged, or a value is not of its column's type. PortError: the server does not
        answer.
        """
        wanted = columns or tuple(CATALOGUE_TABLES[table])
        found = self._rows(table, wanted)
        for name in wanted:
            kind = CATALOGUE_TABLES[table][name]
            for row in found:
                if not isinstance(row[name], COLUMN_TYPES[kind][0]):
                    expected = f"table {table}: expected {kind}, got {row[name]!r}"
                    raise FormatError(self.name, expected, column=name)
        return found

    @abstractmethod
    def _rows(self, table: str, columns: Sequence[str]) -> list[Row]:
        """Return the given columns of all rows of a table; raises the errors of :meth:`rows`."""

    def add(self, table: str, rows: Iterable[Row]) -> int:
        """Add the rows that the table does not contain yet, and return their number.

        WriteError: the disk is full, or the folder may not be written to. PortError: the server does not
        answer, or rejects the rows.
        """
        keyed = {}
        for row in rows:
            content = msgspec.json.encode(row, order="sorted", enc_hook=plain)
            keyed[sha256(content).hexdigest()] = {name: row[name] for name in CATALOGUE_TABLES[table]}
        return self._insert(table, dict(sorted(keyed.items()))) if keyed else 0

    def add_tables(self, tables: Mapping[str, Iterable[Row]]) -> int:
        """Add rows to several tables (name -> rows) as :meth:`add`, and return the number of new rows."""
        return sum(self.add(table, rows) for table, rows in tables.items())

    def compact(self) -> None:  # noqa: B027  most need not
        """Merge small files if the catalogue consists of files; else do nothing."""

    @abstractmethod
    def _insert(self, table: str, keyed: Mapping[str, Row]) -> int:
        """Add rows (key -> row) whose keys the table does not contain yet, and return their number."""

    def _check_format(self, found: int) -> None:
        if found > CATALOGUE_FORMAT:
            expected = f"expected a catalogue of format {CATALOGUE_FORMAT} at most"
            raise FormatError(self.name, f"{expected}, got {found}; update magbridge")


class FolderCatalogue(Catalogue):
    """Catalogue in a folder of Parquet files; several processes may write to it on a shared disk.

    ::

        catalogue/
          catalogue.json            {"format": 1}
          TABLE/*.parquet           one file for each batch of rows
          results/VEHICLE/DEPLOYMENT/     corrected logs and maps

    A file's name is the hash of its rows' keys. So equal rows give the same file, and two processes never
    write different rows to one file. A reader removes duplicate rows.
    """

    def __init__(self, folder: Path, results: Path | None = None, *, create: bool = False) -> None:
        self.folder, self.name, self.results = folder, str(folder), results or folder / "results"
        self._keys_of: dict[Path, frozenset[str]] = {}  # the keys in a file, which never changes
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
        """Merge the small files of each table; remove them after the merged file is complete."""
        for table, columns in CATALOGUE_TABLES.items():
            with suppress(FileNotFoundError):  # another process merges the same files
                files = [path for path in self._files(table) if len(self._keys(path)) < SMALL_FILE_ROWS]
                if len(files) < MAX_SMALL_FILES:
                    continue
                written = self._write(table, self._joined(table, files, tuple(columns)))
                for path in files:
                    if path != written:
                        path.unlink(missing_ok=True)

    def _insert(self, table: str, keyed: Mapping[str, Row]) -> int:
        known = set[str]()
        for path in self._files(table):
            with suppress(FileNotFoundError):  # merged by another process; at worst, rows are written twice
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
            with suppress(FileNotFoundError):  # another process has just merged files: read again
                return self._joined(table, self._files(table), columns)

    def _joined(self, table: str, files: Sequence[Path], columns: Sequence[str]) -> pl.DataFrame:
        """Return the rows of several files in the order of their keys, without duplicates."""
        schema = {"key": TEXT, **{name: CATALOGUE_TABLES[table][name] for name in columns}}
        parts = [pl.DataFrame(schema=schema)]
        for path in files:
            try:
                part = pl.read_parquet(path, columns=list(schema))
            except pl.exceptions.PolarsError as error:
                raise FormatError(path, f"expected a Parquet file, got a damaged one: {error}") from error
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
            whole = BytesIO()  # polars would hide the reason of a failed write
            frame.write_parquet(whole, compression="zstd")
            with atomic_path(path) as temporary:
                temporary.parent.mkdir(exist_ok=True)
                temporary.write_bytes(whole.getbuffer())
        return path


def open_catalogue(location: str | Path, results: Path | None = None, *, create: bool = False) -> Catalogue:
    """Open the catalogue in a folder, or in a database (``postgresql://USER@HOST/DATABASE``).

    `results` is the folder of corrected logs and maps. Its default is `results` in the catalogue's folder, or
    `fleet-results` in the working directory for a database. With `create`, a missing catalogue is created.

    FormatError: the catalogue does not exist, or has a newer format. PortError: the server does not answer.
    MissingExtra: the client of the database is not installed.
    """
    if not str(location).startswith(SERVERS):
        return FolderCatalogue(Path(location), results, create=create)
    try:
        from magbridge.fleet.postgres import PostgresCatalogue  # noqa: PLC0415  an extra of its own
    except ImportError:
        raise MissingExtra("psycopg", "postgres") from None
    return PostgresCatalogue(str(location), results or Path("fleet-results"), create=create)
