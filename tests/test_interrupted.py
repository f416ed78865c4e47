"""A command that receives a signal, or whose reader has ended: one line at most, no partial file."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import xarray as xr
from demos import demo_log

from magbridge.logs import write


@pytest.mark.parametrize(
    ("number", "code"),
    [(signal.SIGINT, 130), (signal.SIGTERM, -signal.SIGTERM), (signal.SIGHUP, -signal.SIGHUP)],
)
def test_stopped_in_the_middle_leaves_nothing(tmp_path: Path, number: signal.Signals, code: int) -> None:
    # their own times would not be the rows' any more
    rows = demo_log()[[f"mag_{axis}" for axis in "xyz"]]
    long = [rows.assign_coords(time=rows["time"] + 1e5 * k) for k in range(20)]
    write(xr.concat(long, "time"), tmp_path / "long.nc")
    command = [sys.executable, "-m", "magbridge", "convert", "long.nc", "-o", "x.csv"]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr
        while not any(path.stat().st_size for path in tmp_path.glob(".x.*.partial.csv")):
            assert process.poll() is None
            time.sleep(0.01)
        process.send_signal(number)
        output = process.stderr.read()
    assert process.returncode == code
    assert output == ("magbridge: interrupted\n" if number == signal.SIGINT else "")
    assert [path.name for path in tmp_path.iterdir()] == ["long.nc"]


@pytest.mark.parametrize("library", ["cyclopts", "typing", "__future__"])
def test_interrupted_while_libraries_are_loaded(tmp_path: Path, library: str) -> None:
    (tmp_path / f"{library}.py").write_text("import signal; signal.raise_signal(signal.SIGINT)")
    ended = subprocess.run(
        [sys.executable, "-m", "magbridge", "--version"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (ended.returncode, ended.stderr, ended.stdout) == (130, "magbridge: interrupted\n", "")


@pytest.mark.parametrize("arguments", [["--help"], ["simulate", "--help"], ["--version"]])
def test_a_reader_who_has_read_enough_is_not_an_error(arguments: list[str]) -> None:
    """As ``| head -1`` is."""
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "magbridge", *arguments]
    ended = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, check=False)
    os.close(writing)
    assert (ended.returncode, ended.stderr) == (0, b"")


@pytest.mark.parametrize("closed", ["2>&-", "<&- >&- 2>&-"])
def test_streams_that_whoever_started_it_has_closed(tmp_path: Path, closed: str) -> None:
    """As a service's may be: output goes nowhere, and into no file that takes the free descriptor."""
    (tmp_path / "a.csv").write_text("time,mag_x\n1,2\n")
    command = f'exec "{sys.executable}" -m magbridge convert a.csv -o b.csv {closed}'
    assert subprocess.run(["sh", "-c", command], cwd=tmp_path, check=False).returncode == 0
    assert (tmp_path / "b.csv").read_text().startswith("time,mag_x\n1.0,2.0\n")
