"""Plot the demonstration: the fluxgate's readings, the published field, and the true field."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.estimation.residual import rms
from magbridge.files import atomic_path
from sitl.dataset import channels

mpl.use("agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

RAW, NOMINAL, CORRECTED, TRUE, FLAGGED = "#b0b0b0", "#d1793b", "#1f6fb4", "#111111", "#c0392b"


def draw(survey: xr.Dataset, nominal: FloatArray, samples: xr.Dataset, path: Path) -> None:
    """Plot the survey to the file `path`: masses, raw field, corrected field, true field and errors.

    `nominal` (n,) is the survey's total field (nT) as the nominal calibration, one ellipsoid, corrects it.
    `samples` are the values received over the link.
    """
    hours, received = (
        (time.to_numpy() - float(survey["time"][0])) / 3600.0 for time in (survey["time"], samples["time"])
    )
    truth = survey["truth_total_field"].to_numpy()
    total, sigma = samples["total_field"].to_numpy(), samples["sigma"].to_numpy()
    style: dict[Any, Any] = {"font.size": 9, "axes.spines.top": False, "axes.titlelocation": "left"}
    with mpl.rc_context(style | {"axes.spines.right": False}):
        figure, (masses, raw, levels, errors) = plt.subplots(
            4, 1, figsize=(10, 10), sharex=True, height_ratios=(1, 1.4, 1.6, 1.6), layout="constrained"
        )
        _masses(masses, hours, survey)
        raw.plot(hours, np.linalg.norm(channels(survey), axis=1), color=RAW, lw=1.4, label="raw |H|")
        _finish(raw, "What the fluxgate reads", hours, truth)
        low, high = total - 2 * sigma, total + 2 * sigma
        levels.fill_between(received, low, high, color=CORRECTED, alpha=0.2, lw=0, label="its 2 sigma")
        levels.plot(received, total, color=CORRECTED, lw=1.4, label="corrected")
        _finish(levels, "What a ground station receives", hours, truth)
        _errors(errors, hours, nominal - truth, received, samples)
        errors.set_xlabel("hours since the survey began")
        with atomic_path(path) as temporary:
            figure.savefig(temporary, dpi=130)
        plt.close(figure)


def _masses(axes: Axes, hours: FloatArray, survey: xr.Dataset) -> None:
    axes.set_title("What moves: battery and ballast")
    axes.spines["right"].set_visible(True)
    for one, name, label, colour in (
        (axes, "battpos", "battery, in", "#5b8a3c"), (axes.twinx(), "ballast", "ballast, cm³", "#8a3c6e"),
    ):  # fmt: skip
        one.step(hours, survey[name].to_numpy(), color=colour, lw=1)
        one.set_ylabel(label, color=colour)


def _finish(axes: Axes, title: str, hours: FloatArray, truth: FloatArray) -> None:
    """Add the true field, title and legend to a panel of total fields."""
    axes.plot(hours, truth, color=TRUE, lw=1.0, label="true")
    axes.set(title=title, ylabel="total field, nT")
    axes.ticklabel_format(axis="y", useOffset=False)
    axes.legend(loc="upper right", frameon=False, ncols=3)
    axes.margins(y=0.15)


def _errors(
    axes: Axes, hours: FloatArray, nominal: FloatArray, received: FloatArray, samples: xr.Dataset
) -> None:
    error = (samples["total_field"] - samples["truth"]).to_numpy()
    flagged = samples["flagged"].to_numpy()
    good = rms(error[~flagged])
    axes.set_title("Error")
    axes.plot(hours, nominal, color=NOMINAL, lw=1, label=f"one ellipsoid: {rms(nominal):.0f} nT RMS")
    axes.plot(received, error, color=CORRECTED, lw=1, label=f"magbridge: {good:.1f} nT RMS where not flagged")
    axes.plot(received[flagged], error[flagged], ".", color=FLAGGED, ms=4, label="flagged: a mass in motion")
    axes.axhline(0.0, color=TRUE, lw=0.6)
    axes.set_yscale("symlog", linthresh=10.0)
    axes.set_ylim(-3e3, 1.5e4)
    axes.set_ylabel("nT (linear within ±10)")
    axes.legend(loc="upper right", frameon=False, ncols=3)
