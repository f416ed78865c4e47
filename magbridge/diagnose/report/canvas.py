"""What the report's figures share: their look, their two sides, and how many points they draw."""

from __future__ import annotations

from base64 import b64encode
from io import BytesIO
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from magbridge.arrays import FloatArray
from magbridge.diagnose.diagnosis import Diagnosis
from magbridge.pictures import literal

__all__ = [
    "AFTER", "BEFORE", "DOT_STYLE", "FAINT", "INK", "MIN_FONT_PT", "canvas", "clock", "curves", "ends", "png",
    "rolling",
    "sides", "thin",
]  # fmt: skip

BEFORE, AFTER, INK, FAINT = "#c8553d", "#1f6f8b", "#22303c", "#9aa5b1"
"""Vermilion and blue, which any eye distinguishes; in grey print the second is darker."""
MIN_FONT_PT = 9.0
"""pt, the smallest letters."""
CURVE_POINTS = 4000
"""Points drawn per curve; more only make the page heavy."""
PALETTE_SIZE = 256
"""Colours of a plot: as many as fit a byte for each pixel, which needs two fifths of the memory."""
DOT_STYLE: dict[str, Any] = {
    "marker": "s",
    "markersize": 1.6,
    "markeredgewidth": 0,
    "linestyle": "none",
    "alpha": 0.5,
}
"""Samples as squares of whole pixels: round dots look the same, but their edges double the picture."""
LINE_GAP_STEPS = 20.0
"""Median steps between two points beyond which no line joins them."""
STRETCHES = 150
"""Stretches of a log whose means make a line through its dots."""


def canvas(width: float, height: float, rows: int = 1, columns: int = 1, **more: Any) -> tuple[Figure, Any]:
    """Return a figure of `width` by `height` inches, and its axes (rows, columns)."""
    figure = Figure(figsize=(width, height), layout="constrained", dpi=140)
    axes = figure.subplots(rows, columns, squeeze=False, **more)
    for axis in axes.flat:
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(colors=INK, labelsize=MIN_FONT_PT)
        axis.xaxis.label.set_size(MIN_FONT_PT + 0.5)
        axis.yaxis.label.set_size(MIN_FONT_PT + 0.5)
        axis.grid(color="#e6e9ec", linewidth=0.6)
        axis.set_axisbelow(True)
    return figure, axes


def png(figure: Figure) -> str:
    """Return the picture as a PNG in base64, its colours those of a palette."""
    literal(figure)
    drawn, packed = BytesIO(), BytesIO()
    figure.savefig(drawn, format="png")
    picture = Image.open(drawn).convert("RGB").quantize(PALETTE_SIZE, dither=Image.Dither.NONE)
    picture.save(packed, "PNG", optimize=True)
    return b64encode(packed.getvalue()).decode()


def thin(n: int) -> slice:
    """Return which of n points to draw."""
    return slice(None, None, max(1, n // CURVE_POINTS))


def clock(diagnosis: Diagnosis) -> tuple[float, str]:
    """Return the unit of time that suits the length of the log: its seconds and its name."""
    return (3600.0, "hours") if np.ptp(diagnosis.problem.survey.time) > 7200.0 else (60.0, "minutes")


def curves(diagnosis: Diagnosis, *values: FloatArray) -> tuple[FloatArray, ...]:
    """Return (m,) of time since the start and each of `values` (n,), thinned, with no line across a gap."""
    t, part = diagnosis.problem.survey.time, thin(len(diagnosis.problem))
    since = (t[part] - t[0]) / clock(diagnosis)[0]
    steps = np.diff(since)
    gap = np.append(steps > LINE_GAP_STEPS * np.median(steps), False)
    return since, *(np.where(gap, np.nan, value[part]) for value in values)


def rolling(diagnosis: Diagnosis, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (m,) of time since the start and the mean of `values` (n,) in equal stretches; NaN in gaps."""
    t = diagnosis.problem.survey.time
    edges = np.linspace(t[0], t[-1], STRETCHES + 1)
    place = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, STRETCHES - 1)
    count = np.bincount(place, minlength=STRETCHES)
    mean = np.bincount(place, values, STRETCHES) / np.where(count, count, np.nan)
    return (0.5 * (edges[1:] + edges[:-1]) - t[0]) / clock(diagnosis)[0], mean


def ends(*values: FloatArray, low: float, high: float) -> tuple[float, float]:
    """Return an axis' limits for `values` (n,) without extremes; `low`, `high`: margins, as fractions."""
    first, last = np.nanquantile(np.concatenate(values), [0.002, 0.998])
    span = max(float(last - first), 1e-9)
    return float(first) - low * span, float(last) + high * span


def sides(diagnosis: Diagnosis) -> dict[str, tuple[FloatArray, str]]:
    """Return the two residuals (n,) to compare, each with its colour.

    Without findings, the second is that of the refitted calibration.
    """
    if not diagnosis.findings:
        return {
            "as calibrated": (diagnosis.before, BEFORE),
            "calibration refitted": (diagnosis.residual, AFTER),
        }
    return {"before": (diagnosis.before, BEFORE), "after, held out": (diagnosis.after, AFTER)}
