"""Effects of where moving masses are: further powers of a position, and iron that they pass."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from math import isnan
from typing import Any, ClassVar

import numpy as np
from numpy.polynomial.legendre import leg2poly

from magbridge.arrays import FloatArray
from magbridge.calibration.effects import SingleChannelEffect, held, offsets, powers
from magbridge.calibration.kernel import Kernel
from magbridge.calibration.terms import MAX_ORDER, Effect, Exponents, Power, Series, Step, Width
from magbridge.errors import CalibrationError

__all__ = ["LegendreEffect", "MassEffect", "PathEffect", "PowersEffect", "SourcesEffect"]

Factors = list[tuple[int, float, float, list[float]]]
"""Of each: place of the position, its centre and scale, coefficients of its polynomial, the highest first."""


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

    def batch(self, series: Series) -> FloatArray:
        """(r, n) regressors."""
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

    Here ``x_k = (p - centre) / scale - k apart``. Iron that the mass magnetises, or that magnetises the
    mass, makes a field that falls with the cube of their distance. Its place is unknown, but a row of
    sources near the path can make the same field: an equivalent layer (Dampney 1969, Geophysics 34:39).

    Attributes
    ----------
    centre, scale : float
        Position of the first source, and distance of all of them from the path, in the channel's unit.
    apart : float
        Distance between neighbouring sources, in units of `scale`.
    count : int
        Number of sources.
    """

    kind: ClassVar[str] = "sources"
    apart: Width
    count: Power = 1

    @property
    def size(self) -> int:
        """Three coefficients (nT) for each source."""
        return 3 * self.count

    def regressors(self, x: Any) -> tuple[Any, ...]:
        """Return what each source does."""
        near = [1.0 / (1.0 + (x - self.apart * k) ** 2) for k in range(self.count)]
        return tuple(one * one**0.5 for one in near)


class LegendreEffect(Effect, frozen=True, kw_only=True):
    """What the calibration's own positions do beyond its terms: ``T += c prod_k P_e_k(x_k)``.

    P_e is Legendre's polynomial of degree e: of x^e it is what a fit of all lower powers leaves, over the
    travel that the calibration saw.
    """

    kind: ClassVar[str] = "legendre"
    remembers: ClassVar[bool] = False
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
        """Return a stepper; it has no state."""
        factors = self._factors(kernel)

        def step(time_us: int, hx: float, hy: float, hz: float, values: Sequence[float]) -> tuple[float]:
            return (_product(factors, values),)

        return step

    def batch(self, series: Series) -> FloatArray:
        """(1, n) regressors."""
        values = list(series.values.values())
        return np.reshape(_product(self._factors(series.kernel), values), (1, -1))

    def _factors(self, kernel: Kernel) -> Factors:
        return [
            (k, centre, scale, leg2poly([0.0] * e + [1.0])[::-1].tolist())
            for k, (centre, scale, e) in enumerate(
                zip(kernel.centre, kernel.scale, self.exponents, strict=True)
            )
            if e
        ]


def _product(factors: Factors, values: Sequence[Any]) -> Any:
    """Return the product of the factors' polynomials, by Horner's scheme, of numbers or arrays."""
    product: Any = 1.0
    for k, centre, scale, polynomial in factors:
        x, value = (values[k] - centre) / scale, 0.0
        for c in polynomial:
            value = value * x + c
        product = product * value
    return product
