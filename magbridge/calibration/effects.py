"""Effects: terms that follow something else than the positions, some with a memory.

An effect names its channels, says what its coefficients do with its regressors (`columns`), and
steps one sample at a time (`begin` gives a stepper with a fresh state). Live and batch run the same
stepper, so both give the same bits.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, isnan
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from magbridge.calibration.terms import Effect, Power, Step

if TYPE_CHECKING:
    from magbridge.calibration.model import Calibration

__all__ = ["ChannelEffect", "Follower"]

FloatArray = NDArray[np.float64]


class Follower(Effect, frozen=True, kw_only=True):
    """An effect of one channel.

    Attributes
    ----------
    cause : str
        What it stands for, as in ``findings.json``.
    channel : str
        The telemetry that it follows.
    """

    cause: str
    channel: str

    @property
    def size(self) -> int:
        """One for each axis."""
        return 3

    def channels(self) -> tuple[str, ...]:
        """Name the one that it follows."""
        return (self.channel,)


class ChannelEffect(Follower, frozen=True, kw_only=True):
    """Offset or scale that follows a channel, at once or through lags in series.

    Attributes
    ----------
    origin : float
        Where the channel does nothing (the temperature at calibration; 0 A).
    lag : float
        s, by how much it is behind in all, of a number of equal first-order lags
        ``dy/dt = (x - y) / (lag / stages)``; 0: at once.
    stages : int
        How many stand in series, each following the one before: 1, a single store of heat; 2, what heat
        reaches through another.
    on : {"offset", "scale"}
        ``offset``: three coefficients, nT per unit of the channel, added to T. ``scale``: three,
        added to the diagonal of ``a``, nT at F_0 per unit.
    """

    kind: ClassVar[str] = "channel"
    origin: float = 0.0
    lag: Annotated[float, Meta(ge=0.0)] = 0.0
    stages: Power = 1
    on: Literal["offset", "scale"] = "offset"

    def columns(self, field: float) -> FloatArray:  # noqa: ARG002  (others need it)
        """One regressor, one slot for each axis."""
        columns = np.zeros((3, 1, 9))
        columns[:, 0, 6:9] = np.eye(3) * (self.on == "offset")
        columns[:, 0, 0:3] = np.eye(3) * (self.on == "scale")
        return columns

    def begin(self, calibration: Calibration) -> Step:
        """Return a stepper that starts in equilibrium with the first value it sees."""
        index = calibration.channels.index(self.channel)
        origin, stages, lag = self.origin, self.stages, self.lag / self.stages
        levels, then, first = [origin] * stages, 0, True

        def step(time_us: int, hx: float, hy: float, hz: float, values: Sequence[float]) -> tuple[float]:
            nonlocal then, first
            value = values[index]
            if not isnan(value):  # without a value the last level holds
                if first or lag == 0.0:
                    levels[:], first = [value] * stages, False
                else:
                    share = 1.0 - exp((then - time_us) * 1e-6 / lag)
                    for k, level in enumerate(levels):
                        value = levels[k] = level + (value - level) * share
                then = time_us
            return (levels[-1] - origin,)

        return step
