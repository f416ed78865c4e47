"""A simulated deployment as a Dataset: names, units, and the mission's parts."""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sitl.platform import MOUNTINGS
from sitl.trajectory import Track

__all__ = ["COLUMNS", "dataset", "segments"]

Array = NDArray[np.float64]

COLUMNS = {
    "mag_x": ("nT", "raw magnetometer channel, forward"),
    "mag_y": ("nT", "raw magnetometer channel, starboard"),
    "mag_z": ("nT", "raw magnetometer channel, down"),
    "mag_time_x": ("s", "time of the forward channel's sample"),
    "mag_time_y": ("s", "time of the starboard channel's sample"),
    "mag_time_z": ("s", "time of the downward channel's sample"),
    "sensor_temperature": ("degC", "temperature at the fluxgate"),
    "power_cycle": ("1", "times the instrument was powered on again"),
    "roll": ("deg", "roll, starboard down"),
    "pitch": ("deg", "pitch, nose up"),
    "heading": ("deg", "heading, true"),
    "latitude": ("deg", "latitude as the vehicle knows it"),
    "longitude": ("deg", "longitude as the vehicle knows it"),
    "depth": ("m", "depth"),
    "run": ("1", "number of the leg"),
    "reference_field": ("nT", "total field to calibrate against"),
    "truth_total_field": ("nT", "true total field"),
    "truth_field_x": ("nT", "true field, body forward"),
    "truth_field_y": ("nT", "true field, body starboard"),
    "truth_field_z": ("nT", "true field, body down"),
    "truth_latitude": ("deg", "true latitude"),
    "truth_longitude": ("deg", "true longitude"),
}
"""Unit and meaning of each column, telemetry of the moving masses aside."""


def dataset(track: Track, when: Array, columns: Mapping[str, Array], name: str) -> xr.Dataset:
    """Return `columns`, sampled at `when` (s after the track's start), as a deployment."""
    units = COLUMNS | {
        parameter: (MOUNTINGS[parameter].unit if parameter in MOUNTINGS else "1", f"position of {parameter}")
        for parameter in track.parameters
    }
    parts = [(part, track.start + first, track.start + last) for part, first, last in track.segments]
    return xr.Dataset(
        {
            column: ("time", columns[column], dict(zip(("units", "long_name"), units[column], strict=True)))
            for column in units
            if column in columns
        },
        coords={"time": ("time", track.start + when, {"units": "s", "long_name": "time since 1970 UTC"})},
        attrs={"source": f"simulated: {name}", "segments": json.dumps(parts)},
    )


def segments(deployment: xr.Dataset) -> dict[str, xr.Dataset]:
    """Return the parts of a simulated deployment's mission by name."""
    return {
        name: deployment.sel(time=slice(first, np.nextafter(last, first)))
        for name, first, last in json.loads(deployment.attrs["segments"])
    }
