"""Files are whole or not there, whatever happens to the process that writes them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from magbridge.errors import WriteError
from magbridge.files import atomic_path, new_folder

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


def test_no_folder_is_one_line(tmp_path: Path) -> None:
    with (
        pytest.raises(WriteError, match=os.strerror(2)),
        atomic_path(tmp_path / "no" / "a.json") as temporary,
    ):
        temporary.write_text("")


@pytest.mark.parametrize(("name", "left"), [("new/doubt", []), (".", ["half"])])
def test_a_folder_that_was_made_goes_with_what_raised_and_one_that_was_there_stays(
    tmp_path: Path, name: str, left: list[str]
) -> None:
    with pytest.raises(ZeroDivisionError), new_folder(tmp_path / name) as folder:
        (folder / "whole").write_text(str(1 // (folder / "half").write_text("")))
    assert [path.name for path in tmp_path.iterdir()] == left
