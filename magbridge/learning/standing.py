"""State of an alarm: when to announce it, when to learn its cause, and when it is cleared."""

from __future__ import annotations

from typing import Final

from magbridge.learning.causes import NO_COEFFICIENT, Alarm, named
from magbridge.records import Quality

__all__ = ["Standing"]

SURE: Final = 6.0
"""Least growth of an alarm's log-likelihood ratio before its cause is learned (6 = a factor of 400)."""
LOG_RATIO_PER_CAUSE: Final = 3.0
"""Additional growth required for each further cause that fits: more evidence often excludes causes, whereas
separating them after all were learned takes hours."""
MAX_WAIT_SAMPLES: Final = 128
"""Informative samples for each cause that fits, after which the decision is made at the latest."""
MIN_ALARM_GROWTH: Final = 2.0
"""Least growth of an alarm's log-likelihood ratio that updates the alarm."""
QUIET: Final = 300
"""Informative samples without an alarm after which its cause is cleared."""


SLOWER: Final = 4
"""Factor by which each relapse multiplies the evidence and the samples required."""
SIGNIFICANT_SQUARE: Final = 16.0
"""Squared normalised error from which on a prediction error is significant."""


class Standing:
    """The current alarm, if any; `mapped` is True if the reference is a map.

    A relapse is an alarm that comes before the last learned cause has explained :data:`QUIET` informative
    samples. Alarms after a relapse continue the first one: it is announced once, and ends once a learned
    calibration has explained as many samples.

    Attributes
    ----------
    alarm : Alarm or None
        Alarm at its last update.
    flags : int
        ``unexplained`` during an alarm, or 0.
    variance : float
        Variance of the unexplained residual, nT².
    relapses : int
        Number of relapses.
    tried : bool
        True if the cause was learned and no alarm has followed.
    pending : bool
        True if, in addition, later samples have not confirmed what was learned, so that it is not published.
    """

    def __init__(self, *, mapped: bool = False) -> None:
        self._mapped = mapped
        self._peak = self._since = 0.0
        self.end()

    def end(self) -> None:
        """Close the alarm."""
        self.alarm: Alarm | None = None
        self.flags, self.variance, self.relapses = 0, 0.0, 0
        self.tried = self.pending = False
        self._sure = 0.0
        self._doubted = self._quiet = 0
        self._explained = QUIET + 1

    @property
    def _slower(self) -> int:
        return int(SLOWER**self.relapses)

    def raised(self, alarm: Alarm) -> str:
        """Update the state with an alarm of the change detector; return the notification, or ""."""
        before = self.alarm
        anew = before is None or self.tried
        if before is not None and (alarm.mapless or before.mapless):
            if alarm.mapless and before.causes == alarm.causes:
                self.alarm, self._quiet = alarm, 0
            return ""  # a map error explains every further alarm
        if before is not None and not anew and alarm.strength < before.strength + MIN_ALARM_GROWTH:
            return ""
        if anew and self._explained <= QUIET:
            self.relapses += 1
        self._since = self._since if self.relapses else alarm.since
        self.alarm, self._quiet = alarm._replace(since=self._since), 0
        self.tried = self.pending = False
        self.flags = int(Quality.UNEXPLAINED)
        self._cover()
        if anew:
            self._doubted, self._sure = 0, alarm.strength + self._slower * SURE
        if before is not None:
            return ""
        return f"unexplained{' still' * bool(self.relapses)}: {alarm.size:.0f} nT, {named(alarm.causes)}"

    def take_up(self) -> None:
        """Record that the alarm's cause was learned, but is not published until it is confirmed."""
        self.tried = self.pending = True
        self._quiet = self._explained = 0
        self._cover()

    def restart(self) -> None:
        """Require new evidence to learn the alarm's cause, because learning restarts."""
        if self.alarm is not None:
            self.alarm = self.alarm._replace(strength=0.0)
        self._sure, self._doubted = self._slower * SURE, 0

    def confirmed(self) -> bool:
        """Record that what was learned is published; return True if the alarm is closed."""
        self.pending, self._quiet = False, 0
        if self.relapses:
            self._cover()
            return False
        self.end()
        self._explained = 0
        return True

    def mistaken(self) -> None:
        """Record that the learned calibration was rolled back."""
        if self.alarm is not None and not self.mapless:
            self.relapses, self.tried, self.pending = max(1, self.relapses), True, False
            self._explained = self._quiet = 0

    def count(self, error: float, variance: float, *, telling: bool) -> None:
        """Count a sample, with the published calibration's error (nT) and its predicted variance (nT²).

        `telling` is True if the sample is informative about the coefficients.
        """
        self._quiet += telling
        self._doubted += telling
        self._explained += telling
        seen = error * error - SIGNIFICANT_SQUARE * variance
        self._peak = max(self._peak * (1.0 - telling / QUIET), seen)
        if self.relapses and seen > 0.0:
            self._quiet = 0
        self._cover()

    def _cover(self) -> None:
        """Set the variance to that of the likeliest cause, and of the errors once a cause was learned."""
        learned = self.tried and not self.pending
        size = 0.0 if self.alarm is None or learned or self.mapless else self.alarm.size
        self.variance = max(size * size, self._peak if self.relapses or self.pending else 0.0)

    @property
    def mapless(self) -> bool:
        """True during a map alarm: an unmapped crustal field explains the data."""
        return self.alarm is not None and self.alarm.mapless

    @property
    def gone(self) -> bool:
        """True if the alarm has not been raised for :data:`QUIET` informative samples."""
        return self.alarm is not None and self._quiet > QUIET

    @property
    def learnable(self) -> bool:
        """True if there is an alarm whose cause coefficients can represent."""
        return self.alarm is not None and not NO_COEFFICIENT.issuperset(self.alarm.causes)

    @property
    def ripe(self) -> bool:
        """True if the evidence suffices to learn the alarm's cause."""
        if self.alarm is None or self.tried or not self.learnable:
            return False
        fit, slower = len(self.alarm.channels), self._slower
        sure = self.alarm.strength > self._sure + slower * LOG_RATIO_PER_CAUSE * (fit - 1)
        if self._mapped and "map_error" in self.alarm.causes:
            sure = False  # maps have sheets: the attitudes to come tell an offset from another level
        return sure or self._doubted > slower * MAX_WAIT_SAMPLES * fit
