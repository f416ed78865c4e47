"""Terms of a calibration; each adds to the nine coefficients of ``A`` and ``T``.

A :class:`Polynomial` depends on the scaled positions of the masses. An *effect* depends on another quantity,
such as a temperature, and may have a state (:mod:`magbridge.calibration.effects`). A new effect needs one
class and one row in :data:`TERMS`.
"""

from __future__ import annotations

from abc import ABCMeta, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from itertools import combinations_with_replacement
from typing import Annotated, Any, ClassVar, NamedTuple, cast

import msgspec
import numpy as np
from msgspec import Meta

from magbridge.arrays import FloatArray
from magbridge.calibration.kernel import Kernel
from magbridge.errors import CalibrationError
from magbridge.plugins import load, plugins
from magbridge.wording import one_of

__all__ = [
    "MAX_ORDER", "SLOTS", "TERMS", "Effect", "Exponents", "LogSeries", "Parameter", "Polynomial", "Power",
    "Step", "Term", "Width", "full_order", "term_class",
]  # fmt: skip

Exponents = tuple[int, ...]
Step = Callable[[int, float, float, float, Sequence[float]], tuple[float, ...]]
"""Function from a sample's time (µs), raw channels x, y, z (nT) and telemetry to an effect's regressors."""

MAX_ORDER = 30
"""Largest total degree of a monomial."""
Power = Annotated[int, Meta(ge=1, le=MAX_ORDER)]
Width = Annotated[float, Meta(ge=1e-9, le=1e12)]
"""Positive divisor, in any unit."""
Position = Annotated[float, Meta(ge=-1e12, le=1e12)]
"""Position of a mass, or the value of another parameter, in any unit."""

SLOTS = ("a_xx", "a_yy", "a_zz", "a_xy", "a_xz", "a_yz", "t_x", "t_y", "t_z")
"""Names of the nine coefficients, nT: six of the symmetric ``A`` (as ``a = (A - I) F_0``), three of ``T``."""

TERMS: dict[str, str] = {
    "polynomial": "magbridge.calibration.terms:Polynomial",
    "channel": "magbridge.calibration.effects:ChannelEffect",
    "powers": "magbridge.calibration.effects:PowersEffect",
    "sources": "magbridge.calibration.effects:SourcesEffect",
    "legendre": "magbridge.calibration.effects:LegendreEffect",
    "play": "magbridge.calibration.effects:PlayEffect",
    "clock": "magbridge.calibration.effects:ClockEffect",
    "time": "magbridge.calibration.effects:TimeEffect",
    "rate": "magbridge.calibration.effects:RateEffect",
    "response": "magbridge.calibration.effects:ResponseEffect",
}
"""Class of each kind of term, as ``module:class``, by its name in ``cal.json``. Plugins add further kinds
through the entry point group ``magbridge.terms``."""


class Parameter(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Telemetry channel that reports the position of a mass, or another input of the position terms."""

    name: str
    unit: str
    """`name`, `unit`: As in the deployment's columns."""
    low: Position
    high: Position
    """`low`, `high`: Range of the values in the calibration data, in `unit`."""
    centre: Position
    scale: Annotated[float, Meta(gt=0.0, le=1e12)]
    """`centre`, `scale`: In `unit`; the scaled position of a value p is ``x = (p - centre) / scale``."""


class _Interface(msgspec.StructMeta, ABCMeta):
    """Metaclass of structs with abstract methods."""


class Term(msgspec.Struct, metaclass=_Interface, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a term; the coefficient vector of the calibration holds its coefficients."""

    kind: ClassVar[str]
    """Name of the class in ``cal.json``."""

    @property
    @abstractmethod
    def size(self) -> int:
        """Number of coefficients of the term."""

    def check(self, parameters: tuple[str, ...]) -> None:
        """Raise CalibrationError if the settings do not fit the calibration's `parameters` (their names)."""


class Polynomial(Term, frozen=True, kw_only=True):
    """Term in which each of the nine slots is a polynomial in the scaled positions (paper, eq. 8).

    The term's coefficient ``9 m + s`` multiplies monomial m in slot s.
    """

    kind: ClassVar[str] = "polynomial"
    exponents: tuple[Exponents, ...]
    """Exponents of the monomials, the constant first."""

    @property
    def size(self) -> int:
        """Number of coefficients of the term, nine for each monomial."""
        return 9 * len(self.exponents)

    def check(self, parameters: tuple[str, ...]) -> None:
        """Raise CalibrationError if `exponents` are unusable.

        Each monomial needs one exponent for each parameter and a total degree of at most 30, and may occur
        once.
        """
        # a high power of a position outside its range grows without bounds
        for exponent in self.exponents:
            if len(exponent) != len(parameters) or min(exponent, default=0) < 0 or sum(exponent) > MAX_ORDER:
                raise CalibrationError(
                    f"exponents {list(exponent)}: expected {len(parameters)} numbers >= 0, one for each "
                    f"parameter, of {MAX_ORDER} in all at most"
                )
        if len(set(self.exponents)) != len(self.exponents):
            raise CalibrationError("exponents: a monomial stands there twice")


class LogSeries(NamedTuple):
    """Log of n samples, as the method ``batch`` of an effect reads it."""

    time: FloatArray
    """(n,): Time of the samples, s since 1970 UTC, ascending."""
    reading: FloatArray
    """(n, 3): Raw reading of the sensor, nT, sensor axes."""
    values: Mapping[str, FloatArray]
    """(n,) each: Telemetry by channel name, the parameters first; NaN where it is unknown."""
    kernel: Kernel
    """Compiled form of the calibration."""

    @property
    def time_us(self) -> FloatArray:
        """Time of the samples, (n,), µs since 1970 UTC, rounded to integers as for single samples."""
        return np.rint(self.time * 1e6)


class Effect(Term, frozen=True, kw_only=True):
    """Term that depends on a quantity other than the positions: a temperature, a current, time.

    An effect computes *regressors* from each sample; :meth:`columns` states how each coefficient maps them to
    the slots. There are two ways to compute them. Corrections, live or of a log, use the function that
    :meth:`begin` returns, sample by sample, so that both give the same bits. Simulation, comparison and fits
    use :meth:`batch`, which computes the regressors of a whole log at once. While its channel is NaN, an
    effect must use the last known value.
    """

    remembers: ClassVar[bool] = True
    """True if regressors depend on earlier samples too, so that some rows of a log need the whole log."""
    cause: str = ""
    """Cause, as named in ``findings.json``, for which a diagnosis added the effect; else empty."""

    def channels(self) -> tuple[str, ...]:
        """Return the names of the telemetry channels that the effect needs: parameters or other columns."""
        return ()

    @property
    def regressor_count(self) -> int:
        """Number of regressors r, if :meth:`columns` is not overridden."""
        return 1

    @property
    def size(self) -> int:
        """Number of coefficients K."""
        return len(self.columns(1.0))

    def columns(self, field: float) -> FloatArray:  # noqa: ARG002  (overrides need it)
        """Return the contribution (K, r, 9) of each coefficient, times each regressor, to the nine slots.

        By default each regressor adds three coefficients (nT) to T. `field`: F_0, nT.
        """
        # coefficient 3 r + i multiplies regressor r and adds to T_i
        r = self.regressor_count
        return np.asarray(np.kron(np.eye(r)[:, :, None], np.eye(3, 9, 6)[:, None, :]), float)

    @abstractmethod
    def begin(self, channels: tuple[str, ...], kernel: Kernel) -> Step:
        """Return a function that computes the regressors sample by sample, with its state as at power-on.

        Parameters
        ----------
        channels : tuple of str
            Names of the telemetry values of each sample; the parameters come first.
        kernel : Kernel
            Compiled form of the calibration.
        """

    def batch(self, series: LogSeries) -> FloatArray:
        """Return the regressors (r, n) of a whole log, with the state at its start as at power-on."""
        # The function of begin() defines the regressors; effects with a faster array form override batch().
        step = self.begin(tuple(series.values), series.kernel)
        values = np.reshape([*series.values.values()], (-1, len(series.time))).T.tolist()
        times = series.time_us.astype(np.int64).tolist()
        samples = zip(times, *series.reading.T.tolist(), values, strict=True)
        return np.array([step(*sample) for sample in samples]).T


def full_order(parameters: int, order: int) -> tuple[Exponents, ...]:
    """Return all monomials of a number of `parameters` up to total degree `order`, the constant first."""
    return tuple(
        # each choice of `degree` parameters, with repetition, is one monomial
        tuple(picks.count(k) for k in range(parameters))
        for degree in range(order + 1)
        for picks in combinations_with_replacement(range(parameters), degree)
    )


def term_class(kind: str) -> type[Term]:
    """Return the class of a kind of term, from :data:`TERMS` or from a plugin's entry point.

    CalibrationError: no such kind exists.
    """
    # a class is imported only when a file names it
    found: Any
    if kind in TERMS:
        module, _, name = TERMS[kind].partition(":")
        found = getattr(import_module(module), name)
    else:
        offers = plugins("magbridge.terms")
        if kind not in offers:
            raise CalibrationError(f"kind of a term: {one_of(kind, [*TERMS, *offers])}")
        found = load(offers[kind])
    return cast("type[Term]", found)
