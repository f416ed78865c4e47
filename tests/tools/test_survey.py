"""The study of surveys: what it has flown it does not fly again."""

from __future__ import annotations

from pathlib import Path

from survey import Row, keep, kept


def test_a_glider_is_read_as_it_was_kept(tmp_path: Path) -> None:
    row = Row(6.0, 30.0, 1000.0, "1 nT white", 0.0, 7, ratio=1.02, seconds=9.5, failed="did not settle")
    keep(row, tmp_path / "rows.csv")
    keep(row._replace(seed=8), tmp_path / "rows.csv")
    again = kept(tmp_path / "rows.csv")
    assert [one.seed for one in again] == [7, 8]
    assert again[0][:7] == row[:7]
    assert (again[0].seconds, again[0].failed) == (9.5, "did not settle")
