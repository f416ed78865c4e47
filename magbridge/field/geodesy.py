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
"""Squared first eccentricity of WGS84."""
RADIAN = pi / 180.0
"""Radians in a degree."""
ACROSS = EQUATORIAL_RADIUS * RADIAN
"""Metres per degree across the meridian for w = 1, before cos φ (:func:`metres_per_degree`)."""
ALONG = ACROSS * (1.0 - ECCENTRICITY_SQUARED)
"""Metres per degree of latitude for w = 1 (:func:`metres_per_degree`)."""

Number = TypeVar("Number", float, FloatArray)


@overload
def metres_per_degree(latitude: float) -> tuple[float, float]: ...
@overload
def metres_per_degree(latitude: FloatArray) -> tuple[FloatArray, FloatArray]: ...
def metres_per_degree(latitude: float | FloatArray) -> tuple[float | FloatArray, float | FloatArray]:
    """Return the lengths, m, of a degree of latitude and of a degree of longitude at `latitude` (deg; (n,)).

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


def offset(latitude: Any, longitude: Any, north: Number, east: Number) -> tuple[Number, Number]:
    """Return (latitude, longitude), deg, at `north` and `east` m from a position; longitude in -180..180.

    Arrays (n,) give places from one position, or pair by pair. Both radii of curvature are those at the
    start, so that :func:`separation` is the exact inverse. The error of an east-west line of 20 km at 60
    degrees is 55 m.
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
    """Return the separation, m (north, east), from one position (deg) to another; the inverse of `offset`.

    Arrays (n,) give separations from one position to many, or pair by pair.
    """
    per_latitude, per_longitude = metres_per_degree(latitude)
    return (to_latitude - latitude) * per_latitude, wrap(to_longitude - longitude) * per_longitude


def worse_axis(nn: Number, ne: Number, ee: Number) -> Number:
    """Return a position's 1-sigma (m) along the longer axis of its error ellipse; covariance elements in m².

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
    """Return an angle or an array of angles, deg, wrapped to -180..180."""
    return (degrees + 180.0) % 360.0 - 180.0


def signed_longitude(longitude: float) -> float:
    """Return a longitude of up to 540 deg, as of a map across the antimeridian, in -180 to 180 deg.

    180, the east edge of a map, stays 180; :func:`wrap` would return -180.
    """
    return longitude - 360.0 if longitude > 180.0 else longitude
