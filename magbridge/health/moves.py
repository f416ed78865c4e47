"""Jumps of the level that nothing explains: what follows is doubtful, and for how long.

While their sum is not nothing, a sample is flagged, and its sigma is the largest of them. Once it is, sigma
remembers: a minute at first, an hour where a mass moved, four times longer each time it comes again, and as
long as the jump itself lasted; no more than an hour, or a day where a mass moved.
"""

from __future__ import annotations

from typing import Final

from magbridge.health.notices import Notices

__all__ = ["Moves"]

LASTING_US: Final = 120_000_000
"""µs after which a jump is no passing thing."""
HOLD_US: Final = 60_000_000
LONG_US: Final = 3_600_000_000
LONGEST_US: Final = 86_400_000_000
"""µs for which a jump that came back is remembered: at first, and at most; hours where a mass moved."""


class Moves:
    """The jumps so far.

    Attributes
    ----------
    away : bool
        The level is another than before the first.
    """

    def __init__(self, notices: Notices) -> None:
        self._notices = notices
        self.away = False
        self._sum = self._largest = 0.0
        self._count = 0
        self._since_us = self._until_us = 0

    def take(self, time_us: int, by: float, nothing: float, *, by_mass: bool) -> None:
        """Take note that the level has moved `by` nT; a square of no more than `nothing` (nT²) is none."""
        if self._sum * self._sum <= nothing:
            self._since_us = time_us  # from here on it is another level
        elif time_us - self._since_us > LASTING_US:
            away_us = time_us - self._since_us
            self._until_us = max(self._until_us, time_us + min(away_us, LONG_US))
        self._sum += by
        self._largest = max(self._largest, abs(self._sum), abs(by))
        hold, most = (LONG_US, LONGEST_US) if by_mass else (HOLD_US, LONG_US)
        self._until_us = max(self._until_us, time_us + min(hold << min(2 * self._count, 20), most))
        self._count += 1
        if by_mass:
            text = f"field jumps by {by:+.0f} nT as a mass moves: calibration or telemetry wrong"
            self._notices.report("move", text)
        else:
            self._notices.report("jump", f"field jumps by {by:+.0f} nT, which no telemetry explains")

    def doubt(self, time_us: int, nothing: float) -> float:
        """Set :attr:`away`; return the variance (nT²) that the jumps add."""
        self.away = False
        if not self._count:
            return 0.0
        self.away = self._sum * self._sum > nothing
        if not self.away and time_us >= self._until_us:
            self._sum = self._largest = 0.0
        return self._largest * self._largest

    def forget(self) -> None:
        """Take note that another calibration explains them."""
        self._sum = self._largest = 0.0
        self._count = self._until_us = 0
