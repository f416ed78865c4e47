r"""Continuation of a field to another height, with an error estimate; one map from several surveys.

A map holds at an altitude above the sea, but the vehicle is below. Every wave of a field whose sources lie
deeper decays with height (Blakely 1995, eq. 12.8),

.. math:: \hat T(\mathbf k, z + h) = \hat T(\mathbf k, z)\, e^{-|\mathbf k| h} .

Downward, the inverse would amplify waves that the survey did not resolve. With p = 1 - exp(-|k| h) the
inverse is the series exp(|k| h) = 1 / (1 - p) = 1 + p + p² + ... The module uses its first three terms, which
at most treble the map's noise, and counts later terms as error. Above and below the new level, it
extrapolates the field by its vertical gradient, of spectrum |k| T.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isfinite, nan, sqrt
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from magbridge.arrays import FloatArray
from magbridge.errors import OutOfRange, WrongUse
from magbridge.field.geodesy import metres_per_degree, signed_longitude
from magbridge.field.grid import AnomalyGrid
from magbridge.field.spline import filled

__all__ = [
    "continued", "draw_steps", "merge", "prepare", "raised", "smoothed", "surveyed_at",
]  # fmt: skip

SURE, TERMS = 3, 10
"""Number of terms of the series that the continuation uses, and that stand for the true field in the error
estimate. Later terms are waves that no survey from above resolves."""
DEPTH_QUANTILES = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Quantiles of the depths at which the error is computed and averaged."""


class Continued(NamedTuple):
    """Grid continued to another height, and the error of the continuation."""

    grid: AnomalyGrid
    sigma: float
    """1-sigma of the error of series and slope, nT; 0 for an upward continuation to a single depth. The sigma
    of the grid includes the error at its edges and holes."""
    length: float
    """Correlation length of the error, m: its correlation at a short distance r is exp(-r²/2 length²)."""


def continued(grid: AnomalyGrid, depth: ArrayLike) -> Continued:
    """Return a grid continued to the mean depth, with its vertical gradient there; holes stay holes.

    `depth` (n,) are all depths at which the grid will be used, m below the surface; negative is above, NaN is
    ignored. A grid of unknown altitude is returned unchanged, and also one without a known depth.

    Notes
    -----
    The cosine transform mirrors the field at its edges, so that the wrap-around joins equal values. With the
    error's spectrum E(k), sigma² is the mean of |E|², and length² = 2 sigma² / mean of |k E|².
    """
    from scipy.fft import dctn, idctn  # noqa: PLC0415 - the live path runs without scipy

    used = np.asarray(depth, float)
    used = used[np.isfinite(used)]
    level = float(used.mean()) if used.size else nan
    # Continue to the mean depth, and keep the vertical slope for depths about it.
    height = grid.altitude + level  # downward
    if not isfinite(height):
        return Continued(grid, 0.0, float("inf"))
    # Laplace: a component of wave number k grows as exp(k h) downward.
    k = _wavenumber(grid.anomaly.shape, _spacing(grid))
    surveyed = dctn(filled(grid.anomaly), norm="ortho")
    gain = _growth(k, height, SURE)
    # Spectrum of the error of the truncated series and of the linear term, over quantiles of depth.
    error2 = np.zeros_like(k)
    for below in np.quantile(used, DEPTH_QUANTILES) - level:
        linear = gain * (1 + k * below)
        error2 += (surveyed * (_growth(k, height + below, TERMS) - linear)) ** 2 / len(DEPTH_QUANTILES)
    hole = np.isnan(grid.anomaly)
    anomaly, vertical = (np.where(hole, np.nan, idctn(surveyed * g, norm="ortho")) for g in (gain, k * gain))
    there = grid.replaced(anomaly=anomaly, altitude=-level, vertical=filled(vertical))
    if height:
        own = np.nan_to_num(grid.sigma)
        # The error at edges varies over as long a distance as the field; elsewhere, the map's own dominates.
        length = grid.sigma_length if own.any() or not isfinite(L := grid.correlation_length) else L
        there = there.replaced(sigma=np.hypot(own, _outside_sigma(grid, height)), sigma_length=length)
    # Parseval: mean square of the error and of its slope.
    sigma2, steepness2 = float(error2.mean()), float((k * k * error2).mean())
    return Continued(there, sqrt(sigma2), sqrt(2 * sigma2 / steepness2) if steepness2 else float("inf"))


def raised(grid: AnomalyGrid, altitude: float) -> Callable[[FloatArray], FloatArray]:
    """Return a function that continues values (ny, nx), nT, on a grid's nodes to another altitude, m."""
    gain = _growth(_wavenumber(grid.anomaly.shape, _spacing(grid)), grid.altitude - altitude, SURE)
    return lambda values: _filtered(values, gain)


CUTS = (1 / 3, 1 / 2, 2 / 3)
"""Places of the cuts at which a map's edge error is measured, as fractions of its side."""


def _outside_sigma(grid: AnomalyGrid, height: float) -> FloatArray:
    """Return the 1-sigma (ny, nx), nT, of what a continuation by `height`, m, downward, takes from outside.

    Notes
    -----
    A value continued upward is a mean of the field, weighted by Poisson's kernel, which reaches over the
    edges; downward, each term of the series contains such means. Errors from the four edges add as
    independent ones. Near a hole, the error is that at the edge's distance d with the same weight of unknown
    nodes, ``w = 1/2 - arctan(d/|h|) / π``.
    """
    spacing, hole = _spacing(grid), np.isnan(grid.anomaly)
    values = filled(grid.anomaly)
    # Edges: independent errors of the four sides add.
    north = _edge_variance(values, spacing, height)
    east = _edge_variance(values.T, spacing[::-1], height)
    variance = (north + north[::-1])[:, None] + east + east[::-1]
    # Holes: the weight of unknown nodes is the continued mask; the error is that at the edge's distance of w.
    unknown = _moved(hole.astype(float), spacing, -abs(height))
    for step, measured in zip(spacing, (north, east), strict=True):
        w = 0.5 - np.arctan((np.arange(measured.size) + 0.5) * step / abs(height)) / np.pi
        variance += 0.5 * np.interp(unknown, [0.0, *w[::-1]], [0.0, *measured[::-1]])
    return np.asarray(np.sqrt(variance))


def _edge_variance(values: FloatArray, spacing: tuple[float, float], height: float) -> FloatArray:
    """Return the mean square error (ny,), nT², of a continuation at each distance from a northern edge.

    It is measured on the map itself: a part that ends at a cut is continued and compared with the whole.
    """
    # The part without the rows beyond a cut has the error of an edge there.
    whole = _moved(values, spacing, height)
    squares, count = np.zeros((2, len(values)))
    for n in (int(part * len(values)) for part in CUTS):  # on the other side of a cut, the error is opposite
        error = _moved(values[:n], spacing, height) - whole[:n]
        squares[:n] += (error[::-1] ** 2).mean(axis=1)
        count[:n] += 1.0
    # Beyond the longest part, the error at its far end.
    reach = int(np.count_nonzero(count))
    return np.asarray((squares / np.maximum(count, 1.0))[np.minimum(np.arange(len(values)), reach - 1)])


def _moved(values: FloatArray, spacing: tuple[float, float], height: float) -> FloatArray:
    """Return values (ny, nx) on nodes with a `spacing`, m, continued by `height`, m, downward."""
    return _filtered(values, _growth(_wavenumber(values.shape, spacing), height, SURE))


def _filtered(values: FloatArray, gain: FloatArray) -> FloatArray:
    """Return values (ny, nx), holes filled, after multiplying their cosine transform by `gain` (ny, nx)."""
    from scipy.fft import dctn, idctn  # noqa: PLC0415 - the live path runs without scipy

    return np.asarray(idctn(dctn(filled(values), norm="ortho") * gain, norm="ortho"))


SIGN_WAVELENGTH_FRACTION = 0.25
"""Correlation length of the part that smoothing removes, as a fraction of the smoothed wavelength."""


def smoothed(grid: AnomalyGrid, wavelength: float) -> AnomalyGrid:
    """Return a grid without its short waves; the removed part adds to its sigma. Holes stay holes.

    A wave of `wavelength` (m) keeps half its amplitude, a wave twice as long 84 %, one half as long 6 %.

    Notes
    -----
    The cosine transform's terms are multiplied by ``2^-(k λ / 2π)²``, a Gaussian. The added sigma is the RMS
    of the removed part over the whole map, because around a node too few waves determine it.
    """
    gain = np.exp2(-((_wavenumber(grid.anomaly.shape, _spacing(grid)) * wavelength / (2.0 * np.pi)) ** 2))
    anomaly = np.where(np.isnan(grid.anomaly), np.nan, _filtered(grid.anomaly, gain))
    # The removed part is an error of the smoothed map, correlated over a fraction of the wavelength.
    removed = np.sqrt(np.nanmean((grid.anomaly - anomaly) ** 2))
    sigma = np.hypot(np.nan_to_num(grid.sigma), removed)
    length = max(grid.sigma_length, SIGN_WAVELENGTH_FRACTION * wavelength)
    return grid.replaced(anomaly=anomaly, sigma=sigma, vertical=None, sigma_length=length)


def _growth(k: FloatArray, height: float, terms: int) -> FloatArray:
    """Return exp(k height), or for height > 0 (downward) the sum of the first `terms` of its series."""
    if height <= 0:
        return np.asarray(np.exp(k * height))
    # exp(k h) = 1 / (1 - p) = 1 + p + p^2 + ...: the first terms amplify noise least.
    p = -np.expm1(-k * height)
    return np.asarray(sum((p**n for n in range(1, terms)), np.ones_like(p)))


def _spacing(grid: AnomalyGrid) -> tuple[float, float]:
    """Return the distance of the nodes to the north and to the east, m."""
    per_latitude, per_longitude = metres_per_degree(float(np.mean(grid.latitude)))
    north, east = (float(axis[1] - axis[0]) for axis in (grid.latitude, grid.longitude))
    return per_latitude * north, per_longitude * east


def _wavenumber(shape: tuple[int, ...], spacing: tuple[float, float]) -> FloatArray:
    """Return |k| (ny, nx), rad/m, of the cosine transform's terms."""
    # The cosine transform mirrors the grid: half waves over its sides.
    north, east = (np.pi / (n * step) * np.arange(n) for n, step in zip(shape, spacing, strict=True))
    return np.asarray(np.hypot(north[:, None], east))


MAX_MERGED_NODES = 10_000_000
"""Largest number of nodes of a merged map; from two surveys that overlap, they take 2 GB of memory."""


class PreparationStep(NamedTuple):
    """One step of the preparation of a map, with its resulting grid."""

    title: str
    grid: AnomalyGrid


def prepare(
    grids: Sequence[AnomalyGrid],
    altitude: float | None = None,
    smooth: float = 0.0,
    mask: ArrayLike | None = None,
    spacing: float | None = None,
) -> tuple[AnomalyGrid, list[PreparationStep]]:
    """Return one map from several surveys, and each intermediate step.

    Every grid is continued upward to `altitude`, m; default: the highest altitude of the grids. `smooth` (km)
    is the wavelength that keeps half its amplitude (:func:`smoothed`); 0 for no smoothing. Nodes outside the
    polygon `mask` (k, 2), longitude and latitude in deg, become holes. `spacing` is the node distance of the
    map, deg; default: the finest of the grids.

    OutOfRange: an altitude below a grid's; a grid of unknown altitude that is to be continued, or merged with
    one of known altitude; more than :data:`MAX_MERGED_NODES` nodes.
    """
    steps = [PreparationStep(f"as surveyed: {Path(grid.name).name}", grid) for grid in grids]
    known = [grid.altitude for grid in grids if isfinite(grid.altitude)]
    level = altitude if altitude is not None else max(known, default=nan)
    if isfinite(level) and len(known) < len(grids):
        silent = next(grid.name for grid in grids if not isfinite(grid.altitude))
        covered = f"{silent} does not say how high it was surveyed (--survey-altitude)"
        raise OutOfRange("altitude", f"{level:.0f} m", covered)
    lifted = []
    for grid in grids:
        up = level - grid.altitude
        if up < 0.0:
            covered = (
                f"{grid.name} was surveyed at {grid.altitude:.0f} m: a field can only be continued upward"
            )
            raise OutOfRange("altitude", f"{level:.0f} m", covered)
        if isfinite(up) and up != 0.0:
            lifted.append(continued(grid, -level).grid)
            steps.append(PreparationStep(f"continued {up:+.0f} m: {Path(grid.name).name}", lifted[-1]))
        else:
            lifted.append(grid)
    result, apart = merge(lifted, spacing)
    if len(grids) > 1:
        nowhere = "no two of them overlap"
        differ = f"{apart:.1f} nT RMS difference in their overlap" if isfinite(apart) else nowhere
        steps.append(PreparationStep(f"merged, {differ}", result))
    if mask is not None:
        result = _masked(result, np.asarray(mask, float))
        steps.append(PreparationStep("masked", result))
    if smooth:
        before, result = result, smoothed(result, 1000.0 * smooth)
        lost = float(np.sqrt(np.nanmean((before.anomaly - result.anomaly) ** 2)))
        steps.append(
            PreparationStep(f"smoothed over {smooth:g} km: {lost:.1f} nT RMS removed, now its sigma", result)
        )
    return result, steps


def surveyed_at(grids: Sequence[AnomalyGrid], altitudes: Sequence[float]) -> list[AnomalyGrid]:
    """Return the grids; those of unknown altitude get one of `altitudes` (m): one for all, or one for each.

    WrongUse: the number of altitudes is neither one nor that of the grids.
    """
    if len(altitudes) not in (1, len(grids)):
        count = f"{len(altitudes)} altitudes for {len(grids)} grids"
        raise WrongUse(f"--survey-altitude: {count}: one for all, or one for each")
    each = altitudes if len(altitudes) > 1 else [*altitudes] * len(grids)
    return [
        grid if isfinite(grid.altitude) else grid.replaced(altitude=altitude)
        for grid, altitude in zip(grids, each, strict=True)
    ]


def merge(grids: Sequence[AnomalyGrid], spacing: float | None = None) -> tuple[AnomalyGrid, float]:
    """Return the mean of the grids at each node that any grid covers, and their RMS difference, nT.

    `spacing` is in deg; default: the finest of the grids. The difference is over the overlaps, and NaN
    without any. The variance of a grid in an overlap is at least half of the mean squared difference.
    OutOfRange: more than :data:`MAX_MERGED_NODES` nodes.
    """
    first = grids[0]
    if len(grids) == 1 and spacing is None:
        return first, nan
    # Common grid: the finest spacing, over the area of all grids, with longitudes unwound to the first one.
    step = spacing or min(float(np.diff(axis[:2])[0]) for g in grids for axis in (g.longitude, g.latitude))
    near = [(g, 360.0 * round((float(first.longitude[0]) - float(g.longitude[0])) / 360.0)) for g in grids]
    longitude = _cover([g.longitude + turn for g, turn in near], step)
    latitude = _cover([g.latitude for g in grids], step)
    size = longitude.size * latitude.size
    if size > MAX_MERGED_NODES:
        wide = 1.05 * step * sqrt(size / MAX_MERGED_NODES)
        raise OutOfRange(
            "map", f"{size} nodes", f"at most {MAX_MERGED_NODES}: set a spacing of {wide:.2g} deg or more"
        )
    # Sums over the grids at each node, row by row to save memory.
    total, squares, variance, count = np.zeros((4, latitude.size, longitude.size))
    for grid, turn in near:
        columns = _reach(longitude, grid.longitude + turn)
        x = longitude[columns]
        for row in range(*_reach(latitude, grid.latitude).indices(latitude.size)):  # all at once: 1 kB a node
            local = grid.evaluate(x, np.full(x.size, latitude[row]))
            anomaly = np.nan_to_num(local.anomaly)
            total[row, columns] += anomaly
            squares[row, columns] += anomaly**2
            variance[row, columns] += np.nan_to_num(local.variance)
            count[row, columns] += np.isfinite(local.anomaly)
    shared = count > 1
    # Twice the sample variance of the grids is the mean squared difference of two of them.
    differences = 2.0 * (squares - total**2 / np.maximum(count, 1.0))[shared] / (count[shared] - 1.0)
    apart = sqrt(max(float(differences.mean()), 0.0)) if shared.any() else nan
    variance = np.fmax(variance, 0.5 * apart**2 * count)
    with np.errstate(invalid="ignore"):
        mean, sigma = total / np.where(count > 0, count, np.nan), np.sqrt(variance) / count
        name = " + ".join(Path(grid.name).name for grid in grids)
        merged = AnomalyGrid(
            longitude, latitude, mean, sigma, first.altitude, name,
            sigma_length=max(grid.sigma_length for grid in grids),
            level_sigma=max(grid.level_sigma for grid in grids),
        )  # fmt: skip
    return merged, apart


def draw_steps(steps: Sequence[PreparationStep], path: str | Path) -> None:
    """Draw the grids of all steps with one colour scale, and write the page to `path` (PNG, PDF, SVG)."""
    from matplotlib.figure import Figure  # noqa: PLC0415  only drawing needs it

    from magbridge.pictures import save  # noqa: PLC0415

    columns = min(3, len(steps))
    rows = -(-len(steps) // columns)
    figure = Figure(figsize=(5.2 * columns, 4.4 * rows), layout="constrained")
    axes = np.atleast_1d(figure.subplots(rows, columns, sharex=True, sharey=True)).ravel()
    values = np.concatenate([step.grid.anomaly[np.isfinite(step.grid.anomaly)] for step in steps])
    low, high = np.percentile(values, [1, 99])
    for step, axis in zip(steps, axes, strict=False):
        grid = step.grid
        image = axis.pcolormesh(
            grid.longitude, grid.latitude, grid.anomaly, vmin=low, vmax=high, cmap="RdYlBu_r",
            shading="nearest",
        )  # fmt: skip
        axis.set_title(step.title, fontsize=10)
        axis.set_aspect(1.0 / np.cos(np.radians(grid.latitude.mean())))
        axis.ticklabel_format(axis="y", useOffset=False)
        axis.locator_params(axis="x", nbins=4)
        axis.xaxis.set_major_formatter(lambda value, _: f"{signed_longitude(value):.7g}")
    for axis in axes[len(steps) :]:
        axis.set_axis_off()
    figure.colorbar(image, ax=axes, label="anomaly, nT", shrink=0.8)
    figure.supxlabel("longitude, deg", fontsize="medium")
    figure.supylabel("latitude, deg", fontsize="medium")
    save(figure, path)


def _masked(grid: AnomalyGrid, polygon: FloatArray) -> AnomalyGrid:
    from matplotlib.path import Path as Polygon  # noqa: PLC0415  only a mask needs it

    x, y = np.meshgrid(grid.longitude, grid.latitude)
    inside = Polygon(polygon).contains_points(np.column_stack([x.ravel(), y.ravel()])).reshape(x.shape)
    if not (inside & np.isfinite(grid.anomaly)).any():
        raise OutOfRange("mask", f"{len(polygon)} corners", f"no node of {grid} lies inside")
    return grid.replaced(anomaly=np.where(inside, grid.anomaly, np.nan), vertical=None)


def _cover(axes: Sequence[FloatArray], step: float) -> FloatArray:
    low, high = min(float(a[0]) for a in axes), max(float(a[-1]) for a in axes)
    axis: FloatArray = low + step * np.arange(int((high - low) / step + 1e-6) + 1, dtype=float)
    return axis


def _reach(axis: FloatArray, grid_axis: FloatArray) -> slice:
    """Return the slice of `axis` that `grid_axis` covers, with one more node on either side."""
    first, last = np.searchsorted(axis, grid_axis[[0, -1]])
    return slice(max(int(first) - 1, 0), int(last) + 1)
