"""Effects that follow the positions of masses: more powers, what they pass, backlash, a clock that is off."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, repeat
from math import isnan, tanh
from operator import mul, sub
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from magbridge.calibration.effects import Follower
from magbridge.calibration.terms import HIGHEST, Effect, Exponents, Power, Step, Width
from magbridge.errors import CalibrationError

if TYPE_CHECKING:
    from magbridge.calibration.model import Calibration

__all__ = ["ClockEffect", "MonomialEffect", "PlayEffect", "PowersEffect", "SourcesEffect"]

FloatArray = NDArray[np.float64]
MAX_INTERVAL = 60_000_000
"""µs; over a longer gap a rate of change means nothing."""


def offsets(regressors: int) -> FloatArray:
    """(3 r, r, 9): each regressor adds to T with three coefficients of its own, axis by axis."""
    columns = np.zeros((3 * regressors, regressors, 9))
    for r in range(regressors):
        columns[3 * r : 3 * r + 3, r, 6:9] = np.eye(3)
    return columns


def powers(x: float, order: int) -> tuple[float, ...]:
    """``x, x^2, ... x^order``."""
    return tuple(accumulate(repeat(x, order), mul))


class MassEffect(Follower, frozen=True, kw_only=True):
    """Offsets by a mass whose position one channel tells.

    Attributes
    ----------
    centre, scale : float
        In the channel's unit.
    """

    centre: float
    scale: Width

    def columns(self, field: float) -> FloatArray:  # noqa: ARG002  (others need it)
        """Offsets."""
        return offsets(self.size // 3)


class PowersEffect(MassEffect, frozen=True, kw_only=True):
    """A mass that another channel moves: ``T += sum_k c_k x^k``, ``x = (p - centre) / scale``.

    A permanent moment on a mass at ``r(p)`` gives ``G(r(p)) m`` (see :mod:`.dipole`), a power series in p.

    Attributes
    ----------
    order : int
        Highest power.
    """

    kind: ClassVar[str] = "powers"
    order: Power = 1

    @property
    def size(self) -> int:
        """Three for each power, nT."""
        return 3 * self.order

    def begin(self, calibration: Calibration) -> Step:
        """Return a stepper; a missing value leaves the last one standing."""
        index, order = calibration.channels.index(self.channel), self.order
        centre, scale, x = self.centre, self.scale, 0.0

        def step(time_us: int, hx: float, hy: float, hz: float, values: Sequence[float]) -> tuple[float, ...]:
            nonlocal x
            if not isnan(values[index]):
                x = (values[index] - centre) / scale
            return powers(x, order)

        return step


class SourcesEffect(MassEffect, frozen=True, kw_only=True):
    """What a mass passes on its way: ``T += sum_k c_k (1 + x_k^2)^(-3/2)``.

    Here ``x_k = (p - centre) / scale - k apart``. Iron that a mass magnetises, or is magnetised by, has a
    field that falls with the cube of their distance. Wherever it is, sources in a row beside the way make the
    same field: an equivalent layer (Dampney 1969, Geophysics 34:39).

    Attributes
    ----------
    centre, scale : float
        Where the first source is, and how far all are from the way.
    apart : float
        How far from each other, in `scale`.
    count : int
        Sources.
    """

    kind: ClassVar[str] = "sources"
    apart: Width
    count: Power = 1

    @property
    def size(self) -> int:
        """Three for each source, nT."""
        return 3 * self.count

    def begin(self, calibration: Calibration) -> Step:
        """Return a stepper; a missing value leaves the last one standing."""
        index, count, apart = calibration.channels.index(self.channel), self.count, self.apart
        centre, scale, x = self.centre, self.scale, 0.0

        def step(time_us: int, hx: float, hy: float, hz: float, values: Sequence[float]) -> tuple[float, ...]:
            nonlocal x
            if not isnan(values[index]):
                x = (values[index] - centre) / scale
            return tuple((1.0 + (x - apart * k) ** 2) ** -1.5 for k in range(count))

        return step


class MonomialEffect(Effect, frozen=True, kw_only=True):
    """A monomial of the calibration's own positions that its terms lack: ``T += c prod_k x_k^e_k``.

    Attributes
    ----------
    cause : str
    exponents : tuple of int
        One for each parameter, of positions scaled as the calibration scales them.
    """

    kind: ClassVar[str] = "monomial"
    cause: str
    exponents: Exponents

    @property
    def size(self) -> int:
        """One for each axis, nT."""
        return 3

    def check(self, parameters: tuple[str, ...]) -> None:
        """Require one exponent for each parameter."""
        if len(self.exponents) != len(parameters):
            raise CalibrationError(f"monomial: expected {len(parameters)} exponents, one for each parameter")
        if min(self.exponents, default=0) < 0 or sum(self.exponents) > HIGHEST:
            raise CalibrationError(f"monomial: expected exponents >= 0, together at most {HIGHEST}")

    def columns(self, field: float) -> FloatArray:  # noqa: ARG002  (others need it)
        """Offsets."""
        return offsets(1)

    def begin(self, calibration: Calibration) -> Step:
        """Return a stepper; it has no state."""
        factors = [
            (k, parameter.centre, parameter.scale)
            for k, parameter in enumerate(calibration.parameters)
            for _ in range(self.exponents[k])
        ]

        def step(time_us: int, hx: float, hy: float, hz: float, values: Sequence[float]) -> tuple[float]:
            product = 1.0
            for k, centre, scale in factors:
                product *= (values[k] - centre) / scale
            return (product,)

        return step


class PlayEffect(MassEffect, frozen=True, kw_only=True):
    """Backlash or remanence: ``T += c (S(y) - S(p)) / width``, y the play operator of the channel p.

    ``y = min(max(y, p - width / 2), p + width / 2)``: the last position drags behind by half the width, on
    the side that the mass came from. A drive's backlash is straight. Steel that the mass passes by is turned
    where it is near, relays of one width about one place, so the loop closes beyond:
    ``S(v) = scale tanh((v - centre) / scale)``, a generalised play (Brokate & Sprekels 1996, *Hysteresis and
    Phase Transitions*, sec. 2.1 and 2.4).

    Attributes
    ----------
    width : float
        In the channel's unit.
    centre, scale : float
        Where the steel is, and how far it reaches; the loop is straight where the scale is far
        beyond the travel.
    order : int
        0: a branch as above. Older files have polynomials up to this power, ``sum_k c_k (v^k - x^k)`` with
        ``v = (y - centre) / scale`` and ``x = (p - centre) / scale``.
    """

    kind: ClassVar[str] = "play"
    width: Width
    order: Annotated[int, Meta(ge=0, le=HIGHEST)] = 0

    @property
    def size(self) -> int:
        """One for each axis, nT, and power."""
        return 3 * max(self.order, 1)

    def begin(self, calibration: Calibration) -> Step:
        """Return a stepper that starts in the middle of its play."""
        index, centre, scale, width, order = (
            calibration.channels.index(self.channel), self.centre, self.scale, self.width, self.order
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


class ClockEffect(Effect, frozen=True, kw_only=True):
    """Telemetry that is late: ``theta += delay * dtheta/dp * dp/dt``, all nine coefficients at once.

    One coefficient, s by which the telemetry lags behind the field's samples.

    Attributes
    ----------
    cause : str
    sign : float
        -1: by which the field's samples lag behind the telemetry, as a filter's do.
    """

    kind: ClassVar[str] = "clock"
    cause: str = "clock_offset"
    sign: float = 1.0

    @property
    def size(self) -> int:
        """One delay."""
        return 1

    def columns(self, field: float) -> FloatArray:  # noqa: ARG002  (others need it)
        """Nine regressors, the rates of the nine coefficients, under one coefficient."""
        return self.sign * np.eye(9)[None]

    def begin(self, calibration: Calibration) -> Step:
        """Return a stepper; rates are differences to the sample before."""
        kernel, field = calibration.kernel, calibration.reference.field
        W = kernel.weights[: kernel.monomials] * np.array([field] * 6 + [1.0] * 3)
        last: list[float] = []
        still, weights, then = (0.0,) * 9, W.T.tolist(), 0

        def step(time_us: int, hx: float, hy: float, hz: float, values: Sequence[float]) -> tuple[float, ...]:
            nonlocal last, then
            now, before, apart = kernel.powers(values, 1.0), last, time_us - then
            last, then = now, time_us
            if now == before or not before or not 0 < apart < MAX_INTERVAL:
                return still
            rates = [(a - b) / (1e-6 * apart) for a, b in zip(now, before, strict=True)]
            return tuple(
                sum(rate * weight for rate, weight in zip(rates, column, strict=True)) for column in weights
            )

        return step
