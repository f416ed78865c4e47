"""The blind study's own arithmetic, and its run on a cluster of two processes."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm
from study.both import by_causes, held, named, weighed
from study.cases import PARTS, plan
from study.deployment import CHARTS, charted, drawn, project
from study.draws import SHOWN, Draws, Span, evidence, with_another
from study.nameless import against, nameless
from study.noise import LOSSES, MEMORY, kept_rows, whiten
from study.rates import against_ideal, efficiency, share
from study.table import lines
from study.theory import SIZES

from magbridge.diagnose.descriptions import Description
from magbridge.diagnose.evidence import log_bayes
from sitl import Twin, load
from sitl.signals import correlated

TOOLS = Path(__file__).parents[2] / "tools"


def test_what_a_free_calibration_absorbs_against_the_naive_way() -> None:
    rng = np.random.default_rng(1)
    n, k = 300, 5
    A, X = rng.normal(size=(n, k)), rng.normal(size=(n, 2))
    prior = np.diag([0.1, 1.0, 10.0, 0.0, 1e-3]) * 0.1
    whole = np.eye(n) + A @ prior @ A.T
    np.testing.assert_allclose(project(X, A, prior), np.linalg.solve(whole, X), atol=1e-10)


def test_whitened_noise_is_white() -> None:
    rng = np.random.default_rng(2)
    noise = correlated(rng.normal(size=(20_000, 1)), MEMORY)[:, 0]
    assert np.std(noise) == pytest.approx(1.0, abs=0.03)
    for losses in ("", *LOSSES):
        rows = kept_rows(losses, len(noise), 3)
        white = whiten(noise[rows], "ar", rows)
        assert np.std(white) == pytest.approx(1.0, abs=0.02)
        assert abs(np.mean(white[1:] * white[:-1])) < 0.02
    every = np.arange(20_000)
    assert np.std(whiten(1.5 * rng.normal(size=20_000), "half", every)) == pytest.approx(1.0, abs=0.02)


def test_what_the_losses_leave_is_what_theory_knows() -> None:
    """Against the inverse of the existing samples' covariance, but for the first row, which has no past."""
    rng = np.random.default_rng(4)
    rows = np.flatnonzero(rng.random(80) > 0.3)
    covariance = MEMORY ** np.abs(rows[:, None] - rows)
    X = rng.normal(size=(len(rows), 3))
    white = whiten(X, "ar", rows)
    naive = X.T @ np.linalg.solve(covariance, X) - np.outer(X[0], X[0])
    np.testing.assert_allclose(white.T @ white, naive, rtol=1e-9)


def test_a_third_of_every_part_loses_samples() -> None:
    """But where the vehicle surfaces in every log."""
    long = plan(2000)
    for name in PARTS:
        own = [entry["losses"] for entry in long if entry["part"] == name]
        if name == "charted":
            assert set(own) == {"surfacing"}
            continue
        assert sum(map(bool, own)) == pytest.approx(len(own) / 3, abs=0.02 * len(own) + 1)
        assert set(own) == {"", *LOSSES}


def test_a_dive_loses_as_much_as_the_next() -> None:
    rows = kept_rows("surfacing", 5000, 5)
    gone = np.diff(rows)[np.diff(rows) > 1]
    assert set(gone) == {12}
    assert np.ptp(np.diff(np.flatnonzero(np.diff(rows) > 1))) <= 1
    assert 15 <= len(gone) <= 100


def test_a_map_is_off_and_less_so_at_its_depth() -> None:
    """And what a reference was off before it still is."""
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


def test_a_longer_study_holds_the_shorter_and_every_part_has_its_share() -> None:
    short, long = plan(200), plan(800)
    numbers = [entry["number"] for entry in long]
    assert len(set(numbers)) == len(numbers)
    assert {entry["number"] for entry in short} <= set(numbers)
    assert sum(part.share for part in PARTS.values()) == pytest.approx(1.0)
    assert {entry["part"] for entry in short} == set(PARTS)
    first = [entry["part"] for entry in long[: len(long) // 4]]
    for name, part in PARTS.items():  # no part waits for another
        assert first.count(name) == pytest.approx(part.share * len(first), abs=3)
    assert {entry["part"] for entry in plan(200, ("null",))} == {"null"}


def test_another_seed_shares_nothing() -> None:
    numbers = [{entry["number"] for entry in plan(200, seed=seed)} for seed in (0, 1)]
    assert numbers[0].isdisjoint(numbers[1])
    assert len(numbers[0]) == len(numbers[1])


def test_two_rivals_imitate_what_neither_does_alone() -> None:
    """Against least squares: what the best competing cause and its best companion leave of the truth."""
    rng = np.random.default_rng(5)
    A, B, other = rng.normal(size=(3, 60, 2))
    truth = A[:, 0] + B[:, 1] + 0.2 * rng.normal(size=60)
    X = np.column_stack([A, B, other, truth])
    spans = [Span("a", None, slice(0, 2), 0.0), Span("b", None, slice(2, 4), 0.0)]
    residual = with_another(Draws.of(X.T @ X), spans[0], spans)
    for cause, columns in (("a", A), ("b", np.column_stack([A, B]))):
        naive = truth - columns @ np.linalg.lstsq(columns, truth, rcond=None)[0]
        assert residual[cause][0] == pytest.approx(np.linalg.norm(naive), rel=1e-6)


def test_likelihood_ratios_are_drawn_without_any_data() -> None:
    """Against least squares on simulated data: mean and scatter of what two causes together explain."""
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


def test_two_are_named_unless_another_whole_says_the_same() -> None:
    """By one cause that swallows both, or by two others; and the set holds what cannot be told from them."""
    one, two, both, else_ = 10.0 * np.linalg.qr(np.random.default_rng(8).normal(size=(60, 4)))[0].T
    look_elsewhere = dict.fromkeys("abcd", 1.0)

    def chances(*columns: tuple[str, np.ndarray]) -> tuple[float, float]:
        X = np.column_stack([*(column for _, column in columns), one + two])
        spans = [Span(name, None, slice(k, k + 1)) for k, (name, _) in enumerate(columns)]
        wholes = by_causes(weighed(Draws.of(X.T @ X), spans, spans, look_elsewhere))
        return named(wholes, frozenset("ab")), held(wholes, frozenset("ab"))

    truth = (("a", one), ("b", two))
    assert chances(*truth, ("c", both), ("d", else_)) == (1.0, 1.0)
    assert chances(*truth, ("c", one + two)) < (0.05, 0.05)  # one cause is likelier than two that say no more
    first, inside = chances(*truth, ("c", one + 0.01 * else_))
    assert first == pytest.approx(0.5, abs=0.1)
    assert inside == 1.0
    assert chances(("c", both), ("d", else_)) == (0.0, 0.0)


def nameless_chances(apart: float) -> dict[str, float]:
    """Of a truth of three numbers, at S/N 10, one name of three leaves so much; 27 hold it in twenty ways."""
    wanted, X = 10.0, np.zeros((31, 31))
    X[:30, :30] = np.eye(30)
    X[27, 30], X[0, 30] = np.sqrt(wanted**2 - apart**2), apart
    X[:, 0] = X[:, 30] / wanted
    draws, name = Draws.of(X.T @ X), Span("other", None, slice(27, 30))
    ratio, freedom = draws.ratio(name)
    needed = against(draws, {"other": log_bayes(ratio, freedom)}, [], {})
    free = Description(lambda rows: X[rows, :27], (("drift", np.ones(27)),) * 20)
    truth = Span("truth", SHOWN, slice(30, 31), more=2)
    return nameless(draws, evidence(truth, *draws.ratio(truth)), needed, [free])


def test_what_has_no_name_must_beat_the_names() -> None:
    """The chance grows with what the best name leaves, and no description does better."""
    chances = [nameless_chances(apart) for apart in (0.0, 3.0, 4.5, 6.0, 8.0, 9.9)]
    unnamed, described = ([chance[key] for chance in chances] for key in ("unnamed", "described"))
    assert unnamed == sorted(unnamed)
    assert unnamed[0] < 0.05
    assert unnamed[1] < 0.8
    assert unnamed[-1] == 1.0
    assert all(a <= b for a, b in zip(described, unnamed, strict=True))
    assert nameless_chances(4.8)["unnamed"] == pytest.approx(0.95, abs=0.03)


def test_the_point_of_half_detection_is_read_off_a_ladder() -> None:
    rng = np.random.default_rng(3)
    a = rng.uniform(2.0, 8.0, 2000)
    rows = [
        {
            "wanted": x,
            "theory": [{"half": 4.0, "sure": 5.6}],
            "verdict": "explained" if x / 1.2 + rng.normal() * 0.97 > 4.0 else "nothing_found",
        }
        for x in a
    ]
    factor, low, high = efficiency(rows) or (0.0, 0.0, 0.0)
    assert factor == pytest.approx(1.2, abs=0.03)
    assert low < factor < high < low + 0.06


def test_a_detector_that_needs_more_is_told_by_its_p_values() -> None:
    """One that hears 10 % less than theory's in every log, whose noise is as large as what it lacks."""
    rng = np.random.default_rng(4)
    rows = []
    for a in rng.uniform(4.0, 8.0, 20):
        noise = rng.normal()
        here = [2.0 * norm.sf(size + noise) for size in SIZES]
        rows.append({"wanted": a, "p_value": 2.0 * norm.sf(a / 1.1 + noise), "theory": [{"here": here}]})
    factor, low, high = against_ideal(rows) or (0.0, 0.0, 0.0)
    assert factor == pytest.approx(1.1, abs=0.005)
    assert low <= factor <= high < low + 0.02


def test_a_share_tells_its_interval() -> None:
    rows = [{"k": k} for k in range(100)]
    assert share(rows, lambda r: r["k"] < 1) == "1.0 % (0.0-5.4) | 1/100"
    assert share([], bool) == "not run | 0"
    assert "not run" in "\n".join(lines([]))


def started(stack: ExitStack, *command: str, cwd: Path) -> None:
    """A process that ends with the stack."""
    process = subprocess.Popen(
        [sys.executable, "-m", *command], cwd=cwd, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )

    def end() -> None:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    stack.callback(end)


def test_a_study_that_was_stopped_continues(tmp_path: Path) -> None:
    """Two worker processes run the cases that an earlier run, stopped while it wrote, has not done."""
    log = tmp_path / "cases.jsonl"
    outcome = {"verdict": "nothing_found", "found": [], "unexplained": None, "scores": [], "theory": []}
    before = json.dumps(plan(15, ("null",))[0] | outcome | {"worker": 0}) + "\n"
    log.write_text(before + '{"number": 7')
    command: list[str | Path] = [TOOLS / "blind.py", "--cases", "15", "--part", "null", "--out", tmp_path]
    done = subprocess.run(
        [sys.executable, *command, "--workers", "2"],
        capture_output=True, text=True, timeout=240, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "1 cases done, 2 to do" in done.stdout
    after = log.read_text()
    assert after.startswith(before)
    rows = [json.loads(line) for line in after.splitlines()]
    assert [r["part"] for r in rows] == ["null"] * 3
    assert "false alarm on nulls | at most 1 % |" in (tmp_path / "table.md").read_text()
    assert (tmp_path / "confusion.png").stat().st_size > 10_000
