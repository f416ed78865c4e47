"""What is counted: the outcome of one case, and rates over many, beside theory's."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.stats import binomtest, norm

from magbridge.arrays import BoolArray, FloatArray
from study.theory import SIZES

Row = dict[str, Any]
SURE = norm.ppf(0.95)
ALLOWED = 0.95
"""Least chance, by theory, to name the truth alone (or to name nothing) in the cases held to a target."""
COMPARABLE = 0.1
"""Largest p-value, by theory, of a log whose diagnosis is compared with theory: p-values end at one."""


ALIKE = {"clock_offset": "filter_lag"}
"""Causes that count as one: in a uniform field a late field and an early clock leave the same trace."""


def one_of(causes: Iterable[str]) -> set[str]:
    return {ALIKE.get(cause, cause) for cause in causes}


def hidden(row: Row) -> set[str]:
    """Causes that are hidden."""
    return one_of(row["names"])


def found(row: Row) -> bool:
    return bool(row["verdict"] != "nothing_found")


def unexplained(row: Row) -> bool:
    return row["unexplained"] is not None


def asserted(row: Row) -> set[str]:
    """Causes that the diagnosis names."""
    return one_of(entry[0] for entry in row["found"])


def in_named_set(row: Row) -> set[str]:
    """Causes that the diagnosis names, and those that it cannot tell from them."""
    return asserted(row).union(*(one_of(entry[3]) for entry in row["found"]))


def sets(row: Row) -> set[str]:
    """Causes as in :func:`in_named_set`, and those that are not ruled out for what is 'unexplained'."""
    kept = (row["unexplained"] or {}).get("alternatives", ())
    return in_named_set(row) | one_of(a["cause"] for a in kept)


def right(row: Row) -> bool:
    return hidden(row) <= asserted(row)


def second(row: Row) -> bool:
    """More causes are named than are hidden."""
    return len(asserted(row)) > max(len(hidden(row)), 1)


def right_alone(row: Row) -> bool:
    """Exactly the truth is named, and without alternatives."""
    return asserted(row) == sets(row) == hidden(row)


def holds(row: Row) -> bool:
    return hidden(row) <= sets(row)


def nameable(row: Row) -> bool:
    """By theory, what is hidden can be named, and nothing else (both, where two are hidden)."""
    return all(t.get("both", t.get("alone")) >= ALLOWED for t in row["theory"])


def beyond_any_name(row: Row) -> bool:
    """By theory, what is hidden can be told from every cause of the table."""
    return all(t["unnamed"] >= ALLOWED for t in row["theory"])


def reached(row: Row) -> bool:
    """A diagnosis gains 80 % of what an oracle does, in mean square on another deployment."""
    improvement = row["gain"]
    return bool(
        improvement["before"] - improvement["after"] >= 0.8 * (improvement["before"] - improvement["oracle"])
    )


def worse(row: Row) -> bool:
    """An extension does harm: on the log that it was made from, or on another."""
    improvement = row["gain"]
    there = [where for where in ("", " elsewhere") if "after" + where in improvement]
    return any(improvement["after" + where] > 1.02 * improvement["before" + where] for where in there)


def gained(rows: Sequence[Row]) -> float:
    """Median share of the oracle's gain."""
    gains = [r["gain"] for r in rows if r["gain"]["before"] > r["gain"]["oracle"]]
    shares = [(g["before"] - g["after"]) / (g["before"] - g["oracle"]) for g in gains]
    return float(np.median(shares)) if shares else float("nan")


def scores(rows: Sequence[Row]) -> FloatArray:
    """(value - truth) / sigma of all parameters of known truth."""
    return np.array([z for r in rows for z in r["scores"]])


def predicted(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Theory's predictions for all rows that have any."""
    return [t for r in rows for t in r["theory"]]


def chance(rows: Sequence[Row], key: str) -> float:
    """Mean of theory's chance `key`; NaN if there is none."""
    return float(np.mean([t[key] for t in predicted(rows)])) if predicted(rows) else np.nan


def curve(rows: Sequence[Row], size: FloatArray | float) -> FloatArray:
    """Theory's mean chance that the rows' hidden effects are found, if they had this signal-to-noise."""
    if not predicted(rows):
        return np.full(np.shape(size), np.nan)
    half, sure = np.array([(t["half"], t["sure"]) for t in predicted(rows)]).T
    return np.asarray(norm.cdf((np.asarray(size)[..., None] - half) / ((sure - half) / SURE)).mean(axis=-1))


def efficiency(rows: Sequence[Row]) -> tuple[float, float, float] | None:
    """Ratio of the point of half detection to theory's, with its 68 % interval.

    Detection at signal-to-noise a is ``Phi((a / f - half) / width)``, f by maximum likelihood; `half`
    and the width are theory's of each case.
    """
    rows = [r for r in rows if r["theory"]]
    if len(rows) < 8:
        return None
    a, y = np.array([r["wanted"] for r in rows]), np.array([found(r) for r in rows])
    half, sure = np.array([(r["theory"][0]["half"], r["theory"][0]["sure"]) for r in rows]).T
    width = (sure - half) / SURE

    def cost(log_f: float) -> float:
        p = np.clip(norm.cdf((a / np.exp(log_f) - half) / width), 1e-6, 1 - 1e-6)
        return -float(np.sum(np.where(y, np.log(p), np.log1p(-p))))

    best = minimize_scalar(cost, bounds=(-1.0, 1.2), method="bounded")
    grid = np.linspace(-1.0, 1.2, 441)
    inside = grid[np.array([cost(g) for g in grid]) < best.fun + 0.5]
    return float(np.exp(best.x)), float(np.exp(inside.min())), float(np.exp(inside.max()))


def equal(row: Row) -> float:
    """Signal-to-noise at which the ideal detector would reach the diagnosis' p-value, in the same noise."""
    surprise = -np.log(np.minimum.accumulate(row["theory"][0]["here"]))
    return float(np.interp(-np.log(row["p_value"]), surprise, SIZES))


def against_ideal(rows: Sequence[Row]) -> tuple[float, float, float] | None:
    """Ratio of the signal-to-noise that the detector needs to the ideal one's, with its 68 % interval.

    Both see the same noise, which cancels: one log compared like this tells as much as dozens that are merely
    counted as found or not.
    """
    known = [r for r in rows if r["theory"]]
    rows = [r for r in known if np.interp(r["wanted"], SIZES, r["theory"][0]["here"]) < COMPARABLE]
    if len(rows) < 3:
        return None
    logs = np.log([r["wanted"] / equal(r) for r in rows])
    middle, error = float(np.mean(logs)), float(np.std(logs, ddof=1) / np.sqrt(len(logs)))
    return float(np.exp(middle)), float(np.exp(middle - error)), float(np.exp(middle + error))


def share(rows: Sequence[Row], good: Callable[[Row], bool]) -> str:
    """Percentage of the rows that are good, with its 95 % interval (Clopper and Pearson 1934) | count."""
    return fraction([good(row) for row in rows])


def fraction(good: Sequence[bool] | BoolArray) -> str:
    """See :func:`share`."""
    n, k = len(good), int(np.sum(good))
    if not n:
        return "not run | 0"
    low, high = binomtest(k, n).proportion_ci()
    return f"{100 * k / n:.1f} % ({100 * low:.1f}-{100 * high:.1f}) | {k}/{n}"


def count(rows: Sequence[Row], good: Callable[[Row], bool]) -> str:
    return f"{sum(map(good, rows))}/{len(rows)}"


def percent(share: float) -> str:
    return f"{100 * share:.0f} %" if np.isfinite(share) else "-"


def off(factor: tuple[float, float, float]) -> str:
    """Write by how many per cent a factor, and the ends of its interval, differ from one."""
    middle, low, high = (100 * (f - 1) for f in factor)
    return f"{middle:+.0f} ({low:+.0f} to {high:+.0f}) %"
