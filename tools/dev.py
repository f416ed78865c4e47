"""Set up and run magbridge from a checkout; Python 3.11 or newer is the only requirement.

    python3 tools/dev.py demo [ARG ...]     magbridge demo
    python3 tools/dev.py test [ARG ...]     the tests (pytest ARG ...)
    python3 tools/dev.py check              lint, format, types, import order, wording, names, size, site
    python3 tools/dev.py baseline --compare figures that changed since tools/baseline.json
    python3 tools/dev.py size               lines and modules of each part against its budget
    python3 tools/dev.py bench [ARG ...]    tools/bench.py

The first call makes ``.venv`` and installs the locked dependencies and the checkout itself, editable, into
it.
"""

from __future__ import annotations

import os
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
    ("python", "tools/collection.py"),
    ("mkdocs", "build", "--quiet", "--site-dir", ".site"),
    ("python", "tools/prose.py", "--gate"),
    ("python", "tools/names.py", "--gate"),
    ("python", "tools/commits.py"),
    ("python", "tools/size.py", "--gate"),
)


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


def main() -> None:
    """Run the command that the first argument names."""
    if sys.version_info < (3, 11):  # noqa: UP036 - users of an older version get a message
        sys.exit("magbridge needs Python 3.11 or newer")
    what, *arguments = sys.argv[1:] or ["help"]
    if what == "demo":
        install("analysis")
        run(BIN / "magbridge", "demo", *arguments)
    elif what == "test":
        install("dev")
        run_tests(BIN / "python", *arguments)
    elif what == "check":
        install("dev")
        for command in CHECKS:
            run(BIN / command[0], *command[1:])
    elif what == "baseline":
        install("dev")
        run(BIN / "python", "tools/baseline.py", *arguments)
    elif what == "size":
        run(sys.executable, "tools/size.py")
    elif what == "bench":
        install("dev")
        run(BIN / "python", "tools/bench.py", *arguments)
    else:
        sys.exit(__doc__)


if __name__ == "__main__":
    main()
