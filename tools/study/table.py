"""Make the table of the blind study, with the results of an ideal detector, and its two plots.

Intervals are of 95 %. ``theory`` in a row holds the results of :func:`study.ideal.ideal` for this case.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import binomtest, norm
from studies import fraction
from study.deployment import CHARTS, NOISES
from study.ideal import EQUIVALENT, SIZES, cause_names

from magbridge.arrays import FloatArray
from magbridge.diagnose.causes import CAUSES

Row = dict[str, Any]
Line = tuple[str, str, str]
"""Line of the table: figure, value of an ideal detector, measured value with number of cases."""
KNOWN = tuple(CAUSES)
"""Causes in the table of causes; outliers are not among them, because the noise model finds them."""
NAMELESS = ("unknown", "seen", "foreign")
"""Parts of the study in which the hidden effect is not a cause of the table."""
MIN_CHANCE = 0.95
"""Minimum probability of the ideal detector to name only the truth, for a case that must be named."""
MAX_IDEAL_P_VALUE = 0.1
"""Maximum p-value of the ideal detector for a comparison of sensitivities, as p-values are bounded by 1."""
NEITHER = "no name"


# ---- the result of one case --------------------------------------------------------------------------------


def hidden(row: Row) -> set[str]:
    """Return the names of the hidden causes."""
    return cause_names(row["names"])


def found(row: Row) -> bool:
    """Return True if the diagnosis finds anything."""
    return bool(row["verdict"] != "nothing_found")


def asserted(row: Row) -> set[str]:
    """Return the causes that the diagnosis names."""
    return cause_names(entry[0] for entry in row["found"])


def sets(row: Row) -> set[str]:
    """Return the named causes, their alternatives, and the alternatives of an unexplained residual."""
    kept = (row["unexplained"] or {}).get("alternatives", ())
    alternatives = [cause_names(entry[3]) for entry in row["found"]]
    return asserted(row).union(*alternatives, cause_names(a["cause"] for a in kept))


def is_right_alone(row: Row) -> bool:
    """Return True if the diagnosis names exactly the hidden causes, without alternatives."""
    return asserted(row) == sets(row) == hidden(row)


def holds(row: Row) -> bool:
    """Return True if the named causes and their alternatives include the hidden causes."""
    return hidden(row) <= sets(row)


def has_second(row: Row) -> bool:
    """Return True if the diagnosis names more causes than are hidden."""
    return len(asserted(row) - changed(row)) > max(len(hidden(row)), 1)


def is_false_alarm(row: Row) -> bool:
    """Return True if the diagnosis of a log finds more than the world's own change (no effect is hidden)."""
    return found(row) and not (asserted(row) and asserted(row) <= changed(row))


def changed(row: Row) -> set[str]:
    """Return the names of effects that are part of the simulated world.

    If the reference is a map, the vehicle's offset has changed by `TURN_ON` since its calibration.
    """
    return {"offset_step"} if row["part"] == "charted" else set()


def is_nameable(row: Row) -> bool:
    """Return True if an ideal detector would name only the truth."""
    return all(theory["alone"] >= MIN_CHANCE for theory in row["theory"])


def is_worse(row: Row) -> bool:
    """Return True if the extended calibration is worse, on its own log or on another day's."""
    error = row["gain"]
    return any(error["after" + log] > 1.02 * error["before" + log] for log in ("", " elsewhere"))


# ---- rates over many cases ---------------------------------------------------------------------------------


def share(rows: Sequence[Row], good: Callable[[Row], bool]) -> str:
    """Return the percentage of rows for which `good` holds, with its interval and the count."""
    return fraction([good(row) for row in rows])


def scores(rows: Sequence[Row]) -> FloatArray:
    """Return (value - truth) / sigma (n,) of all parameters with a known truth."""
    return np.array([z for row in rows for z in row["scores"]])


def chance(rows: Sequence[Row], key: str) -> str:
    """Return the ideal detector's mean probability to find the rows' effects at a signal-to-noise ratio."""
    values = [theory[key] for row in rows for theory in row["theory"]]
    return f"{100 * np.mean(values):.0f} %" if values else "-"


def detection_curve(rows: Sequence[Row], size: FloatArray | float) -> FloatArray:
    """Return the ideal detector's mean chance to find the rows' effects at a signal-to-noise."""
    theory = [theory for row in rows for theory in row["theory"]]
    if not theory:
        return np.full(np.shape(size), np.nan)
    half, sure = np.array([(one["half"], one["sure"]) for one in theory]).T
    width = (sure - half) / norm.ppf(0.95)
    return np.asarray(norm.cdf((np.asarray(size)[..., None] - half) / width).mean(axis=-1))


def needed_size(rows: Sequence[Row]) -> tuple[float, float, float] | None:
    """Return the signal-to-noise ratio that the detector needs over the ideal's, with a 68 % interval.

    Both detectors have the same noise, which cancels. So one comparison has the information of dozens of logs
    that are only counted as found or not.
    """
    known = [row for row in rows if row["theory"]]
    known = [r for r in known if np.interp(r["wanted"], SIZES, r["theory"][0]["here"]) < MAX_IDEAL_P_VALUE]
    if len(known) < 3:
        return None
    logs = np.log([row["wanted"] / equal_size(row) for row in known])
    middle, error = float(np.mean(logs)), float(np.std(logs, ddof=1) / np.sqrt(len(logs)))
    return float(np.exp(middle)), float(np.exp(middle - error)), float(np.exp(middle + error))


def equal_size(row: Row) -> float:
    """Return the signal-to-noise ratio at which the ideal detector has the diagnosis' p-value."""
    surprise = -np.log(np.minimum.accumulate(row["theory"][0]["here"]))
    return float(np.interp(-np.log(row["p_value"]), surprise, SIZES))


# ---- the table ---------------------------------------------------------------------------------------------


def lines(rows: Sequence[Row]) -> list[str]:
    """Return the lines of the table in Markdown."""

    def of(*parts: str) -> list[Row]:
        return [row for row in rows if row["part"] in parts]

    null, named, known, outside = of("null"), of("named"), of("ladder", "named"), of(*NAMELESS)
    table: list[Line] = [("false alarms", "1 %", share(null, found))]
    for noise in NOISES:
        own = [row for row in null if row["noise"] == noise]
        table.append((f"... {noise}", "1 %", share(own, found)))
    single = of("ladder", "named", "gain", "loud")
    for size in sorted({row["wanted"] for row in single}):
        own = [row for row in single if row["wanted"] == size]
        ideal = f"{100 * detection_curve(known, size):.0f} %"
        table.append((f"S/N {size:g}: found", ideal, share(own, found)))
    if factor := needed_size(known):
        middle, low, high = (100 * (f - 1) for f in factor)
        text = f"{middle:+.0f} % ({low:+.0f} to {high:+.0f} %, of 68 %) | {len(known)}"
        table.append(("S/N needed beyond an ideal detector's", "0 %", text))
    table.append(("S/N 8: a false second name", "", share(named, has_second)))
    for label, nameable in (("where the ideal detector can", True), ("elsewhere", False)):
        own = [row for row in named if is_nameable(row) is nameable]
        alone = f"S/N 8, {label}: named alone and right"
        table.append((alone, chance(own, "alone"), share(own, is_right_alone)))
        table.append(("... truth in the set of names", chance(own, "inside"), share(own, holds)))
    for label, low, high in (("S/N 8 to 25", 8.0, 25.0), ("S/N 50 and 100", 50.0, 100.0)):
        own = [row for row in rows if row["part"] not in ("charted", "flicker")]
        z = scores([row for row in own if len(row["names"]) == 1 and low <= row["wanted"] <= high])
        table.append((f"95 % intervals cover, {label}", "95 %", fraction(np.abs(z) < 1.96)))
    for chart in CHARTS:
        own = [row for row in of("charted") if row["reference"] == chart]
        table.append((f"harm against a {chart}", "0 %", share(own, is_worse)))
    table += [
        ("an effect outside the list gets a name", "0 %", share(outside, lambda r: bool(r["found"]))),
        ("two at S/N 10, both named", "", share(of("pair"), lambda r: hidden(r) <= asserted(r))),
        (
            "flicker noise: a false name",
            "0 %",
            share(of("flicker"), lambda r: bool(asserted(r) - hidden(r))),
        ),
    ]
    header = ("| figure | ideal detector | measured (95 % interval) | cases |", "|---|---|---|---|")
    return [*header, *(f"| {' | '.join(line)} |" for line in table)]


# ---- the plots ---------------------------------------------------------------------------------------------


def confusion(rows: Sequence[Row]) -> tuple[FloatArray, FloatArray]:
    """Return predicted and measured fractions (hidden cause, first name); the last column means no name."""
    columns = [*KNOWN, NEITHER]
    predicted, measured = np.full((2, len(KNOWN), len(columns)), np.nan)
    for i, name in enumerate(KNOWN):
        own = [r for r in rows if list(r["names"]) == [name] and r["theory"]]
        if not own:
            continue
        predicted[i], measured[i] = 0.0, 0.0
        for r in own:
            for cause, value in r["theory"][0]["first"].items():
                predicted[i, columns.index(cause)] += value / len(own)
            named = [EQUIVALENT.get(f[0], f[0]) for f in r["found"] if f[0] in KNOWN]
            measured[i, columns.index(named[0] if named else NEITHER)] += 1.0 / len(own)
    return predicted, measured


def plot_confusion(rows: Sequence[Row], path: Path) -> None:
    """Plot both matrices of :func:`confusion` to a file."""
    named = [r for r in rows if r["part"] == "named" and r["theory"]]
    figure = Figure(figsize=(17, 8.7), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    titles = ("predicted: an ideal detector on the same cases", f"measured in {len(named)} cases")
    ticks = [name.replace("_", " ") for name in (*KNOWN, NEITHER)]
    for axis, matrix, title in zip(axes, confusion(named), titles, strict=True):
        image = axis.imshow(100 * matrix, cmap="Blues", vmin=0.0, vmax=100.0, aspect="auto")
        axis.set_xticks(range(len(ticks)), ticks, rotation=55, ha="right", rotation_mode="anchor")
        axis.set_yticks(range(len(KNOWN)), ticks[:-1])
        axis.axvline(len(KNOWN) - 0.5, color="0.3", linewidth=1.0)
        axis.set(title=title, xlabel="named first")
        for i, j in zip(*np.nonzero(np.nan_to_num(matrix) > 0.015), strict=True):
            dark = "white" if matrix[i, j] > 0.6 else "black"
            axis.text(j, i, f"{100 * matrix[i, j]:.0f}", ha="center", va="center", fontsize=8, color=dark)
    axes[0].set_ylabel("hidden, at signal-to-noise 8")
    figure.colorbar(image, ax=axes, label="% of the cases with this cause", shrink=0.6, pad=0.01)
    figure.savefig(path, dpi=110)


def plot_detection(rows: Sequence[Row], path: Path) -> None:
    """Plot the fraction found against signal-to-noise ratio, and the ratio that each cause needs."""
    single = [r for r in rows if r["part"] in ("named", "ladder", "loud", "gain")]
    figure = Figure(figsize=(13, 5.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.5, 1.0))
    sizes = sorted({r["wanted"] for r in single})
    for size in sizes:
        own = [found(r) for r in single if r["wanted"] == size]
        mean, ends = float(np.mean(own)), binomtest(sum(own), len(own)).proportion_ci()
        error = [[100 * (mean - ends.low)], [100 * (ends.high - mean)]]
        left.errorbar(size, 100 * mean, error, fmt="o", color="tab:blue", capsize=2)
    if any(r["theory"] for r in single):
        a = np.geomspace(1.5, 100.0, 200)
        left.plot(a, 100 * detection_curve(single, a), color="0.4", label="an ideal detector")
        left.legend(loc="lower right", title="points: measured, with 95 % interval")
    left.set(xscale="log", xlabel="signal-to-noise", ylabel="found, %", ylim=(-2, 104))
    left.set_xticks(sizes, [f"{size:g}" for size in sizes])
    left.minorticks_off()
    _plot_needed_sizes(right, single)
    for axis in (left, right):
        axis.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


def _plot_needed_sizes(axis: Axes, rows: Sequence[Row]) -> None:
    """Plot the signal-to-noise ratio that each cause needs over the ideal detector's, with 68 % intervals."""
    factors = {name: needed_size([r for r in rows if list(r["names"]) == [name]]) for name in KNOWN}
    excess = {name: 100.0 * (np.array(each) - 1.0) for name, each in factors.items() if each}
    for place, (middle, low, high) in enumerate(excess.values()):
        error = [[middle - low], [high - middle]]
        axis.errorbar(middle, place, xerr=error, fmt="o", color="tab:blue", capsize=2)
    axis.axvspan(-15.0, 15.0, color="0.4", alpha=0.12, linewidth=0)
    axis.axvline(0.0, color="0.4")
    axis.set_yticks(range(len(excess)), [name.replace("_", " ") for name in excess])
    axis.invert_yaxis()
    axis.set_xlabel("signal-to-noise needed on the same logs,\n% beyond an ideal detector's (grey: target)")
