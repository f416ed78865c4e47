"""Timers in event time."""

from __future__ import annotations

from collections.abc import Callable

__all__ = ["FOREVER", "Timers"]

FOREVER = 1 << 62


class Timers:
    """Calls the actions that are due, each with its own deadline and in the order of the deadlines.

    The result depends only on the times given to :meth:`advance`, not on when it is called: a replay, which
    calls it at other moments, fires the same timers at the same times.
    """

    def __init__(self) -> None:
        self._deadlines: dict[str, int] = {}
        self._what: dict[str, tuple[int, Callable[[int], None]]] = {}  # period and action
        self._next = ""
        self.next_deadline = FOREVER

    def every(self, name: str, period_us: int, action: Callable[[int], None], first_us: int) -> None:
        """Call ``action(deadline)`` at `first_us` and every `period_us` (a multiple of 4) from there."""
        self._set(name, first_us, max(period_us & ~3, 4), action)

    def at(self, name: str, time_us: int, action: Callable[[int], None]) -> None:
        """Call ``action(time_us)`` once."""
        self._set(name, time_us, 0, action)

    def cancel(self, name: str) -> None:
        """Remove a timer, if there is one."""
        self._deadlines.pop(name, None)
        if name == self._next:
            self._sort()

    def delay(self, name: str, by_us: int) -> None:
        """Fire a timer, if there is one, by so many µs (a multiple of 4) later."""
        if name in self._deadlines:
            self._deadlines[name] += by_us & ~3
            self._sort()

    def advance(self, t_us: int, begin: Callable[[int], None]) -> None:
        """Fire all that are due up to `t_us`, with ``begin(deadline)`` before each."""
        while self.next_deadline <= t_us:
            name, deadline = self._next, self.next_deadline
            period, action = self._what[name]
            if period:
                self._deadlines[name] = deadline + period
            else:
                del self._deadlines[name]
            self._sort()
            begin(deadline)
            action(deadline)

    def _set(self, name: str, deadline: int, period: int, action: Callable[[int], None]) -> None:
        self._deadlines[name], self._what[name] = deadline, (period, action)
        if name == self._next or deadline <= self.next_deadline:
            self._sort()

    def _sort(self) -> None:
        """Find the next timer; of two with the same deadline, the one that was set first."""
        self._next = min(self._deadlines, key=self._deadlines.__getitem__, default="")
        self.next_deadline = self._deadlines.get(self._next, FOREVER)
