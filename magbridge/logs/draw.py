"""A picture of a corrected log."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from magbridge.files import atomic_path
from magbridge.records import Quality

__all__ = ["draw_corrected"]

POINTS = 20_000
"""Samples drawn; more only make a blot."""


def draw_corrected(log: xr.Dataset, path: str | Path) -> None:
    """Draw the total field with its 2-sigma band, the anomaly where there is one, and what is flagged.

    Parameters
    ----------
    log : Dataset (time)
        With what ``magbridge correct`` writes.
    path : path
        PNG, PDF or SVG.

    Raises
    ------
    WriteError
        The file cannot be written.
    """
    log = log.isel(time=slice(None, None, max(1, log.sizes["time"] // POINTS)))
    time = np.array(log["time"].to_numpy() * 1e6, "datetime64[us]")
    total, sigma = log["total_field"].to_numpy(), log["total_field_sigma"].to_numpy()
    doubtful = (log["quality"].to_numpy().astype(int) & ~int(Quality.NO_BORESIGHT)) != 0
    rows = {"total field, nT": total}
    if bool(log["anomaly"].notnull().any()):
        rows["anomaly, nT"] = log["anomaly"].to_numpy()
    rows["1-sigma, nT"] = sigma
    figure = Figure(figsize=(9.0, 1.0 + 2.2 * len(rows)), layout="constrained")
    axes = figure.subplots(len(rows), 1, sharex=True)
    for axis, (label, values) in zip(axes, rows.items(), strict=True):
        clear = np.where(doubtful, np.nan, values)
        axis.plot(time, clear, lw=0.8, color="C0", label="corrected")
        axis.plot(time[doubtful], values[doubtful], ".", ms=3, mew=0, color="C1", label="flagged")
        if not label.startswith("1-sigma"):
            low, high = clear - 2.0 * sigma, clear + 2.0 * sigma
            axis.fill_between(time, low, high, color="C0", alpha=0.25, lw=0, label="2-sigma")
        # flagged samples must not set the scale
        if np.isfinite(clear).any():
            bottom, top = np.nanpercentile(clear, [0.5, 99.5])
            margin = 0.15 * (top - bottom) + 2.0 * float(np.nanmedian(sigma))
            axis.set_ylim(
                max(bottom - margin, 0.0) if label.startswith("1-sigma") else bottom - margin, top + margin
            )
        axis.set_ylabel(label)
        axis.grid(color="0.92", lw=0.6)
        axis.spines[["top", "right"]].set_visible(False)
    axes[-1].set_xlabel("UTC")
    axes[0].legend(loc="upper right", ncols=3, frameon=False, fontsize="small")
    figure.suptitle(str(log.attrs.get("source", "")), fontsize="medium")
    with atomic_path(path) as file:
        figure.savefig(file, dpi=120)
