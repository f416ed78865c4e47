"""Test equation 4, the reference of the total field."""

import numpy as np
import pytest
import xarray as xr
from numpy.typing import ArrayLike

from magbridge.arrays import BoolArray, FloatArray
from magbridge.errors import FormatError, OutOfRange
from magbridge.field import reference as module
from magbridge.field.geodesy import offset
from magbridge.field.grid import AnomalyGrid
from magbridge.field.igrf import igrf, total_field
from magbridge.field.reference import (
    earth_field,
    main_field,
    placed,
    positions,
    reference_field,
    with_true_heading,
)
from magbridge.logs.deployment import deployment as made
from sitl import Twin, load

TIME = 1386201600.0 + np.arange(6.0)


def deployment(**columns: list[float]) -> xr.Dataset:
    return xr.Dataset({name: ("time", values) for name, values in columns.items()}, {"time": TIME})


PLACE = {"latitude": [49.5] * 6, "longitude": [-57.9] * 6, "depth": list(np.arange(6.0) * 100)}


def test_is_the_main_field_at_each_depth_plus_anomaly_plus_bias() -> None:
    grid = AnomalyGrid(np.linspace(-58, -57.8, 9), np.linspace(49.4, 49.6, 9), np.full((9, 9), 33.0))
    expected = total_field(-57.9, 49.5, PLACE["depth"], TIME) + 33.0 - 4.0
    np.testing.assert_allclose(reference_field(deployment(**PLACE), grid, -4.0), expected, atol=1e-6)


def test_total_and_vector_come_from_one_evaluation_of_the_main_field(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []

    def counted(*of: ArrayLike) -> FloatArray:
        calls.append(1)
        return igrf(*of)

    monkeypatch.setattr(module, "igrf", counted)
    total, vector, name = earth_field(deployment(**PLACE))
    assert (len(calls), name) == (1, "IGRF")
    assert vector is not None
    np.testing.assert_allclose(total, total_field(-57.9, 49.5, PLACE["depth"], TIME), rtol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(vector, axis=1), total, rtol=1e-12)


def test_a_map_flown_above_is_continued_to_the_depth() -> None:
    """Under dives, most of the difference between an aircraft's map and the true field is the altitude."""
    twin, rng = Twin.draw(load("demo"), 5), np.random.default_rng(5)
    flown = twin.anomaly_map()
    unknown = AnomalyGrid(flown.longitude, flown.latitude, flown.anomaly)
    time, depth = TIME[0] + np.arange(300.0), rng.uniform(0.0, 140.0, 300)
    latitude, longitude = offset(*twin.world.origin, *rng.uniform(-4_000.0, 4_000.0, (2, 300)))
    truth = np.linalg.norm(twin.world.field(time, latitude, longitude, depth), axis=1)
    columns = {"latitude": latitude, "longitude": longitude, "depth": depth}
    there = xr.Dataset({name: ("time", values) for name, values in columns.items()}, {"time": time})
    error = [np.std(reference_field(there, grid) - truth) for grid in (unknown, flown)]
    assert error[1] < 0.4 * error[0]


def test_a_given_reference_counts_where_it_is_given() -> None:
    given = [50_000.0, np.nan, 50_002.0, np.nan, np.nan, np.nan]
    field = reference_field(deployment(reference_field=given, **PLACE))
    assert field[0] == 50_000.0
    assert field[2] == 50_002.0
    np.testing.assert_allclose(field[[1, 3]], total_field(-57.9, 49.5, [100.0, 300.0], TIME[0]), atol=1e-3)
    alone = reference_field(deployment(reference_field=given))
    assert np.isnan(alone).tolist() == np.isnan(given).tolist()


def test_rows_without_a_position_get_one_from_their_neighbours() -> None:
    nan = np.nan
    gaps = deployment(
        latitude=[nan, 49.0, nan, nan, 49.3, nan], longitude=[nan, 179.9, nan, nan, -179.8, nan]
    )
    longitude, latitude, depth = positions(gaps)
    np.testing.assert_allclose(latitude, [49.0, 49.0, 49.1, 49.2, 49.3, 49.3])
    np.testing.assert_allclose(longitude, [179.9, 179.9, -180.0, -179.9, -179.8, -179.8])
    assert not depth.any()


def test_says_what_is_missing() -> None:
    with pytest.raises(FormatError, match="expected latitude and longitude, or reference_field"):
        reference_field(deployment(depth=[0.0] * 6))
    elsewhere = AnomalyGrid(np.linspace(0, 1, 9), np.linspace(0, 1, 9), np.zeros((9, 9)))
    with pytest.raises(OutOfRange, match="does not cover"):
        reference_field(deployment(**PLACE), elsewhere)
    with pytest.raises(OutOfRange, match="the IGRF covers"):
        reference_field(deployment(**PLACE).assign_coords(time=TIME + 3e9))


def test_a_hole_in_the_positions_is_not_a_track_and_surfacings_are_one() -> None:
    time = np.arange(0.0, 4000.0, 4.0)
    latitude = np.linspace(49.0, 49.1, len(time))
    latitude[300:500] = np.nan
    latitude[700:710] = np.nan

    def of(column: FloatArray) -> BoolArray:
        return placed(xr.Dataset({"latitude": ("time", column)}, {"time": time}))

    np.testing.assert_array_equal(np.flatnonzero(~of(latitude)), np.arange(300, 500))
    late = np.where(time < 1000.0, np.nan, latitude)
    np.testing.assert_array_equal(np.flatnonzero(~of(late)), [*range(230), *range(300, 500)])
    surfaced = np.where(np.arange(len(time)) % 400 < 20, latitude, np.nan)
    assert of(surfaced).all()
    assert of(np.full(len(time), np.nan)).all()


# ---- a log whose times count from the boot has no date, and so no Earth's field ----------------------------


N = 5


def log(start: float, **attrs: str) -> xr.Dataset:
    columns = {"latitude": np.full(N, 47.0), "longitude": np.full(N, -52.0), "heading": np.full(N, 10.0)}
    return made("flight.BIN", start + np.arange(float(N)), columns, attrs=attrs)


UNDATED = [log(0.0), log(1.7e9, time_reference="boot"), log(3e8)]


@pytest.mark.parametrize("undated", UNDATED)
def test_there_is_no_field_of_1970(undated: xr.Dataset) -> None:
    told = r"flight\.BIN: its times count from the boot.* --date YYYY-MM-DD"
    for compute in (reference_field, earth_field):
        with pytest.raises(FormatError, match=told):
            compute(undated)
    with pytest.raises(FormatError, match="--date"):
        with_true_heading(undated, "magnetic")
    assert np.isnan(main_field(undated)).all()


@pytest.mark.parametrize("undated", UNDATED)
def test_a_reference_of_its_own_needs_no_date(undated: xr.Dataset) -> None:
    known = undated.assign(reference_field=("time", np.full(N, 5e4)))
    total, vector, name = earth_field(known)
    assert total.tolist() == [5e4] * N
    assert vector is None
    assert name == "reference_field"
