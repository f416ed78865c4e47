"""Combine several surveys into one map: continue to one altitude, merge, mask, smooth on request.

The pictures show every step, because a map should be looked at before it is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite, nan, sqrt
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from magbridge.arrays import FloatArray
from magbridge.errors import OutOfRange, WrongUse
from magbridge.field.continuation import continued, smoothed
from magbridge.field.geodesy import signed_longitude
from magbridge.field.grid import AnomalyGrid
from magbridge.files import atomic_path

__all__ = ["PreparationStep", "continue_upward", "draw_steps", "merge", "prepare", "surveyed_at"]

MAX_MERGED_NODES = 10_000_000
"""Nodes of a merged map. As many, from two surveys that overlap, take 2 GB."""


class PreparationStep(NamedTuple):
    """A stage of the preparation and the grid that it left."""

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

    Parameters
    ----------
    grids : sequence of AnomalyGrid
        At least one.
    altitude : float, optional
        m, to which every grid is continued upward; default the highest of the grids'.
    smooth : float, optional
        km, wavelength of which half the amplitude stays (:func:`~.continuation.smoothed`); 0: none.
    mask : array_like, (k, 2), optional
        Longitude and latitude (deg) of a polygon; nodes outside become holes.
    spacing : float, optional
        deg, of the map; default the finest of the grids'.

    Raises
    ------
    OutOfRange
        An altitude below a grid's; a grid of unknown altitude that is to be continued, or merged with one of
        known altitude; more than :data:`MAX_MERGED_NODES` nodes.
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
        if isfinite(up) and up != 0.0:
            lifted.append(continue_upward(grid, up))
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
    """Return the grids, those of unknown altitude at `altitudes` (m): one for all, or one for each.

    WrongUse: there are more or fewer of them.
    """
    if len(altitudes) not in (1, len(grids)):
        count = f"{len(altitudes)} altitudes for {len(grids)} grids"
        raise WrongUse(f"--survey-altitude: {count}: one for all, or one for each")
    each = altitudes if len(altitudes) > 1 else [*altitudes] * len(grids)
    return [
        grid if isfinite(grid.altitude) else grid.replaced(altitude=altitude)
        for grid, altitude in zip(grids, each, strict=True)
    ]


def continue_upward(grid: AnomalyGrid, height: float) -> AnomalyGrid:
    """Return the grid as a survey `height` m higher would have seen it, holes kept; OutOfRange: below 0 m."""
    if height < 0.0:
        covered = f"{grid.name} was surveyed at {grid.altitude:.0f} m: a field can only be continued upward"
        raise OutOfRange("altitude", f"{grid.altitude + height:.0f} m", covered)
    return continued(grid, -(grid.altitude + height)).grid


def merge(grids: Sequence[AnomalyGrid], spacing: float | None = None) -> tuple[AnomalyGrid, float]:
    """Return the mean of the grids wherever at least one has a value; on the finest of their spacings.

    And by how many nT RMS two of them differ where they overlap; NaN where none do. The differences show
    their errors: the mean of their variances is taken as at least half of the mean squared difference.
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
    """Draw every step on one page, one colour scale, to `path` (PNG, PDF, SVG)."""
    from matplotlib.figure import Figure  # noqa: PLC0415  only drawing needs it

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
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)


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
    """Return where on an axis a grid with its `grid_axis` axis has values, and a node more on either side."""
    first, last = np.searchsorted(axis, grid_axis[[0, -1]])
    return slice(max(int(first) - 1, 0), int(last) + 1)
