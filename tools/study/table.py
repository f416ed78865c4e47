"""The study's figures against targets, each beside an ideal detector's, with its count and interval.

Intervals are of 95 %.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sitl.inject import EFFECTS
from study.by_cause import by_cause
from study.deployment import CHARTS
from study.noise import LOSSES, NOISES
from study.rates import (
    Row,
    against_ideal,
    beyond_any_name,
    chance,
    curve,
    efficiency,
    found,
    fraction,
    gained,
    hidden,
    holds,
    in_named_set,
    nameable,
    off,
    percent,
    reached,
    right,
    right_alone,
    scores,
    second,
    sets,
    share,
    unexplained,
    worse,
)

Parts = dict[str, list[Row]]
OFF = 0.15
"""Most by which the point of half detection may differ from theory's, as a fraction."""
Line = tuple[str, str, str, str]
"""Figure, target, what an ideal detector does, what was measured | in how many cases."""


def lines(rows: Sequence[Row]) -> list[str]:
    """Return the tables: the figures, logs with losses beside whole ones, and cause by cause."""
    part = {name: [r for r in rows if r["part"] == name] for name in {r["part"] for r in rows}}
    true = [r for r in rows if r["part"] not in ("charted", "flicker")]
    figures = [
        *_nulls(part.get("null", [])), *_flicker(part.get("flicker", [])), *_detection(part),
        *_sets(part.get("named", [])), *_parameters(true), *_gains(part.get("gain", [])), *_harm(part),
        *_nameless(part), *_pairs(part.get("pair", [])),
    ]  # fmt: skip
    return [
        "| figure | target | ideal detector | measured (95 % interval) | cases |",
        "|---|---|---|---|---|",
        *(f"| {' | '.join(line)} |" for line in figures),
        "",
        *_losses(true),
        "",
        *by_cause(part),
    ]


def _nulls(nulls: Sequence[Row]) -> list[Line]:
    def of(label: str, rows: Sequence[Row], target: str = "") -> Line:
        return label, target, "1 %", share(rows, found)

    return [
        of("false alarm on nulls", nulls, "at most 1 %"),
        *(of(f"... {noise}", [r for r in nulls if r["noise"] == noise]) for noise in NOISES),
        *(of(f"... samples lost, {how}", [r for r in nulls if r["losses"] == how]) for how in LOSSES),
    ]


def _flicker(rows: Sequence[Row]) -> list[Line]:
    one, none = ([r for r in rows if bool(r["names"]) == hides] for hides in (True, False))
    return [
        ("in flicker noise, nothing hidden: a name", "", "", share(none, lambda r: bool(r["found"]))),
        ("... one hidden: named", "", "", share(one, right)),
        ("... a false second name", "", "", share(one, second)),
    ]


def _detection(part: Parts) -> list[Line]:
    single = [r for name in ("ladder", "named", "gain", "loud") for r in part.get(name, [])]
    known = part.get("ladder", []) + part.get("named", [])
    targets = {8.0: "at least 95 %"} | dict.fromkeys((15.0, 20.0, 25.0, 50.0, 100.0), "no loss")
    out: list[Line] = []
    for size in sorted({r["wanted"] for r in single} | {8.0}):
        own = [r for r in single if r["wanted"] == size]
        expected = percent(float(curve(known, size)))
        out.append((f"detection at S/N {size:g}", targets.get(size, ""), expected, share(own, found)))
        each = [[r for r in own if list(r["names"]) == [name]] for name in EFFECTS]
        least = min(filter(None, each), key=lambda rows: np.mean([*map(found, rows)]), default=[])
        if size == 8.0 and least:
            rare = percent(float(curve(least, size)))
            label = f"... each cause; least often {least[0]['names'][0]}"
            out.append((label, "at least 95 %", rare, share(least, found)))
    for label, factor in (
        ("point of half detection, against theory's (68 % interval): by what is found", efficiency(known)),
        ("... by p-values, theory's with the same noise", against_ideal(known)),
    ):
        if factor:
            out.append((label, "within 15 %", "0 %", f"{off(factor)} | {len(known)}"))
    factors = [against_ideal([r for r in known if list(r["names"]) == [name]]) for name in EFFECTS]
    if within := [abs(factor[0] - 1.0) <= OFF for factor in factors if factor]:
        share_within = f"{sum(within)} of {len(within)} | {len(known)}"
        out.append(("... cause by cause: within 15 %", "all", "all", share_within))
    return out


def _sets(named: Sequence[Row]) -> list[Line]:
    """Lines on a case's set: what is named, its alternatives, and those of what is 'unexplained'."""
    out: list[Line] = [("one hidden: a false second name", "at most 3 %", "", share(named, second))]
    for label, rows, targets in (
        ("where theory allows 95 %", [*filter(nameable, named)], ("at least 90 %", "", "at most 1.5")),
        ("elsewhere", [r for r in named if not nameable(r)], ("", "at least 97 %", "")),
    ):
        alone, inside = (percent(chance(rows, key)) for key in ("alone", "inside"))
        size = f"{chance(rows, 'size'):.2f}"
        out += [
            (f"S/N 8, {label}: named alone and right", targets[0], alone, share(rows, right_alone)),
            ("... the set holds the truth", targets[1], inside, share(rows, holds)),
            ("... mean size of the set", targets[2], size, _mean_size(rows, sets)),
            ("... without what an 'unexplained' keeps: holds the truth", "", inside,
             share(rows, lambda r: hidden(r) <= in_named_set(r))),
            ("... mean size of that", "", size, _mean_size(rows, in_named_set)),
        ]  # fmt: skip
    return out


def _mean_size(rows: Sequence[Row], of: Callable[[Row], set[str]]) -> str:
    """Mean size of the sets that are not empty."""
    sizes = [len(of(r)) for r in rows if of(r)]
    return f"{np.mean(sizes):.2f} | {len(sizes)}" if sizes else "not run | 0"


def _parameters(rows: Sequence[Row]) -> list[Line]:
    out: list[Line] = []
    for label, low, high in (("S/N 8 to 25", 8.0, 25.0), ("S/N 50 and 100", 50.0, 100.0)):
        own = [r for r in rows if len(r["names"]) == 1 and low <= r["wanted"] <= high]
        z = scores(own)
        bias = f"{np.median(z):+.2f} sigma (mean {z.mean():+.2f})" if z.size else "not run"
        cases = f"{z.size} of {sum(bool(r['scores']) for r in own)} cases"
        out += [
            (f"parameters, {label}: median bias", "under 0.2 sigma", "0", f"{bias} | {cases}"),
            ("... 95 % intervals cover", "92-97 %", "95 %", fraction(np.abs(z) < 1.96)),
        ]
    return out


def _gains(rows: Sequence[Row]) -> list[Line]:
    label = "gain on another deployment (S/N 20), of an oracle's"
    return [
        (f"{label}: median", "at least 80 %", "100 %", f"{percent(gained(rows))} | {len(rows)}"),
        ("... cases with 80 % of an oracle's", "", "100 %", share(rows, reached)),
    ]


def _harm(part: Parts) -> list[Line]:
    """Lines on harm: errors against the true field, or on another deployment against the true reference."""
    extended, charted = part.get("gain", []), part.get("charted", [])
    groups = {"harm: extension makes the corrected field worse": extended + charted}
    groups |= {f"... against a {kind}": [r for r in charted if r["reference"] == kind] for kind in CHARTS}
    return [(label, "0", "0 %", share(rows, worse)) for label, rows in groups.items()]


def _nameless(part: Parts) -> list[Line]:
    """Lines on effects without a name; a wrong name counts if the diagnosis asserts it."""
    unknown = part.get("unknown", [])
    out: list[Line] = []
    for label, rows in (
        ("unknown cause, where theory gives no name", [*filter(beyond_any_name, unknown)]),
        ("foreign, seen before", part.get("seen", [])),
        ("foreign, sealed until now", part.get("foreign", [])),
    ):
        at_best, so = (chance(rows, key) for key in ("unnamed", "described"))
        ideal = f"{percent(at_best)}; with these descriptions {percent(so)}"
        out += [
            (f"{label}: 'unexplained'", "at least 90 %", ideal, share(rows, unexplained)),
            ("... a wrong name", "at most 15 %", percent(1.0 - at_best),
             share(rows, lambda r: bool(r["found"]))),
        ]  # fmt: skip
    return out


def _pairs(pairs: Sequence[Row]) -> list[Line]:
    out: list[Line] = []
    for label, rows in (("where theory names both in 95 %", [*filter(nameable, pairs)]), ("any", pairs)):
        at_best, so, inside = (percent(chance(rows, key)) for key in ("both", "regressed", "inside"))
        ideal = f"{at_best}; with these regressors {so}"
        out += [
            (f"two at S/N 10, {label}: both named", "at least 80 %", ideal, share(rows, right)),
            ("... both in the sets", "", inside, share(rows, holds)),
        ]
    return out


def _losses(rows: Sequence[Row]) -> list[str]:
    """Return the same figures for cases whose logs are whole and for those that lost samples."""
    groups = [r for r in rows if not r["losses"]], [r for r in rows if r["losses"]]

    def line(figure: str, parts: tuple[str, ...], good: Callable[[Row], bool]) -> str:
        shares = [share([r for r in group if r["part"] in parts], good) for group in groups]
        return f"| {figure} | " + " | ".join(cell.replace(" | ", ", ") for cell in shares) + " |"

    covered = [np.abs(scores([r for r in group if 8.0 <= r["wanted"] <= 25.0])) < 1.96 for group in groups]
    return [
        "| | whole logs | samples lost |",
        "|---|---|---|",
        line("false alarm on nulls", ("null",), found),
        line("found at S/N 2 to 6", ("ladder",), found),
        line("found at S/N 8", ("named",), found),
        line("... the set holds the truth", ("named",), holds),
        "| 95 % intervals cover | " + " | ".join(fraction(z).replace(" | ", ", ") for z in covered) + " |",
        line("cases with 80 % of an oracle's gain", ("gain",), reached),
        line("no name for it: 'unexplained'", ("unknown", "seen", "foreign"), unexplained),
        line("two: both named", ("pair",), right),
    ]
