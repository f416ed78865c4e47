"""A temporary PostgreSQL server without a TCP port, if PostgreSQL is installed."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

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
            subprocess.run(
                command, check=True, stdout=subprocess.DEVNULL, cwd=folder, user=OWNER if root else None
            )

        call("initdb", "-U", OWNER, "-A", "trust", "-E", "UTF8", "--no-sync")
        call("pg_ctl", "start", "-w", "-l", f"{folder}/log", "-o", f"-k {folder} -F -c listen_addresses=''")
        try:
            yield f"postgresql:///{OWNER}?host={folder}&user={OWNER}"
        finally:
            call("pg_ctl", "stop", "-m", "immediate")
