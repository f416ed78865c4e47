"""Figures of the report: what speaks for each cause, what it adds, and which causes look alike."""

from __future__ import annotations

import numpy as np

from magbridge.diagnose.diagnosis import Diagnosis
from magbridge.diagnose.inference.isolability import CONFOUNDED
from magbridge.diagnose.report.canvas import (
    AFTER,
    DOTS,
    FAINT,
    INK,
    SMALL,
    canvas,
    clock,
    curves,
    ends,
    png,
    rolling,
    thin,
)
from magbridge.diagnose.report.words import chance, label

__all__ = ["evidence", "likeness", "terms"]


def terms(diagnosis: Diagnosis) -> str | None:
    """Draw what each found cause adds to the total field, through what all others leave."""
    if not diagnosis.findings:
        return None
    count, part = len(diagnosis.findings), thin(len(diagnosis.problem))
    figure, axes = canvas(10, 0.4 + 2.1 * count, count, 1, sharex=True)
    for axis, finding in zip(axes[:, 0], diagnosis.findings, strict=True):
        added = finding.field(diagnosis.problem)
        alone = added + diagnosis.fit.left / diagnosis.problem.gain
        since, line = curves(diagnosis, added)
        axis.plot(since, alone[part], color=FAINT, label="all else removed", **DOTS)
        axis.plot(*rolling(diagnosis, alone), color=INK, linewidth=0.9, label="its running mean")
        axis.plot(since, line, color=AFTER, linewidth=1.4, label="what the cause adds")
        axis.axhline(0.0, color=INK, linewidth=0.5)
        low, high = ends(alone, low=0.1, high=0.1)
        axis.set_ylim(min(low, 0.0), max(high, 0.0))
        axis.set_ylabel("nT")
        axis.set_title(label(*finding.candidate.group), fontsize=SMALL + 1.0, loc="left")
    axes[-1, 0].set_xlabel(f"{clock(diagnosis)[1]} since the start")
    handles = axes[0, 0].get_legend_handles_labels()
    figure.legend(*handles, fontsize=SMALL, frameon=False, loc="outside upper left", ncols=3, markerscale=5)
    return png(figure)


def evidence(diagnosis: Diagnosis) -> str:
    """Draw how strongly the data speak for each cause alone, with the chance that it is a false alarm."""
    tested = diagnosis.outcome.tested
    order = sorted(tested, key=lambda name: tested[name][1])
    figure, axes = canvas(5.8, 0.9 + 0.3 * max(len(order), 1))
    axis = axes[0, 0]
    named = {finding.candidate.cause for finding in diagnosis.findings}
    bars = axis.barh(
        [label(name, None) for name in order],
        [np.sqrt(max(tested[name][1], 0.0)) for name in order],
        color=[AFTER if name in named else FAINT for name in order],
    )
    axis.bar_label(bars, [f" {chance(tested[name][0])}" for name in order], fontsize=SMALL, color=INK)
    axis.grid(visible=False, axis="y")
    axis.margins(x=0.22)
    axis.set_xlabel("strength of the evidence, in units of the noise")
    return png(figure)


def likeness(diagnosis: Diagnosis) -> str:
    """Draw which causes look alike in this log, whatever it shows: every pair once."""
    visible, R = diagnosis.isolability.visible, diagnosis.isolability.correlation
    names = [label(v.cause, v.channel) for v in visible]
    size = 3.0 + 0.22 * len(names)
    figure, axes = canvas(size + 1.0, size)
    axis = axes[0, 0]
    axis.grid(visible=False)
    once = np.ma.masked_where(~np.tri(len(R), k=-1, dtype=bool), R)
    image = axis.imshow(once, cmap="Blues", vmin=0.0, vmax=1.0)
    row, column = np.nonzero(np.tril(R, -1) > CONFOUNDED)
    axis.plot(column, row, ".", color="white", markersize=3)
    axis.set_xticks(range(len(names)), names, rotation=90, fontsize=SMALL - 1.0)
    axis.set_yticks(range(len(names)), names, fontsize=SMALL - 1.0)
    bar = figure.colorbar(image, ax=axis, shrink=0.7)
    bar.set_label("likeness: 0 distinct, 1 the same", size=SMALL)
    bar.ax.tick_params(labelsize=SMALL)
    return png(figure)
