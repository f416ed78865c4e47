"""A Seaglider's dive, made by hand: the real ones are not ours to keep here."""

from __future__ import annotations

from pathlib import Path

import netCDF4
import numpy as np

from magbridge import logs


def test_a_dive_across_the_date_line(tmp_path: Path) -> None:
    """Its positions stand at the times of its CTD, and what lies between two of them is beside them."""
    path = tmp_path / "p1670001.nc"
    with netCDF4.Dataset(path, "w") as file:
        for dimension, rows in (("sg_data_point", 7), ("ctd_data_point", 3)):
            file.createDimension(dimension, rows)
        columns = {
            "time": (1e9 + 10.0 * np.arange(7), "sg_data_point"),
            **{f"eng_mag_{axis}": (np.full(7, 200.0), "sg_data_point") for axis in "xyz"},
            "eng_head": (np.array([350.0, 355, 0, 5, 10, 15, 20]), "sg_data_point"),
            "ctd_time": (1e9 + 30.0 * np.arange(3), "ctd_data_point"),
            "latitude": (np.full(3, -17.0), "ctd_data_point"),
            "longitude": (np.array([179.97, -180.0, -179.97]), "ctd_data_point"),
        }
        for name, (values, dimension) in columns.items():
            file.createVariable(name, "f8", (dimension,))[:] = values
    dive = logs.read(path)
    east = np.array([-3, -2, -1, 0, 1, 2, 3]) * 0.01
    np.testing.assert_allclose((dive["longitude"] + 360.0) % 360.0, 180.0 + east, atol=1e-9)
    assert float(np.abs(dive["longitude"]).max()) <= 180.0
