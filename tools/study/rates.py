"""What is counted in the cases: what came out of one, and rates of many beside theory's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.stats import binomtest, norm

from study.theory import SIZES

Row = dict[str, Any]
SURE = norm.ppf(0.95)
ALLOWED = 0.95
"""Theory's chance to name the truth alone, or to name nothing, from which on a detector is held to it."""
SEEN = 0.1
"""Theory's p-value in a log, up to which the diagnosis' is compared with it: p-values end at one."""


def found(row: Row) -> bool:
    return bool(row["verdict"] != "nothing_found")


def unexplained(row: Row) -> bool:
    return row["unexplained"] is not None


def asserted(row: Row) -> set[str]:
    """Causes that the diagnosis names."""
    return {entry[0] for entry in row["found"]}


def beside(row: Row) -> set[str]:
    """Those, and what it cannot tell from them."""
    return asserted(row).union(*(entry[3] for entry in row["found"]))


def sets(row: Row) -> set[str]:
    """Those, and the names that what is 'unexplained' cannot be told from."""
    return beside(row).union(a["cause"] for a in (row["unexplained"] or {}).get("alternatives", ()))


def right(row: Row) -> bool:
    return set(row["names"]) <= asserted(row)


def right_alone(row: Row) -> bool:
    """One cause is named, the truth, and no other stands beside it."""
    return asserted(row) == sets(row) == set(row["names"])


def holds(row: Row) -> bool:
    return set(row["names"]) <= sets(row)


def nameable(row: Row) -> bool:
    """Theory can name what is hidden, and nothing else."""
    return all(t.get("both", t.get("alone")) >= ALLOWED for t in row["theory"])


def unlike(row: Row) -> bool:
    """Theory can tell what is hidden from all that the table knows."""
    return all(t["unnamed"] >= ALLOWED for t in row["theory"])


def reached(row: Row) -> bool:
    """A diagnosis gains 80 % of what an oracle does, in mean square on another deployment."""
    gain = row["gain"]
    return bool(gain["before"] - gain["after"] >= 0.8 * (gain["before"] - gain["oracle"]))


def worse(row: Row) -> bool:
    """An extension does harm: on the log that it was made from, or on another."""
    gain = row["gain"]
    there = [where for where in ("", " elsewhere") if "after" + where in gain]
    return any(gain["after" + where] > 1.02 * gain["before" + where] for where in there)


def gained(rows: Sequence[Row]) -> float:
    """Median share of the oracle's gain."""
    gains = [r["gain"] for r in rows if r["gain"]["before"] > r["gain"]["oracle"]]
    shares = [(g["before"] - g["after"]) / (g["before"] - g["oracle"]) for g in gains]
    return float(np.median(shares)) if shares else float("nan")


def scores(rows: Sequence[Row]) -> NDArray[np.float64]:
    """(value - truth) / sigma of all parameters that physics knows."""
    return np.array([z for r in rows for z in r["scores"]])


def told(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Theory of the rows that have one."""
    return [t for r in rows for t in r["theory"]]


def chance(rows: Sequence[Row], key: str) -> float:
    """Theory's mean chance."""
    return float(np.mean([t[key] for t in told(rows)])) if told(rows) else np.nan


def curve(rows: Sequence[Row], size: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """Theory's mean chance that what is hidden in the rows is found, were it of that signal-to-noise."""
    if not told(rows):
        return np.full(np.shape(size), np.nan)
    half, sure = np.array([(t["half"], t["sure"]) for t in told(rows)]).T
    return np.asarray(norm.cdf((np.asarray(size)[..., None] - half) / ((sure - half) / SURE)).mean(axis=-1))


def efficiency(rows: Sequence[Row]) -> tuple[float, float, float] | None:
    """By how much the point of half detection is off theory's: factor with its 68 % interval.

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
    """Signal-to-noise at which theory's detector would have the diagnosis' p-value, in the same noise."""
    surprise = -np.log(np.minimum.accumulate(row["theory"][0]["here"]))
    return float(np.interp(-np.log(row["p_value"]), surprise, SIZES))


def beside_ideal(rows: Sequence[Row]) -> tuple[float, float, float] | None:
    """By how much more signal-to-noise the detector needs than theory's: factor with its 68 % interval.

    Both see the same noise, which cancels: a log says as much as dozens that are counted as found or not.
    """
    rows = [r for r in rows if r["theory"] and np.interp(r["wanted"], SIZES, r["theory"][0]["here"]) < SEEN]
    if len(rows) < 3:
        return None
    logs = np.log([r["wanted"] / equal(r) for r in rows])
    middle, error = float(np.mean(logs)), float(np.std(logs, ddof=1) / np.sqrt(len(logs)))
    return float(np.exp(middle)), float(np.exp(middle - error)), float(np.exp(middle + error))


def share(rows: Sequence[Row], good: Callable[[Row], bool]) -> str:
    """Percentage of the rows that are good, with its 95 % interval (Clopper and Pearson 1934) | count."""
    return fraction([good(row) for row in rows])


def fraction(good: Sequence[bool] | NDArray[np.bool_]) -> str:
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
    """By how many per cent factor and its interval's ends are off one."""
    middle, low, high = (100 * (f - 1) for f in factor)
    return f"{middle:+.0f} ({low:+.0f} to {high:+.0f}) %"
