"""The study's figures against their targets, each with its count and a 95 % interval."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.stats import binomtest, norm

from sitl.inject import EFFECTS
from study.stage import NOISES

Row = dict[str, Any]
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
    """Theory can name what is hidden alone."""
    return all(t is None or t["alone"] >= ALLOWED for t in row["theory"])


def unlike(row: Row) -> bool:
    """Theory can tell what is hidden from all that the table knows."""
    return all(t["unnamed"] >= ALLOWED for t in row["theory"])


def _of_theory(rows: Sequence[Row], chance: Callable[[str, Row], float]) -> str:
    """Theory's mean chance for all that is hidden in a case."""
    known = [[chance(*one) for one in zip(r["names"], r["theory"], strict=True)] for r in rows]
    return f"{100 * np.mean([np.prod(chances) for chances in known]):.0f} %" if known else "unknown"


def _mean_set(rows: Sequence[Row]) -> str:
    sizes = [len(sets_of(r)) for r in rows if r["found"]]
    return f"{np.mean(sizes):.2f} | {len(sizes)}" if sizes else "not run | 0"


def efficiency(rows: Sequence[Row]) -> tuple[float, float, float] | None:
    """By how much the point of half detection is off theory's: factor with its 68 % interval.

    Detection at signal-to-noise a is ``Phi((a / f - half) / width)``, f by maximum likelihood; `half`
    and the width are theory's of each case.
    """
    rows = [r for r in rows if any(r["theory"])]
    if len(rows) < 8:
        return None
    a, y = np.array([r["wanted"] for r in rows]), np.array([found(r) for r in rows])
    half, sure = np.array([(r["theory"][0]["half"], r["theory"][0]["sure"]) for r in rows]).T
    width = (sure - half) / 1.645

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
    out = ["| figure | target | measured (95 % interval) | cases |", "|---|---|---|---|"]

    def add(figure: str, target: str, measured: str) -> None:
        out.append(f"| {figure} | {target} | {measured} |")

    nulls = part.get("null", [])
    add("false alarm on nulls", "at most 1 %", share(nulls, found))
    for noise in NOISES:
        add(f"... {noise}", "", share([r for r in nulls if r["noise"] == noise], found))
    _detection(add, part)
    loud = part.get("named", [])
    clear, other = [r for r in loud if allowed(r)], [r for r in loud if not allowed(r)]
    add("S/N 8: named alone and right, where theory allows 95 %", "at least 90 %", share(clear, right_alone))
    there = [r for r in other if all(r["theory"])]
    expected = _of_theory(there, lambda _, t: t["inside"])
    add("... elsewhere the set holds the truth", f"at least 97 % (theory {expected})", share(other, holds))
    add("... mean size of the set where separable", "at most 1.5", _mean_set(clear))
    sizes = [r["theory"][0]["size"] for r in other if r["theory"][0]]
    add("... elsewhere", f"theory {np.mean(sizes) if sizes else np.nan:.2f}", _mean_set(other))
    single = [r for r in rows if len(r["names"]) == 1]
    _parameters(add, "S/N 8 to 25", [r for r in single if 8.0 <= r["wanted"] <= 25.0])
    _parameters(add, "S/N 50 and 100", [r for r in single if r["wanted"] > 25.0])
    _gains(add, part.get("gain", []))
    unknown = part.get("unknown", [])
    apart = [r for r in unknown if unlike(r)]
    groups = (
        ("where theory gives no name in 95 %", apart),
        ("all", unknown),
        ("foreign to table and descriptions", part.get("foreign", [])),
    )
    for label, chosen in groups:
        at_best, so = (_of_theory(chosen, lambda _, t, key=key: t[key]) for key in ("unnamed", "described"))
        add(
            f"unknown at S/N 10, {label}: 'unexplained'",
            f"at least 90 % (theory {at_best}; of its descriptions {so})",
            share(chosen, lambda r: r["unexplained"] is not None),
        )
        add("... a wrong name", "at most 5 %", share(chosen, lambda r: bool(r["found"])))
    pairs = part.get("pair", [])
    apart = [r for r in pairs if allowed(r)]
    for label, chosen in (("each nameable beside the other", apart), ("any two", pairs)):
        add(
            f"two at S/N 10, {label}: both named",
            f"at least 80 % (theory {_of_theory(chosen, lambda name, t: t['first'].get(name, 0.0))}; "
            f"of its regressors {_of_theory(chosen, lambda _, t: t['regressed'])})",
            share(chosen, lambda r: set(r["names"]) <= causes_of(r)),
        )
        add(
            "... both in the sets",
            f"theory {_of_theory(chosen, lambda _, t: t['inside'])}",
            share(chosen, holds),
        )
    return [*out, "", *_by_cause(part)]  # fmt: skip


def _detection(add: Callable[[str, str, str], None], part: dict[str, list[Row]]) -> None:
    single = [r for name in ("ladder", "named", "gain", "loud") for r in part.get(name, [])]
    targets = {8.0: "at least 95 %"} | dict.fromkeys((15.0, 20.0, 25.0, 50.0, 100.0), "no loss")
    for size in sorted({r["wanted"] for r in single} | {8.0}):
        own = [r for r in single if r["wanted"] == size]
        add(f"detection at S/N {size:g}", targets.get(size, ""), share(own, found))
        named = {name: [r for r in own if tuple(r["names"]) == (name,)] for name in EFFECTS}
        least = min((name for name in named if named[name]), key=lambda name: _rate(named[name]), default="")
        if size == 8.0 and least:
            add(f"... each cause; least often {least}", "at least 95 %", share(named[least], found))
    known = part.get("ladder", []) + part.get("named", [])
    off = efficiency(known)
    if off:
        add(
            "point of half detection, against theory's", "within 15 %",
            f"{_off(off)} % (68 %) | {len(known)}",
        )  # fmt: skip


def _rate(rows: Sequence[Row]) -> float:
    return sum(map(found, rows)) / len(rows)


def _off(factor: tuple[float, float, float]) -> str:
    """By how many per cent factor and its interval's ends are off one."""
    middle, low, high = (100 * (f - 1) for f in factor)
    return f"{middle:+.0f} ({low:+.0f} to {high:+.0f})"


def _parameters(add: Callable[[str, str, str], None], label: str, rows: Sequence[Row]) -> None:
    z = np.array([x for r in rows for x in r["scores"]])
    if not z.size:
        add(f"parameters, {label}", "bias under 0.2 sigma", "not run | 0")
        return
    add(
        f"parameters, {label}: median bias", "under 0.2 sigma",
        f"{np.median(z):+.2f} sigma (mean {z.mean():+.2f}) | {z.size} of {sum(bool(r['scores']) for r in rows)} cases",
    )  # fmt: skip
    inside = np.abs(z) < 1.96
    low, high = binomtest(int(inside.sum()), z.size).proportion_ci()
    add(
        "... 95 % intervals cover", "92-97 %",
        f"{100 * inside.mean():.1f} % ({100 * low:.1f}-{100 * high:.1f}) | {z.size}",
    )  # fmt: skip


def gained(rows: Sequence[Row]) -> float:
    """Median share of the oracle's gain, in mean square on another deployment."""
    gains = [r["gain"] for r in rows if r["gain"]["before"] > r["gain"]["oracle"]]
    shares = [(g["before"] - g["after"]) / (g["before"] - g["oracle"]) for g in gains]
    return float(np.median(shares)) if shares else float("nan")


def _gains(add: Callable[[str, str, str], None], rows: Sequence[Row]) -> None:
    add(
        "gain on another deployment (S/N 20), of an oracle's: median", "at least 80 %",
        f"{100 * gained(rows):.0f} % | {len(rows)}" if rows else "not run | 0",
    )  # fmt: skip
    add("... cases with 80 % of an oracle's", "", share(rows, lambda r: _reached(r["gain"])))
    add(
        "... cases that are worse than before",
        "",
        share(rows, lambda r: r["gain"]["after"] > 1.02 * r["gain"]["before"]),
    )


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
        known = [r["theory"][0] for r in named if r["theory"] and r["theory"][0]]
        theory = {
            key: f"{np.mean([t[key] for t in known]):.2f}" if known else "-"
            for key in ("alone", "inside", "size")
        }
        z = np.array([x for key in ("named", "loud", "gain") for r in own.get(key, []) for x in r["scores"]])
        off = efficiency(own.get("ladder", []) + named)
        half = [t["half"] for t in known]
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
