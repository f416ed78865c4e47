"""The study's figures against their targets, each with its count and a 95 % interval."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.stats import binomtest, norm

from sitl.inject import EFFECTS
from study.stage import NOISES

Row = dict[str, Any]
Add = Callable[[str, str, str, str], None]
"""Figure, target, what an ideal detector does, what was measured and in how many cases."""
SURE = norm.ppf(0.95)
ALLOWED = 0.95
"""Theory's chance to name the truth alone, or to name nothing, from which on a detector is held to it."""


def share(rows: Sequence[Row], good: Callable[[Row], bool]) -> str:
    """Percentage of the rows that are good, with its 95 % interval (Clopper and Pearson 1934) | count."""
    n = len(rows)
    if not n:
        return "not run | 0"
    k = sum(map(good, rows))
    low, high = binomtest(k, n).proportion_ci()
    return f"{100 * k / n:.1f} % ({100 * low:.1f}-{100 * high:.1f}) | {k}/{n}"


def found(row: Row) -> bool:
    return bool(row["verdict"] != "nothing_found")


def causes_of(row: Row) -> set[str]:
    return {entry[0] for entry in row["found"]}


def sets_of(row: Row) -> set[str]:
    return causes_of(row).union(*(entry[3] for entry in row["found"]))


def right_alone(row: Row) -> bool:
    """One cause found, the truth, and no other beside it."""
    return sets_of(row) == set(row["names"])


def holds(row: Row) -> bool:
    return set(row["names"]) <= sets_of(row)


def allowed(row: Row) -> bool:
    """Theory can name what is hidden, and nothing else."""
    return all(t.get("both", t.get("alone")) >= ALLOWED for t in row["theory"])


def unlike(row: Row) -> bool:
    """Theory can tell what is hidden from all that the table knows."""
    return all(t["unnamed"] >= ALLOWED for t in row["theory"])


def told(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Theory of the rows that have one."""
    return [t for r in rows for t in r["theory"]]


def chance(rows: Sequence[Row], key: str) -> float:
    """Theory's mean chance."""
    return float(np.mean([t[key] for t in told(rows)])) if told(rows) else np.nan


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if np.isfinite(share) else "-"


def curve(rows: Sequence[Row], size: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """Theory's mean chance that what is hidden in the rows is found, were it of that signal-to-noise."""
    half, sure = np.array([(t["half"], t["sure"]) for t in told(rows)]).reshape(-1, 2).T
    return np.asarray(norm.cdf((np.asarray(size)[..., None] - half) / ((sure - half) / SURE)).mean(axis=-1))


def _mean_set(rows: Sequence[Row]) -> str:
    sizes = [len(sets_of(r)) for r in rows if r["found"]]
    return f"{np.mean(sizes):.2f} | {len(sizes)}" if sizes else "not run | 0"


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


def lines(rows: Sequence[Row]) -> list[str]:
    """Return the tables."""
    part = {name: [r for r in rows if r["part"] == name] for name in {r["part"] for r in rows}}
    out = ["| figure | target | ideal detector | measured (95 % interval) | cases |", "|---|---|---|---|---|"]

    def add(figure: str, target: str, ideal: str, measured: str) -> None:
        out.append(f"| {figure} | {target} | {ideal} | {measured} |")

    nulls = part.get("null", [])
    add("false alarm on nulls", "at most 1 %", "1 %", share(nulls, found))
    for noise in NOISES:
        add(f"... {noise}", "", "1 %", share([r for r in nulls if r["noise"] == noise], found))
    _detection(add, part)
    loud = part.get("named", [])
    clear, other = [r for r in loud if allowed(r)], [r for r in loud if not allowed(r)]
    for label, chosen, target in (
        ("where theory allows 95 %", clear, ("at least 90 %", "", "at most 1.5")),
        ("elsewhere", other, ("", "at least 97 %", "")),
    ):
        add(
            f"S/N 8, {label}: named alone and right",
            target[0],
            _percent(chance(chosen, "alone")),
            share(chosen, right_alone),
        )
        add(
            "... the set holds the truth", target[1], _percent(chance(chosen, "inside")), share(chosen, holds)
        )
        add("... mean size of the set", target[2], f"{chance(chosen, 'size'):.2f}", _mean_set(chosen))
    single = [r for r in rows if len(r["names"]) == 1]
    _parameters(add, "S/N 8 to 25", [r for r in single if 8.0 <= r["wanted"] <= 25.0])
    _parameters(add, "S/N 50 and 100", [r for r in single if r["wanted"] > 25.0])
    _gains(add, part.get("gain", []))
    _nameless(add, part)
    pairs = part.get("pair", [])
    for label, chosen in (
        ("where theory names both in 95 %", [r for r in pairs if allowed(r)]),
        ("any", pairs),
    ):
        at_best, so = (_percent(chance(chosen, key)) for key in ("both", "regressed"))
        add(
            f"two at S/N 10, {label}: both named", "at least 80 %", f"{at_best}; with these regressors {so}",
            share(chosen, lambda r: set(r["names"]) <= causes_of(r)),
        )  # fmt: skip
        add("... both in the sets", "", _percent(chance(chosen, "inside")), share(chosen, holds))
    return [*out, "", *_by_cause(part)]


def _nameless(add: Add, part: dict[str, list[Row]]) -> None:
    unknown = part.get("unknown", [])
    for label, chosen in (
        ("cause not in the table, where theory gives no name in 95 %", [r for r in unknown if unlike(r)]),
        ("cause not in the table, all", unknown),
        ("foreign, seen before", part.get("seen", [])),
        ("foreign, sealed until now", part.get("foreign", [])),
    ):
        at_best, so = (chance(chosen, key) for key in ("unnamed", "described"))
        add(
            f"{label}: 'unexplained'", "at least 90 %", f"{_percent(at_best)}; with these descriptions {_percent(so)}",
            share(chosen, lambda r: r["unexplained"] is not None),
        )  # fmt: skip
        add(
            "... a wrong name",
            "at most 5 %",
            _percent(1.0 - at_best),
            share(chosen, lambda r: bool(r["found"])),
        )


def _detection(add: Add, part: dict[str, list[Row]]) -> None:
    single = [r for name in ("ladder", "named", "gain", "loud") for r in part.get(name, [])]
    known = part.get("ladder", []) + part.get("named", [])
    targets = {8.0: "at least 95 %"} | dict.fromkeys((15.0, 20.0, 25.0, 50.0, 100.0), "no loss")
    for size in sorted({r["wanted"] for r in single} | {8.0}):
        own = [r for r in single if r["wanted"] == size]
        expected = _percent(float(curve(known, size))) if told(known) else "-"
        add(f"detection at S/N {size:g}", targets.get(size, ""), expected, share(own, found))
        named = {name: [r for r in own if tuple(r["names"]) == (name,)] for name in EFFECTS}
        least = min((name for name in named if named[name]), key=lambda name: _rate(named[name]), default="")
        if size == 8.0 and least:
            rare = float(curve(named[least], size)) if told(named[least]) else np.nan
            add(
                f"... each cause; least often {least}",
                "at least 95 %",
                _percent(rare),
                share(named[least], found),
            )
    off = efficiency(known)
    if off:
        add(
            "point of half detection, against theory's",
            "within 15 %",
            "0 %",
            f"{_off(off)} % (68 %) | {len(known)}",
        )


def _rate(rows: Sequence[Row]) -> float:
    return sum(map(found, rows)) / len(rows)


def _off(factor: tuple[float, float, float]) -> str:
    """By how many per cent factor and its interval's ends are off one."""
    middle, low, high = (100 * (f - 1) for f in factor)
    return f"{middle:+.0f} ({low:+.0f} to {high:+.0f})"


def _parameters(add: Add, label: str, rows: Sequence[Row]) -> None:
    z = np.array([x for r in rows for x in r["scores"]])
    if not z.size:
        add(f"parameters, {label}", "bias under 0.2 sigma", "0", "not run | 0")
        return
    add(
        f"parameters, {label}: median bias", "under 0.2 sigma", "0",
        f"{np.median(z):+.2f} sigma (mean {z.mean():+.2f}) | {z.size} of {sum(bool(r['scores']) for r in rows)} cases",
    )  # fmt: skip
    inside = np.abs(z) < 1.96
    low, high = binomtest(int(inside.sum()), z.size).proportion_ci()
    add(
        "... 95 % intervals cover", "92-97 %", "95 %",
        f"{100 * inside.mean():.1f} % ({100 * low:.1f}-{100 * high:.1f}) | {z.size}",
    )  # fmt: skip


def gained(rows: Sequence[Row]) -> float:
    """Median share of the oracle's gain, in mean square on another deployment."""
    gains = [r["gain"] for r in rows if r["gain"]["before"] > r["gain"]["oracle"]]
    shares = [(g["before"] - g["after"]) / (g["before"] - g["oracle"]) for g in gains]
    return float(np.median(shares)) if shares else float("nan")


def _gains(add: Add, rows: Sequence[Row]) -> None:
    add(
        "gain on another deployment (S/N 20), of an oracle's: median", "at least 80 %", "100 %",
        f"{100 * gained(rows):.0f} % | {len(rows)}" if rows else "not run | 0",
    )  # fmt: skip
    add("... cases with 80 % of an oracle's", "", "100 %", share(rows, lambda r: _reached(r["gain"])))
    add(
        "... cases that are worse than before", "", "0 %",
        share(rows, lambda r: r["gain"]["after"] > 1.02 * r["gain"]["before"]),
    )  # fmt: skip


def _reached(gain: dict[str, float]) -> bool:
    return gain["before"] - gain["after"] >= 0.8 * (gain["before"] - gain["oracle"])


def _by_cause(part: dict[str, list[Row]]) -> list[str]:
    """One line a cause."""
    out = [
        "| hidden | found at 8 | half point, theory's / measured | alone at 8 (theory's) | in the set (theory's) | set size (theory's) | loud: found, in the set | parameters: bias, cover, n | gain of oracle's | named or called instead |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name in EFFECTS:
        own = {key: [r for r in rows if r["names"] in ((name,), [name])] for key, rows in part.items()}
        named, loud = own.get("named", []), own.get("loud", []) + own.get("gain", [])
        theory = {
            key: f"{chance(named, key):.2f}" if told(named) else "-" for key in ("alone", "inside", "size")
        }
        z = np.array([x for key in ("named", "loud", "gain") for r in own.get(key, []) for x in r["scores"]])
        off = efficiency(own.get("ladder", []) + named)
        half = [t["half"] for t in told(named)]
        halves = (
            f"{np.mean(half):.1f} / {np.mean(half) * off[0]:.1f} ({_off(off)} %)" if half and off else "-"
        )
        else_ = sorted(
            {c for r in named for c in causes_of(r) - {name}}
            | {r["unexplained"]["kind"] for r in named if r["unexplained"]}
        )
        gain = own.get("gain", [])
        cells = [
            f"{_of(named, found)}", halves, f"{_of(named, right_alone)} ({theory['alone']})",
            f"{_of(named, holds)} ({theory['inside']})",
            f"{np.mean([len(sets_of(r)) for r in named if r['found']] or [0.0]):.1f} ({theory['size']})",
            f"{_of(loud, found)}, {_of(loud, holds)}",
            f"{np.median(z):+.2f}, {100 * np.mean(np.abs(z) < 1.96):.0f} %, {z.size}" if z.size else "-",
            f"{100 * gained(gain):.0f} %" if np.isfinite(gained(gain)) else "-", ", ".join(else_),
        ]  # fmt: skip
        out.append(f"| {name} | " + " | ".join(cells) + " |")
    return out


def _of(rows: Sequence[Row], good: Callable[[Row], bool]) -> str:
    return f"{sum(map(good, rows))}/{len(rows)}"
