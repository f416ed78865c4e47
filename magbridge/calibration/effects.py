"""Effects: terms of a calibration that depend on telemetry, time, the reading, or earlier positions.

Notes
-----
An effect names its channels (`channels`) and states how its coefficients map regressors to the slots
(`columns`). It computes the regressors sample by sample (`begin` returns the stepper, a function with a
state) or of a whole log (`batch`). A :class:`MomentaryEffect` has no state and uses one function for both.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from itertools import accumulate, repeat
from math import exp, isnan, pi, tanh
from operator import mul, sub
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from msgspec import Meta
from numpy.polynomial.legendre import leg2poly

from magbridge.arrays import FloatArray
from magbridge.calibration.kernel import Kernel
from magbridge.calibration.terms import MAX_ORDER, Effect, Exponents, LogSeries, Power, Step, Width
from magbridge.errors import CalibrationError

MAX_INTERVAL = 60_000_000
"""Longest gap over which a rate of change is computed, µs."""


def powers(x: Any, order: int) -> tuple[Any, ...]:
    """Return ``x, x^2, ... x^order`` of a number or an array, by products: ``pow()`` is slower."""
    return tuple(accumulate(repeat(x, order), mul))


def held(values: FloatArray, first: float) -> FloatArray:
    """Return values (n,) with each NaN replaced by the last known value, or by `first` at the start."""
    known = ~np.isnan(values)
    if known.all():
        return values
    # Index of the last known value at each row; 0 stands for `first`.
    last = np.maximum.accumulate(np.where(known, np.arange(1, len(values) + 1), 0))
    return np.append(first, values)[last]


def lagged(time: FloatArray, values: FloatArray, lag: float, stages: int = 1) -> FloatArray:
    """Return `values` (n,) filtered by equal first-order lags in series (:class:`ChannelEffect`).

    The filter starts in equilibrium with the first value. `time` (n,): s. `lag`: s, the sum of the time
    constants of all `stages`; with 0 the values are returned unchanged.
    """
    if lag <= 0.0 or len(time) < 2:
        return values
    from scipy.linalg.lapack import dtbtrs  # noqa: PLC0415  (the live path starts without scipy)

    # Exact solution for a step input: y moves by s = 1 - exp(-dt / tau) of its distance from x. So
    # y_t - (1 - s_t) y_(t-1) = s_t x_t, a bidiagonal system.
    share = -np.expm1(-np.diff(time) / (lag / stages))
    band = np.ones((2, len(time)))
    band[1, :-1] = share - 1.0
    for _ in range(stages):
        values = dtbtrs(band, np.append(values[0], share * values[1:]), uplo="L", diag="U")[0]
    return values


class MomentaryEffect(Effect, frozen=True, kw_only=True):
    """Effect without a state; the function that its :meth:`begin` returns accepts numbers and arrays."""

    remembers: ClassVar[bool] = False

    def batch(self, series: LogSeries) -> FloatArray:
        """Return the regressors (r, n) of a whole log."""
        step: Any = self.begin(tuple(series.values), series.kernel)
        rows = step(series.time_us, *series.reading.T, [*series.values.values()])
        return np.stack([np.broadcast_to(row, len(series.time)) for row in rows])


class SingleChannelEffect(Effect, frozen=True, kw_only=True):
    """Effect that depends on one telemetry channel."""

    channel: str
    """Name of the telemetry channel."""

    def channels(self) -> tuple[str, ...]:
        """Return the name of the effect's only channel."""
        return (self.channel,)


class ChannelEffect(SingleChannelEffect, frozen=True, kw_only=True):
    """Effect whose offset or scale is proportional to a channel, directly or through lags in series."""

    kind: ClassVar[str] = "channel"
    origin: float = 0.0
    """Value of the channel at which the effect is zero, such as the temperature at calibration or 0 A."""
    lag: Annotated[float, Meta(ge=0.0)] = 0.0
    """Sum of the time constants (s) of equal first-order lags in series, each ``dy/dt = (x - y) / (lag /
    stages)``; 0: no lag."""
    stages: Power = 1
    """Number of lags in series: 1 for a single heat store, 2 for a store that is heated through another."""
    on: Literal["offset", "scale"] = "offset"
    """``offset``: the three coefficients, nT per unit of the channel, add to T. ``scale``: they add to the
    diagonal of ``a``, in nT at F_0 per unit of the channel."""

    def columns(self, field: float) -> FloatArray:
        """Return the columns (3, 1, 9): the only regressor adds one coefficient to one slot of each axis."""
        columns = np.zeros((3, 1, 9))
        # Slots 6 to 8 are T (offset), slots 0 to 2 the diagonal of a (scale).
        columns[:, 0, 6:9] = np.eye(3) * (self.on == "offset")
        columns[:, 0, 0:3] = np.eye(3) * (self.on == "scale")
        return columns

    def begin(self, channels: tuple[str, ...], kernel: Kernel) -> Step:
        """Return a stepper that starts in equilibrium with the first known value of the channel."""
        index = channels.index(self.channel)
        origin, stages, lag = self.origin, self.stages, self.lag / self.stages
        levels, then, first = [origin] * stages, 0, True

        def step(time_us: int, hx: float, hy: float, hz: float, values: Sequence[float]) -> tuple[float]:
            nonlocal then, first
            value = values[index]
            if not isnan(value):  # while the value is unknown, the last level holds
                # Equilibrium at the start: a vehicle is switched on long before it dives.
                if first or lag == 0.0:
                    levels[:], first = [value] * stages, False
                else:
                    share = 1.0 - exp((then - time_us) * 1e-6 / lag)
                    for k, level in enumerate(levels):
                        value = levels[k] = level + (value - level) * share
                then = time_us
            return (levels[-1] - origin,)

        return step

    def batch(self, series: LogSeries) -> FloatArray:
        """Return the regressor (1, n) of a whole log; it is 0 before the first known value."""
        values = series.values[self.channel]
        known = np.flatnonzero(~np.isnan(values))
        out = np.full(len(values), np.nan)
        out[known] = lagged(series.time[known], values[known], self.lag, self.stages) - self.origin
        return held(out, 0.0)[None]


class MassEffect(SingleChannelEffect, frozen=True, kw_only=True):
    """Effect on the offset T of a mass whose position p is reported by one telemetry channel."""

    centre: float
    scale: Width
    """`centre`, `scale`: In the channel's unit; the scaled position is ``(p - centre) / scale``."""


class PathEffect(MassEffect, frozen=True, kw_only=True):
    """Effect on the offset T that depends only on the mass's present position, not on its path."""

    remembers: ClassVar[bool] = False

    @abstractmethod
    def regressors(self, x: Any) -> tuple[Any, ...]:
        """Return the regressors at the scaled position x, a number or an array."""

    def begin(self, channels: tuple[str, ...], kernel: Kernel) -> Step:
        """Return a stepper that uses the last known value of the channel while the value is NaN."""
        index, x = channels.index(self.channel), 0.0

        def step(time_us: int, hx: float, hy: float, hz: float, values: Sequence[float]) -> tuple[float, ...]:
            nonlocal x
            if not isnan(values[index]):
                x = (values[index] - self.centre) / self.scale
            return self.regressors(x)

        return step

    def batch(self, series: LogSeries) -> FloatArray:
        """Return the regressors (r, n) of a whole log."""
        return np.stack(self.regressors(held((series.values[self.channel] - self.centre) / self.scale, 0.0)))


class PowersEffect(PathEffect, frozen=True, kw_only=True):
    """Polynomial offset of a mass that another channel moves: ``T += sum_k c_k x^k``.

    Here ``x = (p - centre) / scale``. A permanent moment m on a mass at ``r(p)`` causes the field ``G(r(p))
    m`` (see :mod:`.dipole`), which is a power series in p.
    """

    kind: ClassVar[str] = "powers"
    order: Power = 1
    """Highest power."""

    @property
    def regressor_count(self) -> int:
        """Number of powers."""
        return self.order

    def regressors(self, x: Any) -> tuple[Any, ...]:
        """Return the powers of x from 1 to `order`."""
        return powers(x, self.order)


class SourcesEffect(PathEffect, frozen=True, kw_only=True):
    """Offset by iron near the path of a mass: ``T += sum_k c_k (1 + x_k^2)^(-3/2)``.

    Here ``x_k = (p - centre) / scale - k apart``. Iron that the mass magnetises, or that magnetises the mass,
    causes a field that falls with the cube of their distance. A row of sources near the path can cause the
    same field as iron at an unknown position: an equivalent layer (Dampney 1969, Geophysics 34:39). `centre`
    is the position of the first source, and `scale` the distance of all sources from the path.
    """

    kind: ClassVar[str] = "sources"
    apart: Width
    """Distance between neighbouring sources, in units of `scale`."""
    count: Power = 1
    """Number of sources."""

    @property
    def regressor_count(self) -> int:
        """Number of sources."""
        return self.count

    def regressors(self, x: Any) -> tuple[Any, ...]:
        """Return the regressor of each source at the scaled position x."""
        # (1 + x_k^2)^(-3/2) without a power of a non-integer exponent.
        near = [1.0 / (1.0 + (x - self.apart * k) ** 2) for k in range(self.count)]
        return tuple(one * one**0.5 for one in near)


class LegendreEffect(MomentaryEffect, frozen=True, kw_only=True):
    """Offset by a higher power of the calibration's own positions: ``T += c prod_k P_e_k(x_k)``.

    P_e is the Legendre polynomial of degree e. It is proportional to the residual of x^e after a fit of all
    lower powers over the calibrated travel.
    """

    kind: ClassVar[str] = "legendre"
    exponents: Exponents
    """Degree e_k for each parameter, whose positions x_k are scaled by the calibration."""

    def check(self, parameters: tuple[str, ...]) -> None:
        """Raise CalibrationError unless each parameter has an exponent >= 0, with a sum of at most 30."""
        if len(self.exponents) != len(parameters):
            raise CalibrationError(f"legendre: expected {len(parameters)} exponents, one for each parameter")
        if min(self.exponents, default=0) < 0 or sum(self.exponents) > MAX_ORDER:
            raise CalibrationError(f"legendre: expected exponents >= 0, together at most {MAX_ORDER}")

    def begin(self, channels: tuple[str, ...], kernel: Kernel) -> Step:
        """Return a function that computes the product of the polynomials, by Horner's scheme."""
        factors = [
            (k, kernel.centre[k], kernel.scale[k], leg2poly([0.0] * e + [1.0])[::-1].tolist())
            for k, e in enumerate(self.exponents)
            if e
        ]

        def step(time_us: int, hx: Any, hy: Any, hz: Any, values: Sequence[Any]) -> tuple[Any]:
            product: Any = 1.0
            for k, centre, scale, polynomial in factors:
                x, value = (values[k] - centre) / scale, 0.0
                for c in polynomial:
                    value = value * x + c
                product = product * value
            return (product,)

        return step


class PlayEffect(MassEffect, frozen=True, kw_only=True):
    """Offset by backlash or remanence: ``T += c (S(y) - S(p)) / width``.

    y is the play operator (backlash) of the channel p, ``y = min(max(y, p - width / 2), p + width / 2)``. It
    lags behind p by up to half the width, on the side from which the mass came. A drive's backlash causes a
    loop of constant width (S linear). Steel near the path is remagnetised only while the mass is near, so its
    loop closes farther away. S is then ``S(v) = scale tanh((v - centre) / scale)``, a generalised play
    (Brokate & Sprekels 1996, *Hysteresis and Phase Transitions*, sec. 2.1 and 2.4).

    `centre` is the position of the steel, `scale` the range of its effect; beyond the travel S is linear.
    """

    kind: ClassVar[str] = "play"
    width: Width
    """Width of the loop, in the channel's unit."""
    order: Annotated[int, Meta(ge=0, le=MAX_ORDER)] = 0
    """0: S as above. Older files have the highest power of a polynomial instead: ``sum_k c_k (v^k - x^k)``
    with ``v = (y - centre) / scale`` and ``x = (p - centre) / scale``."""

    @property
    def regressor_count(self) -> int:
        """Number of regressors: one, or one for each power of a polynomial."""
        return max(self.order, 1)

    def begin(self, channels: tuple[str, ...], kernel: Kernel) -> Step:
        """Return a stepper that starts with ``y = p`` at the first known value, the middle of the play."""
        index, centre, scale, width, order = (
            channels.index(self.channel), self.centre, self.scale, self.width, self.order
        )  # fmt: skip
        half, y, p, first = 0.5 * width, 0.0, 0.0, True

        def step(time_us: int, hx: float, hy: float, hz: float, values: Sequence[float]) -> tuple[float, ...]:
            nonlocal y, p, first
            if not isnan(values[index]):
                p = values[index]
                # Play operator: y moves only where p leaves the dead band.
                y = p if first else min(max(y, p - half), p + half)
                first = False
            if order:
                dragged, here = (powers((at - centre) / scale, order) for at in (y, p))
                return tuple(map(sub, dragged, here))
            return (scale * (tanh((y - centre) / scale) - tanh((p - centre) / scale)) / width,)

        return step

    def batch(self, series: LogSeries) -> FloatArray:
        """Return the regressors (r, n) of a whole log; they are 0 before the first known value."""
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
    """Return the play operator y (n,) of `values` (n,), starting at the first value (:class:`PlayEffect`).

    Each row clips the output of the previous row. Two clips are one clip: combine 2, 4, 8 ... rows.
    """
    # Row t clips the output of row t - 1 to [p - w/2, p + w/2]; the first row begins in the middle.
    low, high = values - 0.5 * width, values + 0.5 * width
    low[:1] = high[:1] = values[:1]
    step = 1
    while step < len(values):
        bounds = low[step:].copy(), high[step:].copy()
        low[step:], high[step:] = (np.clip(x[:-step], *bounds) for x in (low, high))
        step *= 2
    return low


class ClockEffect(Effect, frozen=True, kw_only=True):
    """Effect of delayed telemetry: ``theta += delay * dtheta/dp * dp/dt``, for all nine slots theta.

    The only coefficient is the delay: the time (s) by which the telemetry lags behind the field's samples.
    """

    kind: ClassVar[str] = "clock"
    sign: float = 1.0
    """1 if the telemetry lags behind the field's samples, -1 if the samples lag, as after a filter."""

    def columns(self, field: float) -> FloatArray:
        """Return the columns (1, 9, 9): the delay multiplies the rate of change (nT/s) of each slot."""
        return self.sign * np.eye(9)[None]

    def begin(self, channels: tuple[str, ...], kernel: Kernel) -> Step:
        """Return a stepper that computes the rates of the nine slots as backward differences."""
        last: list[float] = []
        still, weights, then = (0.0,) * 9, kernel.rate_weights.T.tolist(), 0

        def step(time_us: int, hx: float, hy: float, hz: float, values: Sequence[float]) -> tuple[float, ...]:
            nonlocal last, then
            # d theta / dt = W^T d phi / dt, with the backward difference of the monomials.
            now, before, apart = kernel.monomials(values, 1.0), last, time_us - then
            last, then = now, time_us
            if now == before or not before or not 0 < apart < MAX_INTERVAL:
                return still
            rates = [(a - b) / (1e-6 * apart) for a, b in zip(now, before, strict=True)]
            return tuple(
                sum(rate * weight for rate, weight in zip(rates, column, strict=True)) for column in weights
            )

        return step

    def batch(self, series: LogSeries) -> FloatArray:
        """Return the regressors (9, n) of a whole log: the rates of change of the nine slots, nT/s."""
        # Backward difference, as in the stepper; across a gap or at a repeated time the rate is zero.
        monomials = np.stack(series.kernel.monomials([*series.values.values()], np.ones(len(series.time))))
        apart = 1e-6 * np.diff(series.time_us)
        joined = (apart > 0.0) & (apart < 1e-6 * MAX_INTERVAL)
        rates = np.zeros_like(monomials)
        rates[:, 1:] = np.where(joined, np.diff(monomials) / np.where(joined, apart, 1.0), 0.0)
        return np.asarray(series.kernel.rate_weights.T @ rates)


# ---- Effects of the instrument: time, the rate of change of the reading, a nonlinear response ----


class TimeEffect(MomentaryEffect, frozen=True, kw_only=True):
    """Offset that depends on time only."""

    kind: ClassVar[str] = "time"
    shape: Literal["step", "drift", "tone"]
    """``step``: 1 from t_0 on. ``drift``: the powers of ``x = (t - t_0) / period``; x is limited to -1 and 1,
    because a drift is unknown outside the time of its fit. ``tone``: ``cos`` and ``sin`` of ``2 pi (t - t_0)
    / period``."""
    start: Annotated[float, Meta(ge=-1e12, le=1e12)]
    """Time t_0, s since 1970 UTC."""
    period: Width = 86_400.0
    """Period of a tone, or time in which x of a drift changes by 1, s."""
    order: Power = 1
    """Highest power of a drift."""

    @property
    def regressor_count(self) -> int:
        """Number of functions of time."""
        return {"step": 1, "drift": self.order, "tone": 2}[self.shape]

    def begin(self, channels: tuple[str, ...], kernel: Kernel) -> Step:
        """Return a function that computes the functions of time at a sample's time."""
        start, period, shape, order = round(self.start * 1e6), self.period * 1e6, self.shape, self.order

        def step(time_us: Any, hx: Any, hy: Any, hz: Any, values: Sequence[Any]) -> tuple[Any, ...]:
            if shape == "step":
                return (1.0 * (time_us >= start),)
            x = (time_us - start) / period
            if shape == "tone":
                return np.cos(2.0 * pi * x), np.sin(2.0 * pi * x)
            return powers(np.clip(x, -1.0, 1.0), order)

        return step


class RateEffect(Effect, frozen=True, kw_only=True):
    """Offset proportional to the rate of change of the reading, ``dH_r/dt``; coefficients in s.

    Notes
    -----
    Later samples are unknown in live operation, so the rate is the second-order backward difference of three
    samples.
    """

    kind: ClassVar[str] = "rate"
    on: Literal["skew", "eddy"]
    """``skew``: channel i is sampled tau_i later than the log states; the three coefficients are tau_i in
    ``T_i = tau_i dH_i/dt``. ``eddy``: a changing field drives eddy currents; the six coefficients xy, xz, yx,
    yz, zx, zy are k_ij in ``T_i = k_ij dH_j/dt`` (Tolles & Lawson 1950, in the notation of Leliak 1961)."""

    def columns(self, field: float) -> FloatArray:
        """Return the columns (K, 3, 9): each coefficient (s) adds the rate (nT/s) of one channel to T."""
        # k_ij: the rate of channel j adds to offset i; the skews are the k_ii
        pairs = [(i, j) for i in range(3) for j in range(3) if (i == j) == (self.on == "skew")]
        columns = np.zeros((len(pairs), 3, 9))
        for k, (i, j) in enumerate(pairs):
            columns[k, j, 6 + i] = 1.0
        return columns

    def begin(self, channels: tuple[str, ...], kernel: Kernel) -> Step:
        """Return a stepper that computes the channels' rates, nT/s.

        The rate is 0 at the first sample after a gap, and a first-order difference at the second.
        """
        before: tuple[float, float, float] = (0.0, 0.0, 0.0)
        slope: tuple[float, float, float] = (0.0, 0.0, 0.0)
        then, apart_before, count = 0, 0.0, 0

        def step(time_us: int, hx: float, hy: float, hz: float, values: Sequence[float]) -> tuple[float, ...]:
            nonlocal before, slope, then, apart_before, count
            if hx + hy + hz - (hx + hy + hz) != 0.0:  # NaN or infinite: ignore the sample
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
        """Return the rates (3, n) of a whole log, nT/s, as the backward differences of the stepper.

        Centred differences would not do: they share less noise with their sample than live rates share.
        """
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


class ResponseEffect(MomentaryEffect, frozen=True, kw_only=True):
    """Nonlinear response of the sensor: a power of each channel's reading, or a knee in one channel."""

    kind: ClassVar[str] = "response"
    unit: Annotated[float, Meta(ge=1.0, le=1e9)]
    """Field (nT) by which readings are divided."""
    power: Annotated[int, Meta(ge=0, le=MAX_ORDER)] = 0
    """Exponent in ``T_i += c_i (H_i / unit)^power``, with three coefficients, nT; 0: a knee instead."""
    axis: Annotated[int, Meta(ge=0, le=2)] = 0
    """Index of the channel that has the knee."""
    knee: float = 0.0
    """Reading at the knee, nT, of sign s. Where ``s H >= s knee``, ``T -= s c_1 + c_2 (H - knee) / unit``."""

    @property
    def size(self) -> int:
        """Number K of the amplitudes, also of an axis that does not exist."""
        return 3 if self.power else 2

    def columns(self, field: float) -> FloatArray:
        """Return the columns (K, K, 9), nT: three for a power, one for each channel; two for a knee."""
        if self.power:
            return np.eye(3, 9, 6)[:, None, :] * np.eye(3)[:, :, None]
        columns = np.zeros((2, 2, 9))
        columns[[0, 1], [0, 1], 6 + self.axis] = -1.0
        return columns

    def begin(self, channels: tuple[str, ...], kernel: Kernel) -> Step:
        """Return a function that computes the readings' powers, or the two regressors beyond the knee."""
        power, unit, axis, knee = self.power, self.unit, self.axis, self.knee
        sign = 1.0 if knee >= 0.0 else -1.0

        def step(time_us: int, hx: Any, hy: Any, hz: Any, values: Sequence[Any]) -> tuple[Any, ...]:
            if power:
                return tuple(powers(h / unit, power)[-1] for h in (hx, hy, hz))
            # Beyond the knee: a step of c_1 and a slope of c_2.
            over = sign * ((hx, hy, hz)[axis] - knee)
            beyond = sign * (over >= 0.0)
            return beyond, beyond * over / unit

        return step
