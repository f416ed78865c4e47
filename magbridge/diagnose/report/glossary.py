"""What the page's names mean, for a reader who meets them for the first time."""

from __future__ import annotations

import re
from collections.abc import Iterable

__all__ = ["TRIALS", "legend"]

TRIALS = (
    "In blind trials on simulated deployments one log in a hundred with nothing hidden in it gave a false "
    "alarm. A hidden cause of the table was named alone and rightly in 97 % of the logs that allow it by "
    "theory. But a cause that was missing from the table got a wrong name in about a quarter of the cases, "
    "and effects invented afterwards did in more than a third"
)
"""What blind trials say of the names (``tools/study/README.md``)."""

TERMS = {
    r"[xyz]( |\d|$)": "x, y, z: along the sensor's axes, forward, starboard and down",
    r"[xyz]\d": "a digit after them: the power of what it follows",
    r"[xyz]{2}$": "xy: what the field along y does to channel x, and so on",
    r"lag": "lag: time constant with which the effect follows",
    r"origin": "origin: the value at which the effect is zero",
    r"onset": "onset: when it began",
    r"knee": "knee: the reading beyond which the channel clips",
    r"delay": "delay: by how much it is late",
    r"period": "period: of one oscillation",
    r"(cos|sin) ": "cos, sin: amplitudes of an oscillation's two phases",
    r"rms": "rms: its size over the whole log, where its many terms say little one by one",
}
"""Pattern of a term's name -> what it means."""


def legend(names: Iterable[str]) -> str:
    """Explain those names of terms that need it, in one line without its full stop."""
    names = list(names)
    return "; ".join(
        text for pattern, text in TERMS.items() if any(re.match(pattern, name) for name in names)
    )
