"""The catalogue: tables to which rows are only ever added, in a folder or on a server.

A row's key is the SHA-256 of its content, so a row is there once, by any writer, however often. No row
holds the time at which it was written: a catalogue made in one go, and one whose making was killed and begun
again, are the same.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

import msgspec
import polars as pl

from magbridge.arrays import plain
from magbridge.errors import FormatError, MissingExtra

__all__ = ["CATALOGUE_FORMAT", "CATALOGUE_TABLES", "TEXT", "Catalogue", "Row", "open_catalogue"]

Row = dict[str, Any]
CATALOGUE_FORMAT = 1
"""Version of the written catalogues; newer ones are refused."""
SERVERS = ("postgresql://", "postgres://")
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
`precision` and `vector` what the data alone say of its coefficients (:func:`.packed`); `job` names what a
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
    """As people know it."""
    results: Path
    """Folder of corrected logs and maps."""

    def rows(self, table: str, columns: Sequence[str] = ()) -> list[Row]:
        """Return a table's rows, each once, in the order of their keys.

        Parameters
        ----------
        table : str
            One of :data:`CATALOGUE_TABLES`.
        columns : sequence of str
            Those that are wanted; all, if none is named.

        Raises
        ------
        FormatError
            A file is damaged, or a value is not of its column's type.
        PortError
            The server does not answer.
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
        """Rearrange what many additions have left behind, where that makes reading quicker."""

    @abstractmethod
    def _insert(self, table: str, keyed: Mapping[str, Row]) -> int:
        """Add rows by their keys, unless those are there; return how many were not."""

    def _check_format(self, found: int) -> None:
        if found > CATALOGUE_FORMAT:
            raise FormatError(
                self.name,
                f"a catalogue of format {found}; this magbridge reads up to {CATALOGUE_FORMAT}: update it",
            )


def open_catalogue(location: str | Path, results: Path | None = None, *, create: bool = False) -> Catalogue:
    """Open a catalogue.

    Parameters
    ----------
    location : str or Path
        A folder, or the URL of a PostgreSQL database: ``postgresql://USER@HOST/DATABASE``.
    results : Path, optional
        Folder of corrected logs and maps; by default `results` in the catalogue's folder, and
        `fleet-results` here for one on a server.
    create : bool
        Make it where there is none.

    Raises
    ------
    FormatError
        There is none, or it is of a newer format.
    PortError
        The server does not answer.
    MissingExtra
        A server was named, and its client is not installed.
    """
    if str(location).startswith(SERVERS):
        try:
            from magbridge.fleet.postgres import PostgresCatalogue  # noqa: PLC0415  an extra of its own
        except ImportError:
            raise MissingExtra("psycopg", "postgres") from None
        return PostgresCatalogue(str(location), results or Path("fleet-results"), create=create)
    from magbridge.fleet.folder import FolderCatalogue  # noqa: PLC0415  it builds on this module

    return FolderCatalogue(Path(location), results, create=create)


def _key(row: Row) -> str:
    return sha256(msgspec.json.encode(row, order="sorted", enc_hook=plain)).hexdigest()
