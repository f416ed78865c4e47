"""Test that a killed scheduler or command, run again by two processes, ends in the same catalogue."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import xarray as xr
from fleets import content

from magbridge.fleet.catalogue import FolderCatalogue

PATIENCE = 120.0
"""Time limit on a busy computer, s."""


def until(what: Callable[[], bool], *processes: subprocess.Popen[str]) -> None:
    """Wait until a condition holds; fail if one of the processes ends before."""
    end = time.monotonic() + PATIENCE
    while not what():
        assert time.monotonic() < end
        for process in processes:
            assert process.poll() is None, process.communicate()
        time.sleep(0.02)


def start(*command: str | Path, module: str = "magbridge") -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", module, *map(str, command)],
        text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env={**os.environ, "COLUMNS": "200"},
    )  # fmt: skip


def test_killed_and_run_again_it_is_the_same(done: FolderCatalogue, flown: Path, tmp_path: Path) -> None:
    folder, where = tmp_path / "fleet", tmp_path / "scheduler.json"
    catalogue = FolderCatalogue(folder, create=True)
    with start("fleet", "add", flown / "fleet.toml", "--catalogue", folder) as adding:
        assert adding.wait() == 0

    def finished(count: int) -> Callable[[], bool]:
        return lambda: len(catalogue.rows("done")) >= count

    scheduler = start(
        "--port", "0", "--no-dashboard", "--scheduler-file", where, module="distributed.cli.dask_scheduler"
    )
    try:
        until(where.exists, scheduler)
        worker = start(
            "--scheduler-file", where, "--nthreads", "1", "--no-dashboard",
            "--local-directory", tmp_path / "worker", module="distributed.cli.dask_worker",
        )  # fmt: skip
        address = json.loads(where.read_text())["address"]
        command = start("fleet", "process", "--catalogue", folder, "--scheduler", address)
        until(finished(1), scheduler, worker, command)
    finally:
        scheduler.kill()
        scheduler.communicate()
    out, output = command.communicate(timeout=PATIENCE)
    worker.kill()
    worker.communicate()
    if len(catalogue.rows("done")) < 3:  # it was not too late to be killed
        assert command.returncode == 1, (out, output)
        assert (
            f"magbridge: {address}: the dask scheduler was lost; run magbridge fleet process again" in output
        )
        assert "Traceback" not in output
        command = start("fleet", "process", "--catalogue", folder, "--workers", "1")
        until(finished(2), command)
        command.send_signal(signal.SIGKILL)
        command.communicate()
    two = [start("fleet", "process", "--catalogue", folder, "--workers", "1") for _ in range(2)]
    for one in two:  # two people at once
        out, output = one.communicate(timeout=PATIENCE)
        lines = [line for line in output.splitlines() if not line.startswith("magbridge: deployments: ")]
        assert (one.returncode, lines) == (0, []), out  # a busy computer prints the progress
    # except the last results, which the fixture's run did not learn
    mine, theirs = content(catalogue), content(done)
    assert len(mine.pop("populations")) == 1
    theirs.pop("populations")
    assert mine == theirs
    for row in mine["corrected"]:
        logs = [xr.load_dataset(one.results / row["path"]) for one in (catalogue, done)]
        for log in logs:
            assert "written by magbridge" in log.attrs.pop("history")  # with its time
        xr.testing.assert_identical(*logs)
