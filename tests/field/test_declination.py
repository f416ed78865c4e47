"""Magnetic headings made true."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest
import xarray as xr

from magbridge.field.reference import with_true_heading

TIME = 1_400_000_000.0 + np.arange(3.0)


def deployment(**attrs: str) -> xr.Dataset:
    columns = {
        "heading": [350.0, 10.0, 200.0],
        "latitude": [49.5] * 3,
        "longitude": [-57.9] * 3,
        "depth": [0.0] * 3,
    }
    return xr.Dataset({name: ("time", values) for name, values in columns.items()}, {"time": TIME}, attrs)


def test_the_declination_is_that_of_another_implementation() -> None:
    ppigrf = pytest.importorskip("ppigrf")
    east, north, _ = ppigrf.igrf(-57.9, 49.5, 0.0, datetime.fromtimestamp(TIME[0], UTC).replace(tzinfo=None))
    declination = float(np.degrees(np.arctan2(east, north)).item())
    true = with_true_heading(deployment(heading_reference="magnetic"))
    np.testing.assert_allclose(
        true["heading"], (np.array([350.0, 10.0, 200.0]) + declination) % 360, atol=1e-3
    )
    assert true.attrs["heading_reference"] == "true"
    assert declination < -15  # west of north off Newfoundland


def test_a_true_heading_stays() -> None:
    assert with_true_heading(deployment())["heading"].to_numpy().tolist() == [350.0, 10.0, 200.0]


def test_without_a_position_a_magnetic_heading_is_unknown() -> None:
    unplaced = deployment(heading_reference="magnetic").drop_vars(["latitude", "longitude"])
    assert np.isnan(with_true_heading(unplaced)["heading"]).all()
