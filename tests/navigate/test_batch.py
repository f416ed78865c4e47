"""Test a log against a map: the track, the backward pass, the findings, the rejections."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from msgspec.structs import replace
from voyages import PLACE, Map, magnav_flight, synthetic, track_over

from magbridge.errors import FormatError
from magbridge.field.geodesy import metres_per_degree
from magbridge.field.grid import AnomalyGrid
from magbridge.field.igrf import total_field
from magbridge.navigate import NavigationOptions, Navigator
from magbridge.navigate.batch import navigate
from magbridge.navigate.draw import measured_on_track


@pytest.fixture(scope="module")
def ds(grid: AnomalyGrid, options: NavigationOptions) -> xr.Dataset:
    return track_over(grid, options, 6, hours=4.0)


@pytest.fixture(scope="module")
def result(ds: xr.Dataset, grid: AnomalyGrid, options: NavigationOptions) -> xr.Dataset:
    return navigate(ds, grid, options, start=PLACE)


@pytest.fixture(scope="module")
def findings(ds: xr.Dataset, options: NavigationOptions) -> Callable[[AnomalyGrid], str]:
    """Return a function from a map to the findings of the track on this map."""
    return lambda grid: str(navigate(ds, grid, options, start=PLACE).attrs["findings"])


def rms(result: xr.Dataset, prefix: str = "") -> float:
    return float(np.sqrt((result[f"{prefix}error_north"] ** 2 + result[f"{prefix}error_east"] ** 2).mean()))


def test_the_track_and_the_backward_pass(result: xr.Dataset) -> None:
    assert result.attrs["motion"] == "velocity"
    assert result.attrs["reference_track"] == "truth_"
    assert result.attrs["findings"] == ""
    assert rms(result, "smoothed_") < rms(result) < 200.0
    sigma = np.hypot(result["smoothed_sigma_north"], result["smoothed_sigma_east"])
    assert float(sigma.mean()) < float(np.sqrt(result["covariance_nn"] + result["covariance_ee"]).mean())
    assert {"units", "long_name"} <= set(result["bias"].attrs)


def test_a_batch_is_the_live_filter(
    ds: xr.Dataset, grid: AnomalyGrid, options: NavigationOptions, result: xr.Dataset
) -> None:
    nav = Navigator(grid, options)
    time_us = np.round(ds["time"].to_numpy() * 1e6).astype(int)
    nav.fix(int(time_us[0]) - 1, *PLACE)
    records = []
    for i, t in enumerate(time_us.tolist()):
        nav.telemetry(
            t, **{name: float(ds[name][i]) for name in ("velocity_north", "velocity_east", "depth")}
        )
        if record := nav.measure(t, float(ds["total_field"][i]), 1.0):
            records.append(record)
        if len(records) == 100:
            break
    np.testing.assert_array_equal([r.latitude for r in records], result["latitude"][:100])
    np.testing.assert_array_equal([r.innovation for r in records], result["innovation"][:100])


def test_what_is_drawn_is_the_anomaly_on_the_filters_track(result: xr.Dataset) -> None:
    """The record has the main field of the dead-reckoned position: five km north it differs by 10 nT."""
    moved = result.isel(time=slice(3)).assign(
        north=("time", [0.0, -5_000.0, 0.0]), east=("time", np.zeros(3))
    )
    same, other, _ = measured_on_track(moved) - moved["anomaly"].to_numpy()
    assert same == pytest.approx(0.0, abs=1e-6)
    there = moved["latitude"][1] + 5_000.0 / metres_per_degree(49.5)[0]
    place = {name: moved[name].to_numpy()[1:2] for name in ("longitude", "latitude", "depth", "time")}
    expected = total_field(**place | {"latitude": [float(there)]}) - total_field(**place)
    assert other == pytest.approx(float(expected[0]), abs=0.01)
    assert 5.0 < abs(other) < 30.0


def test_a_shifted_map_is_recognised(grid: AnomalyGrid, findings: Callable[[AnomalyGrid], str]) -> None:
    shifted = AnomalyGrid(grid.longitude + 300 / 72_400, grid.latitude + 400 / 111_200, grid.anomaly)
    assert "the map fits best when moved 500 m (SW)" in findings(shifted)


def test_a_map_that_the_vehicle_leaves_is_reported(
    ds: xr.Dataset, grid: AnomalyGrid, findings: Callable[[AnomalyGrid], str]
) -> None:
    edge = int(np.searchsorted(grid.longitude, float(ds["truth_longitude"].quantile(0.6))))
    west = AnomalyGrid(grid.longitude[:edge], grid.latitude, grid.anomaly[:, :edge])
    assert "off the map for" in findings(west)


def test_a_map_of_another_epoch_is_recognised(
    grid: AnomalyGrid, findings: Callable[[AnomalyGrid], str]
) -> None:
    found = findings(grid.replaced(anomaly=grid.anomaly - 85.0))
    assert "the map does not explain the field" in found
    assert "at the known positions the field is 8" in found
    assert "above the map's level: its main field may be of another epoch, or at another altitude" in found


def test_another_map_altogether_is_recognised(ds: xr.Dataset, options: NavigationOptions) -> None:
    wrong = synthetic(Map(30, 1500), 4)
    result = navigate(ds, wrong, options, start=PLACE)
    assert "lost for" in result.attrs["findings"]
    assert float(result["valid"][result["time"] > result["time"][0] + 1800].mean()) < 0.1


def test_what_is_known_badly_says_nothing_about_the_map(
    ds: xr.Dataset, grid: AnomalyGrid, options: NavigationOptions
) -> None:
    """While a mass moves the error is hundreds of nT, and so is the sigma."""
    moving = np.arange(ds.sizes["time"]) % 25 == 0
    off = ds.assign(
        total_field=ds["total_field"] + np.where(moving, 400.0, 0.0),
        total_field_sigma=ds["total_field_sigma"].where(~moving, 300.0),
    )
    assert navigate(off, grid, options, start=PLACE).attrs["findings"] == ""


def test_a_flat_map_is_recognised(options: NavigationOptions) -> None:
    flat = synthetic(Map(0.2, 1500), 4)
    result = navigate(track_over(flat, options, 5, hours=3.0), flat, options, start=PLACE)
    why = "the map is flat there (0.2 nT RMS, where calibration and map are known only to 1.4 nT)"
    assert "the field carries no information for" in result.attrs["findings"]
    assert why in result.attrs["findings"]


def test_a_map_of_another_place_gives_one_message(
    ds: xr.Dataset, grid: AnomalyGrid, options: NavigationOptions
) -> None:
    elsewhere = AnomalyGrid(grid.longitude + 5.0, grid.latitude, grid.anomaly)
    unsure = replace(options, start_sigma=5_000.0)
    result = navigate(ds.isel(time=slice(0, 50)), elsewhere, unsure, start=PLACE)
    assert result.attrs["findings"] == (
        "off the map for 100 % of the track, first after 0.0 h: dead reckoning only"
    )


def test_motion_from_what_the_log_has(ds: xr.Dataset, grid: AnomalyGrid, options: NavigationOptions) -> None:
    inertial = ds.drop_vars(["velocity_north", "velocity_east"]).assign(
        dr_latitude=ds["truth_latitude"] - ds["away_north"] / 111_200,
        dr_longitude=ds["truth_longitude"] - ds["away_east"] / 72_400,
    )
    result = navigate(inertial.isel(time=slice(0, 1200)), grid, options, start=PLACE)
    assert result.attrs["motion"] == "inertial"
    assert rms(result) < 400.0


def test_a_gliders_log_is_distinguished_from_another_vehicles(
    ds: xr.Dataset, grid: AnomalyGrid, options: NavigationOptions
) -> None:
    """Depth, pitch and heading make a motion only where pitch makes the depth; else the log's track does."""
    depth = 40.0 + 30.0 * np.sin(np.arange(900) * 4 / 150)
    pitch = np.where(np.cos(np.arange(900) * 4 / 150) > 0, -26.0, 26.0)
    log = ds.isel(time=slice(0, 900))
    heading = np.degrees(np.arctan2(log["velocity_east"], log["velocity_north"])) % 360.0
    log = log.drop_vars(["velocity_north", "velocity_east"]).assign(heading=heading)
    log = log.assign(depth=("time", depth), latitude=log["truth_latitude"], longitude=log["truth_longitude"])
    glider = log.assign(pitch=("time", pitch))
    other = log.assign(pitch=("time", np.abs(pitch) / 10))
    assert navigate(glider, grid, options).attrs["motion"] == "glide"
    assert navigate(other, grid, options).attrs["motion"] == "position"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda ds: ds.drop_vars("total_field"), "expected total_field: correct the log with a calibration"),
        (
            lambda ds: ds.drop_vars("velocity_north"),
            "expected a motion: velocity_north velocity_east, or wat",
        ),
        (lambda ds: ds.isel(time=[0, 1, 3, 2, 4]), "row 4, column 'time': expected a time after "),
        (lambda ds: ds.assign(total_field=ds["total_field"] * np.nan), "none was usable"),
        (lambda ds: ds.assign(quality=ds["depth"] * 0 + 16), "none was usable"),
    ],
)
def test_one_clear_line(
    ds: xr.Dataset,
    grid: AnomalyGrid,
    options: NavigationOptions,
    change: Callable[[xr.Dataset], xr.Dataset],
    message: str,
) -> None:
    with pytest.raises(FormatError, match=message):
        navigate(change(ds.isel(time=slice(0, 50))), grid, options, start=PLACE)


def test_a_start_is_needed(ds: xr.Dataset, grid: AnomalyGrid, options: NavigationOptions) -> None:
    with pytest.raises(FormatError, match="expected a position to start from"):
        navigate(ds.isel(time=slice(0, 50)), grid, options)


@pytest.mark.real
def test_magnavs_published_flight(real_data: Path) -> None:
    """100 s at 300 km/h with an inertial track: the example that MagNav.jl navigates.

    Its own filter's error on this flight is not stated with the data; asked here is that the field does no
    harm over so short a time, and that the innovations agree with the claimed sigma.
    """
    grid, ds = magnav_flight(real_data / "magnav_example")
    options = NavigationOptions(start_sigma=10.0, current_sigma=0.5, bias_sigma=5.0, map_sigma=3.0, drift=0.1)
    result = navigate(ds, grid, options)
    assert rms(result) < 60.0
    assert result["accepted"].mean() > 0.95
