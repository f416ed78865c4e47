"""Effects of telemetry, masses and the instrument: terms that do not depend on the present positions alone.

Notes
-----
An effect names its channels, says what its coefficients do with its regressors (`columns`), and computes the
regressors sample by sample (`begin` returns a stepper with a fresh state) or of a whole log (`batch`).
Without a state one function does both (:class:`MomentaryEffect`).
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


def offsets(regressors: int) -> FloatArray:
    """Return columns (3 r, r, 9): each regressor adds to T with three coefficients of its own."""
    columns = np.zeros((3 * regressors, regressors, 9))
    for r in range(regressors):
        columns[3 * r : 3 * r + 3, r, 6:9] = np.eye(3)
    return columns


def powers(x: Any, order: int) -> tuple[Any, ...]:
    """Return ``x, x^2, ... x^order`` of a number or an array: ``pow()`` is a hundred times as slow."""
    return tuple(accumulate(repeat(x, order), mul))


def held(values: FloatArray, first: float) -> FloatArray:
    """Return values (n,) with each NaN replaced by the last known value, or by `first`."""
    known = ~np.isnan(values)
    if known.all():
        return values
    # Index of the last known value at each row; 0 stands for `first`.
    last = np.maximum.accumulate(np.where(known, np.arange(1, len(values) + 1), 0))
    return np.append(first, values)[last]


def lagged(time: FloatArray, values: FloatArray, lag: float, stages: int = 1) -> FloatArray:
    """Return y (n,) that follows x through equal lags in series (:class:`ChannelEffect`), from equilibrium.

    `time`, `values` (n,): s, and x. `lag`: s, the sum of all `stages`; at 0, y is x.
    """
    if lag <= 0.0 or len(time) < 2:
        return values
    # Exact solution for a step input: y moves by 1 - exp(-dt / tau) of its distance from x.
    share = -np.expm1(-np.diff(time) / (lag / stages))
    usual = float(np.median(share))
    even = np.abs(share - usual).max() <= 1e-6 * usual  # no gaps, and a clock that does not jitter
    for _ in range(stages):
        values = _filtered(values, usual) if even else _stepped(values, share)
    return values


def _filtered(values: FloatArray, share: float) -> FloatArray:
    """Return (n,) ``y_t = y_(t-1) + s (x_t - y_(t-1))``."""
    from scipy.signal import lfilter  # noqa: PLC0415  (the live path starts without scipy)

    return np.asarray(lfilter([share], [1.0, share - 1.0], values, zi=[(1.0 - share) * values[0]])[0])


def _stepped(values: FloatArray, share: FloatArray) -> FloatArray:
    """Return the same (n,) with a fraction for each step, by doubling over 2, 4, 8 ... rows."""
    # y_t = kept_t y_(t-1) + share_t x_t. Two such maps in series are one: combine pairs by doubling.
    y, kept = np.append(values[0], share * values[1:]), np.append(0.0, 1.0 - share)
    step = 1
    while step < len(y):
        y[step:] = y[step:] + kept[step:] * y[:-step]
        kept[step:] = kept[step:] * kept[:-step]
        step *= 2
    return y


class MomentaryEffect(Effect, frozen=True, kw_only=True):
    """An effect without a state: the function that :meth:`begin` returns accepts numbers and arrays."""

    remembers: ClassVar[bool] = False

    def batch(self, series: LogSeries) -> FloatArray:
        """Return (r, n) regressors."""
        step: Any = self.begin(tuple(series.values), series.kernel)
        rows = step(series.time_us, *series.reading.T, [*series.values.values()])
        return np.stack([np.broadcast_to(row, len(series.time)) for row in rows])


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
        """Return one regressor, one slot for each axis."""
        columns = np.zeros((3, 1, 9))
        # Slots 6 to 8 are T (offset), slots 0 to 2 the diagonal of a (scale).
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
        """Return (1, n) regressors; 0 before the first value."""
        values = series.values[self.channel]
        known = np.flatnonzero(~np.isnan(values))
        out = np.full(len(values), np.nan)
        out[known] = lagged(series.time[known], values[known], self.lag, self.stages) - self.origin
        return held(out, 0.0)[None]


class MassEffect(SingleChannelEffect, frozen=True, kw_only=True):
    """Offsets from a mass whose position is one telemetry channel."""

    centre: float
    scale: Width
    """`centre`, `scale`: In the channel's unit."""

    def columns(self, field: float) -> FloatArray:
        """Offsets."""
        return offsets(self.size // 3)


class PathEffect(MassEffect, frozen=True, kw_only=True):
    """Offsets that depend on nothing but where the mass is, ``x = (p - centre) / scale``."""

    remembers: ClassVar[bool] = False

    @abstractmethod
    def regressors(self, x: Any) -> tuple[Any, ...]:
        """Return the regressors at x, a number or an array."""

    def begin(self, channels: tuple[str, ...], kernel: Kernel) -> Step:
        """Return a stepper; while the value is missing, the last one holds."""
        index, x = channels.index(self.channel), 0.0

        def step(time_us: int, hx: float, hy: float, hz: float, values: Sequence[float]) -> tuple[float, ...]:
            nonlocal x
            if not isnan(values[index]):
                x = (values[index] - self.centre) / self.scale
            return self.regressors(x)

        return step

    def batch(self, series: LogSeries) -> FloatArray:
        """Return (r, n) regressors."""
        return np.stack(self.regressors(held((series.values[self.channel] - self.centre) / self.scale, 0.0)))


class PowersEffect(PathEffect, frozen=True, kw_only=True):
    """A mass that another channel moves: ``T += sum_k c_k x^k``, ``x = (p - centre) / scale``.

    A permanent moment on a mass at ``r(p)`` gives ``G(r(p)) m`` (see :mod:`.dipole`), a power series in p.
    """

    kind: ClassVar[str] = "powers"
    order: Power = 1
    """Highest power."""

    @property
    def size(self) -> int:
        """Three coefficients (nT) for each power."""
        return 3 * self.order

    def regressors(self, x: Any) -> tuple[Any, ...]:
        """Return x to x^order."""
        return powers(x, self.order)


class SourcesEffect(PathEffect, frozen=True, kw_only=True):
    """Iron that a mass passes on its path: ``T += sum_k c_k (1 + x_k^2)^(-3/2)``.

    Here ``x_k = (p - centre) / scale - k apart``. Iron that the mass magnetises, or that magnetises the mass,
    makes a field that falls with the cube of their distance. A row of sources near the path can make the same
    field as iron at an unknown place: an equivalent layer (Dampney 1969, Geophysics 34:39).

    `centre`, `scale`: position of the first source, and distance of all from the path, in the channel's unit.
    `apart`: distance between neighbouring sources, in units of `scale`. `count`: number of sources.
    """

    kind: ClassVar[str] = "sources"
    apart: Width
    count: Power = 1

    @property
    def size(self) -> int:
        """Three coefficients (nT) for each source."""
        return 3 * self.count

    def regressors(self, x: Any) -> tuple[Any, ...]:
        """Return the regressor of each source."""
        # (1 + x_k^2)^(-3/2) without a power of a non-integer exponent.
        near = [1.0 / (1.0 + (x - self.apart * k) ** 2) for k in range(self.count)]
        return tuple(one * one**0.5 for one in near)


class LegendreEffect(MomentaryEffect, frozen=True, kw_only=True):
    """Field of the calibration's own positions beyond its terms: ``T += c prod_k P_e_k(x_k)``.

    P_e, Legendre's polynomial of degree e, is what a fit of all lower powers leaves of x^e over the
    calibrated travel.
    """

    kind: ClassVar[str] = "legendre"
    exponents: Exponents
    """Degrees, one for each parameter, of positions scaled as the calibration scales them."""

    @property
    def size(self) -> int:
        """One for each axis, nT."""
        return 3

    def check(self, parameters: tuple[str, ...]) -> None:
        """Require one exponent for each parameter."""
        if len(self.exponents) != len(parameters):
            raise CalibrationError(f"legendre: expected {len(parameters)} exponents, one for each parameter")
        if min(self.exponents, default=0) < 0 or sum(self.exponents) > MAX_ORDER:
            raise CalibrationError(f"legendre: expected exponents >= 0, together at most {MAX_ORDER}")

    def columns(self, field: float) -> FloatArray:
        """Offsets."""
        return offsets(1)

    def begin(self, channels: tuple[str, ...], kernel: Kernel) -> Step:
        """Return the product of the positions' polynomials, by Horner's scheme."""
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
    """Backlash or remanence: ``T += c (S(y) - S(p)) / width``, y the play operator of the channel p.

    ``y = min(max(y, p - width / 2), p + width / 2)``: y lags behind p by up to half the width, on the side
    from which the mass came. A drive's backlash makes a loop of constant width (S linear). Steel near the
    path is remagnetised only while the mass is near, so its loop closes farther away: ``S(v) = scale tanh((v
    - centre) / scale)``, a generalised play (Brokate & Sprekels 1996, *Hysteresis and Phase Transitions*,
    sec. 2.1 and 2.4).

    `width`: in the channel's unit. `centre`, `scale`: position of the steel, and how far its effect reaches,
    in the channel's unit; with a scale far beyond the travel S is linear. `order`: 0: S as above. In older
    files, the highest power of a polynomial in its place: ``sum_k c_k (v^k - x^k)`` with ``v = (y - centre) /
    scale`` and ``x = (p - centre) / scale``.
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
                # Play operator: y moves only where p leaves the dead band.
                y = p if first else min(max(y, p - half), p + half)
                first = False
            if order:
                dragged, here = (powers((at - centre) / scale, order) for at in (y, p))
                return tuple(map(sub, dragged, here))
            return (scale * (tanh((y - centre) / scale) - tanh((p - centre) / scale)) / width,)

        return step

    def batch(self, series: LogSeries) -> FloatArray:
        """Return (r, n) regressors; 0 before the first value."""
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
    """Return (n,) play operator of values, from the middle of the play (:class:`PlayEffect`).

    Each row clips the output of the row before. Two such clips in series are one clip, so they are combined
    by doubling: over 2, 4, 8 ... rows.
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
        """Return one coefficient for nine regressors: the rates of change of the nine coefficients, nT/s."""
        return self.sign * np.eye(9)[None]

    def begin(self, channels: tuple[str, ...], kernel: Kernel) -> Step:
        """Return a stepper; rates are differences from the previous sample over the time between."""
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
        """Return (9, n) regressors."""
        # Backward difference, as in the stepper; across a gap or at a repeated time the rate is zero.
        monomials = np.stack(series.kernel.monomials([*series.values.values()], np.ones(len(series.time))))
        apart = 1e-6 * np.diff(series.time_us)
        joined = (apart > 0.0) & (apart < 1e-6 * MAX_INTERVAL)
        rates = np.zeros_like(monomials)
        rates[:, 1:] = np.where(joined, np.diff(monomials) / np.where(joined, apart, 1.0), 0.0)
        return np.asarray(series.kernel.rate_weights.T @ rates)


# ---- Effects of the instrument: time, the rate of change of the reading, a nonlinear response ----


class TimeEffect(MomentaryEffect, frozen=True, kw_only=True):
    """An offset that depends on time alone."""

    kind: ClassVar[str] = "time"
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
        """Return the functions of time."""
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


class ResponseEffect(MomentaryEffect, frozen=True, kw_only=True):
    """A nonlinear response: a power of each channel's reading, or one channel with a knee."""

    kind: ClassVar[str] = "response"
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
        """Return the powers of the readings, or the two functions beyond the knee."""
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
