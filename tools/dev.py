"""Set up and run magbridge from a checkout, with nothing but Python 3.11 or newer.

    python3 tools/dev.py demo [ARG ...]     magbridge demo
    python3 tools/dev.py test [ARG ...]     the tests (pytest ARG ...)
    python3 tools/dev.py check              lint, format, types, import order
    python3 tools/dev.py compiled [ARG ...] the live path's tests, compiled
    python3 tools/dev.py bench [ARG ...]    tools/bench.py, compiled

The first call makes ``.venv`` and installs the locked dependencies into it; what is edited is what runs there. The
last two install the package as a user would, compiled where there is a C compiler, into ``.compiled``.
"""

from __future__ import annotations

import os
import subprocess
import sys
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = "Scripts" if os.name == "nt" else "bin"
BIN, COMPILED = ROOT / ".venv" / SCRIPTS, ROOT / ".compiled" / SCRIPTS
UV = "uv==0.13.8"
LIVE = (
    "tests/test_align.py", "tests/bridge", "tests/calibration/test_correct.py", "tests/link", "tests/mavlink",
    "tests/sensors", "tests/sitl/test_replay.py",
)  # fmt: skip
CHECKS = (
    ("ruff", "check", "."),
    ("ruff", "format", "--check", "."),
    ("mypy",),
    ("lint-imports", "--no-cache"),
)


def run(*command: str | Path, **variables: str) -> None:
    """Run a command in the checkout; end with its exit code when it fails."""
    code = subprocess.call([str(part) for part in command], cwd=ROOT, env={**os.environ, **variables})
    if code:
        sys.exit(code)


def install(extra: str, place: Path = BIN, *options: str) -> None:
    """Bring an environment to what the lock file says, with one extra; what else is in it stays."""
    if not (BIN / "python").exists():
        venv.create(BIN.parent, with_pip=True)
    if not (BIN / "uv").exists():
        run(BIN / "python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check", UV)
    run(
        BIN / "uv", "sync", "--quiet", "--locked", "--inexact", "--extra", extra, *options,
        UV_PROJECT_ENVIRONMENT=str(place.parent), VIRTUAL_ENV="", UV_PYTHON_DOWNLOADS="never",
    )  # fmt: skip


def run_compiled(*command: str | Path) -> None:
    """Run Python with the package that is installed, and not with the checkout around it."""
    install("dev", COMPILED, "--no-editable", "--reinstall-package", "magbridge")
    run(COMPILED / "python", *command, PYTHONSAFEPATH="1", PYTHONPATH=str(ROOT / "tools"))


def main() -> None:
    """Do what the first argument says."""
    if sys.version_info < (3, 11):  # noqa: UP036 - whoever runs an older one must be told
        sys.exit("magbridge needs Python 3.11 or newer")
    what, *arguments = sys.argv[1:] or ["help"]
    if what == "demo":
        install("analysis")
        run(BIN / "magbridge", "demo", *arguments)
    elif what == "test":
        install("dev")
        run(BIN / "python", "-m", "pytest", "-n", "2", "--dist", "loadfile", *arguments)
    elif what == "check":
        install("dev")
        for command in CHECKS:
            run(BIN / command[0], *command[1:])
    elif what == "compiled":
        run_compiled("-m", "pytest", "-n", "2", "--dist", "loadfile", *(arguments or LIVE))
    elif what == "bench":
        run_compiled("tools/bench.py", *arguments)
    else:
        sys.exit(__doc__)


if __name__ == "__main__":
    main()
