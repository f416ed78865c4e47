"""Whether a channel is stuck, or stands at a limit: it repeats its number while the others change.

How often a healthy one may is learned: a coarse instrument repeats itself, `n` times in a row with the
probability ``p^n``.
"""

from __future__ import annotations

from math import log, nan
from typing import Final

from magbridge.health.notices import Notices
from magbridge.records import Vector

__all__ = ["Axes"]

REPEATS: Final = 256
"""Samples over which the share of repeated numbers is learned."""
RARELY: Final = 1e-9
"""Probability of a run of repeated numbers that a healthy axis does not show."""
NAMES: Final = "xyz"


class Axis:
    """One channel as the instrument sends it: whether it repeats itself."""

    __slots__ = ("last", "rail", "run", "share")

    def __init__(self) -> None:
        self.last = self.rail = nan
        self.run = 0
        self.share = 0.1  # of repeated numbers


class Axes:
    """The three channels."""

    def __init__(self, notices: Notices) -> None:
        self._notices = notices
        self._axes = (Axis(), Axis(), Axis())
        self._stood = False  # whether an axis has a rail

    def stuck(self, raw: Vector) -> bool:
        """Say whether an axis repeats its number while another changes, or stands where it once stuck."""
        first, second, third = self._axes
        x, y, z = raw
        same_x, same_y, same_z = x == first.last, y == second.last, z == third.last
        if not (same_x or same_y or same_z or self._stood):
            first.last, second.last, third.last = x, y, z
            first.run = second.run = third.run = 0
            first.share += (1e-3 - first.share) / REPEATS
            second.share += (1e-3 - second.share) / REPEATS
            third.share += (1e-3 - third.share) / REPEATS
            return False
        if same_x and same_y and same_z:
            return False
        stuck = self._repeats(0, first, x, same_x)
        stuck = self._repeats(1, second, y, same_y) or stuck
        return self._repeats(2, third, z, same_z) or stuck

    def _repeats(self, number: int, axis: Axis, value: float, same: bool) -> bool:
        if not same:
            axis.last, axis.run = value, 0
            axis.share += (1e-3 - axis.share) / REPEATS
            return abs(value) == axis.rail
        axis.run += 1
        if abs(value) != axis.rail and (axis.run < 4 or axis.run * log(axis.share) > log(RARELY)):
            axis.share += (1.0 - axis.share) / REPEATS
            return False
        axis.rail, self._stood = abs(value), True
        self._notices.report("axis", f"axis {NAMES[number]} stuck at {value:.0f} nT, or clipped there")
        return True
