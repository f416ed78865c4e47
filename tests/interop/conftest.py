"""What the interoperability tests share: the peers, and a bridge that lives on while they are asked."""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Thread

import pytest
from rig import Rig

PEERS = Path(__file__).parents[2] / ".peers"
MISSING = "not installed: python3 tools/stations.py"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.interop)


@pytest.fixture(scope="session")
def python() -> Path:
    """Return the interpreter that has MAVProxy and MAVSDK; their commands are in its folder."""
    found = PEERS / "python" / "bin" / "python"
    if not found.exists():
        pytest.skip(f"MAVProxy and MAVSDK are {MISSING}")
    return found


@pytest.fixture(scope="session")
def modules() -> Path:
    """Where npm put node-mavlink."""
    found = PEERS / "node" / "node_modules"
    if not (found / "node-mavlink").exists():
        pytest.skip(f"node-mavlink is {MISSING}")
    return found


class Peer:
    """A program that is asked on its stdin and answers on its stdout."""

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
        """Type a line."""
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()

    def until(self, text: str, since: int = 0, timeout: float = 30.0) -> str:
        """Play the rig until the program says `text`; return that line."""
        try:
            self._rig.until(lambda: any(text in line for line in self.lines[since:]), timeout)
        except AssertionError:
            raise AssertionError(f"never said {text!r}, but: " + "\n".join(self.lines[-60:])) from None
        return next(line for line in self.lines[since:] if text in line)

    def ask_until(self, line: str, text: str, timeout: float = 30.0) -> None:
        """Type a line again and again until the program says `text`: it may not have been ready before."""
        since, begun = len(self.lines), time.monotonic()
        while not any(text in texts for texts in self.lines[since:]):
            assert time.monotonic() - begun < timeout, "\n".join(self.lines[-60:])
            self.ask(line)
            self._rig.run(0.5)

    def answer(self, name: str) -> dict[str, object]:
        """Return what a script of ours tells of `name`: a line of JSON."""
        found: dict[str, object] = json.loads(self.until(f'{{"{name}":'))
        return found

    def end(self) -> None:
        """Close its stdin and wait for it."""
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
    """Start programs that end with the test."""
    started: list[Peer] = []

    def start(rig: Rig, command: list[str | Path]) -> Peer:
        started.append(Peer(rig, command, rig.folder))
        return started[-1]

    yield start
    for one in started:
        one.end()


@pytest.fixture
def make_rig(tmp_path: Path) -> Iterator[Callable[[str], Rig]]:
    """Start a bridge whose link is left to a peer."""
    made: list[Rig] = []

    def make(link: str) -> Rig:
        rig = Rig(tmp_path, link)
        rig.fluxgate.plug()
        rig.process = rig.spawn(rig.config)
        made.append(rig)
        return rig

    yield make
    for rig in made:
        rig.close()
