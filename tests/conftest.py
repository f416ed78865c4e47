"""Fixtures of the whole test suite."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

# on matrices this narrow threads only wait for each other, and for those of a second worker
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from benchmarks.peer import classes
from commands import Command
from hypothesis import settings

from magbridge.parts import OptionalParts

# the same examples every time, and none fails because the machine is busy
settings.register_profile("magbridge", deadline=None, derandomize=True)
settings.load_profile("magbridge")

MAX_ID_LENGTH = 80
"""Characters of a parameter that may be part of a test's id."""


def pytest_make_parametrize_id(val: object, argname: str) -> str | None:
    """Return the parameter's name for bytes and long texts; pytest adds the index."""
    if isinstance(val, bytes) or (isinstance(val, str) and len(val) > MAX_ID_LENGTH):
        return argname
    return None


@pytest.fixture(scope="session", autouse=True)
def exceptions_pass_through() -> Iterator[None]:
    """Switch off the net under the live path's optional parts, so that it hides no fault from a test."""
    OptionalParts.propagate = True
    yield
    OptionalParts.propagate = False


@pytest.fixture(scope="session", autouse=True)
def signals_are_heard() -> Iterator[None]:
    """A background job ignores Ctrl-C, one under nohup a closed terminal, and so does all that they start."""
    wanted: dict[int, Any] = {signal.SIGINT: signal.default_int_handler, signal.SIGHUP: signal.SIG_DFL}
    before = {number: signal.signal(number, handler) for number, handler in wanted.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of measured data, kept outside the project."""
    for candidate in (
        os.environ.get("MAGBRIDGE_REAL_DATA", ""),
        Path(__file__).parents[2] / "shared" / "data",
    ):
        if candidate and Path(candidate).is_dir():
            return Path(candidate)
    pytest.skip("no measured data: set MAGBRIDGE_REAL_DATA or put them in ../shared/data")


@pytest.fixture(scope="session")
def cases() -> Path:
    """Folder of inputs on which the program once failed, next to the measured data."""
    folder = Path(__file__).parents[2] / "shared" / "cases"
    if not folder.is_dir():
        pytest.skip("no failing inputs in ../shared/cases")
    return folder


@pytest.fixture(scope="session")
def peer() -> ModuleType:
    """Our dialect as a ground station has it: classes that pymavlink's mavgen makes from our XML."""
    return classes()


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder in which a command runs: empty."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str], here: Path) -> Command:
    return Command(capsys)
