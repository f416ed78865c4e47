"""Fixtures of the fault tests: bridges with a simulated sensor and autopilot, and the record of results."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from checks import Measured
from rig import Rig


@pytest.fixture
def measured(request: pytest.FixtureRequest) -> Measured:
    """Return a function that appends the test's name and what it measured to the file MAGBRIDGE_FAULTS."""

    def record(**values: float) -> None:
        if path := os.environ.get("MAGBRIDGE_FAULTS"):
            with Path(path).open("a", encoding="utf-8") as file:
                shown = ", ".join(f"{name} {value:.4g}" for name, value in values.items())
                file.write(f"{request.node.name}: {shown}\n")

    return record


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    """Yield a running bridge that all tests of a module share."""
    made = Rig(tmp_path_factory.mktemp("rig"))
    made.start()
    yield made
    made.close()
