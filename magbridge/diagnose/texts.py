"""Numbers, names and sizes of a diagnosis as people read them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from math import floor, isfinite, log10
from operator import itemgetter

from magbridge.diagnose.columns import Candidate
from magbridge.diagnostics import number

SUPERSCRIPTS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
MAX_UNFOLDED_NUMBERS = 12
"""Numbers that a table shows unfolded."""


def label(cause: str, channel: str | None) -> str:
    """Return a cause as people read it."""
    return cause.replace("_", " ") + (f" ({channel})" if channel else "")


def names_of(candidates: Sequence[Candidate], joint: str = ", ") -> str:
    """Return causes as a list in words."""
    return joint.join(label(candidate.cause, series_of(candidate)) for candidate in candidates)


def series_of(candidate: Candidate) -> str | None:
    """Return the telemetry that a candidate follows, as people read it; None where it follows none."""
    several = len({channel for effect in candidate.effects for channel in effect.channels()}) > 1
    return "several together" if candidate.channel is None and several else candidate.channel


def measured(value: float, sigma: float | None) -> str:
    """Write a number to the second digit of its sigma; without one (a count, a period), to four digits."""
    if not sigma or not isfinite(sigma):
        return f"{float(f'{value:.4g}'):g}"
    places = 1 - floor(log10(sigma))
    # an added 0 turns a value that was rounded to -0 into 0
    return f"{round(value, places) + 0.0:.{max(places, 0)}f}".replace("-", "\N{MINUS SIGN}")


def chance(p_value: float) -> str:
    """Write a probability to one digit, without a place where a line could break: 0.002, 3·10⁻⁸."""
    if p_value > 1e-4:
        return f"{p_value:.1g}"
    digit, power = f"{max(p_value, 1e-99):.0e}".split("e-")
    return ("" if p_value > 1e-99 else "below ") + f"{digit}·10⁻{power.lstrip('0').translate(SUPERSCRIPTS)}"


def sizes(smallest: Mapping[str, tuple[float, str]]) -> str:
    """Return sizes in words from values and units by name; an infinite one is left out."""
    seen = [(name, size, unit) for name, (size, unit) in smallest.items() if isfinite(size)]
    shown = seen if len(seen) <= MAX_UNFOLDED_NUMBERS else seen[:3]
    texts = [
        ", ".join(f"{name} {number(size)}" for name, size, _ in same) + f" {unit}"
        for unit, same in groupby(shown, key=itemgetter(2))
    ]
    if len(shown) < len(seen):
        texts.append(f"and {len(seen) - len(shown)} more")
    return ", ".join(texts) or "no plausible size reaches it"
