"""The reference for an estimate: the best position that the log has and that the estimate did not use."""

from __future__ import annotations

import numpy as np
import xarray as xr

from magbridge.field.geodesy import separation

__all__ = ["REFERENCES", "errors", "reference_track", "with_errors"]

REFERENCES = (
    ("truth_latitude", "truth_longitude"),
    ("gps_latitude", "gps_longitude"),
    ("latitude", "longitude"),
)
"""Columns of a position, the best first."""


def reference_track(deployment: xr.Dataset, used: frozenset[str]) -> xr.Dataset | None:
    """Return the best position that the estimate has not used, with the field there, or None."""
    for pair in REFERENCES:
        if pair[0] not in used and all(name in deployment for name in pair):
            others = [name for name in ("total_field_sigma", "depth") if name in deployment]
            wanted = [*pair, "total_field", *others]
            known = deployment[wanted].rename(dict(zip(pair, ("latitude", "longitude"), strict=True)))
            known = known.dropna("time", subset=["latitude", "longitude"])
            if known.sizes["time"]:
                return known.assign_attrs(reference_track=pair[0].removesuffix("latitude") or "log")
    return None


def with_errors(result: xr.Dataset, truth: xr.Dataset | None) -> xr.Dataset:
    """Add the errors against the reference track, m, where that has a position near in time."""
    if truth is None:
        return result
    time = result["time"].to_numpy()
    known = truth["time"].to_numpy()
    spacing = max(60.0, 2.0 * float(np.median(np.diff(known)))) if known.size > 1 else 60.0
    # Interpolate the reference track; a row without a reference position near in time has no error.
    nearest = np.abs(known[np.clip(np.searchsorted(known, time), 0, known.size - 1)] - time)
    before = np.abs(known[np.clip(np.searchsorted(known, time) - 1, 0, known.size - 1)] - time)
    near = np.minimum(nearest, before) <= spacing
    latitude = np.interp(time, known, truth["latitude"].to_numpy())
    longitude = np.interp(time, known, np.unwrap(truth["longitude"].to_numpy(), period=360.0))
    added = {}
    for prefix in ("", "smoothed_"):
        there = (result[f"{prefix}{name}"].to_numpy() for name in ("latitude", "longitude"))
        north, east = separation(latitude, longitude, *there)
        added[f"{prefix}error_north"] = np.where(near, north, np.nan)
        added[f"{prefix}error_east"] = np.where(near, east, np.nan)
    named = {
        name: ("time", values, {"units": "m", "long_name": name.replace("_", " ")})
        for name, values in added.items()
    }
    return result.assign(named).assign_attrs(reference_track=truth.attrs["reference_track"])


def errors(result: xr.Dataset) -> tuple[xr.DataArray, xr.DataArray]:
    """Return the errors (n,), m, of the estimate and of dead reckoning alone; NaN where unknown."""
    if "error_north" not in result:
        nobody = result["north"] * np.nan
        return nobody, nobody
    north, east = result["error_north"], result["error_east"]
    return (north**2 + east**2) ** 0.5, ((north - result["north"]) ** 2 + (east - result["east"]) ** 2) ** 0.5
