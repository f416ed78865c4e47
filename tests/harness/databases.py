"""A private PostgreSQL server without a port, where the system has one installed."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

OWNER = "postgres"
"""Who runs it where we are root, as whom it refuses to run."""


def program(name: str) -> str | None:
    """Return where a program of the newest PostgreSQL is."""
    found = sorted(Path("/usr/lib/postgresql").glob(f"*/bin/{name}"), key=lambda path: path.parts[-3])
    return str(found[-1]) if found else shutil.which(name)


@contextmanager
def server() -> Iterator[str]:
    """Run a server; yield the URL of its database. There must be :func:`program` of initdb and pg_ctl."""
    root = os.geteuid() == 0
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:  # short: a socket's path is
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
