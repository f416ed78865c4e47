"""Figures of the report: measured less reference before and after, and what each cause adds."""

from __future__ import annotations

from base64 import b64encode
from io import BytesIO
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, LogFormatter, MaxNLocator, NullFormatter, NullLocator
from PIL import Image
from scipy.signal import periodogram

from magbridge.arrays import FloatArray
from magbridge.diagnose.diagnosis import Diagnosis
from magbridge.diagnose.texts import label
from magbridge.pictures import literal

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
CHANNELS, BINS = 12, 20
"""Channels drawn, and bins of each."""
MAX_SEPARATED_DIVES = 60
"""Dives from which on no lines separate them."""
PERIOD_LABELS = {
    10.0: "10 s",
    60.0: "1 min",
    600.0: "10 min",
    3600.0: "1 h",
    43200.0: "12 h",
    864e3: "10 days",
}
"""Periods that the spectrum names, s."""


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


def measured(diagnosis: Diagnosis) -> str:
    """Draw the difference of measured and reference field, before and after, one below the other."""
    survey, part = diagnosis.problem.survey, thin(len(diagnosis.problem))
    figure, axes = canvas(10, 4.0, 2, 1, sharex=True)
    unit, hours = clock(diagnosis)
    since, stated = curves(diagnosis, 2.0 * np.sqrt(diagnosis.problem.stated))
    both = sides(diagnosis)
    limits = ends(*(residual for residual, _ in both.values()), low=0.15, high=0.15)
    starts = survey.time[np.flatnonzero(np.diff(survey.dive)) + 1]
    for axis, (name, (residual, colour)) in zip(axes[:, 0], both.items(), strict=True):
        axis.fill_between(
            since, -stated, stated, color=FAINT, alpha=0.25, linewidth=0, label="±2 sigma as calibrated"
        )
        axis.plot(since, residual[part], color=colour, label=name, **DOT_STYLE)
        axis.plot(*rolling(diagnosis, residual), color=INK, linewidth=1.0, label="its running mean")
        axis.axhline(0.0, color=INK, linewidth=0.5)
        for start in starts if starts.size < MAX_SEPARATED_DIVES else ():
            axis.axvline((start - survey.time[0]) / unit, color=FAINT, linewidth=0.4)
        axis.set_ylim(limits)
        axis.set_ylabel("nT")
        axis.legend(  # above the axes, where it covers nothing
            fontsize=MIN_FONT_PT, frameon=False, loc="lower left", bbox_to_anchor=(0.0, 0.98), markerscale=5,
            ncols=3, borderaxespad=0.0,
        )  # fmt: skip
    lines = f"; grey lines separate the {survey.parts}" if starts.size < MAX_SEPARATED_DIVES else ""
    axes[-1, 0].set_xlabel(f"{hours} since the start{lines}")
    return png(figure)


def terms(diagnosis: Diagnosis) -> str | None:
    """Draw the contribution of each cause to the total field, over the residual without it."""
    if not diagnosis.findings:
        return None
    count, part = len(diagnosis.findings), thin(len(diagnosis.problem))
    figure, axes = canvas(10, 0.4 + 2.1 * count, count, 1, sharex=True)
    for axis, finding in zip(axes[:, 0], diagnosis.findings, strict=True):
        added = finding.field(diagnosis.problem)
        alone = added + diagnosis.residual / diagnosis.problem.reference_jacobian
        since, line = curves(diagnosis, added)
        axis.plot(since, alone[part], color=FAINT, label="all else removed", **DOT_STYLE)
        axis.plot(*rolling(diagnosis, alone), color=INK, linewidth=0.9, label="its running mean")
        axis.plot(since, line, color=AFTER, linewidth=1.4, label="what the cause adds")
        axis.axhline(0.0, color=INK, linewidth=0.5)
        low, high = ends(alone, low=0.1, high=0.1)
        axis.set_ylim(min(low, 0.0), max(high, 0.0))
        axis.set_ylabel("nT")
        axis.set_title(label(*finding.candidate.group), fontsize=MIN_FONT_PT + 1.0, loc="left")
    axes[-1, 0].set_xlabel(f"{clock(diagnosis)[1]} since the start")
    handles = axes[0, 0].get_legend_handles_labels()
    figure.legend(
        *handles, fontsize=MIN_FONT_PT, frameon=False, loc="outside upper left", ncols=3, markerscale=5
    )
    return png(figure)


def spectrum(diagnosis: Diagnosis) -> str:
    r"""Draw the spectral density of the difference, before and after, with the noise model's.

    Notes
    -----
    Autoregressive noise of coefficients a and innovations of variance sigma^2 has at the interval D the
    one-sided power density (Box & Jenkins 1976, ch. 3)

    .. math:: S(f) = 2 D \sigma^2 \, |1 - \sum_k a_k e^{-2 \pi i f k D}|^{-2}

    Student's t with nu degrees of freedom and a scale s has the variance ``s^2 nu / (nu - 2)``.
    """
    survey = diagnosis.problem.survey
    interval = float(np.median(np.diff(survey.time)))
    figure, axes = canvas(5.8, 4.0)
    axis = axes[0, 0]
    for name, (values, colour) in sides(diagnosis).items():
        frequency, density = _density(values, interval)
        axis.loglog(frequency, density, color=colour, label=name)
    noise = diagnosis.fit.noise
    f = np.geomspace(1.0 / float(np.ptp(survey.time)), 0.5 / interval, 200)
    lags = np.exp(-2j * np.pi * f[:, None] * interval * np.arange(1, len(noise.ar) + 1))
    sigma = float(np.median(noise.scale)) * (np.sqrt(noise.nu / (noise.nu - 2.0)) if noise.nu < 1e5 else 1.0)
    model = sigma * np.sqrt(2.0 * interval) / np.abs(1.0 - lags @ noise.ar)
    axis.loglog(f, model, "--", color=INK, linewidth=1.2, label="noise model")
    axis.yaxis.set_major_formatter(LogFormatter())
    axis.yaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1.5, 0.6)))
    axis.tick_params(which="minor", labelsize=MIN_FONT_PT, colors=INK)
    axis.set_xlabel("frequency (Hz)")
    axis.set_ylabel("amplitude density (nT/√Hz)")
    _periods(axis)
    figure.legend(fontsize=MIN_FONT_PT, frameon=False, loc="outside upper left", ncols=3)
    return png(figure)


def _density(values: FloatArray, interval: float) -> tuple[list[float], list[float]]:
    """Return frequencies (Hz) and amplitude densities (nT/√Hz), in bins that widen with frequency."""
    frequency, power = periodogram(values, 1.0 / interval, detrend="constant")
    edges = np.unique(np.geomspace(1, len(frequency), 60).astype(int))
    where = [slice(a, b) for a, b in pairwise(edges)]
    return [float(frequency[w].mean()) for w in where], [float(np.sqrt(power[w].mean())) for w in where]


def _periods(axis: Any) -> None:
    """Name periods above an axis of frequencies, as people think of them."""
    low, high = axis.get_xlim()
    above = axis.secondary_xaxis("top")
    seen = {1.0 / period: name for period, name in PERIOD_LABELS.items() if low < 1.0 / period < high}
    above.xaxis.set_major_locator(FixedLocator(list(seen)))
    above.set_xticks(list(seen), list(seen.values()))
    above.xaxis.set_minor_locator(NullLocator())
    above.xaxis.set_minor_formatter(NullFormatter())
    above.tick_params(labelsize=MIN_FONT_PT, colors=INK)
    above.spines["top"].set_visible(False)


def channels(diagnosis: Diagnosis) -> str:
    """Draw the difference against the channels that it follows most: mean and scatter, all at one scale."""
    survey, both = diagnosis.problem.survey, sides(diagnosis)
    units = {name: channel.unit for name, channel in survey.channels.items() if name not in survey.still}
    values = {name: survey.channels[name].values for name in units}
    if survey.attitude is not None:
        angles = ("roll", "pitch", "heading")
        units |= dict.fromkeys(angles, "deg")
        values |= dict(zip(angles, survey.attitude.T, strict=True))
    binned = {name: [_binned(values[name], residual) for residual, _ in both.values()] for name in units}
    power = {name: float(np.nansum(count * mean**2)) for name, [(count, mean, _), _] in binned.items()}
    names = sorted(power, key=power.__getitem__, reverse=True)[:CHANNELS]
    columns = min(3, max(len(names), 1))
    rows = max(-(-len(names) // columns), 1)
    figure, axes = canvas(10, 2.4 * rows, rows, columns, sharey=True)
    seen = []
    for axis, name in zip(axes.flat, names, strict=False):
        middle = np.linspace(values[name].min(), values[name].max(), 2 * BINS + 1)[1::2]
        for (_, mean, spread), (side, (_, colour)) in zip(binned[name], both.items(), strict=True):
            axis.vlines(middle, mean - spread, mean + spread, color=colour, alpha=0.2, linewidth=5)
            axis.plot(middle, mean, "o-", color=colour, markersize=2.5, linewidth=1.2, label=side)
            seen += [mean - spread, mean + spread]
        axis.axhline(0.0, color=INK, linewidth=0.5)
        axis.set_xlabel(f"{name} ({units[name]})" if units[name] else name)
        axis.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    for axis in axes.flat[len(names) :]:
        axis.set_visible(False)
    for axis in axes[:, 0]:
        axis.set_ylabel("difference (nT)")
    if seen:  # a bin or two of wild samples do not set the scale
        low, high = np.nanquantile(seen, [0.02, 0.98])
        axes[0, 0].set_ylim(low - 0.1 * (high - low), high + 0.1 * (high - low))
        handles = axes[0, 0].get_legend_handles_labels()
        figure.legend(*handles, fontsize=MIN_FONT_PT, frameon=False, loc="outside upper left", ncols=2)
    return png(figure)


def _binned(values: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return count, mean and scatter of `residual` in bins of a channel; NaN where it hardly was."""
    edges = np.linspace(values.min(), values.max(), BINS + 1)
    bins = np.clip(np.searchsorted(edges, values) - 1, 0, BINS - 1)
    number = np.bincount(bins, minlength=BINS)
    count = np.where(number > 3, number, np.nan)
    mean = np.bincount(bins, residual, BINS) / count
    return count, mean, np.sqrt(np.maximum(np.bincount(bins, residual**2, BINS) / count - mean**2, 0.0))


def track(diagnosis: Diagnosis) -> str | None:
    """Draw the difference along the track, before and after."""
    place = diagnosis.problem.survey.place
    if place is None or np.ptp(place[:, :2], axis=0).max() < 1.0:
        return None
    part = thin(len(place))
    north, east = np.ptp(place[:, :2], axis=0)
    scale, unit = (1e3, "km") if max(north, east) > 2e3 else (1.0, "m")
    if east > 2.0 * north:  # a long track lies better above the other one
        height = 0.6 + 2.0 * (0.35 + 8.0 * max(float(north / east), 0.1))
        figure, axes = canvas(10, height, 2, 1, sharex=True, sharey=True)
    else:
        figure, axes = canvas(10, 4.2, 1, 2, sharex=True, sharey=True)
    limit = float(np.quantile(np.abs(diagnosis.before), 0.98)) + 1e-9
    dots = None
    for axis, (title, (values, _)) in zip(axes.flat, sides(diagnosis).items(), strict=True):
        dots = axis.scatter(
            place[part, 1] / scale,
            place[part, 0] / scale,
            c=values[part],
            s=6,
            cmap="RdBu_r",
            vmin=-limit,
            vmax=limit,
        )
        axis.set_facecolor("#f2f4f6")  # so that white, no difference, is seen
        axis.set_aspect("equal", adjustable="box")
        axis.xaxis.set_major_locator(MaxNLocator(4))
        axis.set_title(title, fontsize=MIN_FONT_PT + 1.0, loc="left")
    for axis in axes[-1]:
        axis.set_xlabel(f"east ({unit})")
    for axis in axes[:, 0]:
        axis.set_ylabel(f"north ({unit})")
    assert dots is not None
    bar = figure.colorbar(dots, ax=axes, shrink=0.8, extend="both")
    bar.set_label("measured − reference (nT)", size=MIN_FONT_PT)
    bar.ax.tick_params(labelsize=MIN_FONT_PT)
    return png(figure)
