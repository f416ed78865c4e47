"""The catalogue: a folder of Parquet files to which rows are only ever added.

::

    catalogue/
      catalogue.json            {"format": 1}
      vehicles/*.parquet        one file for each batch of rows
      files/  logs/  calibrations/  corrected/  findings/  maps/  failures/  done/
      results/VEHICLE/DEPLOYMENT/     corrected logs and maps

A row's key is the SHA-256 of its content, and a file's name that of its rows' keys. So the same rows are the
same file, whoever writes them and how often; different writers never write to one file; and a reader takes
each row once. No row holds the time at which it was written: a catalogue made in one go, and one whose making
was killed and begun again, are the same.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Any

import msgspec
import polars as pl

from magbridge.arrays import plain
from magbridge.errors import FormatError
from magbridge.files import atomic_path

__all__ = ["FORMAT", "TABLES", "Catalogue", "Row"]

Row = dict[str, Any]
FORMAT = 1
"""Of the catalogues that are written; newer ones are refused."""
MARK = "catalogue.json"
MANY = 64
"""Files of a table from which on they are made one."""
TEXT, NUMBER, COUNT, TEXTS, NUMBERS = (
    pl.String(),
    pl.Float64(),
    pl.Int64(),
    pl.List(pl.String()),
    pl.List(pl.Float64()),
)
TABLES: dict[str, dict[str, pl.DataType]] = {
    "vehicles": {"vehicle": TEXT, "serial": TEXT, "sensor": TEXT, "parameters": TEXTS, "order": COUNT},
    "files": {
        "vehicle": TEXT, "deployment": TEXT, "refit": TEXT, "path": TEXT, "sha256": TEXT, "size": COUNT,
        "version": COUNT,
    },
    "logs": {
        "sha256": TEXT, "start": NUMBER, "end": NUMBER, "rows": COUNT, "samples": COUNT, "gaps": COUNT,
        "losses": COUNT, "sensor": TEXT, "latitude": NUMBER, "longitude": NUMBER,
    },
    "calibrations": {
        "job": TEXT, "vehicle": TEXT, "deployment": TEXT, "refit": TEXT, "start": NUMBER, "method": TEXT,
        "rms": NUMBER, "noise": NUMBER, "expected": NUMBER, "supported": pl.Boolean(), "warnings": TEXTS,
        "calibration": TEXT, "precision": NUMBERS, "vector": NUMBERS,
    },
    "corrected": {
        "job": TEXT, "sha256": TEXT, "path": TEXT, "samples": COUNT, "flagged": COUNT, "sigma": NUMBER,
    },
    "findings": {"job": TEXT, "verdict": TEXT, "cause": TEXT, "channel": TEXT, "signal_to_noise": NUMBER},
    "maps": {"job": TEXT, "path": TEXT, "rms": NUMBER, "sigma": NUMBER},
    "done": {"job": TEXT, "diagnosed": pl.Boolean(), "mapped": pl.Boolean()},
    "failures": {"job": TEXT, "vehicle": TEXT, "deployment": TEXT, "line": TEXT},
}  # fmt: skip
"""Table -> columns and their types, in nT, deg and s since 1970. `calibration` is a whole cal.json,
`precision` and `vector` what the data alone say of its coefficients; `job` names what a result is made of."""


class Catalogue:
    """A catalogue in a folder.

    Parameters
    ----------
    folder : path
        Where it is.
    create : bool
        Make it where there is none.

    Raises
    ------
    FormatError
        There is none, or it is of a newer format.
    """

    def __init__(self, folder: Path, *, create: bool = False) -> None:
        self.folder = folder
        mark = folder / MARK
        if create and not mark.exists():
            folder.mkdir(parents=True, exist_ok=True)
            with atomic_path(mark) as beside:
                beside.write_bytes(msgspec.json.encode({"format": FORMAT}))
        if not mark.is_file():
            raise FormatError(folder, "expected a fleet's catalogue (magbridge fleet add makes one)")
        try:
            found = msgspec.json.decode(mark.read_bytes(), type=dict[str, int])["format"]
        except (msgspec.DecodeError, KeyError) as error:
            raise FormatError(mark, f'expected {{"format": {FORMAT}}}') from error
        if found > FORMAT:
            raise FormatError(
                folder, f"a catalogue of format {found}; this magbridge reads up to {FORMAT}: update it"
            )

    def rows(self, table: str, columns: Sequence[str] = ()) -> list[Row]:
        """Return a table's rows, each once, in the order of their keys.

        Parameters
        ----------
        table : str
            One of :data:`TABLES`.
        columns : sequence of str
            Those that are wanted; all, if none is named.

        Raises
        ------
        FormatError
            A file is damaged.
        """
        wanted = ("key", *(columns or TABLES[table]))
        while True:
            try:
                parts = [self._part(path, wanted) for path in self._files(table)]
                break
            except FileNotFoundError:  # another writer has just made several files one
                continue
        if not parts:
            return []
        whole = pl.concat(parts).unique(subset="key").sort("key")
        return whole.drop("key").to_dicts()

    def add(self, table: str, rows: Iterable[Row]) -> int:
        """Add rows, unless they are there; return how many were not.

        Raises
        ------
        WriteError
            The disk is full, or the folder may not be written to.
        """
        schema = TABLES[table]
        keyed = {_key(row): {name: row[name] for name in schema} for row in rows}
        known = self._keys(table)
        fresh = {key: row for key, row in sorted(keyed.items()) if key not in known}
        if fresh:
            frame = pl.DataFrame(
                [{"key": key, **row} for key, row in fresh.items()], schema={"key": TEXT, **schema}
            )
            self._write(table, frame)
        return len(fresh)

    def compact(self) -> None:
        """Make one file of each table's many.

        What is removed is what is in the file just written, so rows are never lost, whoever else does so.
        """
        for table, schema in TABLES.items():
            files = self._files(table)
            if len(files) < MANY:
                continue
            with suppress(FileNotFoundError):  # another writer does the same
                parts = [self._part(path, ("key", *schema)) for path in files]
                written = self._write(table, pl.concat(parts).unique(subset="key").sort("key"))
                for path in files:
                    if path != written:
                        path.unlink(missing_ok=True)

    def _files(self, table: str) -> list[Path]:
        return sorted((self.folder / table).glob("[!.]*.parquet"))

    def _keys(self, table: str) -> set[str]:
        return {key for path in self._files(table) for key in self._part(path, ("key",))["key"]}

    def _part(self, path: Path, columns: Sequence[str]) -> pl.DataFrame:
        try:
            return pl.read_parquet(path, columns=list(columns))
        except pl.exceptions.PolarsError as error:
            raise FormatError(path, f"expected a catalogue's Parquet: {error}") from error

    def _write(self, table: str, frame: pl.DataFrame) -> Path:
        name = sha256("".join(frame["key"]).encode()).hexdigest()[:40]
        path = self.folder / table / f"{name}.parquet"
        path.parent.mkdir(exist_ok=True)
        if not path.exists():
            with atomic_path(path) as beside:
                frame.write_parquet(beside, compression="zstd")
        return path


def _key(row: Row) -> str:
    return sha256(msgspec.json.encode(row, order="sorted", enc_hook=plain)).hexdigest()
