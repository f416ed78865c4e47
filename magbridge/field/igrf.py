"""The International Geomagnetic Reference Field at the position, depth and time of every sample.

ppigrf carries the coefficients of the current generation. Its import takes a second (pandas) and a call 8 ms,
and N dates at N positions give N x N fields. This module therefore reads ppigrf's coefficient file, and sums
the series itself, degree by degree for a block of samples. Tests compare the results with ppigrf.

Filters need the field at every sample, for which :class:`NearbyField` is a quadratic fit to the series. The
shortest wave of the series is 3,000 km. So over some tens of kilometres and a dive, the fit is exact to 0.001
nT up to 70 deg of latitude, at a hundredth of the cost. Nearer to a pole the meridians converge: the error is
0.01 nT at 80 deg, 0.3 nT at 89 deg and 14 nT at 89.9 deg.
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from functools import cache
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from magbridge.arrays import FloatArray
from magbridge.errors import FormatError, MissingExtra, OutOfRange
from magbridge.field.geodesy import ECCENTRICITY_SQUARED, EQUATORIAL_RADIUS, offset, separation

__all__ = ["HeldField", "NearbyField", "coverage", "igrf", "magnitude", "total_field"]

REFERENCE_RADIUS = 6_371_200.0
"""Radius of the model's sphere, m."""
IGRF_BLOCK_SAMPLES = 2048
"""Number of samples in a block, whose working arrays then fit into the processor's cache."""


class Model(NamedTuple):
    """Gauss coefficients of degree n, nT: ``g[n - 1]`` (epochs, n + 1) and ``h[n - 1]`` (epochs, n).

    `epochs` is in s since 1970 UTC.
    """

    epochs: FloatArray
    g: list[FloatArray]
    h: list[FloatArray]


def igrf(longitude: ArrayLike, latitude: ArrayLike, depth: ArrayLike, time: ArrayLike) -> FloatArray:
    """Return the main field vector, north-east-down, nT.

    Parameters
    ----------
    longitude, latitude : array_like, (n,) or scalar
        Geodetic position (WGS84), deg; longitude -180 to 360.
    depth : array_like, (n,) or scalar
        Depth below the ellipsoid, m; negative is height.
    time : array_like, (n,) or scalar
        Time, s since 1970-01-01 UTC.

    Returns
    -------
    field_ned : ndarray, (n, 3)
        Field, nT; NaN where a position or time is NaN.

    Raises
    ------
    OutOfRange
        A time outside the model's epochs, or an impossible position.

    Notes
    -----
    Minus the gradient of ``V = a Σ_n (a/r)^(n+1) Σ_m (g_nm cos mφ + h_nm sin mφ) P_nm(cos θ)``, with
    Schmidt semi-normalised P and coefficients linear in time between epochs (Alken et al. 2021,
    Earth Planets Space 73:49, eq. 1). The sum runs on ``S_nm = P_nm / sin θ``, which is finite at the poles.
    """
    lon, lat, down, at = (
        np.atleast_1d(np.asarray(a, float)).ravel() for a in (longitude, latitude, depth, time)
    )
    lon, lat, down, at = np.broadcast_arrays(lon, lat, down, at)
    model = _model(newest())
    _refuse("latitude", lat, -90.0, 90.0, "deg, -90 to 90")
    _refuse("longitude", lon, -180.0, 360.0, "deg, -180 to 360")
    start, end = model.epochs[0], model.epochs[-1]
    covered = f"the IGRF covers {_date(start)} to {_date(end)}; pip install -U ppigrf updates it"
    _refuse("time", at, start, end, covered, _date)
    field = np.empty((lat.size, 3))
    for i in range(0, lat.size, IGRF_BLOCK_SAMPLES):
        part = slice(i, i + IGRF_BLOCK_SAMPLES)
        field[part] = _block(model, lon[part], lat[part], down[part], at[part])
    return field


def total_field(longitude: ArrayLike, latitude: ArrayLike, depth: ArrayLike, time: ArrayLike) -> FloatArray:
    """Return the magnitude of :func:`igrf`, nT, (n,); same arguments and errors."""
    return magnitude(igrf(longitude, latitude, depth, time))


def magnitude(field: FloatArray) -> FloatArray:
    """Return the lengths (n,) of vectors (n, 3)."""
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", field, field)))


def coverage() -> tuple[float, float]:
    """Return the first and last time, s since 1970 UTC, at which the model is defined."""
    epochs = _model(newest()).epochs
    return float(epochs[0]), float(epochs[-1])


def newest() -> Path:
    """Return the coefficient file of the latest IGRF generation in the installed ppigrf."""
    spec = find_spec("ppigrf")  # locates the package without importing it, and pandas with it
    if spec is None or not spec.submodule_search_locations:
        raise MissingExtra("ppigrf", "analysis")
    return max(Path(spec.submodule_search_locations[0]).glob("IGRF*.shc"))


@cache
def _model(path: Path) -> Model:
    """Read a spherical-harmonic coefficient file (.shc): a header, epochs in years, rows ``n m value...``."""
    rows = [line.split() for line in path.read_text().splitlines() if line and not line.startswith("#")]
    try:
        degree = int(rows[0][1])
        years = [int(float(year)) for year in rows[1]]
        table = {(int(n), int(m)): np.array(values, float) for n, m, *values in rows[2:]}
        g = [np.stack([table[n, m] for m in range(n + 1)], axis=1) for n in range(1, degree + 1)]
        h = [np.stack([table[n, -m] for m in range(1, n + 1)], axis=1) for n in range(1, degree + 1)]
    except (IndexError, KeyError, ValueError) as error:
        raise FormatError(path, "expected spherical-harmonic coefficients (.shc)") from error
    epochs = np.array([datetime(year, 1, 1, tzinfo=UTC).timestamp() for year in years])
    return Model(epochs, g, h)


def _block(model: Model, lon: FloatArray, lat: FloatArray, depth: FloatArray, time: FloatArray) -> FloatArray:
    """Return the field (n, 3), nT, north-east-down, of one block of samples by summing the series."""
    # Coefficients are linear in time between epochs: sum the series at each epoch, then weight the sums.
    first, weights = _weights(model.epochs, time)
    nodes = slice(first, first + len(weights))
    phi, geodetic = np.radians(lon), np.radians(lat)
    r, geocentric = _geocentric(geodetic, -depth)
    sin, cos = np.cos(geocentric), np.sin(geocentric)  # of the colatitude θ

    # cos(m phi), sin(m phi) for all orders
    order = np.arange(1, len(model.g) + 1)[:, None]
    cos_m, sin_m = np.cos(order * phi), np.sin(order * phi)
    up = np.zeros((len(weights), lat.size))
    south, east = up.copy(), up.copy()
    ratio = REFERENCE_RADIUS / r
    radial = ratio**3
    for n, (p_zero, slope_zero, s, slope) in enumerate(_legendre(sin, cos, len(model.g)), 1):
        g, h = model.g[n - 1][nodes], model.h[n - 1][nodes]
        c, d = cos_m[:n], sin_m[:n]
        # P_nm = S_nm sin(theta); the east component needs S_nm itself, which stays finite at the poles.
        p = s * sin
        # B = -grad V: radial, southward and eastward parts of degree n.
        up += (n + 1) * radial * (g[:, :1] * p_zero + g[:, 1:] @ (p * c) + h @ (p * d))
        south -= radial * (g[:, :1] * slope_zero + g[:, 1:] @ (slope * c) + h @ (slope * d))
        s_m = order[:n] * s
        east += radial * (g[:, 1:] @ (s_m * d) - h @ (s_m * c))
        radial = radial * ratio

    # Interpolate between the epochs, then turn from geocentric to geodetic axes.
    up, south, east = (np.einsum("kn,kn->n", weights, part) for part in (up, south, east))
    tilt = geodetic - geocentric  # the ellipsoid's normal leans this far north of the radius
    sin_tilt, cos_tilt = np.sin(tilt), np.cos(tilt)
    return np.stack([-south * cos_tilt - up * sin_tilt, east, -up * cos_tilt + south * sin_tilt], axis=1)


def _legendre(
    sin: FloatArray, cos: FloatArray, degree: int
) -> Iterator[tuple[FloatArray, FloatArray, FloatArray, FloatArray]]:
    """Yield for n = 1, 2, ... ``P_n0`` and ``dP_n0/dθ`` (k,), ``S_nm`` and ``dP_nm/dθ`` (n, k), m = 1 to n.

    The arguments are the colatitudes' sine and cosine (k,); see the notes of :func:`igrf`.
    """
    p_before, p = np.zeros_like(sin), np.ones_like(sin)  # P_n-1, P_n of order 0
    s_before = s = np.empty((0, sin.size))
    for n in range(1, degree + 1):
        # P_n0 by Bonnet's recursion; S_nm by the recursion in the degree.
        p_before, p = p, ((2 * n - 1) * cos * p - (n - 1) * p_before) / n
        m = np.arange(1, n + 1)[:, None]
        root = np.sqrt(n * n - m * m)  # 0 for m = n
        two_before, s_before = s_before, s
        s = np.empty((n, sin.size))
        s[n - 1] = np.sqrt((2 * n - 1) / (2 * n)) * sin * s_before[n - 2] if n > 1 else 1.0
        s[: n - 1] = (2 * n - 1) * cos * s_before / root[: n - 1]
        if n > 2:
            s[: n - 2] -= np.sqrt((n - 1) ** 2 - m[: n - 2] ** 2) / root[: n - 2] * two_before
        # dP_nm / d theta from S of degrees n and n - 1.
        slope = n * cos * s
        slope[: n - 1] -= root[: n - 1] * s_before
        yield p, -np.sqrt(n * (n + 1) / 2) * sin * s[0], s, slope


def _weights(epochs: FloatArray, time: FloatArray) -> tuple[int, FloatArray]:
    """Return the index of the first epoch needed, and the samples' weights (k, n) on k epochs from there."""
    # Beyond the last epoch, extrapolate the last interval; the caller has checked the range.
    index = np.clip(np.searchsorted(epochs, time, side="right") - 1, 0, epochs.size - 2)
    first = int(index.min())
    weights = np.zeros((int(index.max()) - first + 2, time.size))
    fraction = (time - epochs[index]) / (epochs[index + 1] - epochs[index])
    columns = np.arange(time.size)
    weights[index - first, columns] = 1.0 - fraction
    weights[index - first + 1, columns] = fraction
    return first, weights


def _geocentric(latitude: FloatArray, height: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return radius (m) and geocentric latitude (rad) of points at geodetic latitude (rad) and height (m)."""
    sin, cos = np.sin(latitude), np.cos(latitude)
    # Radius of curvature in the prime vertical, then distance from the axis and from the equator.
    normal = EQUATORIAL_RADIUS / np.sqrt(1.0 - ECCENTRICITY_SQUARED * sin * sin)
    axis = (normal + height) * cos
    polar = (normal * (1.0 - ECCENTRICITY_SQUARED) + height) * sin
    return np.hypot(axis, polar), np.arctan2(polar, axis)


def _refuse(name: str, values: FloatArray, low: float, high: float, covered: str, shown: Any = float) -> None:
    if (bad := values[(values < low) | (values > high)]).size:
        raise OutOfRange(name, shown(bad[0]), covered)


def _date(time: float) -> str:
    return str(np.datetime64("1970-01-01", "s") + np.timedelta64(round(time), "s"))[:10]


BOX_HALF_WIDTH_M = 20_000.0
"""Half width of the box in which :class:`NearbyField` fits the field, m."""
DEEP = 2_000.0
"""Depth and height up to which the field is fitted, m."""
FITTED_TIME_S = 20 * 86_400.0
"""Time before and after the middle for which the field is fitted, s."""


CACHE_TIME_US = 1_000_000
"""Time after which the field at the same place is computed again, µs."""


class HeldField:
    """Total main field at a vehicle's successive positions, with the same bits live and ashore."""

    def __init__(self) -> None:
        self._model = NearbyField()
        self._where = (np.nan, np.nan, np.nan)
        self._when_us, self._field = 0, np.nan

    def field_at(self, position: tuple[float, float, float], utc_us: int) -> float:
        """Return the total field, nT, at latitude and longitude (deg) and depth (m).

        `utc_us` is in µs since 1970 UTC. A value computed for the same place less than a second ago is
        reused. OutOfRange: as :func:`igrf`.
        """
        if position != self._where or abs(utc_us - self._when_us) > CACHE_TIME_US:
            self._field = self._model.field_and_slopes(*position, utc_us * 1e-6)[0]
            self._where, self._when_us = position, utc_us
        return self._field


class NearbyField:
    """Polynomial fit to the total main field around a vehicle, renewed when the vehicle leaves its range."""

    def __init__(self) -> None:
        self._middle = (np.nan, np.nan, np.nan)  # latitude, longitude, time
        self._c = [0.0] * 11

    def field_and_slopes(
        self, latitude: float, longitude: float, depth: float, time: float
    ) -> tuple[float, float, float]:
        """Return the total field (nT) and its slopes north and east (nT/m); `time` is in s since 1970 UTC.

        OutOfRange: as :func:`igrf`.
        """
        north, east = separation(self._middle[0], self._middle[1], latitude, longitude)
        later = time - self._middle[2]
        near = max(abs(north), abs(east)) < BOX_HALF_WIDTH_M and abs(later) < FITTED_TIME_S
        if not near:
            self._fit(latitude, longitude, time)
            north = east = later = 0.0
        # Quadratic in north, east and depth, linear in time; all scaled to the box.
        n, e, d, t = north / BOX_HALF_WIDTH_M, east / BOX_HALF_WIDTH_M, depth / DEEP, later / FITTED_TIME_S
        c0, cn, ce, cd, ct, cnn, cee, cdd, cne, cnd, ced = self._c
        field = (
            c0 + n * (cn + n * cnn + e * cne + d * cnd) + e * (ce + e * cee + d * ced) + d * (cd + d * cdd)
        )
        # Partial derivatives of the polynomial.
        slope_north = cn + 2.0 * n * cnn + e * cne + d * cnd
        slope_east = ce + 2.0 * e * cee + n * cne + d * ced
        return field + t * ct, slope_north / BOX_HALF_WIDTH_M, slope_east / BOX_HALF_WIDTH_M

    def _fit(self, latitude: float, longitude: float, time: float) -> None:
        """Fit the eleven coefficients of the polynomial to the IGRF on 81 nodes around a place and time."""
        # Least squares on a 3 x 3 x 3 x 3 lattice.
        nodes = np.array(list(product((-1.0, 0.0, 1.0), repeat=4)))
        n, e, d, t = nodes.T
        lat, lon = offset(latitude, longitude, n * BOX_HALF_WIDTH_M, e * BOX_HALF_WIDTH_M)
        first, last = coverage()
        times = np.clip(time + t * FITTED_TIME_S, first, last) if first <= time <= last else time
        field = total_field(lon, np.clip(lat, -90.0, 90.0), d * DEEP, times)
        later = (times - time) / FITTED_TIME_S
        design = np.stack([n**0, n, e, d, later, n * n, e * e, d * d, n * e, n * d, e * d], axis=1)
        self._c = np.linalg.lstsq(design, field, rcond=None)[0].tolist()
        self._middle = (latitude, longitude, time)
