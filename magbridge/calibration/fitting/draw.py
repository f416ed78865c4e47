"""Plot the residual of a fit, raw and corrected, against time, heading and each parameter."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.uncertainty import in_sensor_units
from magbridge.calibration.model import Calibration
from magbridge.estimation.residual import rms, robust_scale
from magbridge.pictures import save

PANEL_POINTS = 5_000
"""Approximate number of points in a panel; with more the points merge."""
PANEL_HALF_HEIGHT_SIGMA = 6.0
"""Half the height of the lower panels, in robust standard deviations; larger errors are drawn at the edge."""


def draw_fit(calibration: Calibration, data: Observations, path: str | Path) -> None:
    """Write a plot of each sample's deviation from the reference, nT, with one colour for each run.

    The upper panels show the deviation as read, the lower panels as corrected. The abscissae are time,
    heading (if attitude is known) and each parameter. A trend in a lower panel shows an error that the
    calibration does not describe.

    WriteError: the file cannot be written.
    """
    read = np.linalg.norm(data.field, axis=1) - data.reference
    left, _ = in_sensor_units(calibration, data)
    part = slice(None, None, max(1, len(data) // PANEL_POINTS))
    _, run = np.unique(data.runs, return_inverse=True)
    abscissae = _abscissae(data)
    figure = Figure(figsize=(1.0 + 3.4 * len(abscissae), 6.4), layout="constrained")
    axes = figure.subplots(2, len(abscissae), sharex="col", sharey="row", squeeze=False)
    noise = calibration.noise.sensor
    # the median, because samples with masses in motion must not set the scale
    edge = PANEL_HALF_HEIGHT_SIGMA * max(noise, robust_scale(left))
    beyond = np.abs(left) > edge
    for values, row in ((read, axes[0]), (np.where(beyond, np.nan, left), axes[1])):
        for axis, x in zip(row, abscissae.values(), strict=True):
            dots = axis.scatter(
                x[part], values[part], c=run[part] % 20, cmap="tab20", vmin=0, vmax=19, s=3, lw=0
            )
            axis.axhline(0.0, color="0.2", lw=0.6)
            axis.grid(color="0.92", lw=0.6)
            axis.set_axisbelow(True)
            axis.spines[["top", "right"]].set_visible(False)
    axes[1, 0].set_ylim(-1.1 * edge, 1.1 * edge)
    for axis, (name, x) in zip(axes[1], abscissae.items(), strict=True):
        band = axis.axhspan(-2.0 * noise, 2.0 * noise, color="0.6", alpha=0.25, lw=0)
        up, down = x[beyond & (left > 0.0)], x[beyond & (left < 0.0)]
        (above,) = axis.plot(up, np.full(len(up), 1.05 * edge), "^", c="0.3", ms=3, mew=0)
        axis.plot(down, np.full(len(down), -1.05 * edge), "v", c="0.3", ms=3, mew=0)
        axis.set_xlabel(name)
    axes[0, 0].set_ylabel(f"as read, nT: {rms(read):.0f} RMS")
    axes[1, 0].set_ylabel(f"corrected, nT: {rms(left):.2f} RMS")
    legend = {"a colour for each run": dots} if run.max() else {}
    legend["2 sigma of the sensor's noise"] = band
    if beyond.any():
        legend[f"beyond the scale: {beyond.sum()} of {len(data)}, up to {np.abs(left).max():.0f} nT"] = above
    figure.legend(
        legend.values(), legend, loc="outside upper right", ncols=len(legend), fontsize=8, frameon=False,
        markerscale=2,
    )  # fmt: skip
    save(figure, path)


def _abscissae(data: Observations) -> dict[str, FloatArray]:
    """Return the abscissae (n,) of the plot by their label, which states name and unit."""
    since = data.time - data.time[0]
    shown = {"hours": since / 3600.0} if since.max() > 7200.0 else {"minutes": since / 60.0}
    if data.attitude is not None and np.isfinite(data.attitude[:, 2]).any():
        shown["heading, deg"] = np.degrees(data.attitude[:, 2]) % 360.0
    units = (f", {unit}" if unit else "" for unit in data.units)
    return shown | {f"{n}{u}": p for n, u, p in zip(data.names, units, data.parameters.T, strict=True)}
