"""A Seaglider's dive as the basestation writes it: raw compass counts, attitude and the moving masses.

Conventions, and how they were found (SG167, five dives of 2014, 8 N 85 E: regression of the raw counts on
the IGRF rotated by the logged attitude):

- ``eng_mag_x/y/z`` are x forward, y starboard, z down, as ours: the 3x3 matrix of that regression is the
  identity to 5 % with no element off the diagonal above 0.01;
- one count is 1 mG = 100 nT: the diagonal of that matrix is 0.97 to 1.05 counts/mG; the deviation from 1 is
  the sensor's own calibration;
- ``eng_head`` is magnetic (the file says so, and with that the matrix's elements between x and y vanish);
  ``magnetic_variation`` is kept as an attribute, 0.1 deg coarse;
- ``eng_pitchCtl`` is in cm; ``eng_rollCtl`` in deg (its counts are scaled by ``ROLL_CNV`` = 0.028 deg);
  ``eng_vbdCC`` in cc.

The CTD's temperature, pressure, latitude and longitude are interpolated to the compass samples. Of each
motor's current, the file holds one mean per manoeuvre; rows within a manoeuvre in which that motor ran carry
it, all others 0.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.errors import FormatError
from magbridge.logs.cf import floats
from magbridge.logs.deployment import deployment
from magbridge.logs.resample import CIRCLES, linear

__all__ = ["DIMENSION", "NT_PER_COUNT", "dive"]

DIMENSION = "sg_data_point"
NT_PER_COUNT = 100.0
MAX_GAP = 120.0
"""s between CTD samples across which nothing is interpolated."""
COLUMNS = {
    # ours: (theirs, unit, factor)
    "mag_x": ("eng_mag_x", "nT", NT_PER_COUNT),
    "mag_y": ("eng_mag_y", "nT", NT_PER_COUNT),
    "mag_z": ("eng_mag_z", "nT", NT_PER_COUNT),
    "roll": ("eng_rollAng", "deg", 1.0),
    "pitch": ("eng_pitchAng", "deg", 1.0),
    "heading": ("eng_head", "deg", 1.0),
    "depth": ("depth", "m", 1.0),
    "pitchCtl": ("eng_pitchCtl", "cm", 1.0),
    "rollCtl": ("eng_rollCtl", "deg", 1.0),
    "vbdCC": ("eng_vbdCC", "cc", 1.0),
}
CTD = {
    "latitude": ("latitude", "deg"),
    "longitude": ("longitude", "deg"),
    "water_temperature": ("temperature", "degC"),
    "water_pressure": ("ctd_pressure", "dbar"),
}
MOTORS = ("pitch", "roll", "vbd")


def dive(path: Path, file: Any) -> xr.Dataset:
    """Return one dive.

    Parameters
    ----------
    path : Path
        Named in errors.
    file : netCDF4.Dataset
        Open.

    Raises
    ------
    FormatError
        No magnetometer in the file.
    """
    rows = file.dimensions[DIMENSION].size
    for theirs in ("time", "eng_mag_x", "eng_mag_y", "eng_mag_z"):
        if _numbers(file, theirs, rows) is None:
            raise FormatError(
                path, "expected this variable, as of a Seaglider with a raw compass", column=theirs
            )
    time = floats(file["time"])
    columns, units = {}, {}
    for ours, (theirs, unit, scale) in COLUMNS.items():
        if (values := _numbers(file, theirs, rows)) is not None:
            columns[ours], units[ours] = values * scale, unit
    if "ctd_time" in file.variables:
        ctd_time = floats(file["ctd_time"])
        for ours, (theirs, unit) in CTD.items():
            if (values := _numbers(file, theirs, ctd_time.size)) is not None:
                columns[ours] = linear(time, ctd_time, values, MAX_GAP, *CIRCLES.get(ours, ()))
                units[ours] = unit
    for motor in MOTORS:
        if (current := _current(file, motor, time)) is not None:
            columns[f"{motor}_current"], units[f"{motor}_current"] = current, "A"
    attrs: dict[str, Any] = {"heading_reference": "magnetic", "mag_scale_nT_per_count": NT_PER_COUNT}
    if "magnetic_variation" in file.variables and file["magnetic_variation"].size == 1:
        attrs["magnetic_variation_deg"] = float(file["magnetic_variation"][...])
    return deployment(path, time, columns, units, attrs)


def _numbers(file: Any, name: str, size: int) -> FloatArray | None:
    """Return a variable (size,); None where the file has none of that size."""
    if name not in file.variables or file[name].shape != (size,):
        return None
    return floats(file[name])


def _current(file: Any, motor: str, time: FloatArray) -> FloatArray | None:
    """Return the mean current (A) of one motor in the manoeuvre at each time; 0 outside manoeuvres."""
    if f"gc_{motor}_i" not in file.variables:
        return None
    amperes = floats(file[f"gc_{motor}_i"])
    starts, ends = (_numbers(file, name, amperes.size) for name in ("gc_st_secs", "gc_end_secs"))
    if starts is None or ends is None:
        return None
    current = np.zeros(len(time))
    for start, end, ampere in zip(starts, ends, amperes, strict=True):
        current[(time >= start) & (time <= end)] = ampere
    return current
