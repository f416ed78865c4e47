"""A deployment's motion for a navigator, in columns that an emulated autopilot can send."""

from __future__ import annotations

import numpy as np
import xarray as xr

from magbridge.field.geodesy import separation
from magbridge.navigate.batch import MOTIONS, first_position, motion_of

__all__ = ["with_motion"]


def with_motion(deployment: xr.Dataset) -> xr.Dataset:
    """Return the deployment with the columns that the autopilot sends to a navigator.

    These are ``gps_latitude gps_longitude`` (deg), the log's or its first position, and ``local_north
    local_east`` (m) of a track or a velocity. From a speed or a glide the bridge dead-reckons itself. The
    motions :data:`~magbridge.navigate.batch.MOTIONS` are tried in that order.

    Raises
    ------
    FormatError
        The log has no position to start from, or no motion.
    """
    source = str(deployment.attrs.get("source", "deployment"))
    motion = motion_of(deployment, source)
    if "gps_latitude" not in deployment:
        for name, first in zip(("latitude", "longitude"), first_position(deployment, source), strict=True):
            fix = np.where(np.arange(deployment.sizes["time"]) == 0, first, np.nan)
            deployment = deployment.assign({f"gps_{name}": ("time", fix)})
    columns = [deployment[name].to_numpy().astype(float) for name in MOTIONS[motion]]
    if motion == "velocity":
        step = np.diff(deployment["time"].to_numpy().astype(float), prepend=np.nan)
        local = [np.nancumsum(step * (velocity + np.roll(velocity, 1)) / 2) for velocity in columns]
    elif motion in ("inertial", "position"):
        latitude, longitude = columns
        known = np.flatnonzero(np.isfinite(latitude + longitude))[0]
        local = list(separation(float(latitude[known]), float(longitude[known]), latitude, longitude))
    else:
        return deployment
    return deployment.assign(local_north=("time", local[0]), local_east=("time", local[1]))
