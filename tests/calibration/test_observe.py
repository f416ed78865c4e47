"""Test the observations that are made from a deployment's columns."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import xarray as xr
from demos import demo_log
from gliders import codes
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observations import Observations, unfiltered
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.fitting.solve import flown
from magbridge.calibration.fitting.uncertainty import in_sensor_units
from magbridge.errors import CalibrationError, FormatError
from magbridge.field.reference import with_true_heading


def test_a_deployment_s_columns_become_observations() -> None:
    n = 50
    rng = np.random.default_rng(0)
    columns: dict[str, Any] = {f"mag_{axis}": ("time", rng.normal(0, 3e4, n)) for axis in "xyz"}
    columns["battpos"] = "time", rng.normal(0, 1, n), {"units": "in"}
    columns["reference_field"] = "time", np.full(n, 5e4)
    ds = xr.Dataset(columns, coords={"time": np.arange(n) * 4.0})
    data = observations(ds, ["battpos"])
    assert data.names == ("battpos",) == observations(ds, "battpos").names
    assert data.units == ("in",)
    assert len(data) == n
    with pytest.raises(FormatError, match=r"column 'fin': expected .*; there are: .* battpos"):
        observations(ds, ["fin"])
    with pytest.raises(CalibrationError, match="'battpos': expected numbers"):
        observations(ds.assign(battpos=("time", np.array(["a"] * n))), ["battpos"])


def test_a_log_with_its_own_reference_has_a_boresight_from_headings_of_either_north() -> None:
    deployment = demo_log().isel(time=slice(None, None, 3))
    assert "reference_field" in deployment
    expected = fit(observations(deployment, ("battpos", "ballast")))
    declination = with_true_heading(deployment, "magnetic")["heading"] - deployment["heading"]
    deployment = deployment.assign(heading=(deployment["heading"] - declination) % 360.0)
    deployment.attrs["heading_reference"] = "magnetic"
    found = fit(observations(deployment, ("battpos", "ballast")))
    assert expected.calibration.boresight is not None
    assert found.calibration.boresight is not None
    turn = found.calibration.boresight.matrix() @ expected.calibration.boresight.matrix().T
    np.testing.assert_allclose(turn, np.eye(3), atol=1e-6)


def test_a_channel_that_is_sampled_more_rarely_than_the_rows_is_brought_to_their_time() -> None:
    """The channel repeats its reading and time, from which no slope can be computed."""
    time = 100.0 + 0.1 * np.arange(60)
    sampled = time + 0.03
    sampled[1::3] = sampled[0::3]
    sampled[2::3] = sampled[0::3]
    columns = {f"mag_{axis}": ("time", 20_000.0 + 30.0 * time) for axis in "xy"}
    columns |= {
        "mag_z": ("time", 20_000.0 + 30.0 * sampled + 5.0 * (sampled - 100.0) ** 2),
        "mag_time_z": ("time", sampled),
        "reference_field": ("time", np.full(60, 5e4)),
    }
    field = observations(xr.Dataset(columns, coords={"time": time}), []).field
    truth = 20_000.0 + 30.0 * time + 5.0 * (time - 100.0) ** 2
    np.testing.assert_allclose(field[3:-3, 2], truth[3:-3], atol=1e-6)
    np.testing.assert_allclose(field[:, 2], truth, atol=2.0)


# ---- a log whose end is not the vehicle's flight -----------------------------------------------------------


FIELD = np.array([21_000.0, 2_000.0, 42_000.0])


def drone(crash: int, n: int = 500) -> Observations:
    """Return a drone's log: all attitudes, soft iron of 3 %, 200 nT noise, `crash` last samples near iron."""
    rng, other = np.random.default_rng(1), np.random.default_rng(2)
    body = Rotation.random(n, random_state=1).inv().apply(FIELD)
    body[n - crash :] = body[-1] + other.normal(0.0, 20_000.0, 3) + other.normal(0.0, 2_000.0, (crash, 3))
    field = body @ (np.eye(3) + rng.normal(0.0, 0.03, (3, 3))) + rng.normal(0.0, 3_000.0, 3)
    field += rng.normal(0.0, 200.0, (n, 3))
    return Observations(
        field, np.full(n, np.linalg.norm(FIELD)), np.empty((n, 0)), time=np.arange(n, dtype=float) * 0.1
    )


@pytest.mark.parametrize("mapped", [True, False])
def test_a_crash_is_left_out_and_reported(mapped: bool) -> None:
    data = drone(60)
    found = fit(data if mapped else replace(data, unmapped=np.ones(len(data), bool)))
    error, standardised = in_sensor_units(found.calibration, drone(0))
    assert found.details["ends"] == pytest.approx(60, abs=2)
    assert "ends_left_out" in codes(found)
    assert np.sqrt(np.mean(error**2)) < 220.0
    assert 0.8 < np.std(standardised) < 1.25
    assert "ends" not in fit(drone(0)).details


def test_scattered_outliers_a_crustal_field_and_halves_are_not_ends() -> None:
    rng = np.random.default_rng(2)
    above_rock = rng.normal(size=400) + np.where(np.arange(400) > 320, 30.0, 0.0)
    assert (~flown(above_rock)).sum() == pytest.approx(79, abs=2)
    assert flown(above_rock, 400.0).all()
    residual = rng.normal(size=400)
    residual[rng.choice(400, 40, replace=False)] = 50.0
    assert flown(residual).sum() >= 395
    residual[:230] = 50.0  # most of the log: which part is the flight?
    assert flown(residual).all()


# ---- The anti-alias filter and what a turn makes of it ---------------------------------------------------


CORNER = 0.33


@pytest.mark.parametrize(("step", "noise"), [(4.0, 0.0), (1.0, 0.0), (0.1, 0.5)])
def test_a_turning_field_has_its_length_again(step: float, noise: float) -> None:
    """A spiral of four minutes a turn, RC-filtered: short by tau^2 |dx/dt|^2 / 2 |x|, then no more."""
    fine, tau, turn = 0.02, 1.0 / (2.0 * np.pi * CORNER), 2.0 * np.pi / 240.0
    t = np.arange(0.0, 2400.0, fine)
    true = np.column_stack(
        [18_000.0 * np.cos(turn * t), 18_000.0 * np.sin(turn * t), np.full(len(t), 48_000.0)]
    )
    share = 1.0 - np.exp(-fine / tau)
    slow = lfilter([share], [1.0, share - 1.0], true - true[0], axis=0) + true[0]
    rows = slice(round(20.0 / fine), None, round(step / fine))
    field = slow[rows] + np.random.default_rng(0).normal(0.0, noise, slow[rows].shape)
    F = float(np.linalg.norm(true[0]))
    data = Observations(field, np.full(len(field), F), np.empty((len(field), 0)), time=t[rows])
    inside = slice(60, -60)
    before, after = (
        np.linalg.norm(part.field, axis=1)[inside] - F for part in (data, unfiltered(data, CORNER))
    )
    if not noise:
        assert before.mean() == pytest.approx(-((tau * turn * 18_000.0) ** 2) / (2.0 * F), rel=0.1)
    assert abs(after.mean()) < 0.1 * abs(before.mean()) + noise / 50.0
    assert after.std() < 1.1 * before.std() + 0.05


def test_slopes_stay_within_their_run() -> None:
    field = np.tile([[20_000.0, 0.0, 45_000.0]], (40, 1))
    field[20:, 0] *= -1.0
    data = Observations(field, np.full(40, 49_244.0), np.empty((40, 0)), runs=np.arange(40) // 20)
    assert np.array_equal(unfiltered(data, CORNER).field, field)


@pytest.mark.parametrize("corner", [1e-320, 1e-9, 0.004])
def test_a_filter_slower_than_the_data_is_refused(corner: float) -> None:
    field = np.tile([[20_000.0, 0.0, 45_000.0]], (40, 1))
    data = Observations(field, np.full(40, 49_244.0), np.empty((40, 0)))
    with pytest.raises(CalibrationError, match=r"is longer than the data \(39 s\)"):
        unfiltered(data, corner)
