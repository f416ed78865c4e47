"""Test some hidden effects of finer physics than the detector's; ``tools/blind.py`` is the full study."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from blind import case
from study import deployment
from study.deployment import GLIDER, LOSSES
from study.table import is_worse

from magbridge.calibration.file import load
from magbridge.calibration.model import Calibration
from magbridge.diagnose.assessment import useful
from magbridge.diagnose.causes import CAUSES
from magbridge.diagnose.joint import Improvement
from magbridge.diagnose.report.findings import parameters
from magbridge.diagnose.run import diagnose
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


def test_outliers_are_found() -> None:
    row = blind("named", ("outliers",), 12.0)
    assert row["first"] == ["outliers"]


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
