"""Figures of the report: the measured less the reference field, and the contribution of each cause."""

from __future__ import annotations

from base64 import b64encode
from io import BytesIO
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter, MaxNLocator
from PIL import Image
from scipy.signal import periodogram

from magbridge.arrays import FloatArray
from magbridge.diagnose.diagnosis import Diagnosis, label
from magbridge.pictures import literal

BEFORE, AFTER, INK, FAINT = "#c8553d", "#1f6f8b", "#22303c", "#9aa5b1"
"""Colours of plots. Colour-blind readers distinguish the first two; in grey print the second is darker."""
MIN_FONT_PT = 9.0
"""Smallest size of letters, pt."""
CURVE_POINTS = 4000
"""Number of points per curve, at which it is thinned to limit the size of the page."""
PALETTE_SIZE = 256
"""Number of colours of a plot, for one byte per pixel."""
DOT_STYLE: dict[str, Any] = {
    "marker": "s",
    "markersize": 1.6,
    "markeredgewidth": 0,
    "alpha": 0.5,
    "ls": "none",
}
"""Style of samples: squares of whole pixels, because the edges of round dots double the size of the file."""
LINE_GAP_STEPS = 20.0
"""Distance in time between two points, in median steps, beyond which no line joins them."""
STRETCHES = 150
"""Number of equal parts of a log whose means are drawn as a line."""
CHANNELS, BINS = 12, 20
"""Largest number of channels in a plot, and number of bins of each."""
MAX_SEPARATED_DIVES = 60
"""Number of dives from which on no lines between dives are drawn."""


def canvas(width: float, height: float, rows: int = 1, columns: int = 1, **more: Any) -> tuple[Figure, Any]:
    """Return a figure of `width` by `height` inches, and its axes (rows, columns)."""
    figure = Figure(figsize=(width, height), layout="constrained", dpi=140)
    axes = figure.subplots(rows, columns, squeeze=False, **more)
    for axis in axes.flat:
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(which="both", colors=INK, labelsize=MIN_FONT_PT)
        axis.grid(color="#e6e9ec", linewidth=0.6)
        axis.set_axisbelow(True)
    return figure, axes


def png(figure: Figure, names: Any = None) -> str:
    """Return a figure as a palette PNG in base64; `names` is the axes whose legend to draw, or None."""
    if names is not None:
        handles = names.get_legend_handles_labels()
        figure.legend(
            *handles, fontsize=MIN_FONT_PT, frameon=False, loc="outside upper left", ncols=3, markerscale=4
        )
    literal(figure)
    drawn, packed = BytesIO(), BytesIO()
    figure.savefig(drawn, format="png")
    picture = Image.open(drawn).convert("RGB").quantize(PALETTE_SIZE, dither=Image.Dither.NONE)
    picture.save(packed, "PNG", optimize=True)
    return b64encode(packed.getvalue()).decode()


def thin(n: int) -> slice:
    """Return the slice of n points to draw, about :data:`CURVE_POINTS` of them."""
    return slice(None, None, max(1, n // CURVE_POINTS))


def clock(diagnosis: Diagnosis) -> tuple[float, str]:
    """Return the unit of time for the length of the log: its length in s, and its name."""
    return (3600.0, "hours") if np.ptp(diagnosis.problem.survey.time) > 7200.0 else (60.0, "minutes")


def in_time(diagnosis: Diagnosis, axis: Any, values: FloatArray, colour: str, name: str) -> FloatArray:
    """Draw samples (n,) in time with their running mean; return the times (m,) of the samples drawn."""
    t, part = diagnosis.problem.survey.time, thin(len(diagnosis.problem))
    since, unit = t - t[0], clock(diagnosis)[0]
    axis.plot(since[part] / unit, values[part], color=colour, label=name, **DOT_STYLE)
    # Means in equal stretches; NaN in gaps
    edges = np.linspace(0.0, since[-1], STRETCHES + 1)
    place = np.clip(np.searchsorted(edges, since, side="right") - 1, 0, STRETCHES - 1)
    count = np.bincount(place, minlength=STRETCHES)
    mean = np.bincount(place, values, STRETCHES) / np.where(count, count, np.nan)
    middle = 0.5 * (edges[1:] + edges[:-1]) / unit
    axis.plot(middle, mean, color=INK, linewidth=1.0, label="its running mean")
    axis.axhline(0.0, color=INK, linewidth=0.5)
    axis.set_ylabel("nT")
    return np.asarray(since[part] / unit)


def unjoined(times: FloatArray, values: FloatArray) -> FloatArray:
    """Return values (m,) with NaN before each gap in the times, so that no line crosses it."""
    steps = np.diff(times, append=times[-1])
    return np.where(steps > LINE_GAP_STEPS * np.median(steps), np.nan, values)


def ends(*values: FloatArray, margin: float) -> tuple[float, float]:
    """Return an axis' limits for `values` without extremes, with a `margin` as a fraction of their span."""
    first, last = np.nanquantile(np.concatenate(values), [0.002, 0.998])
    span = max(float(last - first), 1e-9)
    return float(first) - margin * span, float(last) + margin * span


def sides(diagnosis: Diagnosis) -> dict[str, tuple[FloatArray, str]]:
    """Return the two residuals (n,), nT, to compare, each with its colour, by name."""
    if not diagnosis.findings:
        return {
            "as calibrated": (diagnosis.before, BEFORE),
            "calibration refitted": (diagnosis.residual, AFTER),
        }
    return {"before": (diagnosis.before, BEFORE), "after, held out": (diagnosis.after, AFTER)}


def measured(diagnosis: Diagnosis) -> str:
    """Return a plot, as base64 PNG, of measured less reference field against time, before and after."""
    survey, both = diagnosis.problem.survey, sides(diagnosis)
    figure, axes = canvas(10, 4.0, 2, 1, sharex=True)
    stated = 2.0 * np.sqrt(diagnosis.problem.stated)[thin(len(survey))]
    limits = ends(*(residual for residual, _ in both.values()), margin=0.15)
    starts = survey.time[np.flatnonzero(np.diff(survey.dive)) + 1]
    starts = starts if starts.size < MAX_SEPARATED_DIVES else starts[:0]
    unit, hours = clock(diagnosis)
    for axis, (name, (residual, colour)) in zip(axes[:, 0], both.items(), strict=True):
        since = in_time(diagnosis, axis, residual, colour, name)
        band = unjoined(since, stated)
        axis.fill_between(
            since, -band, band, color=FAINT, alpha=0.25, linewidth=0, label="±2 sigma as calibrated"
        )
        for start in starts:
            axis.axvline((start - survey.time[0]) / unit, color=FAINT, linewidth=0.4)
        axis.set_ylim(limits)
        axis.legend(  # above the axes, where it covers nothing
            fontsize=MIN_FONT_PT, frameon=False, loc="lower left", bbox_to_anchor=(0.0, 0.98), markerscale=5,
            ncols=3, borderaxespad=0.0,
        )  # fmt: skip
    lines = f"; grey lines separate the {survey.parts}" if starts.size else ""
    axes[-1, 0].set_xlabel(f"{hours} since the start{lines}")
    return png(figure)


def terms(diagnosis: Diagnosis) -> str | None:
    """Return a plot of each cause's effect, over the residual without it; None without findings."""
    if not diagnosis.findings:
        return None
    count, part = len(diagnosis.findings), thin(len(diagnosis.problem))
    figure, axes = canvas(10, 0.4 + 2.1 * count, count, 1, sharex=True)
    for axis, finding in zip(axes[:, 0], diagnosis.findings, strict=True):
        added = finding.field(diagnosis.problem)
        alone = added + diagnosis.residual / diagnosis.problem.reference_jacobian
        since = in_time(diagnosis, axis, alone, FAINT, "all else removed")
        line = unjoined(since, added[part])
        axis.plot(since, line, color=AFTER, linewidth=1.4, label="what the cause adds")
        low, high = ends(alone, margin=0.1)
        axis.set_ylim(min(low, 0.0), max(high, 0.0))
        axis.set_title(label(*finding.candidate.group), fontsize=MIN_FONT_PT + 1.0, loc="left")
    axes[-1, 0].set_xlabel(f"{clock(diagnosis)[1]} since the start")
    return png(figure, axes[0, 0])


def spectrum(diagnosis: Diagnosis) -> str:
    """Return a plot of the spectral density of the residual, before and after, and of the noise model."""
    survey = diagnosis.problem.survey
    interval = float(np.median(np.diff(survey.time)))
    figure, axes = canvas(5.8, 4.0)
    axis = axes[0, 0]
    for name, (values, colour) in sides(diagnosis).items():
        # Means of the periodogram in bins that widen with frequency
        frequency, power = periodogram(values, 1.0 / interval, detrend="constant")
        starts = np.unique(np.geomspace(1, len(frequency) - 1, 60).astype(int))
        size = np.diff(starts, append=len(frequency))
        f, density = (np.add.reduceat(x, starts) / size for x in (frequency, power))
        axis.loglog(f, np.sqrt(density), color=colour, label=name)
    noise = diagnosis.fit.noise
    f = np.geomspace(1.0 / float(np.ptp(survey.time)), 0.5 / interval, 200)
    lags = np.exp(-2j * np.pi * f[:, None] * interval * np.arange(1, len(noise.ar) + 1))
    # S(f) = 2 D sigma^2 / |1 - sum_k a_k e^(-2 pi i f k D)|^2 at the interval D (Box & Jenkins 1976, ch. 3);
    # Student's t of scale s and nu degrees of freedom has the variance s^2 nu / (nu - 2)
    sigma = float(np.median(noise.scale)) * (np.sqrt(noise.nu / (noise.nu - 2.0)) if noise.nu < 1e5 else 1.0)
    model = sigma * np.sqrt(2.0 * interval) / np.abs(1.0 - lags @ noise.ar)
    axis.loglog(f, model, "--", color=INK, linewidth=1.2, label="noise model")
    axis.yaxis.set_major_formatter(LogFormatter())
    axis.yaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1.5, 0.6)))
    axis.set_xlabel("frequency (Hz)")
    axis.set_ylabel("amplitude density (nT/√Hz)")
    # Periods above, as people think of them; matplotlib asks for that of 0 Hz, too
    unit, hours = clock(diagnosis)
    inverse = lambda value: 1.0 / unit / np.maximum(value, 1e-12)  # noqa: E731 - a conversion is one line
    above = axis.secondary_xaxis("top", functions=(inverse, inverse))
    above.set_xlabel(f"period ({hours})")
    above.tick_params(labelsize=MIN_FONT_PT, colors=INK)
    return png(figure, axis)


def channels(diagnosis: Diagnosis) -> str:
    """Return a plot of the residual's mean and scatter against the channels that it follows most."""
    survey, both = diagnosis.problem.survey, sides(diagnosis)
    series = {
        name: (one.values, one.unit) for name, one in survey.channels.items() if name not in survey.still
    }
    if survey.attitude is not None:
        angles = zip(("roll", "pitch", "heading"), survey.attitude.T, strict=True)
        series |= {name: (values, "deg") for name, values in angles}
    binned = {
        name: [_binned(values, residual) for residual, _ in both.values()]
        for name, (values, _) in series.items()
    }
    power = {name: float(np.nansum(count * mean**2)) for name, [(count, mean, _), _] in binned.items()}
    names = sorted(power, key=power.__getitem__, reverse=True)[:CHANNELS]
    columns = min(3, max(len(names), 1))
    rows = max(-(-len(names) // columns), 1)
    figure, axes = canvas(10, 2.4 * rows, rows, columns, sharey=True)
    drawn = []
    for axis, name in zip(axes.flat, names, strict=False):
        values, unit = series[name]
        middle = np.linspace(values.min(), values.max(), 2 * BINS + 1)[1::2]
        for (_, mean, spread), (side, (_, colour)) in zip(binned[name], both.items(), strict=True):
            axis.vlines(middle, mean - spread, mean + spread, color=colour, alpha=0.2, linewidth=5)
            axis.plot(middle, mean, "o-", color=colour, markersize=2.5, linewidth=1.2, label=side)
            drawn += [mean - spread, mean + spread]
        axis.axhline(0.0, color=INK, linewidth=0.5)
        axis.set_xlabel(f"{name} ({unit})" if unit else name)
        axis.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    for axis in axes.flat[len(names) :]:
        axis.set_visible(False)
    for axis in axes[:, 0]:
        axis.set_ylabel("difference (nT)")
    if drawn:  # a bin or two of wild samples do not set the scale
        low, high = np.nanquantile(drawn, [0.02, 0.98])
        axes[0, 0].set_ylim(low - 0.1 * (high - low), high + 0.1 * (high - low))
    return png(figure, axes[0, 0])


def _binned(values: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return count, mean and scatter of `residual` in bins of a channel; NaN in bins of few samples."""
    edges = np.linspace(values.min(), values.max(), BINS + 1)
    bins = np.clip(np.searchsorted(edges, values) - 1, 0, BINS - 1)
    number = np.bincount(bins, minlength=BINS)
    count = np.where(number > 3, number, np.nan)
    mean = np.bincount(bins, residual, BINS) / count
    return count, mean, np.sqrt(np.maximum(np.bincount(bins, residual**2, BINS) / count - mean**2, 0.0))


def track(diagnosis: Diagnosis) -> str | None:
    """Return a plot of the residual along the track, before and after; None without a track."""
    place = diagnosis.problem.survey.place
    if place is None or np.ptp(place[:, :2], axis=0).max() < 1.0:
        return None
    part = thin(len(place))
    north, east = np.ptp(place[:, :2], axis=0)
    scale, unit = (1e3, "km") if max(north, east) > 2e3 else (1.0, "m")
    # A long track lies better above the other one
    shape = (2, 1) if east > 2.0 * north else (1, 2)
    height = 0.6 + 2.0 * (0.35 + 8.0 * max(float(north / east), 0.1)) if east > 2.0 * north else 4.2
    figure, axes = canvas(10, height, *shape, sharex=True, sharey=True)
    limit = float(np.quantile(np.abs(diagnosis.before), 0.98)) + 1e-9
    style: dict[str, Any] = {"s": 6, "cmap": "RdBu_r", "vmin": -limit, "vmax": limit}
    for axis, (title, (values, _)) in zip(axes.flat, sides(diagnosis).items(), strict=True):
        dots = axis.scatter(place[part, 1] / scale, place[part, 0] / scale, c=values[part], **style)
        axis.set_facecolor("#f2f4f6")  # so that white, no difference, is seen
        axis.set_aspect("equal", adjustable="box")
        axis.xaxis.set_major_locator(MaxNLocator(4))
        axis.set_title(title, fontsize=MIN_FONT_PT + 1.0, loc="left")
        axis.set_xlabel(f"east ({unit})")
        axis.set_ylabel(f"north ({unit})")
        axis.label_outer()
    bar = figure.colorbar(dots, ax=axes, shrink=0.8, extend="both")
    bar.set_label("measured − reference (nT)", size=MIN_FONT_PT)
    bar.ax.tick_params(labelsize=MIN_FONT_PT)
    return png(figure)
