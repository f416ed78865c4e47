"""Magnetic headings made true."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from magbridge.field.reference import main_field, require_date

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["with_true_heading"]


def with_true_heading(deployment: xr.Dataset, reference: str | None = None) -> xr.Dataset:
    """Return the deployment with ``heading`` measured from true north.

    Parameters
    ----------
    deployment : Dataset (time)
        With ``heading`` (deg), and ``latitude longitude`` (deg) if it is magnetic.
    reference : {"true", "magnetic"}, optional
        The north that headings are measured from; default: the attribute ``heading_reference``.

    Raises
    ------
    FormatError
        Magnetic headings on a day that is not known.

    Notes
    -----
    To magnetic headings the IGRF's declination at the position is added, ``D = atan2(B_east, B_north)``; any
    other deployment is returned unchanged. Without a position a magnetic heading becomes NaN.
    """
    reference = reference or deployment.attrs.get("heading_reference")
    if reference != "magnetic" or "heading" not in deployment:
        return deployment
    require_date(deployment)
    north, east, _ = main_field(deployment).T
    heading = (deployment["heading"].to_numpy() + np.degrees(np.arctan2(east, north))) % 360.0
    out = deployment.assign(heading=("time", heading, deployment["heading"].attrs))
    out.attrs["heading_reference"] = "true"
    return out
