"""A map of the magnetic anomaly, and its value, slope and curvature anywhere on it.

The map is a bicubic B-spline through its nodes, with continuous second derivatives: a filter needs them to
linearise the map and to know where it cannot. One look-up is a 4x4 patch of coefficients between two 3x4
matrices of weights: value, gradient and Hessian in one product.
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
"""Share of a step by which rounded coordinates may deviate from an even spacing."""
HOLE = 9.9e4
"""Value beyond any anomaly, nT; 99999 and 1.7e38 are how formats without NaN write a hole."""
PLANE_TOLERANCE_NT = 1e-6
"""Remainder of a plane after rounding, nT."""
NOT_AN_ANOMALY = 15_000.0
"""Median from which on a grid holds the total field, not an anomaly, nT."""

FEWEST, MIDDLE = 20, 400
"""Nodes along an axis, with fewer of which the error between them is not asked for; and at most asked for."""

PARAMETERS = (
    "longitude", "latitude", "anomaly", "sigma", "altitude", "name", "vertical", "sigma_length",
    "typical_error", "level_sigma",
)  # fmt: skip
"""Names of a grid's variables."""

DOWN, ACROSS = [0, 1, 0, 2, 1, 0], [0, 0, 1, 0, 1, 2]
"""Orders of derivative, north and east, in the order of Local."""


class AnomalyGrid:
    """Magnetic anomaly on an even grid of longitude and latitude.

    Parameters
    ----------
    longitude : array_like, (nx,)
        deg, evenly spaced, either direction, across the antimeridian if need be.
    latitude : array_like, (ny,)
        deg, evenly spaced, either direction.
    anomaly : array_like, (ny, nx)
        nT; NaN is a hole.
    sigma : array_like, (ny, nx), or float, optional
        nT, 1-sigma of the map at each node.
    altitude : float, optional
        m above the ellipsoid at which the map holds.
    name : str, optional
        Name of the grid in error messages: its file.
    vertical : array_like, (ny, nx), optional
        nT/m, vertical gradient at that altitude, positive if the anomaly grows downward; without it the map
        is the same at every depth.
    sigma_length : float, optional
        m, within which errors of that sigma are correlated; 0: those of any two samples are independent.
    typical_error : float, optional
        nT, of an error that lasts from sample to sample; `sigma` is then all of that kind.
    level_sigma : float, optional
        Common error of the whole map, nT, 1-sigma; `sigma` is without it.

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
        """Return this grid with other parameters."""
        return AnomalyGrid(**{name: getattr(self, name) for name in PARAMETERS} | changes)

    def error(self, variance: T) -> tuple[T | float, T | float]:
        """Split a local variance (nT²) into a multiple of the typical lasting error and a remainder."""
        if not self.typical_error:
            return 1.0, variance
        return variance**0.5 / self.typical_error, 0.0

    @cached_property
    def _coefficients(self) -> FloatArray:
        return coefficients(filled(self.anomaly))

    @cached_property
    def _vertical(self) -> FloatArray | None:
        return None if self.vertical is None else coefficients(self.vertical)

    def look_up(self, longitude: float, latitude: float, depth: float = nan) -> Local[float]:
        """Return the map around one place, as :meth:`evaluate` does around many."""
        local = self.evaluate(longitude, latitude, depth)
        return Local._make(float(values[0]) for values in local)

    def evaluate(
        self, longitude: ArrayLike, latitude: ArrayLike, depth: ArrayLike = nan
    ) -> Local[FloatArray]:
        """Return the map around n places as arrays (n,), NaN off the map and for NaN positions.

        `depth` is in m below the surface; default, and where it is NaN, the map's own height.
        """
        lon, lat = np.broadcast_arrays(
            np.atleast_1d(np.asarray(longitude, float)), np.atleast_1d(np.asarray(latitude, float))
        )
        rows, columns = self._whole.shape
        with np.errstate(invalid="ignore"):
            u = wrap(lon - self._x0) / self._dx
            u = np.where(u < 0.0, u + 360.0 / self._dx, u)
            v = (lat - self._y0) / self._dy
            inside = (u >= 0.0) & (u <= columns) & (v >= 0.0) & (v <= rows)
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
        """Return the anomaly at n places, nT, (n,): see :meth:`evaluate`.

        OutOfRange: a place that the map does not cover.
        """
        anomaly = self.evaluate(longitude, latitude, depth).anomaly
        lon, lat = np.broadcast_arrays(np.atleast_1d(longitude), np.atleast_1d(latitude))
        bad = np.flatnonzero(np.isnan(anomaly) & ~np.isnan(lon) & ~np.isnan(lat))
        if bad.size:
            raise OutOfRange("position", f"{lat[bad[0]]:.5f} {lon[bad[0]]:.5f}", f"{self} does not cover it")
        return anomaly

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
        """Larger of the distances between nodes, in the map's middle, m."""
        per_latitude, per_longitude = metres_per_degree(float(np.mean(self.latitude)))
        return max(self._dy * per_latitude, self._dx * per_longitude)

    @cached_property
    def correlation_length(self) -> float:
        """Distance over which the anomaly changes by its own RMS, m; infinite for a map without slopes.

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
        """RMS error of the spline between nodes, as far as the nodes tell, nT; 0 on a small map.

        Notes
        -----
        Every second node is left out and predicted from the others: the error at twice the spacing, e(2h);
        likewise e(4h). The field of sources at a depth d falls off as exp(-k d), and what a spacing misses
        begins at k = π/h, so log e goes as 1/h: ``e(h) = e(2h) (e(2h) / e(4h))²``. Noise of the nodes has
        e(h) = e(2h). That is at a cell's middle; over the cell, the mean of its square is half that.
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

        WriteError: the file cannot be written; it is as it was before.
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
    """Return the RMS error (nT) of a spline through every `step`-th node, halfway between them."""
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
    """Return the axis ascending and exactly even, and whether it was descending."""
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
    """The map around one place or n places; NaN outside the map and in its holes.

    ``anomaly`` nT; ``north``, ``east`` nT/m, its gradient; ``north_north``, ``north_east``, ``east_east``
    nT/m², its Hessian; ``variance`` nT², of the map's own error there.
    """

    anomaly: T
    north: T
    east: T
    north_north: T
    north_east: T
    east_east: T
    variance: T


def curvature(local: Local[T], nn: T, ne: T, ee: T) -> tuple[T, T]:
    """Return the effect of curvature on mean (nT) and variance (nT²) of the map within a position's spread.

    `local` is the map at the position's mean; `nn`, `ne`, `ee` are the position's covariance P, m², floats or
    (n,).

    Notes
    -----
    ``tr(C P)/2`` and ``tr((C P)²)/2``, C the Hessian (second-order filter; Bar-Shalom et al. 2001, 10.3).
    """
    # C P, then half its trace and half the trace of its square.
    a, b = local.north_north * nn + local.north_east * ne, local.north_north * ne + local.north_east * ee
    c, d = local.north_east * nn + local.east_east * ne, local.north_east * ne + local.east_east * ee
    return 0.5 * (a + d), 0.5 * (a * a + 2.0 * b * c + d * d)
