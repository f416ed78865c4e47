"""Make the table of the blind study, with the results of an ideal detector.

Intervals are of 95 %. ``theory`` in a row holds the results of :func:`study.ideal.ideal` for this case.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import norm
from studies import fraction
from study.deployment import CHARTS, NOISES
from study.ideal import SIZES
from study.names import cause_names

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


# ---- the result of one case --------------------------------------------------------------------------------


def is_nameable(row: Row) -> bool:
    """Return True if an ideal detector would name only the truth."""
    return all(theory["alone"] >= MIN_CHANCE for theory in row["theory"])


def is_worse(row: Row) -> bool:
    """Return True if the extended calibration is worse, on its own log or on another day's."""
    error = row["gain"]
    return any(error["after" + log] > 1.02 * error["before" + log] for log in ("", " elsewhere"))


# ---- rates over many cases ---------------------------------------------------------------------------------


def share(rows: Sequence[Row], good: str) -> str:
    """Return the percentage of rows in which `good` is true, with its interval and the count."""
    return fraction([bool(row[good]) for row in rows])


def scores(rows: Sequence[Row]) -> FloatArray:
    """Return (value - truth) / sigma (n,) of all parameters with a known truth."""
    return np.array([z for row in rows for z in row["scores"]])


def chance(rows: Sequence[Row], key: str) -> str:
    """Return the ideal detector's mean probability to find the rows' effects at a signal-to-noise ratio."""
    values = [theory[key] for row in rows for theory in row["theory"]]
    return f"{100 * np.mean(values):.0f} %" if values else "-"


def detection(rows: Sequence[Row], size: float) -> float:
    """Return the ideal detector's mean chance to find the rows' effects at a signal-to-noise ratio."""
    ends = np.array([(theory["half"], theory["sure"]) for row in rows for theory in row["theory"]])
    if not len(ends):
        return np.nan
    half, sure = ends.T
    return float(np.mean(norm.cdf((size - half) / (sure - half) * norm.ppf(0.95))))


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
    table: list[Line] = [("false alarms", "1 %", share(null, "found"))]
    for noise in NOISES:
        own = [row for row in null if row["noise"] == noise]
        table.append((f"... {noise}", "1 %", share(own, "found")))
    single = of("ladder", "named", "gain", "loud")
    for size in sorted({row["wanted"] for row in single}):
        own = [row for row in single if row["wanted"] == size]
        ideal = f"{100 * detection(known, size):.0f} %"
        table.append((f"S/N {size:g}: found", ideal, share(own, "found")))
    if factor := needed_size(known):
        middle, low, high = (100 * (f - 1) for f in factor)
        text = f"{middle:+.0f} % ({low:+.0f} to {high:+.0f} %, of 68 %) | {len(known)}"
        table.append(("S/N needed beyond an ideal detector's", "0 %", text))
    table.append(("S/N 8: a false second name", "", share(named, "second")))
    for label, nameable in (("where the ideal detector can", True), ("elsewhere", False)):
        own = [row for row in named if is_nameable(row) is nameable]
        alone = f"S/N 8, {label}: named alone and right"
        table.append((alone, chance(own, "alone"), share(own, "alone")))
        table.append(("... truth in the set of names", chance(own, "inside"), share(own, "in_set")))
    for label, low, high in (("S/N 8 to 25", 8.0, 25.0), ("S/N 50 and 100", 50.0, 100.0)):
        own = [row for row in rows if row["part"] not in ("charted", "flicker")]
        z = scores([row for row in own if len(row["names"]) == 1 and low <= row["wanted"] <= high])
        table.append((f"95 % intervals cover, {label}", "95 %", fraction(np.abs(z) < 1.96)))
    for chart in CHARTS:
        own = [row for row in of("charted") if row["reference"] == chart]
        table.append((f"harm against a {chart}", "0 %", fraction([is_worse(row) for row in own])))
    false = [not set(row["named"]) <= cause_names(row["names"]) for row in of("flicker")]
    table += [
        ("an effect outside the list gets a name", "0 %", share(outside, "named")),
        ("two at S/N 10, both named", "", share(of("pair"), "right")),
        ("flicker noise: a false name", "0 %", fraction(false)),
    ]
    header = ("| figure | ideal detector | measured (95 % interval) | cases |", "|---|---|---|---|")
    return [*header, *(f"| {' | '.join(line)} |" for line in table)]
