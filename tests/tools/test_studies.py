"""Test that a study runs its cases, stores their rows, and tabulates them."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
from studies import Column, Row, Study, fraction


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


def test_rows_have_the_order_of_the_cases(tmp_path: Path) -> None:
    options = argparse.Namespace(workers=2, out=tmp_path / "rows.parquet")
    STUDY.rows([("b", 2)], options)
    rows = STUDY.rows([("c", 5), ("b", 2), ("a", 4)], options)
    assert list(rows["kind"]) == ["c", "b", "a"]


def test_a_column_may_combine_columns_of_the_rows() -> None:
    rows = pd.DataFrame({"error": [2.0, 9.0, np.nan], "bound": [1.0, 3.0, 1.0]})
    ratio = Column(("error", "bound"), lambda values: float(np.max(values[:, 0] / values[:, 1])))
    assert ratio.cell(rows) == "3.00"
    assert ratio.cell(rows.drop(columns="bound")) == ""


def test_a_fraction_has_an_interval() -> None:
    assert fraction([True, *[False] * 99]) == "1.0 % (0.0-5.4) | 1/100"
    assert fraction([]) == "not run | 0"
