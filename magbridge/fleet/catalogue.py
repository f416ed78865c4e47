"""The catalogue: tables to which rows are only ever added, in a folder or on a server.

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
"""Version of the written catalogues; newer ones are refused."""
SERVERS = ("postgresql://", "postgres://")
MARK = "catalogue.json"
"""File that makes a folder a catalogue."""
MAX_SMALL_FILES, SMALL_FILE_ROWS = 64, 1000
"""Number of files with fewer rows than the second number at which :meth:`Catalogue.compact` merges them."""
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
"""Table -> columns and their types, in nT, deg and s since 1970. `calibration` is a whole cal.json,
`precision` and `vector` the information of the data alone (:func:`.packed`); `job` identifies what a
result is made of, and its last `attempt` is the one that counts. A catalogue may lack a table that is newer
than it: it is empty."""
PYTHON_TYPES: dict[pl.DataType, tuple[type, ...]] = {
    TEXT: (str,), NUMBER: (float, int, type(None)), COUNT: (int,), TEXTS: (list,), NUMBERS: (list,),
    PACKED: (bytes,), pl.Boolean(): (bool,),
}  # fmt: skip
"""Type of a column to those of its values; only numbers may be unknown."""


class Catalogue(ABC):
    """A catalogue, wherever it is."""

    name: str
    """Location of the catalogue, for messages."""
    results: Path
    """Folder of corrected logs and maps."""

    def rows(self, table: str, columns: Sequence[str] = ()) -> list[Row]:
        """Return the `columns` (none named: all) of a table, each row once, in the order of their keys.

        FormatError: a file is damaged, or a value is not of its column's type. PortError: the server does not
        answer.
        """
        wanted = columns or tuple(CATALOGUE_TABLES[table])
        found = self._rows(table, wanted)
        for name in wanted:
            kind = CATALOGUE_TABLES[table][name]
            for row in found:
                if not isinstance(row[name], PYTHON_TYPES[kind]):
                    expected = f"table {table}: expected {kind}, got {row[name]!r}"
                    raise FormatError(self.name, expected, column=name)
        return found

    @abstractmethod
    def _rows(self, table: str, columns: Sequence[str]) -> list[Row]:
        """Return the columns of a table's rows; errors as of :meth:`rows`."""

    def add(self, table: str, rows: Iterable[Row]) -> int:
        """Add rows, unless they are there; return how many were not.

        WriteError: the disk is full, or the folder may not be written to. PortError: the server does not
        answer, or refuses to write.
        """
        keyed = {_key(row): {name: row[name] for name in CATALOGUE_TABLES[table]} for row in rows}
        return self._insert(table, dict(sorted(keyed.items()))) if keyed else 0

    def compact(self) -> None:  # noqa: B027  most need not
        """Merge small files, where a catalogue consists of files."""

    @abstractmethod
    def _insert(self, table: str, keyed: Mapping[str, Row]) -> int:
        """Add rows by their keys, unless those are there; return how many were not."""

    def _check_format(self, found: int) -> None:
        if found > CATALOGUE_FORMAT:
            raise FormatError(
                self.name,
                f"expected a catalogue of format {CATALOGUE_FORMAT} at most, got {found}; update magbridge",
            )


class FolderCatalogue(Catalogue):
    """A folder of Parquet files; safe with several writers on a shared disk, without a server.

    ::

        catalogue/
          catalogue.json            {"format": 1}
          TABLE/*.parquet           one file for each batch of rows
          results/VEHICLE/DEPLOYMENT/     corrected logs and maps

    A file's name is the hash of its rows' keys. So the same rows are the same file, different writers never
    write to one file, and a reader takes each row once.
    """

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
        """Merge the small files of each table; the new file is complete before the old ones are removed."""
        for table, columns in CATALOGUE_TABLES.items():
            with suppress(FileNotFoundError):  # another writer does the same
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
                raise FormatError(
                    path, f"expected a Parquet file of the catalogue, got a damaged one: {error}"
                ) from error
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


def open_catalogue(location: str | Path, results: Path | None = None, *, create: bool = False) -> Catalogue:
    """Open a catalogue: a folder, or a database (``postgresql://USER@HOST/DATABASE``).

    `results` is the folder of corrected logs and maps: by default `results` in the catalogue's folder, and
    `fleet-results` here for one on a server. With `create`, a catalogue that does not exist is made.

    FormatError: there is none, or it is of a newer format. PortError: the server does not answer.
    MissingExtra: a server was named, and its client is not installed.
    """
    if not str(location).startswith(SERVERS):
        return FolderCatalogue(Path(location), results, create=create)
    try:
        from magbridge.fleet.postgres import PostgresCatalogue  # noqa: PLC0415  an extra of its own
    except ImportError:
        raise MissingExtra("psycopg", "postgres") from None
    return PostgresCatalogue(str(location), results or Path("fleet-results"), create=create)


def _key(row: Row) -> str:
    return sha256(msgspec.json.encode(row, order="sorted", enc_hook=plain)).hexdigest()
