"""The blind study: effects hidden in simulated deployments, which the detector must find without a hint.

Run it as ``python tools/blind.py --cases 800 --out study``; an interrupted study continues where it
stopped, and a longer one contains the shorter. ``--part null,named`` runs some of its parts.
``--scheduler ADDRESS`` uses an existing dask cluster, ``--workers N`` processes of this machine. Tables go
to ``table.md``, figures next to it.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from studies import add_engine, as_done, command_line
from study.cases import PARTS, case, plan
from study.figures import plot_confusion, plot_detection
from study.table import lines

Row = dict[str, Any]


def read(log: Path) -> dict[int, Row]:
    """Return the cases that are done, by number; a truncated last line is not."""
    whole = log.read_text().splitlines(keepends=True) if log.exists() else []
    return {row["number"]: row for row in (json.loads(line) for line in whole if line.endswith("\n"))}


def run(todo: list[Row], log: Path, options: argparse.Namespace) -> list[str]:
    """Run cases; append each to the log as it comes. Returns what failed."""
    if log.exists() and not log.read_bytes().endswith(b"\n"):
        log.write_text(
            "".join(line for line in log.read_text().splitlines(keepends=True) if line.endswith("\n"))
        )
    failed = []
    with log.open("a") as file:
        for (entry,), future in as_done(case, [(entry,) for entry in todo], options):
            error = future.exception()
            if error is None:
                file.write(json.dumps(future.result()) + "\n")
                file.flush()
            else:
                failed.append(f"{entry['part']} {entry['number']} {entry['names']}: {error!r}")
    return failed


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument(
        "--cases", type=int, default=800, help="cases of the whole study, shared among its parts"
    )
    parser.add_argument("--part", default=",".join(PARTS), help=f"parts to run, of {', '.join(PARTS)}")
    parser.add_argument("--seed", type=int, default=0, help="draws other vehicles, and everything else again")
    parser.add_argument("--out", type=Path, default=Path("study"))
    add_engine(parser)
    options = parser.parse_args()
    parts = tuple(options.part.split(","))
    if not set(parts) <= set(PARTS):
        parser.error(f"--part: {options.part} is not among {', '.join(PARTS)}")
    options.out.mkdir(parents=True, exist_ok=True)
    log = options.out / "cases.jsonl"
    done = read(log)
    todo = [entry for entry in plan(options.cases, parts, options.seed) if entry["number"] not in done]
    print(f"{len(done)} cases done, {len(todo)} to do")
    failed = run(todo, log, options)
    rows = [row for _, row in sorted(read(log).items())]
    text = "\n".join([*lines(rows), *(["", "failed:"] if failed else []), *failed])
    (options.out / "table.md").write_text(text + "\n")
    plot_confusion(rows, options.out / "confusion.png")
    plot_detection(rows, options.out / "detection.png")
    print(f"\n{text}")
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
