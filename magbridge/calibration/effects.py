"""Effects: terms that depend on something other than the positions, some with a state.

An effect names its channels, says what its coefficients do with its regressors (`columns`), and computes the
regressors sample by sample (`begin` returns a stepper with a fresh state) or of a whole log (`batch`).

Here are what they share and the effect of one telemetry channel; the others are in :mod:`.mass_effects`,
:mod:`.memory_effects` and :mod:`.instrument_effects`.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, repeat
from math import exp, isnan
from operator import mul
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from msgspec import Meta

from magbridge.arrays import FloatArray
from magbridge.calibration.kernel import Kernel
from magbridge.calibration.terms import Effect, Power, Series, Step

__all__ = ["MAX_INTERVAL", "ChannelEffect", "SingleChannelEffect", "held", "lagged", "offsets", "powers"]

MAX_INTERVAL = 60_000_000
"""µs; over a longer gap no rate of change is computed."""


def offsets(regressors: int) -> FloatArray:
    """Return columns (3 r, r, 9): each regressor adds to T with three coefficients of its own."""
    columns = np.zeros((3 * regressors, regressors, 9))
    for r in range(regressors):
        columns[3 * r : 3 * r + 3, r, 6:9] = np.eye(3)
    return columns


def powers(x: Any, order: int) -> tuple[Any, ...]:
    """Return ``x, x^2, ... x^order`` of a number or an array: ``pow()`` is a hundred times as slow."""
    return tuple(accumulate(repeat(x, order), mul))


def held(values: FloatArray, before: float) -> FloatArray:
    """Return values (n,) with each NaN replaced by the last known value, or by `before`."""
    known = ~np.isnan(values)
    if known.all():
        return values
    last = np.maximum.accumulate(np.where(known, np.arange(1, len(values) + 1), 0))
    return np.append(before, values)[last]


def lagged(time: FloatArray, values: FloatArray, lag: float, stages: int = 1) -> FloatArray:
    """(n,) y that follows x through equal lags in series (:class:`ChannelEffect`), from equilibrium.

    Parameters
    ----------
    time, values : (n,) array
        s, and x.
    lag : float
        s, the sum of all stages; at 0, y is x.
    stages : int
        Number of lags in series.
    """
    if lag <= 0.0 or len(time) < 2:
        return values
    share = -np.expm1(-np.diff(time) / (lag / stages))
    usual = float(np.median(share))
    even = np.abs(share - usual).max() <= 1e-6 * usual  # no gaps, and a clock that does not jitter
    for _ in range(stages):
        values = _filtered(values, usual) if even else _stepped(values, share)
    return values


def _filtered(values: FloatArray, share: float) -> FloatArray:
    """(n,) ``y_t = y_(t-1) + s (x_t - y_(t-1))``."""
    from scipy.signal import lfilter  # noqa: PLC0415  (the live path starts without scipy)

    return np.asarray(lfilter([share], [1.0, share - 1.0], values, zi=[(1.0 - share) * values[0]])[0])


def _stepped(values: FloatArray, share: FloatArray) -> FloatArray:
    """Return the same (n,) with a fraction for each step, by doubling over 2, 4, 8 ... rows."""
    y, kept = np.append(values[0], share * values[1:]), np.append(0.0, 1.0 - share)
    step = 1
    while step < len(y):
        y[step:] = y[step:] + kept[step:] * y[:-step]
        kept[step:] = kept[step:] * kept[:-step]
        step *= 2
    return y


class SingleChannelEffect(Effect, frozen=True, kw_only=True):
    """An effect that depends on one telemetry channel."""

    channel: str
    """Name of the telemetry series."""

    @property
    def size(self) -> int:
        """Three coefficients, one for each axis."""
        return 3

    def channels(self) -> tuple[str, ...]:
        """Return the name of its channel."""
        return (self.channel,)


class ChannelEffect(SingleChannelEffect, frozen=True, kw_only=True):
    """Offset or scale proportional to a channel, at once or through lags in series."""

    kind: ClassVar[str] = "channel"
    origin: float = 0.0
    """Value of the channel at which the effect is zero (the temperature at calibration; 0 A)."""
    lag: Annotated[float, Meta(ge=0.0)] = 0.0
    """s, sum of the time constants of equal first-order lags in series, each ``dy/dt = (x - y) / (lag /
    stages)``; 0: no lag."""
    stages: Power = 1
    """Number of lags in series: 1 for a single heat store, 2 for one that is heated through another."""
    on: Literal["offset", "scale"] = "offset"
    """``offset``: three coefficients, nT per unit of the channel, added to T. ``scale``: three, added to the
    diagonal of ``a``, nT at F_0 per unit."""

    def columns(self, field: float) -> FloatArray:
        """One regressor, one slot for each axis."""
        columns = np.zeros((3, 1, 9))
        columns[:, 0, 6:9] = np.eye(3) * (self.on == "offset")
        columns[:, 0, 0:3] = np.eye(3) * (self.on == "scale")
        return columns

    def begin(self, channels: tuple[str, ...], kernel: Kernel) -> Step:
        """Return a stepper that starts in equilibrium with the first value it sees."""
        index = channels.index(self.channel)
        origin, stages, lag = self.origin, self.stages, self.lag / self.stages
        levels, then, first = [origin] * stages, 0, True

        def step(time_us: int, hx: float, hy: float, hz: float, values: Sequence[float]) -> tuple[float]:
            nonlocal then, first
            value = values[index]
            if not isnan(value):  # while the value is unknown, the last level holds
                if first or lag == 0.0:
                    levels[:], first = [value] * stages, False
                else:
                    share = 1.0 - exp((then - time_us) * 1e-6 / lag)
                    for k, level in enumerate(levels):
                        value = levels[k] = level + (value - level) * share
                then = time_us
            return (levels[-1] - origin,)

        return step

    def batch(self, series: Series) -> FloatArray:
        """(1, n) regressors; 0 before the first value."""
        values = series.values[self.channel]
        known = np.flatnonzero(~np.isnan(values))
        out = np.full(len(values), np.nan)
        out[known] = lagged(series.time[known], values[known], self.lag, self.stages) - self.origin
        return held(out, 0.0)[None]
