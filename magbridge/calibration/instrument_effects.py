"""Effects of the instrument itself: time, the rate of change of the reading, a nonlinear response."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, pi, sin
from typing import Annotated, ClassVar, Literal

import numpy as np
from msgspec import Meta

from magbridge.arrays import FloatArray
from magbridge.calibration.effects import MAX_INTERVAL, offsets, powers
from magbridge.calibration.kernel import Kernel
from magbridge.calibration.terms import MAX_ORDER, Effect, LogSeries, Power, Step, Width

__all__ = ["RateEffect", "ResponseEffect", "TimeEffect"]


class TimeEffect(Effect, frozen=True, kw_only=True):
    """An offset that depends on time alone."""

    kind: ClassVar[str] = "time"
    remembers: ClassVar[bool] = False
    shape: Literal["step", "drift", "tone"]
    """Step: ``H(t - t_0)``. Drift: ``x = (t - t_0) / period`` and its powers, with x held at -1 and 1 beyond
    them, because nothing is known of a drift outside the time it was fitted to. Tone: ``cos`` and ``sin`` of
    ``2 pi (t - t_0) / period``."""
    start: Annotated[float, Meta(ge=-1e12, le=1e12)]
    """t_0, s since 1970 UTC."""
    period: Width = 86_400.0
    """Period of the slowest term, s."""
    order: Power = 1
    """Highest power of a drift."""

    @property
    def regressors(self) -> int:
        """Number of functions of time."""
        return {"step": 1, "drift": self.order, "tone": 2}[self.shape]

    @property
    def size(self) -> int:
        """Three coefficients (nT) for each function of time."""
        return 3 * self.regressors

    def columns(self, field: float) -> FloatArray:
        """Offsets."""
        return offsets(self.regressors)

    def begin(self, channels: tuple[str, ...], kernel: Kernel) -> Step:
        """Return a stepper; it has no state."""
        start, period, shape, order = round(self.start * 1e6), self.period * 1e6, self.shape, self.order

        def step(time_us: int, hx: float, hy: float, hz: float, values: Sequence[float]) -> tuple[float, ...]:
            if shape == "step":
                return (1.0 if time_us >= start else 0.0,)
            x = (time_us - start) / period
            if shape == "tone":
                return cos(2.0 * pi * x), sin(2.0 * pi * x)
            return powers(min(max(x, -1.0), 1.0), order)

        return step

    def batch(self, series: LogSeries) -> FloatArray:
        """Return (r, n) regressors."""
        after = series.time_us - round(self.start * 1e6)
        if self.shape == "step":
            return (after >= 0.0)[None].astype(float)
        x = after / (self.period * 1e6)
        if self.shape == "tone":
            return np.stack([np.cos(2.0 * pi * x), np.sin(2.0 * pi * x)])
        return np.stack(powers(np.clip(x, -1.0, 1.0), self.order))


class RateEffect(Effect, frozen=True, kw_only=True):
    """Offsets proportional to the rate of change of the reading, ``dH_r/dt``; coefficients in s.

    Notes
    -----
    Live, later samples are not known, so the rate is the second-order backward difference of three samples.
    """

    kind: ClassVar[str] = "rate"
    on: Literal["skew", "eddy"]
    """``skew``: each channel is sampled tau_i later than the log says, ``T_i = tau_i dH_i/dt``: three
    coefficients. ``eddy``: currents that a changing field drives, ``T_i = k_ij dH_j/dt``, i != j: six
    coefficients xy, xz, yx, yz, zx, zy (Tolles & Lawson 1950, in the notation of Leliak 1961)."""

    @property
    def size(self) -> int:
        """Number of coefficients (times, s)."""
        return {"skew": 3, "eddy": 6}[self.on]

    def columns(self, field: float) -> FloatArray:
        """Return three regressors, the rates of the three channels (nT/s)."""
        columns = np.zeros((self.size, 3, 9))
        if self.on == "skew":
            for k in range(3):
                columns[k, k, 6 + k] = 1.0
        else:
            # k_ij: channel j's rate adds to offset i.
            pairs = [(i, j) for i in range(3) for j in range(3) if i != j]
            for k, (i, j) in enumerate(pairs):
                columns[k, j, 6 + i] = 1.0
        return columns

    def begin(self, channels: tuple[str, ...], kernel: Kernel) -> Step:
        """Return a stepper; rates are zero until three samples have come without a gap."""
        before: tuple[float, float, float] = (0.0, 0.0, 0.0)
        slope: tuple[float, float, float] = (0.0, 0.0, 0.0)
        then, apart_before, count = 0, 0.0, 0

        def step(time_us: int, hx: float, hy: float, hz: float, values: Sequence[float]) -> tuple[float, ...]:
            nonlocal before, slope, then, apart_before, count
            if hx + hy + hz - (hx + hy + hz) != 0.0:  # NaN: as if the sample had not come
                return 0.0, 0.0, 0.0
            # Second-order backward difference: slope + (slope - previous slope) h / (h + previous h).
            apart = 1e-6 * (time_us - then)
            if count == 0 or not 0.0 < apart < 1e-6 * MAX_INTERVAL:
                before, then, count = (hx, hy, hz), time_us, 1
                return 0.0, 0.0, 0.0
            now = ((hx - before[0]) / apart, (hy - before[1]) / apart, (hz - before[2]) / apart)
            share = apart / (apart + apart_before) if count > 1 else 0.0
            x, y, z = [a + (a - b) * share for a, b in zip(now, slope, strict=True)]
            before, slope, then, apart_before, count = (hx, hy, hz), now, time_us, apart, 2
            return x, y, z

        return step

    def batch(self, series: LogSeries) -> FloatArray:
        """Return the same backward difference (3, n): a centred one shares less noise with its sample."""
        # Rates over the finite samples only, as the stepper skips the others.
        known = np.flatnonzero(np.isfinite(series.reading).all(axis=1))
        apart = 1e-6 * np.diff(series.time_us[known])
        joined = (apart > 0.0) & (apart < 1e-6 * MAX_INTERVAL)
        apart = np.where(joined, apart, 1.0)
        now = np.diff(series.reading[known], axis=0) * (joined / apart)[:, None]
        joined[:1], joined[1:] = False, joined[1:] & joined[:-1]
        share = joined * apart / (apart + np.roll(apart, 1))
        out = np.zeros((3, len(series.time)))
        out[:, known[1:]] = (now + (now - np.roll(now, 1, axis=0)) * share[:, None]).T
        return out


class ResponseEffect(Effect, frozen=True, kw_only=True):
    """A nonlinear response: a power of each channel's reading, or one channel with a knee."""

    kind: ClassVar[str] = "response"
    remembers: ClassVar[bool] = False
    unit: Annotated[float, Meta(ge=1.0, le=1e9)]
    """Unit of the coefficients, nT."""
    power: Annotated[int, Meta(ge=0, le=MAX_ORDER)] = 0
    """``T_i += c_i (H_i / unit)^power``: three coefficients, nT. 0: the response has a knee instead."""
    axis: Annotated[int, Meta(ge=0, le=2)] = 0
    """Index of the channel that has the knee."""
    knee: float = 0.0
    """Knee of the curve, nT, for either sign s. Where ``s H > s knee``, ``T -= s c_1 + c_2 (H - knee) /
    unit``: two coefficients, nT."""

    @property
    def size(self) -> int:
        """Three coefficients for a power, two for a knee."""
        return 3 if self.power else 2

    def columns(self, field: float) -> FloatArray:
        """For a power, each channel has a regressor of its own; for a knee, one channel has both."""
        columns = np.zeros((self.size, self.size, 9))
        for k in range(self.size):
            columns[k, k, 6 + (k if self.power else self.axis)] = 1.0 if self.power else -1.0
        return columns

    def begin(self, channels: tuple[str, ...], kernel: Kernel) -> Step:
        """Return a stepper; it has no state."""
        power, unit, axis, knee = self.power, self.unit, self.axis, self.knee
        sign = 1.0 if knee >= 0.0 else -1.0

        def step(time_us: int, hx: float, hy: float, hz: float, values: Sequence[float]) -> tuple[float, ...]:
            if power:
                return tuple((h / unit) ** power for h in (hx, hy, hz))
            # Beyond the knee: a step of c_1 and a slope of c_2.
            over = sign * ((hx, hy, hz)[axis] - knee)
            return (sign, sign * over / unit) if over >= 0.0 else (0.0, 0.0)

        return step

    def batch(self, series: LogSeries) -> FloatArray:
        """Return (r, n) regressors."""
        if self.power:
            return np.asarray(powers(series.reading.T / self.unit, self.power)[-1])
        sign = 1.0 if self.knee >= 0.0 else -1.0
        over = sign * (series.reading[:, self.axis] - self.knee)
        return np.where(over >= 0.0, [np.full_like(over, sign), sign * over / self.unit], 0.0)
