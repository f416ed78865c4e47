"""Figures: a track on its map with the filter's innovations and sigma, and the bound of a planned track."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from magbridge.arrays import RealArray
from magbridge.field.geodesy import metres_per_degree, signed_longitude
from magbridge.field.grid import AnomalyGrid
from magbridge.field.igrf import total_field
from magbridge.navigate.bound import Bound
from magbridge.navigate.findings import errors
from magbridge.navigate.record import NavigationState
from magbridge.pictures import save

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_bound", "draw_navigation", "measured_on_track"]

SHADES = {
    NavigationState.SEARCHING: "#f5d76e",
    NavigationState.DEAD_RECKONING: "#d5d8dc",
    NavigationState.LOST: "#e59a93",
}


def draw_navigation(result: xr.Dataset, grid: AnomalyGrid | None, path: str | Path) -> None:
    """Draw a result of :func:`~.batch.navigate`, or, if `grid` is None, of :func:`~.own_survey.localise`."""
    figure = Figure(figsize=(13.0, 9.0), layout="constrained")
    draws = {"field": _field, "innovation": _innovation, "sigma": _sigma}
    if grid is None:
        del draws["innovation"]
    panels = figure.subplot_mosaic([["map", name] for name in draws], width_ratios=(1.1, 1))
    tracks = np.concatenate(_tracks(panels["map"], result), axis=1)
    _frame(panels["map"], *tracks)
    if grid is not None:
        _map(panels["map"], grid, tracks[0])
    hours = (result["time"].to_numpy() - float(result["time"][0])) / 3600.0
    for name, draw in draws.items():
        draw(panels[name], hours, result)
        where, columns = (0.0, 1.0), min(len(panels[name].get_legend_handles_labels()[1]), 3)
        panels[name].legend(loc="lower left", bbox_to_anchor=where, ncols=columns, fontsize=8, frameon=False)
    save(figure, path)


def _field(axis: Axes, hours: RealArray, result: xr.Dataset) -> None:
    measured = measured_on_track(result)
    axis.plot(hours, measured, ".", ms=2, color="0.3", label="measured, on the filter's track")
    axis.plot(hours, result["map_anomaly"], color="C3", lw=1, label="map's, or found, on that track")
    axis.set_ylabel("anomaly, nT")


def _innovation(axis: Axes, hours: RealArray, result: xr.Dataset) -> None:
    spread = 2.0 * np.sqrt(result["innovation_variance"])
    axis.fill_between(hours, -spread, spread, color="C0", alpha=0.2, lw=0, label="2 sigma")
    taken = result["accepted"].to_numpy() > 0
    axis.plot(hours[taken], result["innovation"][taken], ".", ms=2, color="C0", label="taken in")
    axis.plot(hours[~taken], result["innovation"][~taken], "x", ms=4, color="C3", label="beyond the gate")
    reach = np.concatenate([spread, np.abs(result["innovation"])])
    if np.isfinite(reach).any():
        # a wide start's first innovations are as large as the map
        limit = 1.5 * float(np.nanpercentile(reach, 98))
        axis.set_ylim(-limit, limit)
    axis.set_ylabel("innovation, nT")


def _sigma(axis: Axes, hours: RealArray, result: xr.Dataset) -> None:
    sigma = np.sqrt(result["covariance_nn"] + result["covariance_ee"])
    axis.semilogy(hours, sigma, color="C0", label="sigma, filter")
    smoothed = np.hypot(result["smoothed_sigma_north"], result["smoothed_sigma_east"])
    axis.semilogy(hours, smoothed, color="C2", label="sigma, smoothed")
    for name, line, label in (("unaided", "--", "sigma, dead reckoning alone"), ("bound", ":", "bound")):
        if f"{name}_sigma" in result:
            axis.semilogy(hours, result[f"{name}_sigma"], color="C0", ls=line, lw=1, label=label)
    error, reckoned = errors(result)
    if np.isfinite(error).any():
        axis.semilogy(hours, error, color="0.2", lw=0.8, label="error")
        axis.semilogy(hours, reckoned, color="0.35", ls="--", lw=1, label="error, dead reckoning alone")
    axis.set_ylim(bottom=0.02 * float(smoothed.min()))  # the first error may be of millimetres
    axis.set_ylabel("position error, m")
    _plain(axis)
    axis.set_xlabel("hours")
    if "state" in result:
        _shade(axis, hours, result["state"].to_numpy())


def draw_bound(bound: Bound, grid: AnomalyGrid, path: str | Path) -> None:
    """Draw a planned track on the map, coloured by its bound, and bound and dead reckoning over time."""
    figure = Figure(figsize=(9.0, 9.0), layout="constrained")
    panels = figure.subplot_mosaic([["map"], ["time"]], height_ratios=(3, 1))
    axis = panels["map"]
    points = np.column_stack([np.unwrap(bound.longitude, period=360.0), bound.latitude])
    _frame(axis, *points.T)
    _map(axis, grid, points[:, 0])
    axis.plot(*points.T, color="w", lw=7, solid_capstyle="round")
    line = LineCollection(
        list(np.stack([points[:-1], points[1:]], axis=1)), cmap="viridis_r", norm=LogNorm(), linewidths=4
    )
    line.set_array(bound.sigma[1:])
    axis.add_collection(line)
    axis.plot(*points[0], "o", ms=9, mfc="w", mec="k", label="start")
    axis.legend(loc="best", fontsize=8)
    scale = figure.colorbar(line, ax=axis, label="smallest possible position error (DRMS), m", shrink=0.9)
    _plain(scale.ax)
    axis.set_title(
        f"at the end no better than {bound.sigma[-1]:.0f} m; dead reckoning alone {bound.unaided[-1]:.0f} m"
    )

    axis = panels["time"]
    hours = (bound.time - bound.time[0]) / 3600.0
    axis.semilogy(hours, bound.unaided, color="0.5", ls="--", label="dead reckoning alone")
    axis.semilogy(hours, bound.sigma, color="C0", label="with the map, at best")
    off = np.isnan(grid.evaluate(bound.longitude, bound.latitude).anomaly)
    if off.any():
        axis.fill_between(
            hours, 0, 1, where=off, transform=axis.get_xaxis_transform(), color="0.9", label="off the map"
        )
    axis.set_xlabel("hours")
    axis.set_ylabel("position error, m")
    _plain(axis)
    axis.grid(alpha=0.3)
    axis.legend(loc="best", fontsize=8)
    save(figure, path)


def _map(axis: Axes, grid: AnomalyGrid, longitude: Any) -> None:
    """Draw the map within the limits of `axis`; the track's `longitude` (n,), deg, may pass 180."""
    frame = axis.get_xlim(), axis.get_ylim()
    low, high = np.nanpercentile(grid.anomaly, [1, 99])
    west = grid.longitude + 360.0 * np.round((np.nanmean(longitude) - grid.longitude.mean()) / 360.0)
    dx, dy = (0.5 * (edge[-1] - edge[0]) / (edge.size - 1) for edge in (west, grid.latitude))
    drawn = axis.imshow(
        grid.anomaly,
        extent=(west[0] - dx, west[-1] + dx, grid.latitude[0] - dy, grid.latitude[-1] + dy),
        origin="lower",
        interpolation="bilinear",
        vmin=low,
        vmax=high,
        cmap="RdYlBu_r",
        alpha=0.6,
        aspect=axis.get_aspect(),
    )
    axis.set(xlim=frame[0], ylim=frame[1], facecolor="0.92")  # grey is off the map
    scale = axis.inset_axes((0.04, 0.05, 0.3, 0.02))
    axis.figure.colorbar(drawn, cax=scale, orientation="horizontal")
    scale.set_title("anomaly, nT", fontsize=8)
    scale.tick_params(labelsize=8)


def _frame(axis: Axes, longitude: Any, latitude: Any) -> None:
    """Set limits, aspect and labels of the map's axes so that a track (n,), deg, fits."""
    slender = float(np.cos(np.radians(np.nanmean(latitude))))  # of a degree of longitude
    (x, width), (y, height) = (
        (0.5 * (np.nanmin(v) + np.nanmax(v)), 0.65 * float(np.nanmax(v) - np.nanmin(v)) + 0.005)
        for v in (longitude, latitude)
    )
    width, height = max(width, 0.8 * height / slender), max(height, 0.6 * width * slender)
    axis.set_xlim(x - width, x + width)
    axis.set_ylim(y - height, y + height)
    axis.set_aspect(1.0 / slender)
    axis.ticklabel_format(axis="y", useOffset=False)
    axis.xaxis.set_major_locator(MaxNLocator(5))
    axis.xaxis.set_major_formatter(lambda value, _: f"{signed_longitude(value):.7g}")
    axis.set_xlabel("longitude, deg")
    axis.set_ylabel("latitude, deg")


def measured_on_track(result: xr.Dataset) -> RealArray:
    """Return the measured anomaly (n,), nT: total field minus the main field at the filter's position."""
    longitude, latitude = result["longitude"].to_numpy(), result["latitude"].to_numpy()
    per_latitude, per_longitude = metres_per_degree(latitude)
    east, north = result["east"].to_numpy() / per_longitude, result["north"].to_numpy() / per_latitude
    depth, time = np.nan_to_num(result["depth"].to_numpy()), result["time"].to_numpy()
    main = total_field(longitude, latitude, depth, time)
    reckoned = total_field(longitude - east, latitude - north, depth, time)
    measured: RealArray = result["anomaly"].to_numpy() + reckoned - main
    return measured


def _tracks(axis: Axes, result: xr.Dataset) -> list[RealArray]:
    """Draw the tracks; return those that the axes must show, (2, n) each: longitude and latitude, deg."""
    latitude = result["latitude"].to_numpy()
    longitude = np.unwrap(result["longitude"].to_numpy(), period=360.0)
    per_latitude, per_longitude = metres_per_degree(latitude)

    def shifted(north: str, east: str) -> RealArray:
        return np.stack([longitude - result[east] / per_longitude, latitude - result[north] / per_latitude])

    here = np.stack([longitude, latitude])
    sure = np.where(result["valid"] > 0, here, np.nan)
    smoothed = np.stack(
        [np.unwrap(result["smoothed_longitude"].to_numpy(), period=360.0), result["smoothed_latitude"]]
    )
    smoothed[0] += 360.0 * np.round((longitude.mean() - smoothed[0].mean()) / 360.0)
    reckoned = shifted("north", "east")
    axis.plot(*reckoned, color="0.35", ls="--", lw=1, label="dead reckoning")
    axis.plot(*here, ".", color="0.35", ms=1.5, label="filter, not valid")
    axis.plot(*sure, color="k", lw=1.5, label="filter, valid")
    axis.plot(*smoothed, color="C2", lw=1.5, label="smoothed")
    tracks = [reckoned, sure, smoothed]
    if "error_north" in result:
        known = shifted("error_north", "error_east")
        name = result.attrs["reference_track"].rstrip("_")
        axis.plot(*known, color="C3", lw=1.2, ls=(0, (4, 2)), label=f"known position ({name})")
        tracks.append(known)
    axis.legend(loc="upper right", fontsize=8)
    return tracks


def _shade(axis: Axes, hours: Any, state: Any) -> None:
    edges = np.flatnonzero(np.diff(state)) + 1
    seen = set()
    for piece in np.split(np.arange(state.size), edges):
        kind = NavigationState(int(state[piece[0]]))
        if kind in SHADES:
            label = None if kind in seen else kind.name.lower().replace("_", " ")
            end = hours[min(piece[-1] + 1, state.size - 1)]
            axis.axvspan(hours[piece[0]], end, color=SHADES[kind], alpha=0.5, lw=0, label=label)
            seen.add(kind)


def _plain(axis: Axes) -> None:
    """Label the logarithmic y axis with plain numbers: 100, not 10^2."""
    axis.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.yaxis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "25" else "")
