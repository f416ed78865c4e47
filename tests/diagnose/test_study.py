"""Test the computations of the blind study (``tools/blind.py``), and a short run of it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from blind import PARTS, plan
from scipy.stats import norm
from study.deployment import CHARTS, LOSSES, MEMORY, charted, drawn, project, whiten
from study.ideal import SIZES, Draws, Span
from study.names import judge
from study.table import needed_size

from sitl import Twin, load

TOOLS = Path(__file__).parents[2] / "tools"


def test_projection_equals_a_solve_with_the_full_covariance() -> None:
    rng = np.random.default_rng(1)
    n, k = 300, 5
    A, X = rng.normal(size=(n, k)), rng.normal(size=(n, 2))
    prior = np.diag([0.1, 1.0, 10.0, 0.0, 1e-3]) * 0.1
    whole = np.eye(n) + A @ prior @ A.T
    np.testing.assert_allclose(project(X, A, prior), np.linalg.solve(whole, X), atol=1e-10)


def test_whitened_rows_with_gaps_keep_the_information() -> None:
    """Compare with the inverse covariance of the samples that exist, without the first row."""
    rng = np.random.default_rng(4)
    rows = np.flatnonzero(rng.random(80) > 0.3)
    covariance = MEMORY ** np.abs(rows[:, None] - rows)
    X = rng.normal(size=(len(rows), 3))
    white = whiten(X, "ar", rows)
    naive = X.T @ np.linalg.solve(covariance, X) - np.outer(X[0], X[0])
    np.testing.assert_allclose(white.T @ white, naive, rtol=1e-9)


def test_a_third_of_every_part_loses_samples() -> None:
    """In ``charted`` the vehicle surfaces in every log."""
    long = plan(2000)
    for name in PARTS:
        own = [entry["losses"] for entry in long if entry["part"] == name]
        if name == "charted":
            assert set(own) == {"surfacing"}
            continue
        assert sum(map(bool, own)) == pytest.approx(len(own) / 3, abs=0.02 * len(own) + 1)
        assert set(own) == {"", *LOSSES}


def test_a_continued_map_has_a_smaller_error() -> None:
    """An error that the reference had before is kept."""
    twin = Twin.draw(load("demo"), 3)
    track = twin.fly()
    ds = twin.measure(track, np.arange(0.0, track.elapsed[-1] - 1.0, 20.0))
    shifted = ds.assign(reference_field=ds["reference_field"] - 30.0)
    off = {}
    for reference in CHARTS:
        chart = drawn(twin, reference)
        wrong = charted(ds, chart)["reference_field"] - ds["truth_total_field"]
        rebuilt = charted(shifted, chart)["reference_field"] - ds["truth_total_field"]
        np.testing.assert_allclose(rebuilt, wrong - 30.0, atol=1e-6)
        off[reference] = float(np.std(wrong))
    assert 0.5 < off["map at its depth"] < 0.6 * off["map"]


def test_a_longer_study_contains_the_shorter_one() -> None:
    short, long = plan(200), plan(800)
    numbers = [entry["number"] for entry in long]
    assert len(set(numbers)) == len(numbers)
    assert {entry["number"] for entry in short} <= set(numbers)
    assert sum(part.share for part in PARTS.values()) == pytest.approx(1.0)
    assert {entry["part"] for entry in short} == set(PARTS)
    first = [entry["part"] for entry in long[: len(long) // 4]]
    for name, part in PARTS.items():  # the parts are mixed evenly
        assert first.count(name) == pytest.approx(part.share * len(first), abs=3)
    assert {entry["part"] for entry in plan(200, ("null",))} == {"null"}
    assert {entry["number"] for entry in plan(200, seed=1)}.isdisjoint(numbers)


def test_drawn_likelihood_ratios_equal_simulated_ones() -> None:
    """Compare mean and spread with least squares of two causes on simulated data."""
    rng = np.random.default_rng(6)
    A, B = rng.normal(size=(2, 60, 2))
    truth = A[:, 0] - B[:, 1] + rng.normal(size=60)
    X = np.column_stack([A, B, truth])
    spans = [Span("a", None, slice(0, 2)), Span("b", None, slice(2, 4))]
    draws = Draws.of(X.T @ X)
    one, other = draws.ratio(spans[0], 0.5), draws.conditional_on(spans[0]).ratio(spans[1], 0.5)
    ratio, freedom = one[0] + other[0], one[1] + other[1]
    data = 0.5 * truth[:, None] + rng.normal(size=(60, 4000))
    Q = np.linalg.qr(np.column_stack([A, B]))[0]
    naive = np.sum((Q.T @ data) ** 2, axis=0)
    assert freedom == 4
    assert np.mean(ratio) == pytest.approx(np.mean(naive), rel=0.1)
    assert np.std(ratio) == pytest.approx(np.std(naive), rel=0.15)


def test_p_values_show_a_detector_that_needs_more_signal() -> None:
    """The detector needs 10 % more than the ideal one in the same noise."""
    rng = np.random.default_rng(4)
    rows = []
    for a in rng.uniform(4.0, 8.0, 20):
        noise = rng.normal()
        here = [2.0 * norm.sf(size + noise) for size in SIZES]
        rows.append({"wanted": a, "p_value": 2.0 * norm.sf(a / 1.1 + noise), "theory": [{"here": here}]})
    factor, low, high = needed_size(rows) or (0.0, 0.0, 0.0)
    assert factor == pytest.approx(1.1, abs=0.005)
    assert low <= factor <= high < low + 0.02


def test_a_run_writes_the_table(tmp_path: Path) -> None:
    command = [TOOLS / "blind.py", "--cases", "10", "--part", "null", "--out", tmp_path]
    done = subprocess.run(
        [sys.executable, *map(str, command)], capture_output=True, text=True, timeout=240, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "| false alarms | 1 % |" in (tmp_path / "table.md").read_text()


def test_a_change_of_the_world_is_no_false_alarm() -> None:
    found = Mock(findings=[], wrong=True, possible=[], unexplained=None, verdict="explained")
    assert [judge(found, (), world)["false_alarm"] for world in ((), ["outliers"])] == [True, False]
    found.wrong = None
    assert judge(found, (), ["outliers"])["false_alarm"]
    found.verdict = "nothing_found"
    assert not judge(found, ())["false_alarm"]
