"""Fixtures of the whole test suite."""

import os
import shutil
import signal
import tempfile
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from importlib.util import module_from_spec, spec_from_file_location
from io import StringIO
from pathlib import Path
from types import ModuleType
from typing import Any

# BLAS threads slow such narrow matrices down, more so if several pytest workers run
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pymavlink
import pytest
from commands import Command
from hypothesis import settings
from pymavlink.generator import mavgen

from magbridge import mavlink
from magbridge.parts import OptionalParts

# generate the same examples in every run, and fail none because the machine is busy
settings.register_profile("magbridge", deadline=None, derandomize=True)
settings.load_profile("magbridge")

MAX_ID_LENGTH = 80
"""Maximum number of characters of a text that becomes part of a test's id."""


def pytest_make_parametrize_id(val: object, argname: str) -> str | None:
    """Return the argument's name as the id of bytes and long texts; pytest appends the index."""
    if isinstance(val, bytes) or (isinstance(val, str) and len(val) > MAX_ID_LENGTH):
        return argname
    return None


@pytest.fixture(scope="session", autouse=True)
def exceptions_pass_through() -> Iterator[None]:
    """Propagate exceptions of the live path's optional parts, so that a test sees them."""
    OptionalParts.propagate = True
    yield
    OptionalParts.propagate = False


@pytest.fixture(scope="session", autouse=True)
def signals_are_heard() -> Iterator[None]:
    """Restore the handlers of SIGINT and SIGHUP, which a background job ignores and its children inherit."""
    wanted: dict[int, Any] = {signal.SIGINT: signal.default_int_handler, signal.SIGHUP: signal.SIG_DFL}
    before = {number: signal.signal(number, handler) for number, handler in wanted.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Return the folder of measured data, which is outside the repository; skip the test if it is missing."""
    beside = Path(__file__).parents[2] / "shared" / "data"
    for candidate in (os.environ.get("MAGBRIDGE_REAL_DATA", ""), beside):
        if candidate and Path(candidate).is_dir():
            return Path(candidate)
    pytest.skip("no measured data: set MAGBRIDGE_REAL_DATA or put them in ../shared/data")


@pytest.fixture(scope="session")
def cases() -> Path:
    """Return the folder of inputs on which the program once failed; skip the test if it is missing."""
    folder = Path(__file__).parents[2] / "shared" / "cases"
    if not folder.is_dir():
        pytest.skip("no failing inputs in ../shared/cases")
    return folder


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Change to an empty folder and return it."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str], here: Path) -> Command:
    return Command(capsys)


@pytest.fixture
def make_rig(tmp_path: Path) -> Iterator[Callable[..., Any]]:
    """Yield a function that makes a bridge with simulated devices; the fixture closes all of them."""
    from rig import Rig  # noqa: PLC0415 - few tests need it

    made: list[Rig] = []

    def make(*arguments: Any, **settings: Any) -> Rig:
        folder = tmp_path / f"rig{len(made)}"
        folder.mkdir()
        made.append(Rig(folder, *arguments, **settings))
        return made[-1]

    yield make
    for rig in made:
        rig.close()


@pytest.fixture(scope="session")
def peer() -> ModuleType:
    """Return the message classes that pymavlink's mavgen generates from the project's XML dialect."""
    with tempfile.TemporaryDirectory() as name, redirect_stdout(StringIO()):
        folder = Path(name)
        shutil.copy(Path(mavlink.__file__).with_name("magbridge.xml"), folder)
        for included in ("common", "standard", "minimal"):
            shutil.copy(Path(pymavlink.__file__).parent / "dialects" / "v20" / f"{included}.xml", folder)
        options = mavgen.Opts(str(folder / "peer"), wire_protocol="2.0", language="Python3")
        if not mavgen.mavgen(options, [str(folder / "magbridge.xml")]):
            raise RuntimeError("mavgen refused magbridge.xml")
        place = spec_from_file_location("peer", folder / "peer.py")
        assert place is not None
        assert place.loader is not None
        module = module_from_spec(place)
        place.loader.exec_module(module)
    return module
