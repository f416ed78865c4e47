"""Hide effects in simulated deployments, and count how often ``diagnose`` finds and names them unaided.

    python tools/blind.py --cases 800 --out study
    python tools/blind.py --cases 250 --part null,named --seed 1409

An interrupted study continues where it stopped, and a longer one contains the shorter one. Table and plots
are written to the folder ``--out``.
"""

from __future__ import annotations

import json
from pathlib import Path

from studies import Row, Study, command_line
from study.cases import PARTS, case, plan
from study.table import lines, plot_confusion, plot_detection


def run(entry: Row) -> list[Row]:
    """Run a case; return its part and its result as JSON, because the result is nested."""
    return [{"part": entry["part"], "row": json.dumps(case(entry))}]


def main() -> None:
    """Run the cases, and write table and plots."""
    options = command_line(__doc__, cases=800, part=",".join(PARTS), seed=0, out=Path("study"), workers=2)
    folder = options.out
    folder.mkdir(parents=True, exist_ok=True)
    options.out = folder / "cases.parquet"
    cases = [(entry,) for entry in plan(options.cases, tuple(options.part.split(",")), options.seed)]
    kept = Study(run, ("part",), {}).rows(cases, options)
    rows = sorted((json.loads(row) for row in kept["row"]), key=lambda row: row["number"])
    text = "\n".join(lines(rows))
    (folder / "table.md").write_text(text + "\n")
    plot_confusion(rows, folder / "confusion.png")
    plot_detection(rows, folder / "detection.png")
    print(text)


if __name__ == "__main__":
    main()
