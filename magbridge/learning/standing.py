"""How a doubt stands: when it is news, when what is behind it is learned, and when it is gone."""

from __future__ import annotations

from typing import Final

from magbridge.learning.doubt import Alarm
from magbridge.records import Quality

__all__ = ["Standing"]

SURE: Final = 6.0
"""By which a doubt's log-likelihood ratio has to grow until it is learned what is behind it."""
COMPETING: Final = 3.0
"""And by which more for each further cause that fits: a bit more evidence often leaves fewer of them, where
sorting out what was learned of all takes hours."""
PATIENCE: Final = 128
"""Telling samples for each cause that fits, after which that is decided at the latest."""
MORE: Final = 2.0
"""By which an alarm's log-likelihood ratio has to grow to be news."""
QUIET: Final = 300
"""Telling samples without an alarm after which its cause is gone."""


class Standing:
    """The alarm that stands, if any.

    Attributes
    ----------
    alarm : Alarm or None
        As it was last news.
    flags : int
        ``unexplained`` while it stands, or 0.
    variance : float
        nT², of what is not explained.
    """

    def __init__(self) -> None:
        self.end()

    def end(self) -> None:
        """Let none stand."""
        self.alarm: Alarm | None = None
        self.flags, self.variance = 0, 0.0
        self._sure = 0.0
        self._doubted = self._quiet = 0

    def raised(self, alarm: Alarm) -> str:
        """Take an alarm that the doubt has raised; return what to say of it, if anything."""
        standing = self.alarm
        if standing is not None and alarm.strength < standing.strength + MORE:
            return ""
        self.alarm, self._quiet = alarm, 0
        self.flags, self.variance = int(Quality.UNEXPLAINED), alarm.size**2
        if standing is None:
            self._doubted, self._sure = 0, alarm.strength + SURE
            names = " or ".join(alarm.causes[:2]).replace("_", " ")
            return f"unexplained: {alarm.size:.0f} nT, {names}"
        if standing.causes != alarm.causes and len(alarm.causes) == 1:
            return f"unexplained: it is {alarm.causes[0].replace('_', ' ')}"
        return ""

    def count(self, *, telling: bool) -> None:
        """Take note of a sample that tells something of the coefficients, or does not."""
        self._quiet += telling
        self._doubted += telling

    @property
    def gone(self) -> bool:
        """Whether the alarm has not been news for long."""
        return self.alarm is not None and self._quiet > QUIET

    @property
    def ripe(self) -> bool:
        """Whether it is time to learn what is behind the alarm."""
        if self.alarm is None:
            return False
        fit = len(self.alarm.channels)
        return self.alarm.strength > self._sure + COMPETING * (fit - 1) or self._doubted > PATIENCE * fit
