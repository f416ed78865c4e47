"""Test the output of a bridge that a user starts in a terminal."""

from __future__ import annotations

import os
import pty
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from small import bridge_text

from magbridge.calibration.file import save
from magbridge.calibration.model import identity

CONFIG = bridge_text(
    "hmr2300", "", port="/dev/ttyNo", url="udpout:127.0.0.1:9", masses={}, calibration=False, log=False
)


WANTED = ("until Ctrl-C", "no calibration: raw field", "hmr2300 lost: No such file or directory: /dev/ttyNo")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_terminal_gets_the_state_of_the_link(tmp_path: Path, number: signal.Signals) -> None:
    """The terminal shows the state until the bridge receives a signal or the terminal is closed."""
    with on_a_terminal(tmp_path, end=number) as terminal:
        read_until(terminal, WANTED)


def test_a_calibration_that_its_data_do_not_support_is_reported(tmp_path: Path) -> None:
    save(replace(identity(), method="nominal", warnings=("few headings",)), tmp_path / "cal.json")
    with on_a_terminal(tmp_path, '[calibration]\nfile = "cal.json"') as terminal:
        read_until(terminal, ("calibration is not supported by its data",))


def test_a_terminal_that_hangs_does_not_stop_the_bridge(tmp_path: Path) -> None:
    """Ctrl-S, or a connection that is gone: the bridge runs, and ends at a signal."""
    with on_a_terminal(tmp_path, '[log]\ndirectory = "."') as terminal:
        read_until(terminal, WANTED[:1])
        os.write(terminal, b"\x13")
        deadline = time.monotonic() + 60.0
        while not any(b"hmr2300 lost" in path.read_bytes() for path in tmp_path.glob("*.tlog")):
            assert time.monotonic() < deadline
            time.sleep(0.05)


def test_a_service_tells_the_journal_how_severe_it_is(tmp_path: Path) -> None:
    """To systemd's journal, standard error is a socket that JOURNAL_STREAM names."""
    (tmp_path / "bridge.toml").write_text(CONFIG)
    ours, theirs = socket.socketpair()
    end = theirs.fileno()
    status = os.fstat(end)
    environment = os.environ | {"JOURNAL_STREAM": f"{status.st_dev}:{status.st_ino}"}
    command = [sys.executable, "-m", "magbridge", "run", "--config", "bridge.toml"]
    with subprocess.Popen(command, cwd=tmp_path, stderr=end, env=environment) as process, theirs, ours:
        try:
            read_until(ours.fileno(), ("<4>no calibration: raw field\n", "<3>hmr2300 lost: No such file or"))
        finally:
            process.terminate()
    assert process.returncode == 0


@pytest.mark.parametrize("content", ['{"parameters": {"MB_GAP_F', None])
def test_kept_parameters_that_cannot_be_read_keep_no_vehicle_ashore(
    tmp_path: Path, content: str | None
) -> None:
    """An unreadable file is renamed; a folder of this name stays."""
    kept = tmp_path / "bridge.parameters.json"
    kept.write_text(content) if content else kept.mkdir()
    with on_a_terminal(tmp_path) as terminal:
        read_until(terminal, (*WANTED, "cannot be read, not used: bridge.parameters.json"))
    aside = tmp_path / "bridge.parameters.json.damaged"
    assert kept.is_dir() if content is None else aside.read_text() == content


@contextmanager
def on_a_terminal(folder: Path, more: str = "", end: signal.Signals = signal.SIGTERM) -> Iterator[int]:
    """Start a bridge on a terminal and yield the terminal's far end; end it by the signal `end`."""
    (folder / "bridge.toml").write_text(CONFIG + more)
    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "magbridge", "run", "--config", "bridge.toml"]
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    process = subprocess.Popen(command, cwd=folder, stderr=theirs, env=buffered)
    os.close(theirs)
    os.set_blocking(ours, False)
    try:
        yield ours
        process.send_signal(end)
        assert process.wait(30.0) == 0
    finally:
        process.kill()
        process.wait()
        os.close(ours)


def read_until(terminal: int, wanted: tuple[str, ...]) -> None:
    """Read until the whole text has come; a busy machine takes seconds to start a bridge."""
    seen, deadline = "", time.monotonic() + 60.0
    while not all(words in seen for words in wanted):
        assert time.monotonic() < deadline, seen
        if select.select([terminal], [], [], 0.05)[0]:
            seen += os.read(terminal, 4096).decode()
