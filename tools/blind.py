"""The blind study: effects hidden in simulated deployments, which the detector must find without a hint.

Run it as ``python tools/blind.py --cases 800 --out study``; an interrupted study continues where it
stopped, and a longer one contains the shorter. ``--part null,named`` runs some of its parts.
``--scheduler ADDRESS`` uses an existing dask cluster (its workers start in a checkout); otherwise a local
one is made. Tables go to ``table.md``, figures beside.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # processes share the cores, not threads
sys.path.insert(0, str(Path(__file__).parent))

try:
    from distributed import Client, LocalCluster, as_completed
except ImportError:
    sys.exit("distributed is not installed: pip install '.[dev]', or python3 tools/dev.py check")
from study.cases import PARTS, plan
from study.figures import plot_confusion, plot_detection
from study.table import lines
from terminal import command_line

Row = dict[str, Any]


def read(log: Path) -> dict[int, Row]:
    """Return the cases that are done, by number; a truncated last line is not."""
    whole = log.read_text().splitlines(keepends=True) if log.exists() else []
    return {row["number"]: row for row in (json.loads(line) for line in whole if line.endswith("\n"))}


def case_there(folder: str, entry: Row) -> Row:
    """Run a case on a worker: a function of the main program travels by value, and finds the tools there."""
    if folder not in sys.path:
        sys.path.insert(0, folder)
    from study.cases import case  # noqa: PLC0415  (the worker's own)

    return case(entry)


def run(client: Client, todo: list[Row], log: Path) -> list[str]:
    """Run cases on a cluster; append each to the log as it comes. Returns what failed."""
    if log.exists() and not log.read_bytes().endswith(b"\n"):
        log.write_text(
            "".join(line for line in log.read_text().splitlines(keepends=True) if line.endswith("\n"))
        )
    failed = []
    began = time.monotonic()
    with log.open("a") as file:
        futures = {
            client.submit(case_there, str(Path(__file__).parent), entry, pure=False): entry for entry in todo
        }
        for k, future in enumerate(as_completed(futures), 1):
            error = future.exception()
            if error is None:
                file.write(json.dumps(future.result()) + "\n")
                file.flush()
            else:
                entry = futures[future]
                failed.append(f"{entry['part']} {entry['number']} {entry['names']}: {error!r}")
            future.release()
            left = (time.monotonic() - began) / k * (len(todo) - k) / 60.0
            print(f"\r{k} of {len(todo)}, {left:.0f} min left ", end="", file=sys.stderr)
    print(file=sys.stderr)
    return failed


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument(
        "--cases", type=int, default=800, help="cases of the whole study, shared among its parts"
    )
    parser.add_argument("--part", default=",".join(PARTS), help=f"parts to run, of {', '.join(PARTS)}")
    parser.add_argument("--seed", type=int, default=0, help="draws other vehicles, and everything else anew")
    parser.add_argument("--out", type=Path, default=Path("study"))
    parser.add_argument(
        "--scheduler", default="", help="address of a dask scheduler; a local cluster if not given"
    )
    parser.add_argument("--workers", type=int, default=2, help="processes of the local cluster")
    parser.add_argument(
        "--wait-for", type=int, default=1, help="workers that a scheduler must have before it starts"
    )
    options = parser.parse_args()
    parts = tuple(options.part.split(","))
    if not set(parts) <= set(PARTS):
        parser.error(f"--part: {options.part} is not among {', '.join(PARTS)}")
    options.out.mkdir(parents=True, exist_ok=True)
    log = options.out / "cases.jsonl"
    done = read(log)
    todo = [entry for entry in plan(options.cases, parts, options.seed) if entry["number"] not in done]
    print(f"{len(done)} cases done, {len(todo)} to do")
    if options.scheduler:
        with Client(options.scheduler) as client:
            client.wait_for_workers(options.wait_for, timeout=60)
            failed = run(client, todo, log)
    elif todo:
        with (
            LocalCluster(n_workers=options.workers, threads_per_worker=1, dashboard_address=None) as cluster,
            Client(cluster) as client,
        ):
            failed = run(client, todo, log)
    else:
        failed = []
    rows = [row for _, row in sorted(read(log).items())]
    text = "\n".join([*lines(rows), *(["", "failed:"] if failed else []), *failed])
    (options.out / "table.md").write_text(text + "\n")
    plot_confusion(rows, options.out / "confusion.png")
    plot_detection(rows, options.out / "detection.png")
    print(f"\n{text}")
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
