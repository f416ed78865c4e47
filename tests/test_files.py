"""Test that a file is complete or missing, whatever happens to the process that writes it."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import xarray as xr
from demos import demo_log

from magbridge.files import atomic_path, new_folder
from magbridge.logs import write

WRITER = """
import sys, time
from magbridge.files import atomic_path, new_folder
with atomic_path(sys.argv[1]) as partial:
    partial.write_text("half")
    print(partial.name, flush=True)
    time.sleep(60)
"""


def writing(target: Path) -> tuple[subprocess.Popen[str], Path]:
    """Start a process that writes `target`; return it and the name of its temporary file."""
    process = subprocess.Popen([sys.executable, "-c", WRITER, str(target)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    with process.stdout as output:
        return process, target.with_name(output.readline().strip())


def test_a_write_clears_what_a_killed_one_left_and_leaves_a_living_ones(tmp_path: Path) -> None:
    target = tmp_path / "a [1].json"
    target.write_text("before")
    killed, left = writing(target)
    living, still = writing(target)
    other = tmp_path / ".b.1.partial.json"
    try:
        killed.send_signal(signal.SIGKILL)
        killed.wait()
        assert left.read_text() == "half"
        assert target.read_text() == "before"
        other.write_text("of another target")
        with atomic_path(target) as temporary:
            temporary.write_text("after")
        assert {path.name for path in tmp_path.iterdir()} == {target.name, still.name, other.name}
        assert target.read_text() == "after"
    finally:
        living.kill()
        living.wait()


def test_a_block_that_raises_leaves_everything_as_it_was(tmp_path: Path) -> None:
    target = tmp_path / "a.json"
    target.write_text("before")
    with pytest.raises(ZeroDivisionError), atomic_path(target) as temporary:
        temporary.write_text(str(1 // (temporary.write_text("half") - 4)))
    assert [path.read_text() for path in tmp_path.iterdir()] == ["before"]


@pytest.mark.parametrize(("name", "left"), [("new/doubt", []), (".", ["half"])])
def test_a_folder_that_was_made_goes_with_what_raised_and_one_that_was_there_stays(
    tmp_path: Path, name: str, left: list[str]
) -> None:
    with pytest.raises(ZeroDivisionError), new_folder(tmp_path / name) as folder:
        (folder / "whole").write_text(str(1 // (folder / "half").write_text("")))
    assert [path.name for path in tmp_path.iterdir()] == left


# ---- A command that receives a signal, or whose reader has ended: one line at most, no partial file ------


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
    command = [sys.executable, "-m", "magbridge", "--version"]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr, ended.stdout) == (130, "magbridge: interrupted\n", "")


@pytest.mark.parametrize("arguments", [["--help"], ["simulate", "--help"], ["--version"]])
def test_a_reader_who_has_read_enough_is_not_an_error(arguments: list[str]) -> None:
    """A reader such as ``| head -1`` closes the pipe early."""
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
