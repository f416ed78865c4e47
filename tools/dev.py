"""Set up and run magbridge from a checkout; Python 3.11 or newer is the only requirement.

    python3 tools/dev.py demo [ARG ...]     magbridge demo
    python3 tools/dev.py test [ARG ...]     the tests (pytest ARG ...)
    python3 tools/dev.py check              lint, format, types, import order, wording, names, size, site
    python3 tools/dev.py baseline --compare figures that changed since tools/baseline.json
    python3 tools/dev.py size               lines and modules of each part against its budget
    python3 tools/dev.py bench [ARG ...]    tools/bench.py
    python3 tools/dev.py stations           third-party programs of the interoperability tests, into .peers

The first call makes ``.venv`` and installs the locked dependencies and the checkout itself, editable, into
it.
"""

from __future__ import annotations

import os
import shutil
import ssl
import subprocess
import sys
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = "Scripts" if os.name == "nt" else "bin"
BIN = ROOT / ".venv" / SCRIPTS
UV = "uv==0.13.8"
REAL_TIME = ("tests/bridge", "tests/sitl", "tests/interop", "tests/monitor")
"""Folders whose tests run in real time, against pseudo-terminals and sockets."""
CHECKS = (
    ("ruff", "check", "."),
    ("ruff", "format", "--check", "."),
    ("mypy",),
    ("lint-imports", "--no-cache"),
    ("mkdocs", "build", "--quiet", "--site-dir", ".site"),
    ("python", "tools/prose.py", "--gate"),
    ("python", "tools/names.py", "--gate"),
    ("python", "tools/commits.py"),
    ("python", "tools/size.py", "--gate"),
)


STATIONS = ROOT / ".peers"
PYTHON_STATIONS = "MAVProxy==1.8.75", "mavsdk==4.1.0", "pymavlink==2.4.50", "pyserial==3.5", "lxml==6.1.3"
NODE_STATIONS = ("node-mavlink@2.3.0",)


def call(*command: str | Path, **variables: str) -> int:
    """Run a command in the checkout; return its exit code."""
    return subprocess.call([str(part) for part in command], cwd=ROOT, env={**os.environ, **variables})


def run(*command: str | Path, **variables: str) -> None:
    """Run a command in the checkout; exit with the command's exit code if the command fails."""
    if code := call(*command, **variables):
        sys.exit(code)


def run_tests(python: Path, *arguments: str) -> None:
    """Run the tests in two processes: first the tests that only compute, then the tests in real time.

    A test in real time would compete for the processor with a computing test. Two tests in real time mostly
    wait.
    """
    if arguments:
        run(python, "-m", "pytest", *arguments)
        return
    ignored = [f"--ignore={folder}" for folder in REAL_TIME]
    two_at_a_time = (python, "-m", "pytest", "-n", "2", "--dist", "loadfile")
    codes = [call(*two_at_a_time, *ignored), call(*two_at_a_time, *REAL_TIME)]
    sys.exit(max(codes))


def install(extra: str) -> None:
    """Install the locked dependencies with one extra into ``.venv``, and keep other packages in it.

    The function also compiles the checkout to bytecode. Otherwise, each start of the program would compile
    all modules again if PYTHONDONTWRITEBYTECODE is set.
    """
    if not (BIN / "python").exists():
        venv.create(BIN.parent, with_pip=True)
    if not (BIN / "uv").exists():
        run(BIN / "python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check", UV)
    known = ssl.get_default_verify_paths()  # only the system's store has a proxy's certificate
    run(
        BIN / "uv", "sync", "--quiet", "--locked", "--inexact", "--compile-bytecode",
        "--extra", extra,
        UV_PROJECT_ENVIRONMENT=str(BIN.parent), VIRTUAL_ENV="", UV_PYTHON_DOWNLOADS="never",
        UV_SYSTEM_CERTS=str(bool(known.cafile or known.capath)).lower(),
    )  # fmt: skip
    run(BIN / "python", "-m", "compileall", "-q", "magbridge", "sitl")


def install_stations() -> None:
    """Install MAVProxy, MAVSDK, pymavlink's tools and node-mavlink in their pinned versions into ``.peers``.

    Programs of the right version are kept. MAVProxy's maps and plots (1 GB), which the modules that the tests
    load do not need, are left out.
    """
    python = STATIONS / "python" / SCRIPTS / "python"
    if not python.exists():
        venv.create(python.parents[1], with_pip=True)
    pip = (python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps")
    npm = ("npm", "install", "--silent", "--no-audit", "--no-fund", "--prefix", STATIONS / "node")
    for kind, command, wanted in (("python", pip, PYTHON_STATIONS), ("node", npm, NODE_STATIONS)):
        done = STATIONS / f"{kind}.txt"
        if done.is_file() and done.read_text() == "\n".join(wanted):
            continue
        if kind == "node" and shutil.which("npm") is None:
            print("npm is not here: node-mavlink is left out, and its test will be skipped")
            continue
        run(*command, *wanted)
        done.write_text("\n".join(wanted))


def main() -> None:
    """Run the command that the first argument names."""
    if sys.version_info < (3, 11):  # noqa: UP036 - users of an older version get a message
        sys.exit("magbridge needs Python 3.11 or newer")
    what, *arguments = sys.argv[1:] or ["help"]
    programs: dict[str, tuple[str | Path, ...]] = {
        "demo": (BIN / "magbridge", "demo"),
        "baseline": (BIN / "python", "tools/baseline.py"),
        "bench": (BIN / "python", "tools/bench.py"),
    }
    if what in (*programs, "test", "check"):
        install("analysis" if what == "demo" else "dev")
    if what in programs:
        run(*programs[what], *arguments)
    elif what == "test":
        run_tests(BIN / "python", *arguments)
    elif what == "check":
        for command in CHECKS:
            run(BIN / command[0], *command[1:])
    elif what == "stations":
        install_stations()
    elif what == "size":
        run(sys.executable, "tools/size.py")
    else:
        sys.exit(__doc__)


if __name__ == "__main__":
    main()
