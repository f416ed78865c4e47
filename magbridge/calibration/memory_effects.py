"""Effects of where moving masses came from: backlash or remanence, and telemetry that is late."""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan, tanh
from operator import sub
from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta

from magbridge.arrays import FloatArray
from magbridge.calibration.effects import MAX_INTERVAL, held, powers
from magbridge.calibration.kernel import Kernel
from magbridge.calibration.mass_effects import MassEffect
from magbridge.calibration.terms import MAX_ORDER, Effect, Series, Step, Width

__all__ = ["ClockEffect", "PlayEffect", "play"]


class PlayEffect(MassEffect, frozen=True, kw_only=True):
    """Backlash or remanence: ``T += c (S(y) - S(p)) / width``, y the play operator of the channel p.

    ``y = min(max(y, p - width / 2), p + width / 2)``: y lags behind p by up to half the width, on the side
    from which the mass came. A drive's backlash makes a loop of constant width (S linear). Steel near the
    path is remagnetised only while the mass is near (Preisach relays of one width about one place), so its
    loop closes farther away: ``S(v) = scale tanh((v - centre) / scale)``, a generalised play (Brokate &
    Sprekels 1996, *Hysteresis and Phase Transitions*, sec. 2.1 and 2.4).

    Attributes
    ----------
    width : float
        In the channel's unit.
    centre, scale : float
        Position of the steel, and how far its effect reaches, in the channel's unit. With a scale far beyond
        the travel S is linear, as for backlash.
    order : int
        0: S as above. In older files, the highest power of a polynomial in its place:
        ``sum_k c_k (v^k - x^k)`` with ``v = (y - centre) / scale`` and ``x = (p - centre) / scale``.
    """

    kind: ClassVar[str] = "play"
    width: Width
    order: Annotated[int, Meta(ge=0, le=MAX_ORDER)] = 0

    @property
    def size(self) -> int:
        """Three coefficients (nT), one for each axis; for a polynomial, three for each power."""
        return 3 * max(self.order, 1)

    def begin(self, channels: tuple[str, ...], kernel: Kernel) -> Step:
        """Return a stepper that starts in the middle of its play."""
        index, centre, scale, width, order = (
            channels.index(self.channel), self.centre, self.scale, self.width, self.order
        )  # fmt: skip
        half, y, p, first = 0.5 * width, 0.0, 0.0, True

        def step(time_us: int, hx: float, hy: float, hz: float, values: Sequence[float]) -> tuple[float, ...]:
            nonlocal y, p, first
            if not isnan(values[index]):
                p = values[index]
                y = p if first else min(max(y, p - half), p + half)
                first = False
            if order:
                dragged, here = (powers((at - centre) / scale, order) for at in (y, p))
                return tuple(map(sub, dragged, here))
            return (scale * (tanh((y - centre) / scale) - tanh((p - centre) / scale)) / width,)

        return step

    def batch(self, series: Series) -> FloatArray:
        """(r, n) regressors; 0 before the first value."""
        values = series.values[self.channel]
        known = ~np.isnan(values)
        out = np.full((max(self.order, 1), len(values)), np.nan)
        p = values[known]
        dragged, here = ((at - self.centre) / self.scale for at in (play(p, self.width), p))
        if self.order:
            out[:, known] = np.stack(powers(dragged, self.order)) - np.stack(powers(here, self.order))
        else:
            out[0, known] = self.scale / self.width * (np.tanh(dragged) - np.tanh(here))
        return np.stack([held(row, 0.0) for row in out])


def play(values: FloatArray, width: float) -> FloatArray:
    """(n,) play operator of values, from the middle of the play (:class:`PlayEffect`).

    Each row clips the output of the row before. Two such clips in series are one clip, so they are combined
    by doubling: over 2, 4, 8 ... rows.
    """
    low, high = values - 0.5 * width, values + 0.5 * width
    low[:1] = high[:1] = values[:1]
    step = 1
    while step < len(values):
        bounds = low[step:].copy(), high[step:].copy()
        low[step:], high[step:] = (np.clip(x[:-step], *bounds) for x in (low, high))
        step *= 2
    return low


class ClockEffect(Effect, frozen=True, kw_only=True):
    """Telemetry that is late: ``theta += delay * dtheta/dp * dp/dt``, for all nine coefficients theta.

    The only coefficient is the delay: the time (s) by which the telemetry lags behind the field's samples.
    """

    kind: ClassVar[str] = "clock"
    sign: float = 1.0
    """1; or -1 if the delay is that of the field's samples behind the telemetry, as after a filter."""

    @property
    def size(self) -> int:
        """One delay."""
        return 1

    def columns(self, field: float) -> FloatArray:
        """One coefficient for nine regressors: the rates of change of the nine coefficients, nT/s."""
        return self.sign * np.eye(9)[None]

    def begin(self, channels: tuple[str, ...], kernel: Kernel) -> Step:
        """Return a stepper; rates are differences from the previous sample over the time between."""
        last: list[float] = []
        still, weights, then = (0.0,) * 9, kernel.rate_weights.T.tolist(), 0

        def step(time_us: int, hx: float, hy: float, hz: float, values: Sequence[float]) -> tuple[float, ...]:
            nonlocal last, then
            now, before, apart = kernel.monomials(values, 1.0), last, time_us - then
            last, then = now, time_us
            if now == before or not before or not 0 < apart < MAX_INTERVAL:
                return still
            rates = [(a - b) / (1e-6 * apart) for a, b in zip(now, before, strict=True)]
            return tuple(
                sum(rate * weight for rate, weight in zip(rates, column, strict=True)) for column in weights
            )

        return step

    def batch(self, series: Series) -> FloatArray:
        """(9, n) regressors."""
        monomials = np.stack(series.kernel.monomials([*series.values.values()], np.ones(len(series.time))))
        apart = 1e-6 * np.diff(series.time_us)
        joined = (apart > 0.0) & (apart < 1e-6 * MAX_INTERVAL)
        rates = np.zeros_like(monomials)
        rates[:, 1:] = np.where(joined, np.diff(monomials) / np.where(joined, apart, 1.0), 0.0)
        return np.asarray(series.kernel.rate_weights.T @ rates)
