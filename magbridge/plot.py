"""Draw logs, residuals and grids in a notebook, on given or on new axes, which each function returns.

::

    import magbridge as mb

    axes = mb.plot.corrected(log)
    axes.set_title("Dive 12")
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr

from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.uncertainty import in_sensor_units
from magbridge.calibration.model import Calibration
from magbridge.datasets import in_standard_units
from magbridge.errors import MissingExtra, WrongUse
from magbridge.estimation.residual import rms, robust_scale
from magbridge.field.grid import AnomalyGrid
from magbridge.pictures import save
from magbridge.records import Quality
from magbridge.wording import one_of

try:
    import matplotlib.pyplot as plt
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
except ImportError:
    raise MissingExtra("matplotlib", "analysis") from None

__all__ = ["corrected", "draw_corrected", "draw_fit", "grid", "residuals"]

DRAWN_SAMPLES = 20_000
"""Largest number of samples drawn; more would overlap."""
HALF_HEIGHT_SIGMA = 6.0
"""Half the height of the panels of corrected samples in :func:`draw_fit`, in robust standard deviations."""
LABELS = {"total_field": "total field, nT", "anomaly": "anomaly, nT", "total_field_sigma": "1-sigma, nT"}


def corrected(log: xr.Dataset, column: str = "total_field", ax: Axes | None = None) -> Axes:
    """Draw a column of a corrected log over time, with its 2-sigma band and the flagged samples.

    Parameters
    ----------
    log : Dataset (time)
        Result of :func:`magbridge.correct_rows`, or the log in a file written by ``magbridge correct``.
    column : str
        ``total_field``, ``anomaly`` or ``total_field_sigma``, nT.
    ax : Axes, optional
        Axes to draw on; new axes by default.

    Raises
    ------
    WrongUse
        The log lacks the column because it has not been corrected.
    """
    if column not in log:
        raise WrongUse(f"expected a column {column!r}, got a log without it; correct the log first")
    axes = _axes(ax)
    _corrected_panel(axes, in_standard_units(log), column)
    axes.legend(frameon=False, fontsize="small")
    return axes


def draw_corrected(log: xr.Dataset, path: str | Path) -> None:
    """Draw a log from ``magbridge correct`` and save the chart as PNG, PDF or SVG.

    The panels show total field and, if known, anomaly with 2-sigma bands, and the total field's 1-sigma.

    WriteError: the file cannot be written.
    """
    names = ["total_field", "anomaly", "total_field_sigma"]
    if not bool(log["anomaly"].notnull().any()):
        names.remove("anomaly")
    figure = Figure(figsize=(9.0, 1.0 + 2.2 * len(names)), layout="constrained")
    axes = figure.subplots(len(names), 1, sharex=True)
    for axis, name in zip(axes, names, strict=True):
        _corrected_panel(axis, log, name)
    for axis in axes[:-1]:
        axis.set_xlabel("")
    axes[0].legend(loc="upper right", ncols=3, frameon=False, fontsize="small")
    figure.suptitle(str(log.attrs.get("source", "")), fontsize="medium")
    save(figure, path, dpi=120)


def _corrected_panel(axis: Axes, log: xr.Dataset, name: str) -> None:
    """Draw a column of a corrected log against time, with flagged samples and the 2-sigma band of a field."""
    log = log.isel(time=slice(None, None, max(1, log.sizes["time"] // DRAWN_SAMPLES)))
    time = np.array(log["time"].to_numpy() * 1e6, "datetime64[us]")
    values, sigma = log[name].to_numpy(), log["total_field_sigma"].to_numpy()
    doubtful = (log["quality"].to_numpy().astype(int) & ~int(Quality.NO_BORESIGHT)) != 0
    clear = np.where(doubtful, np.nan, values)
    axis.plot(time, clear, lw=0.8, color="C0", label="corrected")
    axis.plot(time[doubtful], values[doubtful], ".", ms=3, mew=0, color="C1", label="flagged")
    spread = name.endswith("sigma")
    if not spread:
        low, high = clear - 2.0 * sigma, clear + 2.0 * sigma
        axis.fill_between(time, low, high, color="C0", alpha=0.25, lw=0, label="2-sigma")
    if np.isfinite(clear).any():  # flagged samples must not set the scale
        bottom, top = np.nanpercentile(clear, [0.5, 99.5])
        margin = 0.15 * (top - bottom) + 2.0 * float(np.nanmedian(sigma))
        axis.set_ylim(max(bottom - margin, 0.0) if spread else bottom - margin, top + margin)
    axis.set_xlabel("UTC")
    axis.set_ylabel(LABELS.get(name, f"{name}, nT"))
    axis.grid(color="0.92", lw=0.6)
    axis.spines[["top", "right"]].set_visible(False)


def residuals(
    calibration: Calibration, data: Observations, against: str = "time", ax: Axes | None = None
) -> Axes:
    """Draw the residual of the corrected total field; a trend shows an effect that the model lacks.

    Parameters
    ----------
    calibration : Calibration
        Calibration that corrects the readings.
    data : Observations
        Observations of a log with a reference field (:func:`magbridge.observations`).
    against : str
        Abscissa: ``time``, ``heading``, or a parameter of the data.
    ax : Axes, optional
        Axes to draw on; new axes by default.

    Raises
    ------
    WrongUse
        `against` is none of these.
    """
    left, _ = in_sensor_units(calibration, data)
    if against == "time":
        x, label = (data.time - data.time[0]) / 60.0, "minutes"
    elif against == "heading" and data.attitude is not None:
        x, label = np.degrees(data.attitude[:, 2]) % 360.0, "heading, deg"
    elif against in data.names:
        number = data.names.index(against)
        x, label = data.parameters[:, number], f"{against}, {data.units[number] or '?'}"
    else:
        raise WrongUse(f"against: {one_of(against, ('time', 'heading', *data.names))}")
    axes = _axes(ax)
    noise = calibration.noise.sensor
    axes.axhspan(-2.0 * noise, 2.0 * noise, color="0.6", alpha=0.25, lw=0, label="2 sigma of the noise")
    axes.plot(x, left, ".", ms=2, label=f"{rms(left):.2f} nT RMS")
    axes.set_xlabel(label)
    axes.set_ylabel("corrected minus reference, nT")
    axes.legend(frameon=False, fontsize="small")
    return axes


def draw_fit(calibration: Calibration, data: Observations, path: str | Path) -> None:
    """Write a plot of each sample's deviation from the reference, nT, as read and as corrected.

    The abscissae are time, heading (if it is known) and each parameter. A trend in a lower panel shows an
    error that the calibration does not describe.

    WriteError: the file cannot be written.
    """
    known = data.attitude is not None and np.isfinite(data.attitude[:, 2]).any()
    names = ["time", *(["heading"] if known else []), *data.names]
    read = np.linalg.norm(data.field, axis=1) - data.reference
    figure = Figure(figsize=(1.0 + 3.4 * len(names), 6.4), layout="constrained")
    axes = figure.subplots(2, len(names), sharex="col", sharey="row", squeeze=False)
    for name, (above, below) in zip(names, axes.T, strict=True):
        residuals(calibration, data, name, below)
        above.plot(below.lines[0].get_xdata(), read, ".", ms=2, label=f"{rms(read):.0f} nT RMS")
    axes[0, 0].set_ylabel("as read minus reference, nT")
    axes[0, 0].legend(frameon=False, fontsize="small")
    for right in axes[1, 1:]:  # label and legend of the first panel hold for its row
        right.set_ylabel("")
        right.get_legend().remove()
    # the median, because samples with masses in motion must not set the scale
    left = np.asarray(axes[1, 0].lines[0].get_ydata(), float)
    edge = HALF_HEIGHT_SIGMA * max(calibration.noise.sensor, robust_scale(left))
    axes[1, 0].set_ylim(-edge, edge)
    save(figure, path)


def grid(anomaly: AnomalyGrid, track: xr.Dataset | None = None, ax: Axes | None = None) -> Axes:
    """Draw an anomaly grid, and the track of a log on it.

    Parameters
    ----------
    anomaly : AnomalyGrid
        Grid to draw (:func:`magbridge.read_grid`).
    track : Dataset (time), optional
        Log with ``latitude`` and ``longitude``, deg.
    ax : Axes, optional
        Axes to draw on; new axes by default.
    """
    axes = _axes(ax)
    middle = float(np.nanmedian(anomaly.anomaly))
    reach = float(np.nanquantile(np.abs(anomaly.anomaly - middle), 0.99))
    mesh = axes.pcolormesh(
        anomaly.longitude, anomaly.latitude, anomaly.anomaly,
        cmap="RdBu_r", vmin=middle - reach, vmax=middle + reach, rasterized=True,
    )  # fmt: skip
    axes.figure.colorbar(mesh, ax=axes, label="anomaly, nT", shrink=0.85)
    if track is not None:
        axes.plot(track["longitude"], track["latitude"], color="0.1", lw=1.0)
    axes.set_aspect(1.0 / np.cos(np.radians(float(np.mean(anomaly.latitude)))))
    axes.set_xlabel("longitude, deg")
    axes.set_ylabel("latitude, deg")
    return axes


def _axes(ax: Axes | None) -> Axes:
    if ax is not None:
        return ax
    _, axes = plt.subplots(figsize=(8.0, 4.0), layout="constrained")
    return axes
