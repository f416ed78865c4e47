"""Draw charts of a corrected log."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from magbridge.pictures import save
from magbridge.records import Quality

DRAWN_SAMPLES = 20_000
"""Largest number of samples drawn; more would overlap."""
LABELS = {"total_field": "total field, nT", "anomaly": "anomaly, nT", "total_field_sigma": "1-sigma, nT"}


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
        corrected_panel(axis, log, name)
    for axis in axes[:-1]:
        axis.set_xlabel("")
    axes[0].legend(loc="upper right", ncols=3, frameon=False, fontsize="small")
    figure.suptitle(str(log.attrs.get("source", "")), fontsize="medium")
    save(figure, path, dpi=120)


def corrected_panel(axis: Axes, log: xr.Dataset, name: str) -> None:
    """Draw a column of a corrected log against time, with flagged samples and the 2-sigma band of a field.

    `name` is ``total_field``, ``anomaly``, ``total_field_sigma`` or ``level_sigma``.
    """
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
