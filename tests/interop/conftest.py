"""Fixtures of the interoperability tests: third-party programs, and a bridge to which they connect."""

import json
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Thread

import pytest
from rig import Rig

PEERS = Path(__file__).parents[2] / ".peers"
MISSING = "not installed: python3 tools/dev.py stations"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.interop)


@pytest.fixture(scope="session")
def python() -> Path:
    """Return the Python interpreter with MAVProxy and MAVSDK; their commands are in its folder."""
    found = PEERS / "python" / "bin" / "python"
    if not found.exists():
        pytest.skip(f"MAVProxy and MAVSDK are {MISSING}")
    return found


@pytest.fixture(scope="session")
def modules() -> Path:
    """Return the folder in which npm installed node-mavlink."""
    found = PEERS / "node" / "node_modules"
    if not (found / "node-mavlink").exists():
        pytest.skip(f"node-mavlink is {MISSING}")
    return found


class Peer:
    """Third-party process that reads requests on stdin and replies on stdout."""

    def __init__(self, rig: Rig, command: list[str | Path], folder: Path) -> None:
        self._rig = rig
        self.lines: list[str] = []
        self._process = subprocess.Popen(
            [str(part) for part in command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            cwd=folder,
            text=True,
            errors="replace",
            bufsize=1,
        )
        self._ear = Thread(target=self._listen, daemon=True)
        self._ear.start()

    def _listen(self) -> None:
        assert self._process.stdout is not None
        self.lines.extend(line.rstrip() for line in self._process.stdout)

    def ask(self, line: str) -> None:
        """Write a line to the program's stdin."""
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()

    def until(self, text: str, since: int = 0, timeout: float = 30.0) -> str:
        """Run the rig until the program prints `text`; return that line."""
        try:
            self._rig.until(lambda: any(text in line for line in self.lines[since:]), timeout)
        except AssertionError:
            raise AssertionError(f"never said {text!r}, but: " + "\n".join(self.lines[-60:])) from None
        return next(line for line in self.lines[since:] if text in line)

    def ask_until(self, line: str, text: str, timeout: float = 30.0) -> None:
        """Write a line every 0.5 s until the program prints `text`, because it may not be ready at first."""
        since, begun = len(self.lines), time.monotonic()
        while not any(text in texts for texts in self.lines[since:]):
            assert time.monotonic() - begun < timeout, "\n".join(self.lines[-60:])
            self.ask(line)
            self._rig.run(0.5)

    def answer(self, name: str) -> dict[str, object]:
        """Return the JSON object that the project's script prints for `name`."""
        found: dict[str, object] = json.loads(self.until(f'{{"{name}":'))
        return found

    def end(self) -> None:
        """Close the program's stdin and wait for its end."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._ear.join(10)
        assert self._process.stdout is not None
        self._process.stdout.close()


@pytest.fixture
def start_peer() -> Iterator[Callable[..., Peer]]:
    """Yield a function that starts a third-party program; the fixture ends all of them after the test."""
    started: list[Peer] = []

    def start(rig: Rig, command: list[str | Path]) -> Peer:
        started.append(Peer(rig, command, rig.folder))
        return started[-1]

    yield start
    for one in started:
        one.end()
