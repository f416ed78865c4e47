"""The study cause by cause: one line each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from sitl.inject import EFFECTS
from study.rates import (
    Row,
    against_ideal,
    asserted,
    chance,
    count,
    found,
    gained,
    holds,
    off,
    predicted,
    right_alone,
    scores,
    sets,
)

COLUMNS = (
    "hidden", "found at 8", "half point, theory's / measured", "alone at 8 (theory's)",
    "in the set (theory's)", "set size (theory's)", "loud: found, in the set", "parameters: bias, cover, n",
    "gain of oracle's", "named or called instead",
)  # fmt: skip


def by_cause(part: Mapping[str, Sequence[Row]]) -> list[str]:
    """Return the table; `part` holds each part's cases."""
    table = [COLUMNS, ["---"] * len(COLUMNS), *(_line(name, part) for name in EFFECTS)]
    return [f"| {' | '.join(cells)} |" for cells in table]


def _line(name: str, part: Mapping[str, Sequence[Row]]) -> list[str]:
    """Return the table's cells for one cause."""

    def own(*parts: str) -> list[Row]:
        return [r for p in parts for r in part.get(p, ()) if list(r["names"]) == [name]]

    named, loud = own("named"), own("loud", "gain")
    ideal = {
        key: f"{chance(named, key):.2f}" if predicted(named) else "-" for key in ("alone", "inside", "size")
    }
    sizes = [len(sets(r)) for r in named if sets(r)] or [0]
    improvement = gained(own("gain"))
    return [
        name,
        count(named, found),
        _half(own("ladder", "named")),
        f"{count(named, right_alone)} ({ideal['alone']})",
        f"{count(named, holds)} ({ideal['inside']})",
        f"{np.mean(sizes):.1f} ({ideal['size']})",
        f"{count(loud, found)}, {count(loud, holds)}",
        _parameters(scores(own("named", "loud", "gain"))),
        f"{100 * improvement:.0f} %" if np.isfinite(improvement) else "-",
        ", ".join(_instead(name, named)),
    ]


def _half(known: Sequence[Row]) -> str:
    """Return the signal-to-noise of half detection: theory's, the measured one, and by how much it is off."""
    half, factor = [t["half"] for t in predicted(known)], against_ideal(known)
    if not half or factor is None:
        return "-"
    return f"{np.mean(half):.1f} / {np.mean(half) * factor[0]:.1f} ({off(factor)})"


def _parameters(z: np.ndarray) -> str:
    return f"{np.median(z):+.2f}, {100 * np.mean(np.abs(z) < 1.96):.0f} %, {z.size}" if z.size else "-"


def _instead(name: str, named: Sequence[Row]) -> list[str]:
    """Return what else was named, and the kinds of what was left unexplained."""
    kinds = {r["unexplained"]["kind"] for r in named if r["unexplained"]}
    return sorted(kinds.union(*map(asserted, named)) - {name})
