"""The confusion matrix, predicted beside measured; detection against size."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.stats import binomtest, norm

from study.cases import KNOWN
from study.table import Row, found

NEITHER = "unexplained or nothing"


def confusion(rows: Sequence[Row]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Predicted and measured shares, hidden by row, named first by column; the last column is no name at all."""
    columns = [*KNOWN, NEITHER]
    predicted, measured = np.full((2, len(KNOWN), len(columns)), np.nan)
    for i, name in enumerate(KNOWN):
        own = [r for r in rows if list(r["names"]) == [name] and r["theory"] and r["theory"][0]]
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
    named = [r for r in rows if r["part"] == "named" and any(r["theory"])]
    figure = Figure(figsize=(17, 8.5), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    titles = ("predicted: an ideal detector on the same cases", f"measured: {len(named)} cases")
    for axis, matrix, title in zip(axes, confusion(named), titles, strict=True):
        image = axis.imshow(matrix, cmap="Blues", vmin=0.0, vmax=1.0)
        axis.set_xticks(range(len(KNOWN) + 1), [*KNOWN, NEITHER], rotation=60, ha="right")
        axis.set_yticks(range(len(KNOWN)), KNOWN)
        axis.set_title(title)
        axis.set_xlabel("named first")
        for i, j in zip(*np.nonzero(np.nan_to_num(matrix) > 0.045), strict=True):
            dark = "white" if matrix[i, j] > 0.6 else "black"
            axis.text(j, i, f"{100 * matrix[i, j]:.0f}", ha="center", va="center", fontsize=7, color=dark)
    axes[0].set_ylabel("hidden, at signal-to-noise 8")
    figure.colorbar(image, ax=axes, label="share of cases", shrink=0.6)
    figure.savefig(path, dpi=110)


def plot_detection(rows: Sequence[Row], path: Path) -> None:
    """Draw the share that was found against signal-to-noise, beside theory's."""
    single = [r for r in rows if r["part"] in ("named", "ladder", "loud", "gain")]
    told = [r["theory"][0] for r in single if any(r["theory"])]
    figure = Figure(figsize=(8, 5), layout="constrained")
    axis = figure.subplots()
    sizes = sorted({r["wanted"] for r in single})
    for size in sizes:
        own = [found(r) for r in single if r["wanted"] == size]
        share, ends = float(np.mean(own)), binomtest(sum(own), len(own)).proportion_ci()
        axis.errorbar(
            size, share, [[share - ends.low], [ends.high - share]], fmt="o", color="tab:blue", capsize=2,
            label="measured, with 95 % interval" if size == sizes[0] else None,
        )  # fmt: skip
    a = np.geomspace(1.5, 100.0, 200)
    if told:
        half, sure = np.array([(t["half"], t["sure"]) for t in told]).T
        curve = norm.cdf((a[:, None] - half) / ((sure - half) / 1.645)).mean(axis=1)
        axis.plot(a, curve, color="0.4", label="an ideal detector")
        axis.legend(loc="lower right")
    axis.set(xscale="log", xlabel="signal-to-noise", ylabel="share found", ylim=(-0.02, 1.04))
    axis.set_xticks(sizes, [f"{size:g}" for size in sizes])
    axis.minorticks_off()
    axis.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
