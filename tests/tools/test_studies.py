"""A study runs its cases, keeps their rows, and tabulates them."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from studies import Column, Row, Study


def run(kind: str, seed: int) -> list[Row]:
    if seed == 3:
        return [{"kind": kind, "error": np.nan, "failed": "no data"}]
    return [{"kind": kind, "error": float(seed), "failed": ""}]


STUDY = Study(run, ("kind",), {"median": Column("error"), "maximum": Column("error", np.max, ".1f")})


def test_rows_are_kept_and_cases_are_not_run_twice(tmp_path: Path) -> None:
    options = argparse.Namespace(workers=2, out=tmp_path / "rows.parquet")
    first = STUDY.rows([("a", 1), ("a", 2)], options)
    assert sorted(first["error"]) == [1.0, 2.0]
    marked = first.assign(error=first["error"] + 10.0)
    marked.to_parquet(options.out)
    again = STUDY.rows([("a", 1), ("a", 2), ("b", 3)], options)
    assert sorted(again["error"].dropna()) == [11.0, 12.0]
    shown = STUDY.table("test", again)
    cells = {column.header: list(column.cells) for column in shown.columns}
    assert cells == {
        "kind": ["a", "b"], "rows": ["2", "1"], "median": ["11.50", ""], "maximum": ["12.0", ""],
        "failed": ["", "1"],
    }  # fmt: skip
