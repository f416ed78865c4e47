"""Set up and run magbridge from a checkout, with nothing but Python 3.11 or newer.

    python3 tools/dev.py demo [ARG ...]     magbridge demo
    python3 tools/dev.py test [ARG ...]     the tests (pytest ARG ...)
    python3 tools/dev.py check              lint, format, types, import order

The first call makes ``.venv`` and installs the locked dependencies into it.
"""

from __future__ import annotations

import os
import subprocess
import sys
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
ENVIRONMENT = ROOT / ".venv"
BIN = ENVIRONMENT / ("Scripts" if os.name == "nt" else "bin")
UV = "uv==0.13.8"
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


def install(extra: str) -> None:
    """Bring ``.venv`` to what the lock file says, with one extra; what else is in it stays."""
    if not (BIN / "python").exists():
        venv.create(ENVIRONMENT, with_pip=True)
    if not (BIN / "uv").exists():
        run(BIN / "python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check", UV)
    run(
        BIN / "uv", "sync", "--quiet", "--locked", "--inexact", "--extra", extra,
        UV_PROJECT_ENVIRONMENT=str(ENVIRONMENT), VIRTUAL_ENV="", UV_PYTHON_DOWNLOADS="never",
    )  # fmt: skip


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
    else:
        sys.exit(__doc__)


if __name__ == "__main__":
    main()
