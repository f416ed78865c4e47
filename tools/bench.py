"""Measure speed and memory, each next to a floor: the same task by a minimal program.

    python3 tools/dev.py bench                      everything: some minutes
    python3 tools/dev.py bench processor start      the named benchmarks
    python3 tools/dev.py bench --table FILE.md      also as a table in Markdown, with date, commit and load

Repetitions of the program and of its floor alternate, so that a busy machine slows both; the table has
medians. Processor time and ratios hold on a busy machine, but latencies do not. The table therefore states
the load average, and the largest latencies of the floor.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import tempfile
from datetime import date
from importlib import import_module
from pathlib import Path
from typing import Any

from benchmarks.row import Row
from studies import command_line

from magbridge.version import __version__

BENCHMARKS: dict[str, tuple[str, int]] = {
    "processor": ("benchmarks.processor:processor", 15),
    "latency": ("benchmarks.latency:latency", 5),
    "start": ("benchmarks.latency:start", 5),
    "learning": ("benchmarks.processor:learning", 5),
    "commands": ("benchmarks.latency:commands", 7),
    "fitting": ("benchmarks.offline:fitting", 3),
    "correcting": ("benchmarks.offline:correcting", 5),
    "diagnosing": ("benchmarks.offline:diagnosing", 1),
}
"""Benchmark's name to ``module:function`` and repetitions; the function takes a folder and this number."""


def measure(name: str, factor: float) -> dict[str, Any]:
    """Run one benchmark; return its rows, and the load before and after."""
    place, repetitions = BENCHMARKS[name]
    module, _, function = place.partition(":")
    before = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as folder:
        count = max(1, round(repetitions * factor))
        rows: list[Row] = getattr(import_module(module), function)(Path(folder), count)
    return {"name": name, "load": (before, os.getloadavg()[0]), "rows": rows}


def markdown(results: list[dict[str, Any]]) -> str:
    """Return a Markdown table of the results, below version, commit, date, load and machine."""
    git = ["git", "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip() or "no commit"
    loads = [load for result in results for load in result["load"]]
    lines = [
        f"Version {__version__}, commit {commit}, {date.today()}, load {min(loads):.1f} to {max(loads):.1f}.",
        f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}.",
        "",
        "| quantity | magbridge | floor | target |",
        "|---|---|---|---|",
    ]
    for row in (row for result in results for row in result["rows"]):
        floor = f"{row.floor_is}: {row.floor:.3g} {row.unit}" if row.floor is not None else ""
        target = f"at least {row.least:g}" if row.least else ""
        if row.most is not None:
            target = f"at most {row.most:g}"
        value = f"{row.value:.3g} {row.unit}"
        if row.ratio is not None:
            value, target = f"{value}, ratio {row.ratio:.2f}", f"ratio {target}"
        lines.append(f"| {row.what} | {value} | {floor} | {target} |")
    return "\n".join(lines) + "\n"


def main() -> int:
    chosen = command_line(__doc__, BENCHMARKS, table=Path, factor=1.0)
    results = []
    for name in chosen.names:
        print(f"{name} ...", file=sys.stderr)
        results.append(measure(name, chosen.factor))
    text = markdown(results)
    if chosen.table:
        chosen.table.write_text(text, encoding="utf-8")
    print(text)
    missed = [row.what for result in results for row in result["rows"] if row.holds is False]
    print(*(f"misses its target: {what}" for what in missed), sep="\n")
    return int(bool(missed))


if __name__ == "__main__":
    sys.exit(main())
