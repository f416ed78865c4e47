"""Store the catalogue of a fleet in a PostgreSQL database, which several users can share.

The tables are those of :data:`.CATALOGUE_TABLES`, in the schema ``magbridge_fleet``. The hash of a row is its
primary key, so that a row is stored once even if two processes add it at the same time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import psycopg
from psycopg import sql
from psycopg.rows import dict_row

from magbridge.errors import FormatError, PortError
from magbridge.fleet.catalogue import CATALOGUE_FORMAT, CATALOGUE_TABLES, COLUMN_TYPES, Catalogue, Row

CONNECT_TIMEOUT_S = 10
"""Longest time to wait for a connection to the server, s."""
CREATION_LOCK = 0x6D616762
"""Key of the advisory lock that a process holds while it creates the tables."""


class PostgresCatalogue(Catalogue):
    """Catalogue in the database ``postgresql://USER@HOST/DATABASE``; ``~/.pgpass`` may hold the password."""

    def __init__(self, url: str, results: Path, *, create: bool = False) -> None:
        self._url, self.results = url, results
        parts = urlsplit(url)
        # without the part that may contain a password
        self.name = f"postgresql://{parts.netloc.rpartition('@')[2]}{parts.path}"
        with self._connected() as connection:
            if create:
                self._make(connection)
            known = connection.execute("select to_regclass('magbridge_fleet.catalogue')").fetchone()
            if known is None or known[0] is None:
                raise FormatError(self.name, "expected a fleet's catalogue (magbridge fleet add makes one)")
            found = connection.execute("select max(format) from magbridge_fleet.catalogue").fetchone()
        self._check_format(found[0] if found else 0)

    def _rows(self, table: str, columns: Sequence[str]) -> list[Row]:
        query = sql.SQL('select {} from magbridge_fleet.{} order by key collate "C"').format(
            sql.SQL(", ").join(map(sql.Identifier, columns)), sql.Identifier(table)
        )
        with self._connected() as connection, connection.cursor(row_factory=dict_row, binary=True) as cursor:
            try:
                return cursor.execute(query).fetchall()
            except psycopg.errors.UndefinedTable:  # the catalogue is older
                return []

    def _insert(self, table: str, keyed: Mapping[str, Row]) -> int:
        with self._connected() as connection:
            known = connection.execute("select to_regclass(%s)", (f"magbridge_fleet.{table}",)).fetchone()
            if known is None or known[0] is None:
                self._make(connection)
        names = ("key", *CATALOGUE_TABLES[table])
        query = sql.SQL(
            "insert into magbridge_fleet.{} ({}) values ({}) on conflict (key) do nothing"
        ).format(
            sql.Identifier(table),
            sql.SQL(", ").join(map(sql.Identifier, names)),
            sql.SQL(", ").join(map(sql.Placeholder, names)),
        )
        with self._connected() as connection, connection.cursor() as cursor:
            cursor.executemany(query, [{"key": key, **row} for key, row in keyed.items()])
            return cursor.rowcount

    @contextmanager
    def _connected(self) -> Iterator[psycopg.Connection]:
        """Yield a connection for one transaction; PortError: the database reports an error."""
        try:
            with psycopg.connect(self._url, connect_timeout=CONNECT_TIMEOUT_S) as connection:
                yield connection
        except psycopg.Error as error:
            raise PortError(self.name, " ".join(str(error).split())) from error

    def _make(self, connection: psycopg.Connection) -> None:
        """Create the schema and the missing tables while holding the creation lock."""
        connection.execute("select pg_advisory_xact_lock(%s)", (CREATION_LOCK,))
        connection.execute("create schema if not exists magbridge_fleet")
        connection.execute("create table if not exists magbridge_fleet.catalogue (format bigint primary key)")
        known = "select from magbridge_fleet.catalogue"
        once = f"insert into magbridge_fleet.catalogue select %s where not exists ({known})"
        connection.execute(once, (CATALOGUE_FORMAT,))
        for table, columns in CATALOGUE_TABLES.items():
            typed = [
                sql.SQL("{} {}").format(sql.Identifier(name), sql.SQL(COLUMN_TYPES[kind][1]))
                for name, kind in columns.items()
            ]
            create = sql.SQL("create table if not exists magbridge_fleet.{} (key text primary key, {})")
            connection.execute(create.format(sql.Identifier(table), sql.SQL(", ").join(typed)))
