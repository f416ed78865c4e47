"""Whether the corrected field changes as the vehicle turns, more than rock along a straight course does.

Rock knows nothing of the attitude. An offset, a gain or a mass that is wrong does: it makes steps in the
total field F where the vehicle turns, dives or climbs. From one anchor to the next, a minute or more later,
the field changes by ``e = F - F_a``. Without a fault that has the variance ``S = sigma^2 + sigma_a^2 + (r
dt)^2``, with the rate r that was learned where the field's direction in body axes stayed the same. Where it
did not, the sum ::

    c = max(0, c + e^2 / S - DRIFT)

stays small (Page 1954, *Continuous inspection schemes*, Biometrika 41:100). Beyond :data:`ALARM` the model
lacks something of the size of the largest e, which is the sigma until c is 0 again. Were S known exactly,
that came by chance once in ``exp(0.47 ALARM)`` turns: 0.47 is the root of ``(1 - 2 x)^-1/2 = exp(DRIFT x)``.
"""

from __future__ import annotations

from typing import Final

from magbridge.health.judge import DOUBTFUL
from magbridge.health.notices import Notices

__all__ = ["Turns"]

LAG_US: Final = 60_000_000
LONGEST_US: Final = 600_000_000
"""µs between two anchors: at least, for a turn takes half a minute; and at most, for rock comes with time."""
EVERY_US: Final = 1_000_000
"""µs from one look to the next."""
TURNED: Final = 0.2
"""Change of the unit vector that is a turn: 11 deg."""
LEAST: Final = 0.02
"""nT/s, 1-sigma, by which the field changes along a course, at least."""
FEW: Final = 4
STRAIGHT: Final = 64
"""Windows without a turn from which on the rate is known, and over which it is learned."""
CLIP: Final = 64.0
"""Times the usual that a square counts as, at most."""
DRIFT: Final = 3.0
ALARM: Final = 25.0
MOST: Final = 75.0
"""Of the sum, at most: as many turns without a fault as make it 0 end a doubt."""


class Turns:
    """Judges the total field from turn to turn.

    Parameters
    ----------
    notices : Notices, optional
        Takes what is found.
    """

    def __init__(self, notices: Notices | None = None) -> None:
        self._notices = notices or Notices()
        self.notices = self._notices.lines
        self._next_us = 0
        self._anchor_us = -LONGEST_US
        self._field, self._variance = 0.0, 0.0
        self._x = self._y = self._z = 0.0
        self._rate2, self._windows = 0.0, 0
        self._sum = self._largest = 0.0
        self._wrong = False

    def check(
        self, time_us: int, x: float, y: float, z: float, total: float, variance: float, quality: int
    ) -> float:
        """Look at a sample now and then; return the variance (nT²) to add to its field's.

        Parameters
        ----------
        time_us : int
            µs.
        x, y, z, total : float
            nT, the corrected vector and total field.
        variance : float
            nT², of the total field so far.
        quality : int
            Flags so far.
        """
        if quality & DOUBTFUL or 0 <= self._next_us - time_us <= EVERY_US or not total > 0.0:
            return self._largest if self._wrong else 0.0
        self._next_us = time_us + EVERY_US
        apart_us = time_us - self._anchor_us
        if apart_us >= LAG_US or apart_us < 0:
            x, y, z = x / total, y / total, z / total
            if 0 <= apart_us < LONGEST_US:
                dx, dy, dz = x - self._x, y - self._y, z - self._z
                turned = dx * dx + dy * dy + dz * dz > TURNED * TURNED
                self._learn(1e-6 * apart_us, total - self._field, variance + self._variance, turned)
            self._anchor_us, self._field, self._variance = time_us, total, variance
            self._x, self._y, self._z = x, y, z
        return self._largest if self._wrong else 0.0

    def explain(self, by: float) -> None:
        """Take note that another calibration moves the total field `by` nT: turns are judged anew."""
        self._field += by
        self._sum = self._largest = 0.0
        self._wrong = False

    def _learn(self, seconds: float, e: float, variance: float, turned: bool) -> None:
        """Take a window: its length (s), the change e (nT) of the field, and the variance of that, nT²."""
        if not turned:
            self._windows = min(self._windows + 1, STRAIGHT)
            rate2 = max(e * e / (seconds * seconds), LEAST * LEAST)
            if self._windows > FEW:
                rate2 = min(rate2, CLIP * self._rate2)
            self._rate2 += (rate2 - self._rate2) / self._windows
            return
        if self._windows < FEW:
            return
        rock = self._rate2 * (1.0 + FEW / self._windows) * seconds * seconds
        ratio = e * e / (variance + rock)
        self._sum = min(max(self._sum + min(ratio, CLIP) - DRIFT, 0.0), MOST)
        self._largest = max(self._largest, e * e) if self._sum else 0.0
        self._wrong = self._sum > (0.0 if self._wrong else ALARM)
        if self._wrong:
            size = self._largest**0.5
            self._notices.report(
                "turns", f"field changes by {size:.0f} nT in turns: offset, gain or a mass wrong"
            )
