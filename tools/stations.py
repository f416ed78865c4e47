"""Install the third-party programs of the interoperability tests into ``.peers``, separate from magbridge.

    python3 tools/stations.py

They are MAVProxy, MAVSDK and pymavlink's tools (Python, ``.peers/python``) and node-mavlink (npm,
``.peers/node``). Versions are pinned; programs of the right version are kept. The tool omits MAVProxy's maps
and plots (1 GB), which the modules that the tests load do not need.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import venv
from pathlib import Path

PEERS = Path(__file__).resolve().parents[1] / ".peers"
PYTHON = ("MAVProxy==1.8.75", "mavsdk==4.1.0", "pymavlink==2.4.50", "pyserial==3.5", "lxml==6.1.3")
NODE = ("node-mavlink@2.3.0",)


def run(*command: str | Path) -> None:
    """Run a command; exit with the command's exit code if the command fails."""
    code = subprocess.call([str(part) for part in command])
    if code:
        sys.exit(code)


def install(kind: str, wanted: tuple[str, ...], make: tuple[tuple[str | Path, ...], ...]) -> None:
    """Run the commands of `make`, unless they ran before for the same versions `wanted`."""
    done = PEERS / f"{kind}.txt"
    if done.is_file() and done.read_text() == "\n".join(wanted):
        return
    for command in make:
        run(*command)
    done.write_text("\n".join(wanted))


def main() -> None:
    PEERS.mkdir(exist_ok=True)
    python = PEERS / "python"
    if not (python / "bin" / "python").exists():
        venv.create(python, with_pip=True)
    pip = (python / "bin" / "python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check")
    install("python", PYTHON, ((*pip, "--no-deps", *PYTHON),))
    if shutil.which("npm") is None:
        print("npm is not here: node-mavlink is left out, and its test will be skipped")
        return
    npm = ("npm", "install", "--silent", "--no-audit", "--no-fund", "--prefix", PEERS / "node")
    install("node", NODE, ((*npm, *NODE),))


if __name__ == "__main__":
    main()
