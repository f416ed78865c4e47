"""One sample after the other, judged by all checks."""

from __future__ import annotations

from math import inf
from typing import Final

from magbridge.health.axes import Axes
from magbridge.health.jump import GATE, Jump
from magbridge.health.level import Level
from magbridge.health.moves import Moves
from magbridge.health.notices import Notices
from magbridge.health.scatter import Scatter
from magbridge.records import Quality, Vector

__all__ = ["DOUBTFUL", "Plausibility"]

IMPLAUSIBLE: Final = int(Quality.IMPLAUSIBLE)
UNSTEADY: Final = int(Quality.MOVING | Quality.STALE_TELEMETRY | Quality.SATURATED | Quality.LATE_JOIN)
"""Flags of a sample by which no level is followed."""
DOUBTFUL: Final = UNSTEADY | IMPLAUSIBLE
"""Flags of one from which nothing is learned."""


class Plausibility:
    """Judges sample after sample.

    Parameters
    ----------
    noise : float
        nT, 1-sigma of a channel's noise by the calibration.
    notices : Notices, optional
        Takes what is found.
    level : float
        nT, the part of every sample's sigma that all share: it makes the field neither jump nor scatter.

    Attributes
    ----------
    flags : int
        Of the last sample: :class:`~magbridge.records.Quality` bits.
    fault : bool
        The last sample is an outlier, of a sensor at fault, or not of the Earth: no level, old or new.
    """

    def __init__(self, noise: float, notices: Notices | None = None, level: float = 0.0) -> None:
        self._shared = level * level
        self.flags = 0
        self.fault = False
        notices = notices or Notices()
        self.notices = notices.lines
        self._axes, self._level, self._moves = Axes(notices), Level(notices), Moves(notices)
        self._scatter = Scatter(noise, notices)
        self._jump = Jump(self._scatter, self._moves)

    def place(self, time_us: int, latitude: float, longitude: float) -> None:
        """Take where the vehicle is, deg; what passes for noise, and not for rock, depends on its speed."""
        self._scatter.place(time_us, latitude, longitude)

    def check(
        self,
        time_us: int,
        raw: Vector,
        total: float,
        sigma: float,
        quality: int,
        reference: float,
        reference_sigma: float,
    ) -> float:
        """Judge a sample: set :attr:`flags`, return the variance (nT²) to add to the field's.

        Parameters
        ----------
        time_us : int
            µs.
        raw : tuple of 3 float
            nT, the channels as the instrument sent them.
        total, sigma : float
            nT, the corrected total field and its 1-sigma.
        quality : int
            Flags so far.
        reference, reference_sigma : float
            nT, main field (NaN where the position is not known) and 1-sigma of the Earth's field about it.
        """
        self.flags = 0
        self.fault = True
        level, jump = self._level, self._jump
        doubtful = self._axes.stuck(raw)
        if not 0.0 <= total < inf:
            return 0.0
        steady = not quality & UNSTEADY
        more = level.check(time_us, total, sigma, reference, reference_sigma, steady)
        doubtful = doubtful or level.wrong
        jump.outlier = False
        if steady:
            apart: float = max(sigma * sigma - self._shared, 0.0) ** 0.5
            more += jump.check(time_us, total, apart, learn=not doubtful)
        else:
            jump.moved = True
        self.fault = doubtful or jump.outlier or time_us < level.until_us
        more += self._moves.doubt(time_us, GATE * GATE * self._scatter.variance)
        if self.fault or self._moves.away:
            self.flags = IMPLAUSIBLE
        return more + self._scatter.excess()

    def explain(self, by: float, *, jumps: bool) -> None:
        """Take note that another calibration moves the total field `by` nT, and may explain past jumps."""
        if by == by:  # noqa: PLR0124 - NaN
            self._jump.explain(by)
            self._scatter.explain(by)
        if jumps:
            self._jump.forget()
            self._moves.forget()
