"""Events: all inputs of the bridge, which a log must therefore contain."""

from __future__ import annotations

import time

import msgspec

from magbridge.mavlink import Stream
from magbridge.mavlink.enums import MAG_PORT_NAME
from magbridge.records import Channel

__all__ = ["Event", "HostClock", "StartEvent", "port_number", "source_of"]


class StartEvent(msgspec.Struct, frozen=True):
    """State of a run in addition to its configuration, its calibration and its events."""

    time_us: int
    """µs since 1970 UTC, a multiple of 4."""
    parameters: dict[str, float] = {}
    """Values that a ground station set in earlier runs."""
    signing_timestamp: int = 0
    """The last that may have been used (units of 10 µs since 2015-01-01)."""
    signing_streams: list[Stream] = []
    """The last time stamp accepted of each signed stream."""


class Event(msgspec.Struct, frozen=True, gc=False):
    """One input of the bridge: bytes from a port, a change of state, or only the passing of time."""

    time_us: int
    """µs since 1970 UTC, when the live edge read it; a multiple of 4, never decreasing."""
    channel: Channel
    """``SENSOR``: bytes as read; ``LINK``: bytes as read; ``STATE``: one MAVLink frame of our own dialect
    that says what changed (a port, the host's clock, the log), or nothing when only time has passed."""
    data: bytes
    sensor_id: int = 0
    """``SENSOR``: which sensor."""


def port_number(sensor_id: int) -> int:
    """Return the MAG_PORT_NAME of a sensor's port."""
    return MAG_PORT_NAME.LOG + sensor_id if sensor_id else MAG_PORT_NAME.SENSOR


def source_of(port: int) -> tuple[Channel, int]:
    """Return channel and sensor id of the bytes that come from a port, by its MAG_PORT_NAME."""
    if port > MAG_PORT_NAME.LOG:
        return Channel.SENSOR, port - MAG_PORT_NAME.LOG
    return Channel(port), 0


class HostClock:
    """The bridge's only clock: starts at the host's UTC and follows the host's monotonic clock.

    A step of the host's UTC does not change it but is reported separately (:meth:`step_us`), so that no
    interval is ever measured across a step.
    """

    THRESHOLD_US = 50_000
    """Smaller differences are ignored: they come from the slewing of the host's clock."""

    AT_ONCE_US = 5_000
    """µs within which the host's two clocks must be read, else both are read again: a process may be held up
    between any two lines."""

    def __init__(self) -> None:
        self._offset_us = self._ahead_us()
        self._known_step_us = 0

    def now_us(self) -> int:
        """Return the time in µs, a multiple of 4."""
        return (time.monotonic_ns() // 1000 + self._offset_us) & ~3

    def step_us(self) -> int:
        """Return the step (µs) of the host's clock since the last call; 0 without one."""
        difference = self._ahead_us() - self._offset_us - self._known_step_us
        if abs(difference) < self.THRESHOLD_US:
            return 0
        self._known_step_us += difference
        return difference

    def _ahead_us(self) -> int:
        """Return by how many µs the host's UTC is ahead of its monotonic clock, to within `AT_ONCE_US`."""
        while True:
            before, utc, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
            if after - before < 1000 * self.AT_ONCE_US:
                return (utc - before) // 1000
