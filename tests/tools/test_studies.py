"""Test that a study runs its cases, stores their rows, and tabulates them."""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from studies import Column, Row, Study, fraction
from study_worlds import TRIALS, Trials, best_fit, fly_trials

from sitl import Twin, load, segments, simulate
from sitl.mission import CrissCross, Spirals
from sitl.platform import Vehicle


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


# ---- The worlds of the studies -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def flight() -> Trials:
    return fly_trials(29, methods=("nominal", "auto"))


def test_the_papers_signature_appears(flight: Trials) -> None:
    """Nominal about 150 nT; parameterised far smaller on the runs than on the survey; trial 1 the worse."""
    for trial in TRIALS:
        assert 100 < flight.rms(trial, trial, "nominal") < 220
        assert flight.rms(trial, trial, "auto") < 30
        assert flight.rms("survey", trial, "auto") > 3 * flight.rms(trial, trial, "auto")
        assert flight.rms("survey", trial, "auto") < flight.rms("survey", trial, "nominal")
    assert flight.rms("survey", "trial 1", "auto") > 1.5 * flight.rms("survey", "trial 2", "auto")


def test_it_is_the_temperature_that_spoils_trial_1(flight: Trials) -> None:
    warm = flight.parts["survey"]["sensor_temperature"].to_numpy()
    error = flight.error("survey", "trial 1", "auto", "truth_total_field")
    assert warm[0] < -5
    assert warm[-1] > 0
    assert abs(np.corrcoef(warm, error)[0, 1]) > 0.7
    later = flight.error("survey", "trial 2", "auto", "truth_total_field")
    assert abs(later[len(later) // 2 :].mean()) < abs(error[len(error) // 2 :].mean())


# ---- The information bound on a calibration's error ------------------------------------------------------


MISSION = (Spirals(duration=200.0), CrissCross(hours=1.0, duration=450.0))
SCENARIO = load("random_glider").replace(mission=MISSION)


@pytest.fixture(scope="module")
def short_flight() -> tuple[Vehicle, xr.Dataset, xr.Dataset]:
    parts = segments(simulate(SCENARIO, 1))
    vehicle = Twin.draw(SCENARIO, 1).vehicle
    assert isinstance(vehicle, Vehicle)
    return vehicle, parts["calibration"], parts["survey"]


def test_no_calibration_beats_the_noise_and_more_knowledge_helps(
    short_flight: tuple[Vehicle, xr.Dataset, xr.Dataset],
) -> None:
    vehicle, calibration, survey = short_flight
    best = best_fit(vehicle, calibration, survey, 1.0)
    assert np.all(best.bound > best.floor)
    vague = best_fit(vehicle, calibration, survey, 1.0, at_sigma=0.5)
    assert np.all(vague.bound >= best.bound - 1e-9)
    fewer = best_fit(vehicle, calibration.isel(time=slice(0, None, 2)), survey, 1.0)
    assert np.all(fewer.bound >= best.bound - 1e-9)


def test_with_only_the_hard_iron_unknown_the_bound_is_three_sines(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bare vehicle: the hard iron's information is the sum of the field's directions, over the variance."""
    monkeypatch.setattr("study_worlds.SOFT_IRON", 1e-12)
    monkeypatch.setattr("study_worlds.HARD_IRON", 1e6)
    scenario = SCENARIO.replace(vehicle=Vehicle())
    parts = segments(simulate(scenario, 1))
    u, v = (
        np.column_stack([parts[name][f"truth_field_{axis}"] for axis in "xyz"])
        for name in ("calibration", "survey")
    )
    u, v = (field / np.linalg.norm(field, axis=1, keepdims=True) for field in (u, v))
    best = best_fit(Vehicle(), parts["calibration"], parts["survey"], sigma=5.0)
    expected = 25.0 * (1 + np.einsum("ni,ij,nj->n", v, np.linalg.inv(u.T @ u), v))
    np.testing.assert_allclose(best.floor, 5.0)
    np.testing.assert_allclose(best.bound**2, expected, rtol=1e-6)
