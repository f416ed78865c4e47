"""Figure of a survey: its map and sigma, the track, residuals and crossovers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from magbridge.arrays import FloatArray
from magbridge.estimation.residual import rms
from magbridge.field.geodesy import metres_per_degree, offset
from magbridge.field.grid import AnomalyGrid
from magbridge.pictures import save
from magbridge.survey.samples import Crossovers, Samples

__all__ = ["draw_survey"]

MAX_DOTS = 20_000
"""Largest number of samples that are drawn."""


def draw_survey(
    grid: AnomalyGrid,
    samples: Samples,
    residual: FloatArray,
    found: Crossovers,
    misties: tuple[FloatArray, FloatArray],
    path: Path,
) -> None:
    """Draw map and sigma, the samples' residuals (n,), and mis-ties before and after levelling (m,), nT."""
    figure = Figure(figsize=(12.0, 9.0), layout="constrained")
    axes = figure.subplots(2, 2)
    latitude, longitude = offset(*samples.origin, samples.place[:, 0], samples.place[:, 1])
    step = slice(None, None, max(len(latitude) // MAX_DOTS, 1))
    extent = float(np.nanquantile(np.abs(grid.anomaly - np.nanmedian(grid.anomaly)), 0.99))
    middle = float(np.nanmedian(grid.anomaly))
    _map(figure, axes[0, 0], grid, grid.anomaly, "Anomaly (nT)", "RdBu_r", (middle - extent, middle + extent))
    axes[0, 0].plot(longitude[step], latitude[step], ",", color="0.2", alpha=0.4)
    top = float(np.nanquantile(grid.sigma, 0.98))
    _map(figure, axes[0, 1], grid, grid.sigma, "1-sigma of the map (nT)", "viridis", (0.0, top))
    _residuals(axes[1, 0], residual)
    _crossings(figure, axes[1, 1], samples, found, misties, (longitude[step], latitude[step]))
    save(figure, path, dpi=150)


def _map(
    figure: Figure,
    ax: Axes,
    grid: AnomalyGrid,
    values: FloatArray,
    title: str,
    colours: str,
    limits: tuple[float, float],
) -> None:
    mesh = ax.pcolormesh(
        grid.longitude, grid.latitude, values, cmap=colours, vmin=limits[0], vmax=limits[1], rasterized=True
    )
    figure.colorbar(mesh, ax=ax, shrink=0.85)
    _geographic(ax, float(np.mean(grid.latitude)), title)


def _geographic(ax: Axes, latitude: float, title: str) -> None:
    per_latitude, per_longitude = metres_per_degree(latitude)
    ax.set_aspect(per_latitude / per_longitude)
    ax.set(title=title, xlabel="Longitude (deg)", ylabel="Latitude (deg)")
    ax.ticklabel_format(useOffset=False)
    ax.tick_params(axis="x", labelrotation=30)


def _residuals(ax: Axes, residual: FloatArray) -> None:
    known = residual[np.isfinite(residual)]
    edge = float(np.quantile(np.abs(known), 0.995))
    ax.hist(np.clip(known, -edge, edge), bins=80, color="0.4")
    ax.set(title=f"Residuals of the samples: {rms(known):.2f} nT RMS", xlabel="nT", ylabel="Samples")


def _crossings(
    figure: Figure,
    ax: Axes,
    samples: Samples,
    found: Crossovers,
    misties: tuple[FloatArray, FloatArray],
    track: tuple[FloatArray, FloatArray],
) -> None:
    before, after = misties
    ax.plot(*track, ",", color="0.7")
    title = "No line crosses another"
    if len(before):
        latitude, longitude = offset(*samples.origin, found.place[:, 0], found.place[:, 1])
        edge = float(np.quantile(np.abs(after), 0.98)) or 1.0
        dots = ax.scatter(longitude, latitude, c=after, s=14, cmap="PuOr", vmin=-edge, vmax=edge)
        figure.colorbar(dots, ax=ax, shrink=0.85)
        size = f"{rms(after):.1f} nT RMS, before {rms(before):.1f}"
        title = f"{len(after)} crossovers: mis-ties after levelling\n{size}"
    _geographic(ax, samples.origin[0], title)
