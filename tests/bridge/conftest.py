"""Fixtures of the fault tests: bridges with a simulated sensor and autopilot, and the table of results."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from rig import Rig

ROWS: list[tuple[str, str, str, str]] = []


@pytest.fixture(scope="module")
def table() -> Iterator[Callable[[str, str, str, str], None]]:
    """Yield a function that adds a row to the table of faults, in the file MAGBRIDGE_FAULTS."""

    def row(fault: str, meanwhile: str, well: str, lost: str) -> None:
        ROWS.append((fault, meanwhile, well, lost))

    yield row
    if path := os.environ.get("MAGBRIDGE_FAULTS"):
        header = (
            "fault",
            "what the bridge publishes meanwhile",
            "recovers after",
            "losses, and their counter",
        )
        lines = [header, ("---",) * 4, *ROWS]
        Path(path).write_text("".join(f"| {' | '.join(line)} |\n" for line in lines), encoding="utf-8")


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    """Yield a running bridge that all tests of a module share."""
    made = Rig(tmp_path_factory.mktemp("rig"))
    made.start()
    yield made
    made.close()


@pytest.fixture
def make_rig(tmp_path: Path) -> Iterator[Callable[..., Rig]]:
    """Yield a function that makes a bridge; the fixture closes all of them after the test."""
    made: list[Rig] = []

    def make(*arguments: Any, **settings: Any) -> Rig:
        folder = tmp_path / f"rig{len(made)}"
        folder.mkdir()
        made.append(Rig(folder, *arguments, **settings))
        return made[-1]

    yield make
    for rig in made:
        rig.close()
