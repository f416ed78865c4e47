"""Posterior Cramér-Rao bound of the position along a planned track."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from magbridge.arrays import FloatArray
from magbridge.errors import OutOfRange
from magbridge.field.geodesy import metres_per_degree, separation, wrap
from magbridge.field.grid import AnomalyGrid
from magbridge.field.igrf import total_field
from magbridge.navigate.model import N_STATES, block_length, measurement_row, prior, transition
from magbridge.navigate.options import NavigationOptions, lasting_errors

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Bound", "as_dataset", "position_bound"]

SLOPE_STEP_DEG = 0.005
"""Difference of latitude or longitude over which the main field's slope is computed, deg."""


class Bound(NamedTuple):
    """Smallest possible errors along a track of n points: time (s), position (deg), covariance (n, 6, 6).

    ``sigma`` (m) is ``sqrt(P_nn + P_ee)``, to compare with the RMS of a position error; ``unaided`` (m) is
    that of dead reckoning alone.
    """

    time: FloatArray
    latitude: FloatArray
    longitude: FloatArray
    covariance: FloatArray
    sigma: FloatArray
    unaided: FloatArray


def position_bound(
    grid: AnomalyGrid,
    time: ArrayLike,
    latitude: ArrayLike,
    longitude: ArrayLike,
    options: NavigationOptions | None = None,
    sigma: float = 1.0,
    depth: float = 0.0,
    every: float = 4.0,
) -> Bound:
    """Return the posterior Cramér-Rao bound of the position along a track.

    Parameters
    ----------
    grid : AnomalyGrid
        The anomaly map.
    time : array_like, (n,)
        Times of the track's corners, increasing, s since 1970 UTC.
    latitude, longitude : array_like, (n,)
        Positions of the corners, deg.
    options : NavigationOptions, optional
        Prior uncertainties of start, current, calibration and map.
    sigma : float, optional
        1-sigma of one sample, nT.
    depth : float, optional
        Depth of the track, m.
    every : float, optional
        Time between samples, s.

    Returns
    -------
    Bound
        At the times of the filter's updates.

    Raises
    ------
    OutOfRange
        A track of one corner, a track shorter than half an update, or time that does not increase.

    Notes
    -----
    ``J_k+1 = (Q + F J_k^-1 F')^-1 + H' R^-1 H`` (Tichavský, Muravchik & Nehorai 1998, eq. 21). With linear
    motion it is the inverse covariance of a Kalman filter that linearises the map at the true position. Off
    the map, measurements are missing.
    """
    # The bound is the covariance of a Kalman filter that linearises at the truth: only the slopes of the
    # field along the track are needed, no measurement.
    grid, o = lasting_errors(grid, options or NavigationOptions())
    corners = np.asarray(time, float)
    lat, lon = np.asarray(latitude, float), np.unwrap(np.asarray(longitude, float), period=360.0)
    along = _along(corners, lat, lon)
    speed = along[-1] / (corners[-1] - corners[0])
    lasts = min(o.interval, block_length(grid) / max(speed, 1e-9))
    # Blocks are those of the filter, so that bound and filter use the same number of samples.
    interval = every * (int(lasts / every + 1e-9) + 1)  # a block of as many samples as the filter's
    at = np.arange(corners[0] + 0.5 * interval, corners[-1], interval)
    if not at.size:
        many = f"{corners[-1] - corners[0]:g} s"
        raise OutOfRange("track", many, f"at least {0.5 * interval:.0f} s are needed")
    lat, lon = np.interp(at, corners, lat), wrap(np.interp(at, corners, lon))
    metres = np.diff(np.interp(at, corners, along), prepend=0.0)
    local = grid.evaluate(lon, lat)
    main = total_field(lon, lat, depth, at)
    per_latitude, per_longitude = metres_per_degree(lat)
    # Slopes of the main field by differences; the map's come from its interpolation.
    slope_north = (total_field(lon, lat + SLOPE_STEP_DEG, depth, at) - main) / (SLOPE_STEP_DEG * per_latitude)
    slope_east = (total_field(lon + SLOPE_STEP_DEG, lat, depth, at) - main) / (SLOPE_STEP_DEG * per_longitude)

    variance = sigma**2 * every / interval
    _, P = prior(o)
    alone = P
    covariance = np.empty((at.size, N_STATES, N_STATES))
    unaided = np.empty(at.size)
    previous = corners[0]
    for i, now in enumerate(at):
        # P' = F P F' + Q, then P = P' - P' H' (H P' H' + R)^-1 H P' where there is a map.
        F, Q = transition(o, now - previous, float(metres[i]))
        P, alone, previous = F @ P @ F.T + Q, F @ alone @ F.T + Q, now
        if np.isfinite(local.anomaly[i]):
            errors, independent = grid.error(float(local.variance[i]))
            row = measurement_row(local.north[i] + slope_north[i], local.east[i] + slope_east[i], errors)
            gain = P @ row.T
            P = P - gain @ gain.T / float((row @ gain)[0, 0] + variance + independent)
        covariance[i], unaided[i] = P, np.sqrt(alone[0, 0] + alone[1, 1])
    reached = np.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1])
    return Bound(at, lat, lon, covariance, reached, unaided)


def _along(time: FloatArray, latitude: FloatArray, longitude: FloatArray) -> FloatArray:
    """Return the distance along a track from its first corner to each corner, (n,) m."""
    if time.size < 2:
        raise OutOfRange("track", f"{time.size} positions", "at least two are needed")
    if (np.diff(time) <= 0.0).any():
        raise OutOfRange("time", "the track's", "it must increase from corner to corner")
    legs = [separation(*a, *b) for a, b in pairwise(zip(latitude, longitude, strict=True))]
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.array(legs).T))])


def as_dataset(bound: Bound, grid: AnomalyGrid) -> xr.Dataset:
    """Return the bound as a dataset on ``time``; the attribute ``findings`` summarises it in a sentence."""
    import xarray as xr  # noqa: PLC0415 - the live path runs without it

    columns = {
        "latitude": ("deg", "planned latitude", bound.latitude),
        "longitude": ("deg", "planned longitude", bound.longitude),
        "sigma": ("m", "smallest possible position error (DRMS)", bound.sigma),
        "unaided": ("m", "position error of dead reckoning alone (DRMS)", bound.unaided),
    }
    off = np.isnan(grid.evaluate(bound.longitude, bound.latitude).anomaly)
    best = int(bound.sigma.argmin())
    hours = (bound.time[best] - bound.time[0]) / 3600.0
    when = f"after {hours:.1f} h" if best else "at the start"
    findings = (
        f"at best {bound.sigma[best]:.0f} m {when}, at the end {bound.sigma[-1]:.0f} m;"
        f" dead reckoning alone {bound.unaided[-1]:.0f} m"
    )
    if off.any():
        findings += f"; off the map for {100.0 * off.mean():.0f} % of the track"
    return xr.Dataset(
        {k: ("time", v, {"units": unit, "long_name": name}) for k, (unit, name, v) in columns.items()},
        {"time": ("time", bound.time, {"units": "s", "long_name": "seconds since 1970-01-01 UTC"})},
        {"map": grid.name, "findings": findings},
    )
