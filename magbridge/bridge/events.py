"""What happens to the bridge: everything it can know, and so everything a log must hold."""

from __future__ import annotations

import time

import msgspec

from magbridge.records import Channel

__all__ = ["Clock", "Event", "Start"]


class Start(msgspec.Struct, frozen=True):
    """All that a run depends on beside its configuration, its calibration and its events.

    Attributes
    ----------
    time_us : int
        µs since 1970 UTC, a multiple of 4.
    parameters : dict of str to float
        Values that a station set in earlier runs.
    signing_timestamp : int
        The last one that was used.
    """

    time_us: int
    parameters: dict[str, float] = {}
    signing_timestamp: int = 0


class Event(msgspec.Struct, frozen=True, gc=False):
    """Something that came in.

    Attributes
    ----------
    time_us : int
        µs since 1970 UTC when it was stamped at the edge; a multiple of 4, never decreasing.
    channel : Channel
        ``SENSOR``: bytes as read; ``LINK``: bytes as read; ``STATE``: one MAVLink frame of our own dialect
        that says what changed at the edge, or nothing when only time has passed.
    data : bytes
    """

    time_us: int
    channel: Channel
    data: bytes


class Clock:
    """The one clock: begins at the host's UTC and then runs steadily, whatever happens to the host's.

    A step of the host's clock is told apart (:meth:`step_us`), so that no interval is ever
    measured across it.
    """

    THRESHOLD_US = 50_000
    """Smaller differences are the host's own slewing, and are left alone."""

    AT_ONCE_US = 5_000
    """The host's two clocks are read within this, or again: a process may be held up between
    any two lines."""

    def __init__(self) -> None:
        self._offset_us = self._ahead_us()
        self._known_step_us = 0

    def now_us(self) -> int:
        """Return the time in µs, a multiple of 4."""
        return (time.monotonic_ns() // 1000 + self._offset_us) & ~3

    def step_us(self) -> int:
        """Return by how much the host's clock was set since this was last asked; 0 where it was not."""
        difference = self._ahead_us() - self._offset_us - self._known_step_us
        if abs(difference) < self.THRESHOLD_US:
            return 0
        self._known_step_us += difference
        return difference

    def _ahead_us(self) -> int:
        """Return by how much the host's UTC is ahead of its steady clock, right to `AT_ONCE_US`."""
        while True:
            before, utc, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
            if after - before < 1000 * self.AT_ONCE_US:
                return (utc - before) // 1000
