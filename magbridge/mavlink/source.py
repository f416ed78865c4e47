"""Which component of a vehicle a value is taken from, where several send it."""

from __future__ import annotations

__all__ = ["Source"]


class Source:
    """Lets one value come from one component at a time: live, and when a bridge's log is read.

    That is the `wanted` one; else the first heard, but the autopilot goes before all others, and another
    takes its place when nothing has come for longer than `patience_us`.

    Parameters
    ----------
    autopilot : int
        Component of the autopilot.
    patience_us : int
        µs.
    wanted : int or None
        The only component that counts.

    Attributes
    ----------
    component : int or None
        Where the last value came from.
    """

    __slots__ = ("_autopilot", "_patience_us", "_received_us", "component", "wanted")

    def __init__(self, autopilot: int, patience_us: int, wanted: int | None = None) -> None:
        self._autopilot, self._patience_us, self.wanted = autopilot, patience_us, wanted
        self.component: int | None = None
        self._received_us = 0

    def admit(self, component: int, time_us: int) -> bool:
        """Return True if a value from `component` at `time_us` (µs) counts."""
        if component != self.component:
            if self.wanted is not None:
                if component != self.wanted:
                    return False
            elif (
                self.component is not None
                and component != self._autopilot
                and time_us - self._received_us <= self._patience_us
            ):
                return False
            self.component = component
        self._received_us = time_us
        return True
