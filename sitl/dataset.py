"""Build the Dataset of a simulated deployment, split it into segments, and correct it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.calibration.correct import CorrectedArrays, correct
from magbridge.calibration.model import Calibration
from magbridge.columns import CHANNELS, COLUMNS, Column
from sitl.platform import MOUNTINGS
from sitl.trajectory import Track

__all__ = ["at_rest", "channels", "corrected", "dataset", "segments", "side_by_side"]

OWN = {
    "power_cycle": Column("1", "times the instrument was powered on again"),
    "run": Column("1", "number of the leg"),
    "truth_total_field": Column("nT", "true total field"),
    "truth_field_x": Column("nT", "true field, body forward"),
    "truth_field_y": Column("nT", "true field, body starboard"),
    "truth_field_z": Column("nT", "true field, body down"),
    "truth_latitude": Column("deg", "true latitude"),
    "truth_longitude": Column("deg", "true longitude"),
}
"""Columns that only a simulated deployment has."""


def dataset(track: Track, time: FloatArray, columns: Mapping[str, FloatArray], source: str) -> xr.Dataset:
    """Return a deployment of `columns` (n,), sampled at `time` (n,), s after the track's start."""
    known = dict(COLUMNS | OWN)
    for name in track.parameters:
        unit = MOUNTINGS[name].unit if name in MOUNTINGS else "1"
        known |= {name: Column(unit, f"position of {name}")}
    parts = [(part, track.start + first, track.start + last) for part, first, last in track.segments]
    return xr.Dataset(
        {name: ("time", columns[name], known[name]._asdict()) for name in known if name in columns},
        coords={"time": ("time", track.start + time, COLUMNS["time"]._asdict())},
        attrs={"source": f"simulated: {source}", "segments": json.dumps(parts)},
    )


def segments(deployment: xr.Dataset) -> dict[str, xr.Dataset]:
    """Return the segments of a simulated deployment by name."""
    return {
        name: deployment.sel(time=slice(first, np.nextafter(last, first)))
        for name, first, last in json.loads(deployment.attrs["segments"])
    }


def at_rest(deployment: xr.Dataset, masses: Iterable[str]) -> xr.Dataset:
    """Return the samples of a deployment at which none of the `masses` (names) is moving."""
    still = np.ones(deployment.sizes["time"], bool)
    for name in masses:
        moved = np.abs(np.diff(deployment[name])) > 1e-9
        still[:-1] &= ~moved
        still[1:] &= ~moved
    return deployment.isel(time=still)


def side_by_side(deployment: xr.Dataset, names: Sequence[str]) -> FloatArray:
    """Return the named columns as an array (n, k)."""
    out = np.empty((deployment.sizes["time"], len(names)))
    for k, name in enumerate(names):
        out[:, k] = deployment[name]
    return out


def channels(deployment: xr.Dataset) -> FloatArray:
    """Return the uncorrected readings of the three channels (n, 3), nT."""
    return side_by_side(deployment, CHANNELS)


def corrected(deployment: xr.Dataset, calibration: Calibration) -> CorrectedArrays:
    """Correct a deployment's channels row by row, without alignment in time; the arrays are (n, ...)."""
    positions = side_by_side(deployment, calibration.channels)
    return correct(calibration, channels(deployment), positions, deployment["time"].to_numpy())
