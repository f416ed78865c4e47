"""Test some hidden effects of finer physics than the detector's; ``tools/blind.py`` is the full study."""

import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import xarray as xr
from blind import PARTS, case, plan
from scipy.stats import norm
from study import deployment
from study.deployment import CHARTS, GLIDER, LOSSES, MEMORY, charted, drawn, project, whiten
from study.ideal import SIZES, Draws, Span
from study.names import judge
from study.table import is_worse, needed_size

from magbridge.calibration.file import load
from magbridge.calibration.model import Calibration
from magbridge.diagnose.assessment import useful
from magbridge.diagnose.causes import CAUSES
from magbridge.diagnose.joint import Improvement
from magbridge.diagnose.report.findings import parameters
from magbridge.diagnose.run import diagnose
from sitl import Twin
from sitl import load as load_scenario
from sitl.dataset import corrected

SAFE = 0.97
"""Ideal probability that the set holds the truth, from which the set must hold it."""
FAR = 8.0
"""Maximum signal-to-noise ratio that the best fit of a competing cause may leave."""


@pytest.fixture(scope="module", autouse=True)
def short() -> Iterator[None]:
    """Set the length of the study's deployments to two hours instead of six."""
    hours, deployment.HOURS = deployment.HOURS, 2.0
    deployment.vehicle.cache_clear()
    yield
    deployment.HOURS = hours
    deployment.vehicle.cache_clear()


def blind(
    part: str, names: tuple[str, ...], wanted: float, noise: str = "white", number: int = 24, **more: str
) -> dict[str, Any]:
    entry = {"part": part, "names": names, "wanted": wanted, "noise": noise, "number": number, "losses": ""}
    return case(entry | more)


ELSEWHERE = {
    "pressure_offset",
    "nonlinearity",
    "offset_step",
    "diurnal_variation",
    "unmodelled_actuator",
    "current_field",
}
"""Causes whose hidden effects another test covers."""


@pytest.mark.parametrize("name", [name for name in CAUSES if name not in ELSEWHERE])
def test_a_hidden_effect_is_found_and_named(name: str) -> None:
    """The set of names holds the truth if the ideal detector's set does, with close imitations only."""
    row = blind("named", (name,), 12.0)
    (theory,) = row["theory"]
    assert row["found"]
    assert row["in_set"] or theory["inside"] < SAFE, row
    assert {cause for cause in row["sets"] if theory["left"].get(cause, 0.0) > FAR} == set(), row


@pytest.mark.parametrize(
    ("noise", "losses"),
    [*product(("white", "ar", "half"), [""]), *zip(("mixed", "heavy", "uneven", "map"), LOSSES, strict=True)],
)
def test_nothing_is_found_where_nothing_is(noise: str, losses: str) -> None:
    """A log without an effect gives no finding, in each kind of noise and with lost samples."""
    assert not blind("null", (), 0.0, noise, number=6, losses=losses)["found"]


def test_samples_that_are_lost_hide_nothing() -> None:
    row = blind("named", ("current_field",), 25.0, "mixed", losses="single")
    assert row["first"] == ["current_field"]
    assert row["unexplained"] is None


@pytest.mark.parametrize("name", ["nonlinearity", "pressure_offset"])
def test_an_extension_against_a_map_does_no_harm(name: str) -> None:
    """Compare with the true field on its own log and on another day's with another offset."""
    row = blind("charted", (name,), 40.0, GLIDER, losses="surfacing", reference="map at its depth")
    assert name in row["first"], row
    assert row["gain"]["after"] < 0.5 * row["gain"]["before"], row
    assert not is_worse(row), row


def test_two_at_once() -> None:
    row = blind("two", ("current_field", "unmodelled_actuator"), 15.0)
    assert set(row["first"]) == {"current_field", "unmodelled_actuator"}


def test_what_no_cause_explains_is_called_unexplained() -> None:
    """Hide a ship: in two hours an unlogged relay cannot be separated from correlated noise."""
    row = blind("foreign", ("ship",), 15.0, number=27)
    assert row["unexplained"].keys() == {
        "kind", "signal_to_noise", "period_s", "best_channel", "alternatives", "correlation_time_s", "rms_nT",
        "follows",
    }  # fmt: skip
    assert not row["named"]


@pytest.fixture(scope="module")
def warm(short: None) -> tuple[xr.Dataset, Calibration]:
    here = deployment.Background.of(deployment.vehicle(0), 24, "white")
    return here.log(here.hide("current_field", 60.0, 24).ds), here.deployment.calibration


@pytest.fixture(scope="module")
def written(
    warm: tuple[xr.Dataset, Calibration], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, str]:
    """Return the folder of a diagnosis and the channel that it names."""
    ds, calibration = warm
    out = tmp_path_factory.mktemp("diagnosis")
    return out, diagnose([ds], calibration, out / "out").diagnosis.findings[0].candidate.channel


def test_what_is_written(warm: tuple[xr.Dataset, Calibration], written: tuple[Path, str]) -> None:
    """The diagnosis writes three files; its calibration is an ordinary one that corrects the named effect."""
    ds, tmp_path = warm[0], written[0]
    found = json.loads((tmp_path / "out" / "findings.json").read_text())
    assert found["verdict"] == "explained"
    assert set(found) == {
        "format", "verdict", "rms_before_nT", "rms_after_nT", "improvement", "findings", "unexplained",
        "remarks", "scalar", "assessment",
    }  # fmt: skip
    assert found["findings"][0]["cause"] == "current_field"
    improvement = found["improvement"]
    assert improvement["interval"][0] <= improvement["rms_ratio"] <= improvement["interval"][1] < 1.0
    assert improvement["after_nT"] < improvement["refit_nT"] <= 1.02 * improvement["before_nT"]
    assert set(found["findings"][0]["parameters"]["x"]) == {"value", "sigma", "unit"}
    extended = load(tmp_path / "out" / "calibration.json")
    error = corrected(ds, extended).total - ds["reference_field"].to_numpy()
    assert np.sqrt(np.mean(error**2)) == pytest.approx(1.0, abs=0.05)
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count("data:image/png;base64,") >= 5
    assert page.index("<b>current field</b>") < page.index("<h2")
    assert "<h3><b>current field</b>" in page
    assert "The extended calibration, calibration.json next to this page," in page
    assert "http" not in page.replace("http-equiv", "")


def test_a_maps_error_is_reported_by_its_size(short: None) -> None:
    """The report states the RMS of a map's error, and the vehicle's calibration stays as it is."""
    here = deployment.Background.of(deployment.vehicle(0), 24, "white")
    hidden = here.hide("map_error", 40.0, 24)
    diagnosis, use = diagnose([here.log(hidden.ds)], here.deployment.calibration)
    (named,) = [one for one in diagnosis.findings if one.candidate.cause == "map_error"]
    numbers = parameters(named, len(diagnosis.problem))
    assert set(numbers) == {"rms"}
    assert numbers["rms"]["value"] == pytest.approx(np.std(hidden.signature), rel=0.2)
    assert diagnosis.calibration is here.deployment.calibration
    assert (use.fit_for_use, diagnosis.refused) == ("no", "reference_only")
    assert 0.0 < numbers["rms"]["sigma"] < 0.2 * numbers["rms"]["value"]


def test_a_channels_name_does_not_decide(
    warm: tuple[xr.Dataset, Calibration], written: tuple[Path, str]
) -> None:
    ds, calibration = warm
    renamed = ds.rename({written[1]: "zz"})
    found = diagnose([renamed], calibration).diagnosis
    assert found.findings[0].candidate.channel == "zz"
    idle = useful(replace(found, improvement=Improvement(1.0, 1.0, 1.0, (0.9, 1.1))))
    used = useful(found)
    assert idle is not None
    assert used is not None
    assert "do not use it" in idle.text
    assert "It leaves" not in used.text
    first = found.findings[0]
    sun = replace(first.candidate, cause="diurnal_variation", channel=None, effects=())
    both = (first, replace(first, hypothesis=replace(first.hypothesis, candidate=sun)))
    partly = useful(replace(found, findings=both))
    assert partly is not None
    assert partly.text.endswith("It leaves diurnal variation in the field, which the RMS above has removed.")


# ---- The computations of the blind study, and a short run of it --------------------------------------------


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


def test_a_continued_map_has_a_smaller_error() -> None:
    """An error that the reference had before is kept."""
    twin = Twin.draw(load_scenario("demo"), 3)
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
