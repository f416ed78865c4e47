"""Draw logs, residuals and grids in a notebook, on given or on new axes, which each function returns.

::

    import magbridge as mb

    axes = mb.plot.corrected(log)
    axes.set_title("Dive 12")
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.uncertainty import in_sensor_units
from magbridge.calibration.model import Calibration
from magbridge.columns import in_seconds
from magbridge.errors import MissingExtra, WrongUse
from magbridge.estimation.residual import rms
from magbridge.field.grid import AnomalyGrid
from magbridge.wording import one_of

try:
    import matplotlib.pyplot as plt
    from matplotlib.axes import Axes
except ImportError:
    raise MissingExtra("matplotlib", "analysis") from None

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["corrected", "grid", "residuals"]


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
    from magbridge.logs.draw import corrected_panel  # noqa: PLC0415 - imports xarray

    if column not in log:
        raise WrongUse(f"expected a column {column!r}, got a log without it; correct the log first")
    axes = _axes(ax)
    corrected_panel(axes, in_seconds(log), column)
    axes.legend(frameon=False, fontsize="small")
    return axes


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
