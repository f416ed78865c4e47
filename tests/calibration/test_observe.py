"""Observations from a deployment's columns."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from magbridge.calibration.fitting.observe import observations
from magbridge.errors import CalibrationError, FormatError


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
    assert data.names == ("battpos",)
    assert data.units == ("in",)
    assert len(data) == n
    with pytest.raises(FormatError, match=r"column 'fin': expected .*; there are: .* battpos"):
        observations(ds, ["fin"])
    with pytest.raises(CalibrationError, match="'battpos': expected numbers"):
        observations(ds.assign(battpos=("time", np.array(["a"] * n))), ["battpos"])
