"""How long a user waits for a command: from its start to its end, everything counted."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from statistics import median

from benchmarks.latency import BIN
from benchmarks.row import Row

from magbridge.logs import write
from sitl.scenario import load
from sitl.twin import simulate

__all__ = ["commands"]

ROWS = 2250
LIBRARIES = "import numpy, cyclopts, pandas, xarray, scipy.linalg, scipy.optimize"
"""What reads the file, fits and understands the command line."""


def commands(folder: Path, repetitions: int) -> list[Row]:
    """Time commands and an interpreter that only imports the libraries they stand on."""
    write(simulate(load("demo"), 1).isel(time=slice(ROWS)), folder / "runs.csv")
    asked = ("--parameter", "battpos", "--parameter", "ballast", "-o", str(folder / "cal.json"))
    measured: dict[str, tuple[list[str], str, float]] = {
        "processor time: magbridge --help": (
            [str(BIN / "magbridge"), "--help"], "import cyclopts, rich.console", 0.3
        ),
        "processor time: calibrate, a file that is not there": (
            [str(BIN / "magbridge"), "calibrate", "missing.csv", *asked], "import cyclopts", 0.3
        ),
        f"processor time: calibrate, a CSV of {ROWS} rows": (
            [str(BIN / "magbridge"), "calibrate", str(folder / "runs.csv"), *asked], LIBRARIES, 1.5
        ),
    }  # fmt: skip
    rows = []
    for what, (command, floor, most) in measured.items():
        times, bare = [], []
        for _ in range(repetitions + 1):  # the first fills the caches
            times.append(_spent(command))
            bare.append(_spent([sys.executable, "-c", floor]))
        rows.append(
            Row(what, median(times[1:]), "s", median(bare[1:]), floor, most=most)
        )  # fmt: skip
    return rows


def _spent(command: list[str]) -> float:
    """Return the processor time, s, of a command from its start to its end."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, _, used = os.wait4(process.pid, 0)
    process.returncode = 0
    return used.ru_utime + used.ru_stime
