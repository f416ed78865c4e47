"""Test localisation without a map, which bends the track to repeat the measured field at crossings."""

import numpy as np
import pytest
import xarray as xr
from msgspec import structs
from rock import Rock

from magbridge.arrays import FloatArray
from magbridge.field.geodesy import offset
from magbridge.field.igrf import total_field
from magbridge.navigate import own_survey
from magbridge.navigate.findings import errors
from magbridge.navigate.options import NavigationOptions
from magbridge.navigate.own_survey import OwnField, localise

START, HOURS, DT = (49.5, -57.9), 3.0, 60.0
OPTIONS = NavigationOptions(start_sigma=1.0, current_sigma=0.03, drift=0.05, bias_sigma=1.0)


def flown(*, straight: bool) -> xr.Dataset:
    """Return a glider's log with a drift of 3 cm/s, on triangles or straight, over a field of 40 nT."""
    rng = np.random.default_rng(4)
    time = np.arange(0.0, HOURS * 3600.0, DT)
    leg = (time // 1800.0).astype(int)
    course = np.radians(0.0 * leg if straight else np.array([20.0, 140.0, 260.0])[leg % 3])
    true = np.cumsum(0.6 * DT * np.stack([np.cos(course), np.sin(course)], axis=1), axis=0)
    drift = np.outer(time, [0.03, -0.02])
    latitude, longitude = offset(*START, true[:, 0], true[:, 1])
    dr_latitude, dr_longitude = offset(*START, *(true - drift).T)
    rock = Rock(rng, 40.0, 700.0, 400).at(true)
    when = 1.4e9 + time
    field = total_field(longitude, latitude, 0.0, when) + rock + rng.normal(0, 1.0, len(time))
    columns = {
        "total_field": field, "dr_latitude": dr_latitude, "dr_longitude": dr_longitude,
        "truth_latitude": latitude, "truth_longitude": longitude,
    }  # fmt: skip
    return xr.Dataset({name: ("time", values) for name, values in columns.items()}, {"time": when})


def test_a_track_that_comes_back_finds_its_drift() -> None:
    """Off by less than half of dead reckoning, and by no more than its sigma says; start given, no map."""
    track = localise(flown(straight=False), OPTIONS, start=START)
    error, reckoned = (float((one**2).mean()) ** 0.5 for one in errors(track))
    assert error < 0.5 * reckoned
    sigma = float((track["covariance_nn"] + track["covariance_ee"]).mean()) ** 0.5
    assert 0.3 < error / sigma < 2.0
    assert sigma < 0.6 * float((track["unaided_sigma"] ** 2).mean()) ** 0.5
    assert track["valid"].all()
    assert "check it against a fix" not in track.attrs["findings"]


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take 24 particles instead of 80, where no error is compared with its sigma."""
    monkeypatch.setattr(own_survey, "PARTICLE_COUNT", 24)


def test_a_straight_track_learns_nothing_and_reports_it(few: None) -> None:
    track = localise(flown(straight=True), OPTIONS, start=START)
    sigma = (track["covariance_nn"] + track["covariance_ee"]) ** 0.5
    assert float(sigma[-1]) > 0.5 * float(track["unaided_sigma"][-1])
    assert "adds little to dead reckoning" in track.attrs["findings"]


def test_a_drift_that_may_be_many_lengths_of_the_field_is_left_to_dead_reckoning(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Rock that repeats itself within what the drift may be: of the many tracks no few are published.

    Half of the blocks tells that, and the other half, which would cost most of the time, is left alone.
    """
    asked, likelihood = set(), OwnField.log_likelihood

    def counted(field: OwnField, u: FloatArray, count: int) -> tuple[float, FloatArray]:
        asked.add(count / len(field.time))
        return likelihood(field, u, count)

    monkeypatch.setattr(OwnField, "log_likelihood", counted)
    lost = localise(flown(straight=True), structs.replace(OPTIONS, current_sigma=1.0), start=START)
    np.testing.assert_allclose(
        lost["covariance_nn"] + lost["covariance_ee"], lost["unaided_sigma"] ** 2, rtol=1e-9
    )
    np.testing.assert_allclose(lost["north"], 0.0, atol=1e-6)
    assert not lost["valid"][-1]
    assert "this is dead reckoning alone" in lost.attrs["findings"]
    assert 0.4 < max(asked) < 0.7


def test_a_drift_that_may_be_longer_than_the_field_is_to_be_checked(few: None) -> None:
    """There a track may converge to another repetition of the field, which its spread does not include."""
    track = localise(flown(straight=False), structs.replace(OPTIONS, current_sigma=0.3), start=START)
    assert "check it against a fix" in track.attrs["findings"]


@pytest.mark.parametrize("missing", ["total_field", "dr_latitude"])
def test_what_is_missing_is_named(missing: str) -> None:
    with pytest.raises(ValueError, match=r"expected (total_field|a motion)"):
        localise(flown(straight=True).drop_vars([missing, "truth_latitude", "truth_longitude"]), OPTIONS)
