"""The twin's equivalents of the paper's Figures 2 to 6; drawn by tools/bonne_bay.py."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import matplotlib as mpl
import numpy as np
import xarray as xr
from bonne_bay_trials import METHODS, TRIALS, Trials
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from magbridge.columns import CHANNELS
from magbridge.field.igrf import magnitude
from magbridge.field.reference import main_field

INK = {"nominal": "#c9a227", "cubic": "#1f77a4", "auto": "#b3315c", "local": "#1b1b1b", "igrf": "#8a8a8a"}


def draw(flight: Trials, folder: Path) -> Iterator[Path]:
    """Draw the figures, yielding each file."""
    mpl.rcParams |= {
        "font.size": 9, "axes.titlesize": 10, "axes.titleweight": "bold", "axes.titlelocation": "left",
        "axes.spines.top": False, "axes.spines.right": False, "axes.linewidth": 0.6, "lines.linewidth": 0.8,
        "legend.frameon": False, "savefig.dpi": 160, "figure.constrained_layout.use": True,
    }  # fmt: skip
    drawings = {
        "figure_2_map": _figure_2,
        "figure_3_nominal": _figure_3,
        "figure_4_parameterised": _figure_4,
        "figure_5_survey": _figure_5,
        "figure_6_anomaly": _figure_6,
    }
    folder.mkdir(parents=True, exist_ok=True)
    for name, drawing in drawings.items():
        figure = drawing(flight)
        figure.savefig(folder / f"{name}.png")
        plt.close(figure)
        yield folder / f"{name}.png"


def _figure_2(flight: Trials) -> Figure:
    figure, axes = plt.subplots(figsize=(6.6, 5.6))
    grid, survey = flight.anomaly, flight.parts["survey"]
    scale = float(np.quantile(np.abs(grid.anomaly), 0.98))
    shade = axes.pcolormesh(
        grid.longitude, grid.latitude, grid.anomaly, cmap="RdBu_r", vmin=-scale, vmax=scale, shading="gouraud"
    )
    axes.plot(survey["longitude"], survey["latitude"], color="black", label="survey")
    for trial, marker, size in zip(TRIALS, "x+", (6, 10), strict=True):  # both have the same position
        part = flight.parts[trial].isel(time=slice(0, None, 90))
        axes.plot(
            part["longitude"],
            part["latitude"],
            marker,
            color="black",
            markersize=size,
            markeredgewidth=0.6,
            label=trial,
        )
    _frame(axes, survey)
    axes.legend(loc="upper right", facecolor="white", frameon=True, edgecolor="none")
    figure.colorbar(shade, label="anomaly, nT, 90 m above the water", shrink=0.8)
    axes.set_title("Calibration spirals and survey on the aeromagnetic map")
    return figure


def _figure_3(flight: Trials) -> Figure:
    figure, panels = plt.subplots(2, 2, figsize=(9, 5), sharex="col", sharey="row", height_ratios=(1, 1))
    for (raw_panel, panel), trial in zip(panels.T, TRIALS, strict=True):
        part = flight.parts[trial]
        hours = _hours(part)
        raw_panel.plot(
            hours, np.sqrt(sum(part[n] ** 2 for n in CHANNELS)) / 1e3, ".", markersize=1.2, color="#777777"
        )
        raw_panel.set_title(f"Trial {trial[-1]}: raw")
        panel.set_title("corrected")
        panel.plot(
            hours,
            flight.corrected[trial, trial, "nominal"],
            ".",
            markersize=1.2,
            color=INK["nominal"],
            label="nominal",
        )
        _references(panel, part)
        _runs(panel, part)
        panel.set_xlabel("hours since the first dive")
    panels[0, 0].set_ylabel("total field, µT")
    panels[1, 0].set_ylabel("total field, nT")
    _legend(panels[1, 1])
    return figure


def _figure_4(flight: Trials) -> Figure:
    figure, panels = plt.subplots(2, 1, figsize=(9, 6.2), sharex=True, sharey=True)
    for panel, trial in zip(panels, TRIALS, strict=True):
        part = flight.parts[trial]
        for method in METHODS:
            if (trial, trial, method) in flight.corrected:
                label = f"{method}: {flight.rms(trial, trial, method):.0f} nT"
                panel.plot(
                    _hours(part),
                    flight.corrected[trial, trial, method],
                    ".",
                    markersize=1.2,
                    color=INK[method],
                    label=label,
                )
        _references(panel, part)
        _runs(panel, part)
        panel.set_title(f"Trial {trial[-1]}")
        panel.set_ylabel("total field, nT")
        _legend(panel)
    panels[1].set_xlabel("hours since the first dive")
    return figure


def _figure_5(flight: Trials) -> Figure:
    figure, panels = plt.subplots(3, 1, figsize=(9, 7.4), sharex=True, height_ratios=(3, 3, 1))
    survey = flight.parts["survey"]
    hours = _hours(survey)
    for panel, trial in zip(panels, TRIALS, strict=False):
        for method in METHODS:
            if ("survey", trial, method) in flight.corrected:
                label = f"{method}: {flight.rms('survey', trial, method):.0f} nT"
                panel.plot(
                    hours,
                    flight.corrected["survey", trial, method],
                    color=INK[method],
                    label=label,
                    linewidth=0.5,
                )
        _references(panel, survey)
        panel.set_title(f"Survey, trial {trial[-1]}'s coefficients")
        panel.set_ylabel("total field, nT")
        _legend(panel)
    panels[0].sharey(panels[1])
    panels[2].plot(hours, survey["sensor_temperature"], color=INK["local"])
    panels[2].axhline(2.0, color=INK["igrf"], linestyle=":")
    panels[2].set_ylabel("fluxgate, °C")
    panels[2].set_xlabel("hours since the first sample of the survey")
    return figure


def _figure_6(flight: Trials) -> Figure:
    figure, panels = plt.subplots(1, 2, figsize=(9, 4.6), sharex=True, sharey=True)
    survey = flight.parts["survey"]
    main = magnitude(main_field(survey))
    method = "cubic" if ("survey", "trial 2", "cubic") in flight.corrected else "auto"
    measured = flight.corrected["survey", "trial 2", method] - main
    mapped = survey["reference_field"] - main
    limit = float(np.quantile(np.abs(mapped), 0.995)) * 1.2
    for panel, anomaly, title in zip(
        panels, (measured, mapped), (f"Measured ({method}, trial 2)", "Map under the track"), strict=True
    ):
        shade = panel.scatter(
            survey["longitude"],
            survey["latitude"],
            c=anomaly,
            s=5,
            cmap="RdBu_r",
            vmin=-limit,
            vmax=limit,
            linewidths=0,
        )
        panel.set_title(title)
        _frame(panel, survey)
    panels[1].set_ylabel("")
    figure.colorbar(shade, ax=panels, label="anomaly, nT", shrink=0.85)
    return figure


def _references(panel: Axes, part: xr.Dataset) -> None:
    panel.plot(
        _hours(part),
        magnitude(main_field(part)),
        color=INK["igrf"],
        linewidth=1.0,
        linestyle="--",
        label="IGRF",
    )
    panel.plot(_hours(part), part["reference_field"], color=INK["local"], linewidth=1.0, label="IGRF + map")
    panel.grid(axis="y", linewidth=0.3, alpha=0.6)


def _runs(panel: Axes, part: xr.Dataset) -> None:
    """Shade every other run."""
    edges = _hours(part)[np.flatnonzero(np.diff(part["run"], prepend=0))]
    edges = np.append(edges, _hours(part)[-1])
    for left, right in zip(edges[::2], edges[1::2], strict=False):
        panel.axvspan(left, right, color="#f3f1ec", zorder=0, linewidth=0)


def _legend(panel: Axes) -> None:
    legend = panel.legend(
        loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=5, fontsize=8, borderpad=0.1, columnspacing=1.2
    )
    for handle in legend.legend_handles:
        if handle is not None and hasattr(handle, "set_markersize"):
            handle.set_markersize(6)


def _frame(axes: Axes, survey: xr.Dataset) -> None:
    latitude, longitude = survey["latitude"].to_numpy(), survey["longitude"].to_numpy()
    middle = float(latitude.mean())
    half = 0.62 * max(float(np.ptp(latitude)), float(np.ptp(longitude)) * np.cos(np.radians(middle)))
    centre = [(float(a.min()) + float(a.max())) / 2 for a in (longitude, latitude)]
    axes.set(
        aspect=1 / np.cos(np.radians(middle)),
        xlim=centre[0] + np.array([-1, 1]) * half / np.cos(np.radians(middle)),
        ylim=centre[1] + np.array([-1, 1]) * half,
        xlabel="longitude, deg",
        ylabel="latitude, deg",
    )
    axes.xaxis.set_major_locator(mpl.ticker.MaxNLocator(4))
    axes.ticklabel_format(useOffset=False)


def _hours(part: xr.Dataset) -> np.ndarray:
    time = part["time"].to_numpy()
    return np.asarray((time - time[0]) / 3600)
