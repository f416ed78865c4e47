"""The confusion matrix, predicted beside measured; detection against size."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import binomtest

from magbridge.arrays import FloatArray
from study.cases import KNOWN
from study.rates import Row, against_ideal, curve, found, predicted

NEITHER = "no name"


def confusion(rows: Sequence[Row]) -> tuple[FloatArray, FloatArray]:
    """Predicted and measured shares, hidden by row, named first by column; the last column is no name."""
    columns = [*KNOWN, NEITHER]
    predicted, measured = np.full((2, len(KNOWN), len(columns)), np.nan)
    for i, name in enumerate(KNOWN):
        own = [r for r in rows if list(r["names"]) == [name] and r["theory"]]
        if not own:
            continue
        predicted[i], measured[i] = 0.0, 0.0
        for r in own:
            for cause, chance in r["theory"][0]["first"].items():
                predicted[i, columns.index(cause)] += chance / len(own)
            named = [f[0] for f in r["found"] if f[0] in KNOWN]
            measured[i, columns.index(named[0] if named else NEITHER)] += 1.0 / len(own)
    return predicted, measured


def plot_confusion(rows: Sequence[Row], path: Path) -> None:
    """Draw both matrices."""
    named = [r for r in rows if r["part"] == "named" and r["theory"]]
    figure = Figure(figsize=(17, 8.7), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    titles = ("predicted: an ideal detector on the same cases", f"measured in {len(named)} cases")
    ticks = [name.replace("_", " ") for name in (*KNOWN, NEITHER)]
    for axis, matrix, title in zip(axes, confusion(named), titles, strict=True):
        image = axis.imshow(100 * matrix, cmap="Blues", vmin=0.0, vmax=100.0, aspect="auto")
        axis.set_xticks(range(len(ticks)), ticks, rotation=55, ha="right", rotation_mode="anchor")
        axis.set_yticks(range(len(KNOWN)), ticks[:-1])
        axis.set_xticks(np.arange(len(ticks) - 1) + 0.5, minor=True)
        axis.set_yticks(np.arange(len(KNOWN) - 1) + 0.5, minor=True)
        axis.grid(which="minor", color="0.9", linewidth=0.6)
        axis.tick_params(which="minor", length=0)
        axis.axvline(len(KNOWN) - 0.5, color="0.3", linewidth=1.0)
        axis.set(title=title, xlabel="named first")
        for i, j in zip(*np.nonzero(np.nan_to_num(matrix) > 0.015), strict=True):
            dark = "white" if matrix[i, j] > 0.6 else "black"
            axis.text(j, i, f"{100 * matrix[i, j]:.0f}", ha="center", va="center", fontsize=8, color=dark)
    axes[0].set_ylabel("hidden, at signal-to-noise 8")
    figure.colorbar(image, ax=axes, label="% of the cases with this cause", shrink=0.6, pad=0.01)
    figure.savefig(path, dpi=110)


def plot_detection(rows: Sequence[Row], path: Path) -> None:
    """Draw the share found against signal-to-noise, and each cause's half point, beside theory's."""
    single = [r for r in rows if r["part"] in ("named", "ladder", "loud", "gain")]
    figure = Figure(figsize=(13, 5.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.5, 1.0))
    sizes = sorted({r["wanted"] for r in single})
    for size in sizes:
        own = [found(r) for r in single if r["wanted"] == size]
        share, ends = float(np.mean(own)), binomtest(sum(own), len(own)).proportion_ci()
        left.errorbar(
            size, 100 * share, [[100 * (share - ends.low)], [100 * (ends.high - share)]], fmt="o",
            color="tab:blue", capsize=2, label="measured, with 95 % interval" if size == sizes[0] else None,
        )  # fmt: skip
    if predicted(single):
        a = np.geomspace(1.5, 100.0, 200)
        left.plot(a, 100 * curve(single, a), color="0.4", label="an ideal detector")
        left.legend(loc="lower right")
    left.set(xscale="log", xlabel="signal-to-noise", ylabel="found, %", ylim=(-2, 104))
    left.set_xticks(sizes, [f"{size:g}" for size in sizes])
    left.minorticks_off()
    _halves(right, single)
    for axis in (left, right):
        axis.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


def _halves(axis: Axes, rows: Sequence[Row]) -> None:
    """Draw the signal-to-noise that each cause needs relative to theory, with its 68 % interval."""
    own = {
        name: against_ideal([r for r in rows if list(r["names"]) == [name] and r["theory"]]) for name in KNOWN
    }
    off = {name: 100.0 * (np.array(each) - 1.0) for name, each in own.items() if each}
    for place, (middle, low, high) in enumerate(off.values()):
        axis.errorbar(
            middle, place, xerr=[[middle - low], [high - middle]], fmt="o", color="tab:blue", capsize=2
        )
    axis.axvspan(-15.0, 15.0, color="0.4", alpha=0.12, linewidth=0)
    axis.axvline(0.0, color="0.4")
    axis.set_yticks(range(len(off)), [name.replace("_", " ") for name in off])
    axis.invert_yaxis()
    axis.set_xlabel("signal-to-noise needed on the same logs,\n% beyond theory's (grey: target)")
