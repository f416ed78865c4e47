"""Magnetic headings made true."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from magbridge.field.reference import main_field

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["with_true_heading"]


def with_true_heading(deployment: xr.Dataset, reference: str | None = None) -> xr.Dataset:
    """Return the deployment with ``heading`` counted from true north.

    Parameters
    ----------
    deployment : Dataset (time)
    reference : {"true", "magnetic"}, optional
        What the headings are counted from; default what the attribute ``heading_reference`` says.

    Notes
    -----
    To magnetic headings the IGRF's declination at the position is added, ``D = atan2(B_east, B_north)``; any
    other deployment comes back as it is. Without a position a magnetic heading becomes NaN: it is not known.
    """
    reference = reference or deployment.attrs.get("heading_reference")
    if reference != "magnetic" or "heading" not in deployment:
        return deployment
    north, east, _ = main_field(deployment).T
    heading = (deployment["heading"].to_numpy() + np.degrees(np.arctan2(east, north))) % 360.0
    out = deployment.assign(heading=("time", heading, deployment["heading"].attrs))
    out.attrs["heading_reference"] = "true"
    return out
