"""Names, numbers, tables and figures as people read them: in plain text, or on the report's page."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from html import escape
from inspect import getdoc
from itertools import groupby
from math import floor, isfinite, log10
from operator import itemgetter

from magbridge.diagnose.alternatives import CompetingHypothesis
from magbridge.diagnose.causes import Cause
from magbridge.diagnose.columns import Candidate
from magbridge.diagnose.observed import Seen

__all__ = [
    "MAX_UNFOLDED_NUMBERS", "bold", "chance", "figure", "goes_with", "label", "listed", "measured",
    "names_of", "number", "physics", "row", "series_of", "sizes", "table",
]  # fmt: skip

SUPERSCRIPTS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
MAX_UNFOLDED_NUMBERS = 12
"""Numbers that a table shows unfolded."""


def label(cause: str, channel: str | None) -> str:
    """Return a cause as people read it."""
    return cause.replace("_", " ") + (f" ({channel})" if channel else "")


def names_of(competing: Sequence[CompetingHypothesis], joint: str = ", ") -> str:
    """Return causes as a list in words, the likeliest first."""
    return joint.join(
        label(hypothesis.candidate.cause, series_of(hypothesis.candidate)) for hypothesis in competing
    )


def series_of(candidate: Candidate) -> str | None:
    """Return the telemetry that a candidate follows, as people read it; None where it follows none."""
    several = len({channel for effect in candidate.effects for channel in effect.channels()}) > 1
    return "several together" if candidate.channel is None and several else candidate.channel


def number(value: float, digits: int = 3) -> str:
    """Write a number to so many significant digits without an exponent: 1070, not 1.07e+03; 2.00, not 2."""
    rounded = float(f"{value:.{digits}g}")
    if not rounded or not isfinite(rounded):
        return f"{rounded:g}"
    places = max(digits - 1 - floor(log10(abs(rounded))), 0)
    return f"{rounded:.{places}f}".replace("-", "\N{MINUS SIGN}")


def measured(value: float, sigma: float | None) -> str:
    """Write a number to the second digit of its sigma; without one (a count, a period), to four digits."""
    if not sigma or not isfinite(sigma):
        return f"{float(f'{value:.4g}'):g}"
    places = 1 - floor(log10(sigma))
    # an added 0 turns a value that was rounded to -0 into 0
    return f"{round(value, places) + 0.0:.{max(places, 0)}f}".replace("-", "\N{MINUS SIGN}")


def bold(candidate: Candidate) -> str:
    """Return a candidate's cause in bold, and its channel."""
    channel = series_of(candidate)
    return f"<b>{label(candidate.cause, None)}</b>" + (f" ({escape(channel)})" if channel else "")


def listed(competing: Sequence[CompetingHypothesis], joint: str = ", ") -> str:
    """Return causes as a list in words, the likeliest first."""
    return escape(names_of(competing, joint))


def goes_with(seen: Seen, *, share: bool = False) -> str:
    """Return what a signal is seen to follow, how late and along which axis; empty if neither."""
    axis = "along the field" if seen.axis == "field" else f"mostly along {seen.axis}" if seen.axis else ""
    if not seen.channel:
        return axis
    late = f"{seen.lag:g} s late" if seen.lag else ""
    much = f"in {100 * seen.share:.0f} % of its power" * share
    return ", ".join(part for part in (f"<code>{escape(seen.channel)}</code>", late, axis, much) if part)


def physics(cause: Cause) -> str:
    """Return the first line of the cause's docstring, with its formulas marked up."""
    line = escape((getdoc(cause.candidates) or "").splitlines()[0])
    parts = line.split("``")
    return "".join(f"<code>{part}</code>" if k % 2 else part for k, part in enumerate(parts))


def row(name: str, value: float, sigma: float | None, unit: str) -> str:
    """Return a number's row: name, value, sigma, unit; a time (s since 1970) as its date."""
    if name.startswith("onset"):
        shown, unit = datetime.fromtimestamp(value, UTC).strftime("%Y-%m-%d %H:%M:%S"), "UTC"
    else:
        shown = measured(value, sigma)
    within = f"± {measured(sigma, sigma)}" if sigma else ""
    return (
        f'<tr><td>{escape(name)}</td><td class="n">{shown}</td><td class="n">{within}</td>'
        f"<td>{escape(unit)}</td></tr>"
    )


def table(heads: Sequence[str], rows: Iterable[str]) -> str:
    """Return a table of rows under their heads; empty without rows."""
    header, body = "".join(f"<th>{one}</th>" for one in heads), "".join(rows)
    return f'<div class="wide" tabindex="0"><table><tr>{header}</tr>{body}</table></div>' * bool(body)


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
        ", ".join(f"{escape(name)} {number(size)}" for name, size, _ in same) + f" {escape(unit)}"
        for unit, same in groupby(shown, key=itemgetter(2))
    ]
    if len(shown) < len(seen):
        texts.append(f"and {len(seen) - len(shown)} more")
    return ", ".join(texts) or "no plausible size reaches it"


def figure(png: str | None, caption: str) -> str:
    """Return a picture (base64 of a PNG) below its caption, as HTML; nothing if there is none."""
    if png is None:
        return ""
    image = f'<img alt="{escape(caption)}" src="data:image/png;base64,{png}">'
    return f'<figure><figcaption>{caption}</figcaption><div class="wide" tabindex="0">{image}</div></figure>'
