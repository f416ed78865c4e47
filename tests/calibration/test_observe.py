"""Observations from a deployment's columns."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from demos import demo_log
from gliders import codes
from scipy.spatial.transform import Rotation

from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.fitting.solve import flown
from magbridge.calibration.fitting.uncertainty import in_sensor_units
from magbridge.errors import CalibrationError, FormatError
from magbridge.field.reference import with_true_heading


def test_a_deployment_s_columns_become_observations() -> None:
    n = 50
    rng = np.random.default_rng(0)
    columns: dict[str, tuple[object, ...]] = {
        f"mag_{axis}": ("time", rng.normal(0, 3e4, n)) for axis in "xyz"
    }
    columns |= {
        "battpos": ("time", rng.normal(0, 1, n), {"units": "in"}),
        "reference_field": ("time", np.full(n, 5e4)),
    }
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
    """It repeats its reading, and the time of that: of which no slope is."""
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
    """All attitudes, 3 % of soft iron, 200 nT of noise; the last `crash` samples are near other iron."""
    rng, other = np.random.default_rng(1), np.random.default_rng(2)
    body = Rotation.random(n, random_state=1).inv().apply(FIELD)
    body[n - crash :] = body[-1] + other.normal(0.0, 20_000.0, 3) + other.normal(0.0, 2_000.0, (crash, 3))
    field = body @ (np.eye(3) + rng.normal(0.0, 0.03, (3, 3))) + rng.normal(0.0, 3_000.0, 3)
    field += rng.normal(0.0, 200.0, (n, 3))
    return Observations(
        field, np.full(n, np.linalg.norm(FIELD)), np.empty((n, 0)), time=np.arange(n, dtype=float) * 0.1
    )


def test_a_crash_is_left_out_and_reported() -> None:
    found = fit(drone(60))
    error, standardised = in_sensor_units(found.calibration, drone(0))
    assert found.details["ends"] == pytest.approx(60, abs=2)
    assert "ends_left_out" in codes(found)
    assert np.sqrt(np.mean(error**2)) < 220.0
    assert 0.8 < np.std(standardised) < 1.25
    assert "ends" not in fit(drone(0)).details


def test_scattered_outliers_and_halves_are_not_ends() -> None:
    rng = np.random.default_rng(2)
    residual = rng.normal(size=400)
    residual[rng.choice(400, 40, replace=False)] = 50.0
    assert flown(residual).sum() >= 395
    residual[:230] = 50.0  # most of the log: which part is the flight?
    assert flown(residual).all()
