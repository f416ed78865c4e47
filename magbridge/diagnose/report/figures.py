"""Figures of the report: measured against simulated, before and after."""

from __future__ import annotations

from base64 import b64encode
from io import BytesIO
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter, MaxNLocator
from scipy.signal import periodogram

from magbridge.arrays import FloatArray
from magbridge.diagnose.diagnosis import Diagnosis
from magbridge.diagnose.report.words import chance, label

__all__ = ["channels", "evidence", "likeness", "measured", "spectrum", "terms", "track"]

BEFORE, AFTER, INK, FAINT = "#c8553d", "#1f6f8b", "#22303c", "#9aa5b1"
POINTS = 4000
"""Points drawn per curve; more only make the page heavy."""
GAP = 20.0
"""Median steps between two points beyond which no line joins them."""
CHANNELS, BINS = 12, 20
"""Channels drawn, and bins of each."""
MANY = 60
"""Dives from which on no lines separate them."""


def _figure(width: float, height: float, rows: int = 1, columns: int = 1, **more: Any) -> tuple[Figure, Any]:
    figure = Figure(figsize=(width, height), layout="constrained", dpi=110)
    axes = figure.subplots(rows, columns, squeeze=False, **more)
    for axis in axes.flat:
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(colors=INK, labelsize=8)
        axis.grid(color="#e6e9ec", linewidth=0.6)
        axis.set_axisbelow(True)
    return figure, axes


def _png(figure: Figure) -> str:
    buffer = BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return b64encode(buffer.getvalue()).decode()


def _thin(n: int) -> slice:
    return slice(None, None, max(1, n // POINTS))


def _curves(diagnosis: Diagnosis, *values: FloatArray) -> tuple[FloatArray, ...]:
    """Return the time since the start and each of `values`, thinned, with no line across a gap."""
    t, part = diagnosis.problem.survey.time, _thin(len(diagnosis.problem))
    since = (t[part] - t[0]) / _clock(diagnosis)[0]
    steps = np.diff(since)
    gap = np.append(steps > GAP * np.median(steps), False)
    return since, *(np.where(gap, np.nan, value[part]) for value in values)


def _clock(diagnosis: Diagnosis) -> tuple[float, str]:
    """Return the unit of time that suits the length of the log: its seconds and its name."""
    return (3600.0, "hours") if np.ptp(diagnosis.problem.survey.time) > 7200.0 else (60.0, "minutes")


def _sides(diagnosis: Diagnosis) -> dict[str, tuple[FloatArray, str]]:
    """Return the two residuals to compare, each with its colour.

    Without findings, the second is that of the refitted calibration.
    """
    if not diagnosis.findings:
        return {
            "as calibrated": (diagnosis.before, BEFORE),
            "calibration refitted": (diagnosis.fit.left, AFTER),
        }
    return {"before": (diagnosis.before, BEFORE), "after, held out": (diagnosis.after, AFTER)}


def measured(diagnosis: Diagnosis) -> str:
    """Draw the total field measured and simulated, and their difference before and after, over time."""
    survey, part = diagnosis.problem.survey, _thin(len(diagnosis.problem))
    figure, axes = _figure(10, 5.2, 2, 1, sharex=True, height_ratios=[1, 1.5])
    top, low = axes[:, 0]
    unit, clock = _clock(diagnosis)
    since, total, reference, stated = _curves(
        diagnosis,
        survey.reference + diagnosis.before,
        survey.reference,
        2.0 * np.sqrt(diagnosis.problem.stated),
    )
    top.plot(since, total, color=BEFORE, linewidth=0.7, label="measured, corrected as calibrated")
    top.plot(since, reference, color=INK, linewidth=1.0, label="simulated (reference)")
    top.set_ylabel("total field (nT)", fontsize=9)
    ends = np.nanquantile(np.append(total, reference), [0.002, 0.998])
    top.set_ylim(ends[0] - 0.1 * np.ptp(ends), ends[1] + 0.35 * np.ptp(ends))
    ends = np.zeros(2)
    for name, (left, colour) in _sides(diagnosis).items():
        low.plot(since, left[part], ".", color=colour, markersize=2, label=name)
        some = np.quantile(left, [0.002, 0.998])
        ends = np.array([min(ends[0], some[0]), max(ends[1], some[1])])
    low.fill_between(
        since, -stated, stated, color=FAINT, alpha=0.25, linewidth=0, label="the calibration's own 2 sigma"
    )
    dives = survey.time[np.flatnonzero(np.diff(survey.dive)) + 1]
    for start in dives if dives.size < MANY else ():
        low.axvline((start - survey.time[0]) / unit, color=FAINT, linewidth=0.4)
    low.axhline(0.0, color=INK, linewidth=0.6)
    low.set_ylim(ends[0] - 0.25 * np.ptp(ends), ends[1] + 0.4 * np.ptp(ends))
    low.set_ylabel("measured − simulated (nT)", fontsize=9)
    low.set_xlabel(
        f"{clock} since the start"
        + (f"; grey lines separate the {survey.parts}" if dives.size < MANY else ""),
        fontsize=9,
    )
    for axis in (top, low):
        axis.legend(fontsize=8, frameon=False, loc="upper right", markerscale=4, ncols=3)
    return _png(figure)


def spectrum(diagnosis: Diagnosis) -> str:
    """Draw the spectral density of the difference, before and after, with the noise model's."""
    survey = diagnosis.problem.survey
    interval = float(np.median(np.diff(survey.time)))
    figure, axes = _figure(5.6, 3.6)
    axis = axes[0, 0]
    for name, (values, colour) in _sides(diagnosis).items():
        frequency, power = periodogram(values, 1.0 / interval, detrend="constant")
        edges = np.unique(np.geomspace(1, len(frequency), 60).astype(int))
        where = [slice(a, b) for a, b in pairwise(edges)]
        axis.loglog(
            [frequency[w].mean() for w in where],
            [np.sqrt(power[w].mean()) for w in where],
            color=colour,
            label=name,
        )
    noise = diagnosis.fit.noise
    frequency = np.geomspace(1.0 / float(np.ptp(survey.time)), 0.5 / interval, 200)
    lags = np.exp(-2j * np.pi * frequency[:, None] * interval * np.arange(1, len(noise.ar) + 1))
    spread = float(np.median(noise.scale)) * (np.sqrt(noise.nu / (noise.nu - 2.0)) if noise.nu < 1e5 else 1.0)
    density = spread * np.sqrt(2.0 * interval) / np.abs(1.0 - lags @ noise.ar)
    axis.loglog(frequency, density, "--", color=INK, linewidth=1, label="noise model")
    axis.yaxis.set_major_formatter(LogFormatter())
    axis.yaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1.5, 0.6)))
    axis.tick_params(which="minor", labelsize=8, colors=INK)
    axis.set_xlabel("frequency (Hz)", fontsize=9)
    axis.set_ylabel("nT/√Hz", fontsize=9)
    axis.legend(fontsize=8, frameon=False)
    return _png(figure)


def channels(diagnosis: Diagnosis) -> str:
    """Draw the difference against the channels that it follows most: mean and scatter, all at one scale."""
    survey, sides = diagnosis.problem.survey, _sides(diagnosis)
    units = {name: channel.unit for name, channel in survey.channels.items() if name not in survey.still}
    values = {name: survey.channels[name].values for name in units}
    if survey.attitude is not None:
        angles = ("roll", "pitch", "heading")
        units |= dict.fromkeys(angles, "deg")
        values |= dict(zip(angles, survey.attitude.T, strict=True))
    binned = {name: [_binned(values[name], left) for left, _ in sides.values()] for name in units}
    power = {name: float(np.nansum(count * mean**2)) for name, [(count, mean, _), _] in binned.items()}
    most = sorted(power, key=power.__getitem__)[-CHANNELS:]
    names = [name for name in units if name in most]
    columns = min(3, max(len(names), 1))
    rows = max(-(-len(names) // columns), 1)
    figure, axes = _figure(10, 2.3 * rows, rows, columns, sharey=True)
    ends = []
    for axis, name in zip(axes.flat, names, strict=False):
        middle = np.linspace(values[name].min(), values[name].max(), 2 * BINS + 1)[1::2]
        for (_, mean, spread), (side, (_, colour)) in zip(binned[name], sides.items(), strict=True):
            axis.vlines(middle, mean - spread, mean + spread, color=colour, alpha=0.2, linewidth=5)
            axis.plot(middle, mean, "o-", color=colour, markersize=2.5, linewidth=1, label=side)
            ends += [mean - spread, mean + spread]
        axis.set_xlabel(f"{name} ({units[name]})" if units[name] else name, fontsize=8)
        axis.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    for axis in axes.flat[len(names) :]:
        axis.set_visible(False)
    for axis in axes[:, 0]:
        axis.set_ylabel("difference (nT)", fontsize=8)
    if ends:  # a bin or two of wild samples do not set the scale
        low, high = np.nanquantile(ends, [0.02, 0.98])
        axes[0, 0].set_ylim(low - 0.1 * (high - low), high + 0.1 * (high - low))
        handles = axes[0, 0].get_legend_handles_labels()
        figure.legend(*handles, fontsize=8, frameon=False, loc="outside upper right", ncols=2)
    return _png(figure)


def _binned(values: FloatArray, left: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return count, mean and scatter of `left` in bins of a channel; NaN where it hardly was."""
    edges = np.linspace(values.min(), values.max(), BINS + 1)
    bins = np.clip(np.searchsorted(edges, values) - 1, 0, BINS - 1)
    number = np.bincount(bins, minlength=BINS)
    count = np.where(number > 3, number, np.nan)
    mean = np.bincount(bins, left, BINS) / count
    return count, mean, np.sqrt(np.maximum(np.bincount(bins, left**2, BINS) / count - mean**2, 0.0))


def track(diagnosis: Diagnosis) -> str | None:
    """Draw the difference along the track, before and after."""
    place = diagnosis.problem.survey.place
    if place is None or np.ptp(place[:, :2], axis=0).max() < 1.0:
        return None
    part = _thin(len(place))
    sides = _sides(diagnosis)
    north, east = np.ptp(place[:, :2], axis=0)
    scale, unit = (1e3, "km") if max(north, east) > 2e3 else (1.0, "m")
    if east > 2.0 * north:  # a long track lies better above the other one
        height = 0.4 + 2.0 * (0.35 + 8.0 * max(float(north / east), 0.1))
        figure, axes = _figure(10, height, 2, 1, sharex=True, sharey=True)
    else:
        figure, axes = _figure(10, 3.8, 1, 2, sharex=True, sharey=True)
    limit = float(np.quantile(np.abs(diagnosis.before), 0.98)) + 1e-9
    dots = None
    for axis, (title, (values, _)) in zip(axes.flat, sides.items(), strict=True):
        dots = axis.scatter(
            place[part, 1] / scale,
            place[part, 0] / scale,
            c=values[part],
            s=5,
            cmap="RdBu_r",
            vmin=-limit,
            vmax=limit,
        )
        axis.set_aspect("equal", adjustable="box")
        axis.xaxis.set_major_locator(MaxNLocator(4))
        axis.set_title(title, fontsize=9)
    for axis in axes[-1]:
        axis.set_xlabel(f"east ({unit})", fontsize=9)
    for axis in axes[:, 0]:
        axis.set_ylabel(f"north ({unit})", fontsize=9)
    assert dots is not None
    figure.colorbar(dots, ax=axes, label="nT", shrink=0.8)
    return _png(figure)


def terms(diagnosis: Diagnosis) -> str | None:
    """Draw what each found cause adds to the total field, over time."""
    if not diagnosis.findings:
        return None
    count = len(diagnosis.findings)
    figure, axes = _figure(10, 1.9 * count, count, 1, sharex=True)
    for axis, finding in zip(axes[:, 0], diagnosis.findings, strict=True):
        axis.plot(*_curves(diagnosis, finding.field(diagnosis.problem)), color=AFTER, linewidth=0.8)
        axis.set_ylabel("nT", fontsize=8)
        axis.set_title(label(*finding.candidate.group), fontsize=9, loc="left")
    axes[-1, 0].set_xlabel(f"{_clock(diagnosis)[1]} since the start", fontsize=9)
    return _png(figure)


def evidence(diagnosis: Diagnosis) -> str:
    """Draw how strongly the data speak for each cause alone, with the chance that it is a false alarm."""
    tested = diagnosis.outcome.tested
    order = sorted(tested, key=lambda name: tested[name][1])
    figure, axes = _figure(5.6, 0.6 + 0.24 * max(len(order), 1))
    axis = axes[0, 0]
    named = {finding.candidate.cause for finding in diagnosis.findings}
    bars = axis.barh(
        [label(name, None) for name in order],
        [np.sqrt(max(tested[name][1], 0.0)) for name in order],
        color=[AFTER if name in named else FAINT for name in order],
    )
    axis.bar_label(bars, [f" p: {chance(tested[name][0])}" for name in order], fontsize=7, color=INK)
    axis.margins(x=0.2)
    axis.set_xlabel("root of the likelihood ratio; p: chance of a false alarm", fontsize=8)
    return _png(figure)


def likeness(diagnosis: Diagnosis) -> str:
    """Draw which causes look alike in this log, whatever it shows."""
    visible, R = diagnosis.isolability.visible, diagnosis.isolability.correlation
    names = [label(v.cause, v.channel) for v in visible]
    size = 2.6 + 0.21 * len(names)
    figure, axes = _figure(size + 1.0, size)
    axis = axes[0, 0]
    axis.grid(visible=False)
    image = axis.imshow(R, cmap="magma_r", vmin=0.0, vmax=1.0)
    axis.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
    axis.set_yticks(range(len(names)), names, fontsize=7)
    figure.colorbar(image, ax=axis, shrink=0.7, label="correlation of signatures")
    return _png(figure)
