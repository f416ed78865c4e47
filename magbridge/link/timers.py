"""Timers in event time."""

from __future__ import annotations

from collections.abc import Callable

__all__ = ["FOREVER", "Timers"]

FOREVER = 1 << 62


class Timers:
    """Fires what is due, each at its own deadline and in the order of the deadlines.

    Nothing depends on when :meth:`advance` is called, only on the times it is given: a replay, which wakes at
    other moments, fires the same timers at the same times.
    """

    def __init__(self) -> None:
        self._timers: dict[str, tuple[int, int, Callable[[int], None]]] = {}
        self.next_deadline = FOREVER

    def every(self, name: str, period_us: int, action: Callable[[int], None], first_us: int) -> None:
        """Call ``action(deadline)`` at `first_us` and every `period_us` (a multiple of 4) from there."""
        self._timers[name] = (first_us, max(period_us & ~3, 4), action)
        self._sort()

    def at(self, name: str, time_us: int, action: Callable[[int], None]) -> None:
        """Call ``action(time_us)`` once."""
        self._timers[name] = (time_us, 0, action)
        self._sort()

    def cancel(self, name: str) -> None:
        """Forget a timer, if there is one."""
        self._timers.pop(name, None)
        self._sort()

    def advance(self, t_us: int, begin: Callable[[int], None]) -> None:
        """Fire all that are due up to `t_us`, with ``begin(deadline)`` before each."""
        while self.next_deadline <= t_us:
            name = min(self._timers, key=lambda one: self._timers[one][0])
            deadline, period, action = self._timers[name]
            if period:
                self._timers[name] = (deadline + period, period, action)
            else:
                del self._timers[name]
            begin(deadline)
            action(deadline)
            self._sort()

    def _sort(self) -> None:
        self.next_deadline = min((one[0] for one in self._timers.values()), default=FOREVER)
