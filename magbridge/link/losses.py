"""Count the frames that are missing by the sequence numbers of each sender."""

from __future__ import annotations

from typing import Final

from magbridge.link.output import Announcer, Timers
from magbridge.mavlink.enums import MAV_SEVERITY

__all__ = ["Losses", "Numbers"]

LATE_FRAMES: Final = 64
"""Frames by which one may come late and no longer count as lost."""
ALL_FRAMES: Final = (1 << LATE_FRAMES) - 1
LOSS_INTERVAL_US = 10_000_000
"""µs over which a share is computed."""
MANY, LEAST = 0.01, 3
"""The share, and the number, of lost frames above which it is announced."""
WATCHED: Final = 16
"""Components that are watched."""


class Numbers:
    """The frames of one component.

    Attributes
    ----------
    received, lost : int
        Frames that came, and those that are missing.
    """

    __slots__ = ("_last", "_missing", "lost", "received")

    def __init__(self, first: int) -> None:
        self.received = self.lost = 0
        self._last = first
        self._missing = 0  # bit k: the frame k before the latest has not come

    def count(self, number: int) -> None:
        """Count a frame. A late frame is no longer lost; a duplicate changes nothing."""
        self.received += 1
        ahead = (number - self._last + 128) % 256 - 128
        if -LATE_FRAMES < ahead <= 0:
            late = self._missing & 1 << -ahead
            self.lost -= late != 0
            self._missing ^= late
            return
        # far behind: the sender restarted
        self.lost += max(ahead - 1, 0)
        self._missing = (self._missing << ahead | (1 << ahead) - 2) & ALL_FRAMES if ahead > 0 else 0
        self._last = number


class Losses:
    """Count the lost frames of each component of one vehicle, and report components that lose many.

    Parameters
    ----------
    system : int
    announcer, timers
        The link's.
    """

    def __init__(self, system: int, announcer: Announcer, timers: Timers) -> None:
        self._system, self._announcer, self._timers = system, announcer, timers
        self._numbers: dict[int, Numbers] = {}
        self._before: dict[int, tuple[int, int]] = {}

    def count(self, component: int, number: int, t_us: int) -> None:
        """Record a frame's number."""
        numbers = self._numbers.get(component)
        if numbers is None:
            if len(self._numbers) >= WATCHED:
                return
            if not self._numbers:
                self._timers.every("losses", LOSS_INTERVAL_US, self._look, t_us + LOSS_INTERVAL_US)
            numbers = self._numbers[component] = Numbers(number)
        numbers.count(number)

    def lost_frames(self, component: int) -> int:
        """Return how many frames of a component are lost."""
        numbers = self._numbers.get(component)
        return 0 if numbers is None else numbers.lost

    def _look(self, _: int) -> None:
        for component, numbers in self._numbers.items():
            received, lost = self._before.get(component, (0, 0))
            self._before[component] = numbers.received, numbers.lost
            received, lost = numbers.received - received, numbers.lost - lost
            if lost >= LEAST and lost > MANY * (received + lost):
                # a router keeps back frames for other receivers
                who = f"{self._system}:{component}"
                text = f"{who}: over {MANY:.0%} of its frames missing, or for others"
                self._announcer.state(f"losses {component}", text, MAV_SEVERITY.WARNING)
            elif received and not lost:
                self._announcer.forget(f"losses {component}")
