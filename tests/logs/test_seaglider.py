"""A Seaglider's dive, made by hand: the real ones are not ours to keep here."""

from __future__ import annotations

from pathlib import Path

import netCDF4
import numpy as np
import pytest
import xarray as xr

from magbridge import logs
from magbridge.errors import FormatError

SIZES = {"sg_data_point": 7, "ctd_data_point": 3, "gc_event": 2}
DIVE = {
    "time": ("sg_data_point", 1e9 + 10.0 * np.arange(7)),
    **{f"eng_mag_{axis}": ("sg_data_point", np.full(7, 200.0)) for axis in "xyz"},
    "eng_head": ("sg_data_point", np.array([350.0, 355, 0, 5, 10, 15, 20])),
    "ctd_time": ("ctd_data_point", 1e9 + 30.0 * np.arange(3)),
    "latitude": ("ctd_data_point", np.full(3, -17.0)),
    "longitude": ("ctd_data_point", np.array([179.97, -180.0, -179.97])),
    "gc_st_secs": ("gc_event", 1e9 + np.array([10.0, 50.0])),
    "gc_end_secs": ("gc_event", 1e9 + np.array([25.0, 50.0])),
    "gc_vbd_i": ("gc_event", np.array([1.5, 2.0])),
}
"""Variable -> its dimension, and its values."""


def dive(path: Path, **changed: tuple[str, np.ndarray]) -> xr.Dataset:
    """Read a file of the dive, with some variables changed."""
    with netCDF4.Dataset(path, "w") as file:
        for dimension, rows in SIZES.items():
            file.createDimension(dimension, rows)
        for name, (dimension, values) in (DIVE | changed).items():
            file.createVariable(name, "f8", (dimension,))[:] = values
    return logs.read(path)


def test_a_dive_across_the_date_line(tmp_path: Path) -> None:
    """Its positions stand at the times of its CTD, and what lies between two of them is beside them."""
    read = dive(tmp_path / "p1670001.nc")
    east = np.array([-3, -2, -1, 0, 1, 2, 3]) * 0.01
    np.testing.assert_allclose((read["longitude"] + 360.0) % 360.0, 180.0 + east, atol=1e-9)
    assert float(np.abs(read["longitude"]).max()) <= 180.0


def test_a_motor_s_current_is_that_of_its_manoeuvre(tmp_path: Path) -> None:
    read = dive(tmp_path / "p1670001.nc")
    np.testing.assert_array_equal(read["vbd_current"], [0.0, 1.5, 1.5, 0.0, 0.0, 2.0, 0.0])


def test_variables_of_another_length_than_their_times_are_left_out(tmp_path: Path) -> None:
    """As in a file that somebody has cut: a channel of the magnetometer is missed aloud."""
    path, short = tmp_path / "p1670001.nc", ("gc_event", np.zeros(2))
    whole = set(dive(path))
    for name, column in (("latitude", "latitude"), ("eng_head", "heading")):
        assert set(dive(path, **{name: short})) == whole - {column}
    assert set(dive(path, gc_end_secs=("ctd_data_point", np.zeros(3)))) == whole - {"vbd_current"}
    with pytest.raises(FormatError, match="column 'eng_mag_y': expected this variable, as of a Seaglider"):
        dive(path, eng_mag_y=short)
