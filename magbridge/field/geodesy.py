"""Metres and degrees on the WGS84 ellipsoid."""

from __future__ import annotations

from math import cos, pi, sin, sqrt
from typing import Any, TypeVar, overload

import numpy as np

from magbridge.arrays import FloatArray

__all__ = [
    "ECCENTRICITY_SQUARED", "EQUATORIAL_RADIUS", "metres_per_degree", "offset", "separation",
    "signed_longitude", "worse_axis", "wrap",
]  # fmt: skip

EQUATORIAL_RADIUS = 6_378_137.0
"""Equatorial radius of WGS84, m."""
ECCENTRICITY_SQUARED = 6.694_379_990_14e-3
"""Of WGS84."""
RADIAN = pi / 180.0
"""A degree, in radians."""
ACROSS = EQUATORIAL_RADIUS * RADIAN
"""m per degree of longitude, divided by w."""
ALONG = ACROSS * (1.0 - ECCENTRICITY_SQUARED)
"""m per degree of latitude, divided by w³."""

Number = TypeVar("Number", float, FloatArray)


@overload
def metres_per_degree(latitude: float) -> tuple[float, float]: ...
@overload
def metres_per_degree(latitude: FloatArray) -> tuple[FloatArray, FloatArray]: ...
def metres_per_degree(latitude: float | FloatArray) -> tuple[float | FloatArray, float | FloatArray]:
    """Return the metres that a degree of latitude and one of longitude span at `latitude` (deg, or (n,)).

    Notes
    -----
    ``M = a (1 - e²) / w³`` and ``N cos φ = a cos φ / w`` with ``w = sqrt(1 - e² sin² φ)``, the radii of
    curvature along the meridian and across it.
    """
    phi = latitude * RADIAN
    if isinstance(phi, float):  # numpy takes ten times as long for one number
        w = sqrt(1.0 - ECCENTRICITY_SQUARED * sin(phi) ** 2)
        return ALONG / (w * w * w), ACROSS * cos(phi) / w
    w_squared = 1.0 - ECCENTRICITY_SQUARED * np.sin(phi) ** 2
    return ALONG / w_squared**1.5, ACROSS * np.cos(phi) / np.sqrt(w_squared)


def offset(latitude: float, longitude: float, north: Number, east: Number) -> tuple[Number, Number]:
    """Return (latitude, longitude), deg, `north` and `east` m from a position; longitude in -180..180.

    Both radii are those at the position one starts from, so :func:`separation` is its exact inverse;
    over 20 km at 60 degrees that bends an east-west line by 50 m at most.
    """
    per_latitude, per_longitude = metres_per_degree(latitude)
    return latitude + north / per_latitude, wrap(longitude + east / per_longitude)


@overload
def separation(
    latitude: float, longitude: float, to_latitude: float, to_longitude: float
) -> tuple[float, float]: ...
@overload
def separation(
    latitude: float | FloatArray,
    longitude: float | FloatArray,
    to_latitude: FloatArray,
    to_longitude: FloatArray,
) -> tuple[FloatArray, FloatArray]: ...
def separation(latitude: Any, longitude: Any, to_latitude: Any, to_longitude: Any) -> tuple[Any, Any]:
    """Return m (north, east) from one position (deg) to another, from one to many (n,), or pair by pair.

    The inverse of :func:`offset`.
    """
    per_latitude, per_longitude = metres_per_degree(latitude)
    return (to_latitude - latitude) * per_latitude, wrap(to_longitude - longitude) * per_longitude


def worse_axis(nn: Number, ne: Number, ee: Number) -> Number:
    """Return a position's 1-sigma (m) along its ellipse's longer axis; the covariance is (north, east) in m².

    Notes
    -----
    The larger eigenvalue is ``(P_nn + P_ee) / 2 + sqrt((P_nn - P_ee)² / 4 + P_ne²)``.
    """
    half: Number = 0.5 * (nn - ee)
    variance: Number = 0.5 * (nn + ee) + (half * half + ne * ne) ** 0.5
    positive: Number = variance * (variance > 0.0)  # rounding may leave a huge covariance negative
    sigma: Number = positive**0.5
    return sigma


def wrap(degrees: Number) -> Number:
    """Return an angle, or an array of them, in -180..180 deg."""
    return (degrees + 180.0) % 360.0 - 180.0


def signed_longitude(longitude: float) -> float:
    """Return a longitude up to 540 deg, of a map across the antimeridian, as -180 to 180: 180.01 is -179.99.

    :func:`wrap` makes -180 of 180, a map's east edge.
    """
    return longitude - 360.0 if longitude > 180.0 else longitude
