"""Names and numbers as people read them, in plain text."""

from __future__ import annotations

from collections.abc import Sequence
from math import floor, isfinite, log10

from magbridge.diagnose.causes.candidates import Candidate
from magbridge.diagnose.inference.competing import CompetingHypothesis

__all__ = ["label", "measured", "names_of", "number", "series_of"]


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
    # an added 0 turns what was rounded to -0 into 0
    return f"{round(value, places) + 0.0:.{max(places, 0)}f}".replace("-", "\N{MINUS SIGN}")
