"""Pictures: a track on its map, what the filter said on the way, and where a fix can be had."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from magbridge.field.earth import metres_per_degree
from magbridge.field.grid import AnomalyGrid
from magbridge.files import atomic_path
from magbridge.navigate.bound import Bound
from magbridge.navigate.record import State

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_bound", "draw_navigation"]

SHADES = {State.SEARCHING: "#f5d76e", State.DEAD_RECKONING: "#d5d8dc", State.LOST: "#e59a93"}


def draw_navigation(result: xr.Dataset, grid: AnomalyGrid, path: str | Path) -> None:
    """Draw what :func:`~magbridge.navigate.batch.navigate` returned, on one page."""
    figure = Figure(figsize=(13.0, 9.0), layout="constrained")
    panels = figure.subplot_mosaic(
        [["map", "field"], ["map", "innovation"], ["map", "sigma"]], width_ratios=(1.1, 1)
    )
    _map(panels["map"], grid, result["longitude"].to_numpy(), result["latitude"].to_numpy())
    _tracks(panels["map"], result)
    hours = (result["time"].to_numpy() - float(result["time"][0])) / 3600.0

    axis = panels["field"]
    axis.plot(
        hours, result["anomaly"], ".", ms=2, color="0.3", label="measured, at the dead-reckoned position"
    )
    axis.plot(hours, result["map_anomaly"], color="C3", lw=1, label="map under the track")
    axis.set_ylabel("anomaly, nT")
    axis.legend(loc="upper right", fontsize=8)

    axis = panels["innovation"]
    spread = 2.0 * np.sqrt(result["innovation_variance"])
    axis.fill_between(hours, -spread, spread, color="C0", alpha=0.2, lw=0, label="2 sigma")
    taken = result["accepted"].to_numpy() > 0
    axis.plot(hours[taken], result["innovation"][taken], ".", ms=2, color="C0", label="taken in")
    axis.plot(hours[~taken], result["innovation"][~taken], "x", ms=4, color="C3", label="beyond the gate")
    axis.set_ylabel("innovation, nT")
    axis.legend(loc="upper right", fontsize=8, ncols=3)

    axis = panels["sigma"]
    sigma = np.sqrt(result["covariance_nn"] + result["covariance_ee"])
    axis.semilogy(hours, sigma, color="C0", label="sigma, filter")
    smoothed = np.hypot(result["smoothed_sigma_north"], result["smoothed_sigma_east"])
    axis.semilogy(hours, smoothed, color="C2", label="sigma, smoothed")
    if "error_north" in result:
        axis.semilogy(
            hours, np.hypot(result["error_north"], result["error_east"]), color="0.2", lw=0.8, label="error"
        )
    axis.set_ylabel("position, m")
    axis.set_xlabel("hours")
    _shade(axis, hours, result["state"].to_numpy())
    axis.legend(loc="upper right", fontsize=8)
    _save(figure, path)


def draw_bound(bound: Bound, grid: AnomalyGrid, path: str | Path) -> None:
    """Draw a planned track on the map, coloured by the best position that can be had there."""
    figure = Figure(figsize=(9.0, 7.5), layout="constrained")
    axis = figure.subplots()
    _map(axis, grid, bound.longitude, bound.latitude)
    points = np.column_stack([bound.longitude, bound.latitude])
    line = LineCollection(list(np.stack([points[:-1], points[1:]], axis=1)), cmap="viridis_r", linewidths=4)
    line.set_array(bound.sigma[1:])
    axis.add_collection(line)
    figure.colorbar(line, ax=axis, label="smallest possible position error (DRMS), m", shrink=0.8)
    axis.set_title(f"at the end {bound.sigma[-1]:.0f} m; dead reckoning alone {bound.unaided[-1]:.0f} m")
    _save(figure, path)


def _map(axis: Axes, grid: AnomalyGrid, longitude: Any, latitude: Any) -> None:
    low, high = np.nanpercentile(grid.anomaly, [1, 99])
    axis.pcolormesh(
        grid.longitude,
        grid.latitude,
        grid.anomaly,
        vmin=low,
        vmax=high,
        cmap="RdYlBu_r",
        shading="nearest",
        alpha=0.7,
    )
    for limits, values, edge in (
        (axis.set_xlim, longitude, grid.longitude),
        (axis.set_ylim, latitude, grid.latitude),
    ):
        margin = 0.15 * float(np.ptp(values)) + 0.005
        limits(max(values.min() - margin, edge[0]), min(values.max() + margin, edge[-1]))
    axis.set_aspect(1.0 / np.cos(np.radians(grid.latitude.mean())))
    axis.ticklabel_format(useOffset=False)
    axis.set_xlabel("longitude, deg")
    axis.set_ylabel("latitude, deg")


def _tracks(axis: Axes, result: xr.Dataset) -> None:
    latitude, longitude = result["latitude"].to_numpy(), result["longitude"].to_numpy()
    per_latitude, per_longitude = metres_per_degree(latitude)
    axis.plot(
        longitude - result["east"] / per_longitude,
        latitude - result["north"] / per_latitude,
        color="0.4",
        ls="--",
        lw=1,
        label="dead reckoning",
    )
    axis.plot(longitude, latitude, color="k", lw=1.2, label="filter")
    axis.plot(result["smoothed_longitude"], result["smoothed_latitude"], color="C2", lw=1.2, label="smoothed")
    if "error_north" in result:
        axis.plot(
            longitude - result["error_east"] / per_longitude,
            latitude - result["error_north"] / per_latitude,
            color="C3",
            lw=1,
            label=f"yardstick ({result.attrs['yardstick'].rstrip('_')})",
        )
    axis.legend(loc="upper right", fontsize=8)


def _shade(axis: Axes, hours: Any, state: Any) -> None:
    edges = np.flatnonzero(np.diff(state)) + 1
    seen = set()
    for piece in np.split(np.arange(state.size), edges):
        kind = State(int(state[piece[0]]))
        if kind in SHADES:
            label = None if kind in seen else kind.name.lower().replace("_", " ")
            end = hours[min(piece[-1] + 1, state.size - 1)]
            axis.axvspan(hours[piece[0]], end, color=SHADES[kind], alpha=0.5, lw=0, label=label)
            seen.add(kind)


def _save(figure: Figure, path: str | Path) -> None:
    with atomic_path(path) as beside:
        figure.savefig(beside, dpi=110)
