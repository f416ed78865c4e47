"""Test that a catalogue on a server equals one in a folder, with several simultaneous writers."""

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Barrier, Thread

import pytest

pytest.importorskip("psycopg", reason="PostgreSQL's client is not installed")

import psycopg
from commands import Command

from magbridge.cli import main
from magbridge.errors import FormatError, PortError
from magbridge.fleet.catalogue import CATALOGUE_TABLES, Catalogue, open_catalogue
from magbridge.fleet.process import work
from magbridge.fleet.register import jobs

OWNER = "postgres"
"""User that runs the server if the tests run as root, because PostgreSQL does not start as root."""


def program(name: str) -> str | None:
    """Return the path of a program of the newest installed PostgreSQL, or None if there is none."""
    found = sorted(Path("/usr/lib/postgresql").glob(f"*/bin/{name}"), key=lambda path: path.parts[-3])
    return str(found[-1]) if found else shutil.which(name)


@contextmanager
def server() -> Iterator[str]:
    """Run a server and yield the URL of its database; :func:`program` must find initdb and pg_ctl."""
    root = os.geteuid() == 0
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:  # a short path, for a socket
        if root:
            shutil.chown(folder, OWNER)

        def call(name: str, *arguments: str) -> None:
            command = [str(program(name)), "-D", f"{folder}/data", *arguments]
            user = OWNER if root else None
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd=folder, user=user)

        call("initdb", "-U", OWNER, "-A", "trust", "-E", "UTF8", "--no-sync")
        call("pg_ctl", "start", "-w", "-l", f"{folder}/log", "-o", f"-k {folder} -F -c listen_addresses=''")
        try:
            yield f"postgresql:///{OWNER}?host={folder}&user={OWNER}"
        finally:
            call("pg_ctl", "stop", "-m", "immediate")


installed = program("initdb") and program("pg_ctl")
pytestmark = pytest.mark.skipif(not installed, reason="no PostgreSQL server is installed")


@pytest.fixture(scope="module")
def running() -> Iterator[str]:
    with server() as url:
        yield url


@pytest.fixture
def url(running: str) -> str:
    """Return the URL of an empty database."""
    with psycopg.connect(running) as connection:
        connection.execute("drop schema if exists magbridge_fleet cascade")
    return running


def test_it_says_what_a_folder_says(url: str, flown: Path, tmp_path: Path) -> None:
    both: list[Catalogue] = []
    for where in (url, str(tmp_path / "fleet")):
        assert main(["fleet", "add", str(flown / "fleet.toml"), "--catalogue", where]) == 0
        catalogue = open_catalogue(where, tmp_path / "results")
        job = jobs(catalogue)[0]
        for _ in range(2):  # the second time, nothing is new
            added = catalogue.add_tables(work(job, catalogue.results).tables)
        assert not added
        catalogue.add("done", [{**job.mark, "diagnosed": False, "mapped": True}])
        both.append(catalogue)
    for table in CATALOGUE_TABLES:
        assert both[0].rows(table) == both[1].rows(table)
    few = [catalogue.rows("calibrations", ["rms", "warnings"]) for catalogue in both]
    assert few[0] == few[1]
    assert set(few[0][0]) == {"rms", "warnings"}


def test_the_commands_know_it(url: str, flown: Path, tmp_path: Path, command: Command) -> None:
    refused = command("fleet", "status", "--catalogue", url, code=1).err
    assert "expected a fleet's catalogue (magbridge fleet add makes one)" in refused
    command("fleet", "add", flown / "fleet.toml", "--catalogue", url)
    catalogue = open_catalogue(url, tmp_path)
    for job in jobs(catalogue):
        catalogue.add_tables(work(job, catalogue.results).tables)
    found = command.json("fleet", "status", "--catalogue", url)["vehicles"]
    assert [one["calibrated"] for one in found] == [2, 1]
    found = command.json("calibrate", flown / "one/second.nc", "--fleet", url, "-o", "cal.json")
    assert found["fleet"]["deployments"] == 1


def test_many_make_it_and_write_to_it_at_once(url: str) -> None:
    together, wrong = Barrier(4), list[Exception]()

    def writer(number: int) -> None:
        together.wait()
        try:
            catalogue = open_catalogue(url, create=True)
            for n in (1, 2, number + 10):
                row = {"job": str(n), "attempt": 1, "vehicle": "v", "deployment": "d", "line": f"failure {n}"}
                catalogue.add("failures", [row])
        except (PortError, FormatError) as error:
            wrong.append(error)

    threads = [Thread(target=writer, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
    assert len(open_catalogue(url).rows("failures")) == 6


def test_a_newer_one_and_a_server_that_is_gone_are_a_line_each(url: str) -> None:
    open_catalogue(url, create=True)
    with psycopg.connect(url) as connection:
        connection.execute("insert into magbridge_fleet.catalogue values (9)")
    with pytest.raises(FormatError, match="expected a catalogue of format 1 at most, got 9"):
        open_catalogue(url)
    with pytest.raises(PortError, match=r"^postgresql:///nothing: ") as refused:
        open_catalogue("postgresql://someone:secret@/nothing?host=/no/such/folder")
    assert "secret" not in str(refused.value)
    assert "\n" not in str(refused.value)
