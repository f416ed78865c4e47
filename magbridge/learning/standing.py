"""How a doubt stands: when it is news, when what is behind it is learned, and when it is gone."""

from __future__ import annotations

from typing import Final

from magbridge.learning.causes import NO_COEFFICIENT, Alarm, named
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


SLOWER: Final = 4
"""How many times as much evidence and patience each relapse asks for."""
SEEN: Final = 16.0
"""Variances of a prediction from which on its error is more than chance."""


class Standing:
    """The alarm that stands, if any; `mapped` is whether the reference is a map.

    What was learned was mistaken if the next alarm comes before it has explained :data:`QUIET` telling
    samples: a relapse. From then on it is one doubt, whatever is learned meanwhile: it is announced once, and
    ends once something has explained as many samples.

    Attributes
    ----------
    alarm : Alarm or None
        As it was last news.
    flags : int
        ``unexplained`` while it stands, or 0.
    variance : float
        nT², of what is not explained.
    relapses : int
        How often what was learned was mistaken.
    tried : bool
        What is behind the doubt was learned again, and has not been mistaken so far.
    """

    def __init__(self, *, mapped: bool = False) -> None:
        self._mapped = mapped
        self._peak = self._since = 0.0
        self.end()

    def end(self) -> None:
        """Let none stand."""
        self.alarm: Alarm | None = None
        self.flags, self.variance, self.relapses, self.tried = 0, 0.0, 0, False
        self._sure = 0.0
        self._doubted = self._quiet = 0
        self._explained = QUIET + 1

    @property
    def _slower(self) -> int:
        return int(SLOWER**self.relapses)

    def raised(self, alarm: Alarm) -> str:
        """Take an alarm that the doubt has raised; return what to say of it, if anything."""
        before = self.alarm
        anew = before is None or self.tried
        if before is not None and (alarm.mapless or before.mapless):
            if alarm.mapless and before.causes == alarm.causes:
                self.alarm, self._quiet = alarm, 0
            return ""  # what else is doubted is doubted by a wrong map
        if before is not None and not anew and alarm.strength < before.strength + MORE:
            return ""
        if anew and self._explained <= QUIET:
            self.relapses += 1
        self._since = self._since if self.relapses else alarm.since
        self.alarm, self.tried, self._quiet = alarm._replace(since=self._since), False, 0
        self.flags = int(Quality.UNEXPLAINED)
        self._cover()
        if anew:
            self._doubted, self._sure = 0, alarm.strength + self._slower * SURE
        if before is not None:
            return ""
        return f"unexplained{' still' * bool(self.relapses)}: {alarm.size:.0f} nT, {named(alarm.causes)}"

    def learned(self) -> bool:
        """Take note that what is behind the alarm was learned; return whether that ends the doubt."""
        self.tried, self._quiet = self.relapses > 0, 0
        if not self.tried:
            self.end()
        self._explained = 0
        return not self.tried

    def mistaken(self) -> None:
        """Take note that what was learned is not published any more."""
        if self.alarm is not None:
            self.relapses, self.tried = max(1, self.relapses), True
            self._explained = self._quiet = 0

    def count(self, error: float, variance: float, *, telling: bool) -> None:
        """Take note of the published calibration's error with a sample, nT, of a variance expected (nT²).

        `telling` is whether the sample tells something of the coefficients.
        """
        self._quiet += telling
        self._doubted += telling
        self._explained += telling
        seen = error * error - SEEN * variance
        self._peak = max(self._peak * (1.0 - telling / QUIET), seen)
        if self.relapses and seen > 0.0:
            self._quiet = 0
        self._cover()

    def _cover(self) -> None:
        """Let the variance cover the likeliest cause and, where that was mistaken, all that is seen."""
        size = 0.0 if self.alarm is None or self.tried or self.mapless else self.alarm.size
        self.variance = max(size * size, self._peak if self.relapses else 0.0)

    @property
    def mapless(self) -> bool:
        """Whether only the map is doubted, and rock that it does not show explains the data."""
        return self.alarm is not None and self.alarm.mapless

    @property
    def gone(self) -> bool:
        """Whether the alarm has not been news for long."""
        return self.alarm is not None and self._quiet > QUIET

    @property
    def learnable(self) -> bool:
        """Whether there is a doubt, behind which may be something to learn."""
        return self.alarm is not None and not NO_COEFFICIENT.issuperset(self.alarm.causes)

    @property
    def ripe(self) -> bool:
        """Whether it is time to learn what is behind the alarm."""
        if self.alarm is None or self.tried or not self.learnable:
            return False
        fit, slower = len(self.alarm.channels), self._slower
        sure = self.alarm.strength > self._sure + slower * COMPETING * (fit - 1)
        if self._mapped and "map_error" in self.alarm.causes:
            sure = False  # maps have sheets: the attitudes to come tell an offset from another level
        return sure or self._doubted > slower * PATIENCE * fit
