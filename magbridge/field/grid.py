"""A map of the magnetic anomaly, with its value, slope and curvature at any place.

The map is a bicubic B-spline through its nodes. Its second derivatives are continuous: a filter linearises
the map, and the curvature shows where this fails. A look-up multiplies a 4x4 patch of coefficients by two 3x4
matrices of weights, which yields value, gradient and Hessian.
"""

from __future__ import annotations

from functools import cached_property
from math import inf, nan, sqrt
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magbridge.arrays import FloatArray
from magbridge.errors import FormatError, OutOfRange
from magbridge.field.geodesy import metres_per_degree, signed_longitude, wrap
from magbridge.field.grid_netcdf import write
from magbridge.field.spline import coefficients, filled, weights

__all__ = ["HOLE", "AnomalyGrid", "Local", "T", "curvature"]

EVEN = 1e-3
"""Largest deviation of rounded coordinates from an even spacing, as a fraction of a step."""
EDGE_CELLS = 1e-6
"""Distance beyond the outermost nodes that still is on the map, in cells: the rounding of coordinates."""
HOLE = 9.9e4
"""Smallest value that is a hole, nT: formats without NaN write holes as 99999 or 1.7e38."""
PLANE_TOLERANCE_NT = 1e-6
"""Largest RMS about a plane, nT, that counts as rounding: the map is then a plane."""
NOT_AN_ANOMALY = 15_000.0
"""Largest absolute median of an anomaly, nT; a grid with a larger median holds the total field."""

FEWEST, MIDDLE = 20, 400
"""Fewest nodes along an axis from which the interpolation error is estimated, and most that are used."""

PARAMETERS = (
    "longitude", "latitude", "anomaly", "sigma", "altitude", "name", "vertical", "sigma_length",
    "typical_error", "level_sigma",
)  # fmt: skip
"""Names of the parameters of :class:`AnomalyGrid`, which are also its attributes."""

DOWN, ACROSS = [0, 1, 0, 2, 1, 0], [0, 0, 1, 0, 1, 2]
"""Orders of the derivatives north and east of value, gradient and Hessian, in the order of :class:`Local`."""


class AnomalyGrid:
    """Magnetic anomaly on an even grid of longitude and latitude.

    Parameters
    ----------
    longitude : array_like, (nx,)
        Longitude of the columns, deg, evenly spaced, in either direction; may cross the antimeridian.
    latitude : array_like, (ny,)
        Latitude of the rows, deg, evenly spaced, in either direction.
    anomaly : array_like, (ny, nx)
        Anomaly at the nodes, nT; NaN is a hole.
    sigma : array_like, (ny, nx), or float, optional
        1-sigma of the map at each node, nT.
    altitude : float, optional
        Altitude of the map above the ellipsoid, m; NaN if unknown.
    name : str, optional
        Name of the grid in error messages: its file.
    vertical : array_like, (ny, nx), optional
        Vertical gradient at `altitude`, nT/m, positive if the anomaly grows downward. Without it the map is
        the same at every depth.
    sigma_length : float, optional
        Correlation length of the errors that `sigma` describes, m; 0: errors of samples are independent.
    typical_error : float, optional
        1-sigma of a typical error, nT, if `sigma` is correlated between samples; 0 if it is not.
    level_sigma : float, optional
        1-sigma of the constant error of the whole map, nT; `sigma` does not include it.

    Raises
    ------
    FormatError
        Axes that are not geographic, not even or too short; a field that is not an anomaly; only holes.
    """

    def __init__(
        self,
        longitude: ArrayLike,
        latitude: ArrayLike,
        anomaly: ArrayLike,
        sigma: ArrayLike = 0.0,
        altitude: float = nan,
        name: str = "grid",
        vertical: ArrayLike | None = None,
        sigma_length: float = 0.0,
        typical_error: float = 0.0,
        level_sigma: float = 0.0,
    ) -> None:
        values = np.array(anomaly, float)
        x, flip_x = _axis(longitude, name, "longitude")
        y, flip_y = _axis(latitude, name, "latitude")
        if values.shape != (y.size, x.size):
            raise FormatError(
                name, f"expected {y.size} rows of {x.size} values, found {' x '.join(map(str, values.shape))}"
            )
        scatter = np.broadcast_to(np.asarray(sigma, float), values.shape)
        # Ascending axes; values beyond HOLE are holes.
        order = (slice(None, None, -1 if flip_y else 1), slice(None, None, -1 if flip_x else 1))
        values, scatter = values[order], scatter[order].copy()
        values[~(np.abs(values) < HOLE)] = nan
        hole = np.isnan(values)
        if hole.all():
            raise FormatError(name, "expected an anomaly, found nothing but holes")
        if abs(median := float(np.nanmedian(values))) > NOT_AN_ANOMALY:
            raise FormatError(
                name, f"expected an anomaly, found a median of {median:.0f} nT: subtract the IGRF first"
            )
        self.name, self.altitude, self.sigma_length = name, float(altitude), float(sigma_length)
        self.typical_error, self.level_sigma = float(typical_error), float(level_sigma)
        self.longitude, self.latitude, self.anomaly, self.sigma = x, y, values, scatter
        self.vertical = None if vertical is None else np.asarray(vertical, float)[order]
        self._x0, self._dx = float(x[0]), float(x[-1] - x[0]) / (x.size - 1)
        self._y0, self._dy = float(y[0]), float(y[-1] - y[0]) / (y.size - 1)
        # A cell can be used if all four of its corners are known.
        self._whole = ~(hole[1:, 1:] | hole[1:, :-1] | hole[:-1, 1:] | hole[:-1, :-1])
        self._variance = np.nan_to_num(scatter**2)
        self._even_sigma = bool(np.ptp(self._variance) == 0.0)

    def replaced(self, **changes: Any) -> AnomalyGrid:
        """Return a grid with the parameters of this grid, except for `changes`."""
        return AnomalyGrid(**{name: getattr(self, name) for name in PARAMETERS} | changes)

    def error(self, variance: T) -> tuple[T | float, T | float]:
        """Return a local variance (nT²) as a multiple of the typical correlated error, and as noise.

        The multiple scales the filter's state of map error; the noise (variance, nT²) is independent.
        """
        if not self.typical_error:
            return 1.0, variance
        return variance**0.5 / self.typical_error, 0.0

    @cached_property
    def _coefficients(self) -> FloatArray:
        return coefficients(filled(self.anomaly))

    @cached_property
    def _vertical(self) -> FloatArray | None:
        return None if self.vertical is None else coefficients(filled(self.vertical))

    def look_up(self, longitude: float, latitude: float, depth: float = nan) -> Local[float]:
        """Return value and derivatives of the map at one place; arguments as :meth:`evaluate`."""
        local = self.evaluate(longitude, latitude, depth)
        return Local._make(float(values[0]) for values in local)

    def evaluate(
        self, longitude: ArrayLike, latitude: ArrayLike, depth: ArrayLike = nan
    ) -> Local[FloatArray]:
        """Return value, derivatives and variance of the map at n places (deg) as arrays (n,).

        They are NaN off the map, in its holes and for NaN positions. `depth` is in m below the surface; NaN,
        the default, stands for the map's own height.
        """
        lon, lat = np.broadcast_arrays(
            np.atleast_1d(np.asarray(longitude, float)), np.atleast_1d(np.asarray(latitude, float))
        )
        rows, columns = self._whole.shape
        with np.errstate(invalid="ignore"):
            u = wrap(lon - self._x0) / self._dx
            u = np.where(u < -EDGE_CELLS, u + 360.0 / self._dx, u)
            v = (lat - self._y0) / self._dy
            right, top = columns + EDGE_CELLS, rows + EDGE_CELLS
            inside = (u >= -EDGE_CELLS) & (u <= right) & (v >= -EDGE_CELLS) & (v <= top)
        u, v = np.where(inside, u, 0.0), np.where(inside, v, 0.0)
        j = np.minimum(u.astype(np.intp), columns - 1)
        i = np.minimum(v.astype(np.intp), rows - 1)
        inside &= self._whole[i, j]
        s, t = u - j, v - i
        across, along = weights(s), weights(t)
        wide = self._coefficients.shape[1]
        # Index of the 4 x 4 coefficients of every place in the flat array.
        window = (wide * i + j) + (wide * np.arange(4)[:, None] + np.arange(4))[..., None]
        patch = self._coefficients.ravel()[window]
        if self._vertical is not None:
            below = np.asarray(depth, float) + self.altitude
            patch = patch + np.where(np.isnan(below), 0.0, below) * self._vertical.ravel()[window]
        lines = (across[:, None] * patch).sum(axis=2)  # (3, 4, n): the patch's rows at s, with their slopes
        if self._even_sigma:
            variance = np.full(s.shape, self._variance[0, 0])
        else:
            variance = (1 - t) * ((1 - s) * self._variance[i, j] + s * self._variance[i, j + 1]) + t * (
                (1 - s) * self._variance[i + 1, j] + s * self._variance[i + 1, j + 1]
            )
        per_degree = metres_per_degree(np.where(inside, lat, 0.0))
        north, east = 1.0 / (per_degree[0] * self._dy), 1.0 / (per_degree[1] * self._dx)
        # Value, two slopes and three second derivatives in one product.
        parts = (along[DOWN] * lines[ACROSS]).sum(axis=1)  # (6, n), in the order of Local
        parts[1] *= north
        parts[2] *= east
        parts[3:] *= north * north, north * east, east * east
        if not inside.all():
            parts[:, ~inside] = variance[~inside] = nan
        return Local._make([*parts, variance])

    def anomaly_at(self, longitude: ArrayLike, latitude: ArrayLike, depth: ArrayLike = nan) -> FloatArray:
        """Return the anomaly (n,), nT, at n places; arguments as :meth:`evaluate`.

        OutOfRange: a place that the map does not cover.
        """
        anomaly = self.evaluate(longitude, latitude, depth).anomaly
        lon, lat = np.broadcast_arrays(np.atleast_1d(longitude), np.atleast_1d(latitude))
        bad = np.flatnonzero(np.isnan(anomaly) & ~np.isnan(lon) & ~np.isnan(lat))
        if bad.size:
            raise OutOfRange("position", f"{lat[bad[0]]:.5f} {lon[bad[0]]:.5f}", f"{self} does not cover it")
        return anomaly

    @cached_property
    def mean_and_variance(self) -> tuple[float, float]:
        """Mean (nT) and variance (nT²) of the map's known nodes."""
        return float(np.nanmean(self.anomaly)), float(np.nanvar(self.anomaly))

    @cached_property
    def rms(self) -> float:
        """RMS of the map about its best-fitting plane, nT."""
        # Residual of the least-squares plane over all known nodes.
        plane = np.stack(np.meshgrid(self.longitude, self.latitude), axis=-1)[~np.isnan(self.anomaly)]
        design = np.column_stack([plane - plane.mean(axis=0), np.ones(len(plane))])
        values = self.anomaly[~np.isnan(self.anomaly)]
        left = values - design @ np.linalg.lstsq(design, values, rcond=None)[0]
        return float(np.sqrt(np.mean(left**2)))

    @property
    def spacing(self) -> float:
        """Larger node distance of the two axes, at the map's middle latitude, m."""
        per_latitude, per_longitude = metres_per_degree(float(np.mean(self.latitude)))
        return max(self._dy * per_latitude, self._dx * per_longitude)

    @cached_property
    def correlation_length(self) -> float:
        """Correlation length of the anomaly, m; infinite for a plane.

        Notes
        -----
        ``L = √2 rms(a) / rms|∇a|``, which is L of a covariance ``exp(-r²/2L²)``.
        """
        middle = float(np.mean(self.latitude))
        per_latitude, per_longitude = metres_per_degree(middle)
        north, east = np.gradient(self.anomaly, self._dy * per_latitude, self._dx * per_longitude)
        # Slopes about their mean: a regional trend does not count as an anomaly.
        flat = north - np.nanmean(north), east - np.nanmean(east)
        slope = sqrt(float(np.nanmean(flat[0] ** 2 + flat[1] ** 2)))
        return sqrt(2.0) * self.rms / slope if self.rms > PLANE_TOLERANCE_NT else inf

    @cached_property
    def interpolation_sigma(self) -> float:
        """RMS error of the spline between nodes, nT, estimated from the nodes; 0 on a small map.

        Notes
        -----
        The error e(2h) at twice the spacing h follows from a spline through every second node, at the others;
        e(4h) likewise. The field of sources at depth d falls off as exp(-k d), and a spacing misses waves
        beyond k = π/h. So log e is proportional to 1/h: ``e(h) = e(2h) (e(2h) / e(4h))²``, at most e(2h).
        This is at a cell's middle; the mean square over the cell is half of that.
        """
        rows, columns = (slice((n - MIDDLE) // 2, (n + MIDDLE) // 2) if n > MIDDLE else slice(None)
                         for n in self.anomaly.shape)  # fmt: skip
        values = filled(self.anomaly)[rows, columns]
        known = ~np.isnan(self.anomaly)[rows, columns]
        if min(values.shape) < FEWEST or known.sum() < known.size / 2:
            return 0.0
        # e(2h) and e(4h), extrapolated to e(h) by log e ~ 1/h.
        finer, coarser = (_left_out(values, known, step) for step in (2, 4))
        at_middle = finer * min(finer / coarser, 1.0) ** 2 if coarser > PLANE_TOLERANCE_NT else 0.0
        return at_middle * sqrt(0.5)

    def save(self, path: str | Path) -> None:
        """Write the grid as CF netCDF, which :func:`~magbridge.field.read.read_grid` and GMT read.

        WriteError: the file cannot be written; an existing file stays as it was.
        """
        write(self, path)

    def __repr__(self) -> str:
        west, east = float(self.longitude[0]), float(self.longitude[-1])
        if east - west < 359.0:  # one all around begins where its file does
            west, east = signed_longitude(west), signed_longitude(east)
        return (
            f"{self.name} (latitude {self.latitude[0]:.4f} to {self.latitude[-1]:.4f},"
            f" longitude {west:.4f} to {east:.4f})"
        )


def _left_out(values: FloatArray, known: NDArray[np.bool_], step: int) -> float:
    """Return the RMS error (nT) of a spline through every `step`-th node, at the nodes halfway between."""
    from scipy.interpolate import RectBivariateSpline  # noqa: PLC0415  the live path runs without scipy

    # Spline through every `step`-th node; its error at the nodes halfway.
    y, x = (np.arange(0, n, step) for n in values.shape)
    spline = RectBivariateSpline(y, x, values[::step, ::step])
    half = step // 2
    rows, columns = np.arange(half, y[-1], step), np.arange(half, x[-1], step)
    there = np.ix_(rows, columns)
    error = (spline(rows, columns) - values[there])[known[there]]
    return float(np.sqrt(np.mean(error**2))) if error.size else 0.0


def _axis(values: ArrayLike, name: str, axis_name: str) -> tuple[FloatArray, bool]:
    """Return the axis, ascending and exactly even, and True if `values` was descending."""
    axis = np.array(values, float).ravel()
    if axis.size < 4 or not np.isfinite(axis).all():
        raise FormatError(name, "expected at least 4 finite coordinates", column=axis_name)
    limit = 90.0 if axis_name == "latitude" else 540.0  # 359 360 361 is how some write Greenwich
    if np.abs(axis).max() > limit * (1 + 1e-9):
        raise FormatError(
            name,
            f"expected degrees, found {axis[np.abs(axis).argmax()]:.6g}: projected coordinates;"
            " reproject the grid to longitude and latitude",
            column=axis_name,
        )
    flip = bool(np.median(np.diff(axis)) < 0.0)
    # Ascending; a longitude that wraps is unwound; then the spacing must be even.
    axis = axis[::-1] if flip else axis
    if axis_name == "longitude":  # 178 179 180 -179: the same meridians, unwound
        axis = np.degrees(np.unwrap(np.radians(axis)))
    even = np.linspace(axis[0], axis[-1], axis.size)
    step = (axis[-1] - axis[0]) / (axis.size - 1)
    if step <= 0.0 or np.abs(axis - even).max() > EVEN * step:
        raise FormatError(name, "expected evenly spaced coordinates in order", column=axis_name)
    return even, flip


T = TypeVar("T", float, FloatArray)


class Local(NamedTuple, Generic[T]):
    """Value and derivatives of the map at one place or n places; NaN outside the map and in its holes.

    ``anomaly`` is in nT; ``north``, ``east``, its gradient, in nT/m; ``north_north``, ``north_east``,
    ``east_east``, its Hessian, in nT/m²; ``variance`` of the map's error in nT².
    """

    anomaly: T
    north: T
    east: T
    north_north: T
    north_east: T
    east_east: T
    variance: T


def curvature(local: Local[T], nn: T, ne: T, ee: T) -> tuple[T, T]:
    """Return the effect of the map's curvature on mean (nT) and variance (nT²) of the field at a position.

    The position is uncertain with the covariance P: `nn`, `ne`, `ee`, m², floats or (n,). `local` is the map
    at its mean.

    Notes
    -----
    ``tr(C P)/2`` and ``tr((C P)²)/2``, C the Hessian (second-order filter; Bar-Shalom et al. 2001, 10.3).
    """
    # C P, then half its trace and half the trace of its square.
    a, b = local.north_north * nn + local.north_east * ne, local.north_north * ne + local.north_east * ee
    c, d = local.north_east * nn + local.east_east * ne, local.north_east * ne + local.east_east * ee
    return 0.5 * (a + d), 0.5 * (a * a + 2.0 * b * c + d * d)
