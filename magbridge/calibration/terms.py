"""What a calibration is made of: terms, each adding to the nine coefficients of ``A`` and ``T``.

A *position term* is a polynomial in the scaled actuator positions (:class:`Polynomial`, and
:class:`~magbridge.calibration.dipole.Dipole`, which expands into one). An *effect* is anything
else that moves the reading, with a state of its own where it needs one: see
:mod:`magbridge.calibration.effects`. Adding a term is one class and one row in :data:`TERMS`.
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
    "MAX_ORDER", "SLOTS", "TERMS", "Effect", "Expansion", "Exponents", "LogSeries", "Parameter",
    "Polynomial", "PositionTerm", "Power", "Step", "Term", "Width", "full_order", "term_class",
]  # fmt: skip

Exponents = tuple[int, ...]
Step = Callable[[int, float, float, float, Sequence[float]], tuple[float, ...]]
"""One sample into an effect: time (µs), the raw channels (nT), the values -> its regressors."""

MAX_ORDER = 30
"""Highest total degree: beyond, powers are noise."""
Power = Annotated[int, Meta(ge=1, le=MAX_ORDER)]
Width = Annotated[float, Meta(ge=1e-9, le=1e12)]
"""A divisor, in any unit."""
Position = Annotated[float, Meta(ge=-1e12, le=1e12)]
"""Position of a mass, or value of another parameter, in any unit."""

SLOTS = ("a_xx", "a_yy", "a_zz", "a_xy", "a_xz", "a_yz", "t_x", "t_y", "t_z")
"""The nine coefficients: six of the symmetric ``A`` (as ``a = (A - I) F_0``, nT) and three of ``T`` (nT)."""

TERMS: dict[str, str] = {
    "polynomial": "magbridge.calibration.terms:Polynomial",
    "dipole": "magbridge.calibration.dipole:Dipole",
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
"""Name in ``cal.json`` -> ``module:class``; others join by the entry point group ``magbridge.terms``."""


class Parameter(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A telemetry channel that moves a mass."""

    name: str
    unit: str
    """`name`, `unit`: As in the deployment's columns."""
    low: Position
    high: Position
    """`low`, `high`: The range that the calibration has seen."""
    centre: Position
    scale: Annotated[float, Meta(gt=0.0, le=1e12)]
    """`centre`, `scale`: ``x = (p - centre) / scale``."""


class Expansion(msgspec.Struct, frozen=True):
    """A position term as a polynomial: ``theta(x) = sum_k c_k sum_m x^m columns[k, m]``."""

    exponents: tuple[Exponents, ...]
    """m monomials; one exponent for each parameter."""
    columns: FloatArray
    """(K, m, 9): What one unit of coefficient k adds to the nine :data:`SLOTS`, nT."""


class _Interface(msgspec.StructMeta, ABCMeta):
    """Metaclass of structs with abstract methods."""


class Term(msgspec.Struct, metaclass=_Interface, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a term; its coefficients stand in the calibration's vector."""

    kind: ClassVar[str]

    @property
    @abstractmethod
    def size(self) -> int:
        """Number of coefficients."""

    def check(self, parameters: tuple[str, ...]) -> None:
        """Raise CalibrationError where the settings do not fit the calibration's parameters."""


class PositionTerm(Term, frozen=True, kw_only=True):
    """A term that depends on the positions alone: a polynomial in them, or expanded into one."""

    @abstractmethod
    def expand(self, parameters: tuple[Parameter, ...]) -> Expansion:
        """Return the term as a polynomial in the positions as `parameters` scale them."""


class Polynomial(PositionTerm, frozen=True, kw_only=True):
    """Each of the nine coefficients a polynomial in the scaled positions (paper, eq. 8).

    Coefficient ``9 m + s`` multiplies monomial m in slot s.
    """

    kind: ClassVar[str] = "polynomial"
    exponents: tuple[Exponents, ...]
    """The monomials; the constant one first."""

    @property
    def size(self) -> int:
        """Nine for each monomial."""
        return 9 * len(self.exponents)

    def check(self, parameters: tuple[str, ...]) -> None:
        """Require one exponent for each parameter, a total degree of at most 30, and no monomial twice."""
        # a high power of a position beyond its range grows without bounds
        for exponent in self.exponents:
            if len(exponent) != len(parameters) or min(exponent, default=0) < 0 or sum(exponent) > MAX_ORDER:
                raise CalibrationError(
                    f"exponents {list(exponent)}: expected {len(parameters)} numbers >= 0, one for each "
                    f"parameter, of {MAX_ORDER} in all at most"
                )
        if len(set(self.exponents)) != len(self.exponents):
            raise CalibrationError("exponents: a monomial stands there twice")

    def expand(self, parameters: tuple[Parameter, ...]) -> Expansion:  # noqa: ARG002  (a dipole needs them)
        """Return the polynomial as itself."""
        # coefficient 9 m + s adds 1 to slot s of monomial m
        m = len(self.exponents)
        return Expansion(self.exponents, np.eye(9 * m).reshape(9 * m, m, 9))


class LogSeries(NamedTuple):
    """A log of n samples, as the array form of an effect takes it."""

    time: FloatArray
    """(n,), s since 1970 UTC, ascending."""
    reading: FloatArray
    """(n, 3), nT, the raw axes."""
    values: Mapping[str, FloatArray]
    """(n,) each: Telemetry by name, the parameters first; NaN where it is not known."""
    kernel: Kernel
    """That of the calibration."""

    @property
    def time_us(self) -> FloatArray:
        """(n,) µs, rounded as those of single samples are."""
        return np.rint(self.time * 1e6)

    def part(self, rows: slice, names: Sequence[str]) -> LogSeries:
        """Return these rows, with the telemetry of these names."""
        values = {name: self.values[name][rows] for name in names}
        return LogSeries(self.time[rows], self.reading[rows], values, self.kernel)


class Effect(Term, frozen=True, kw_only=True):
    """A term that depends on something other than the positions: a temperature, a current, time.

    It turns every sample into a few *regressors* (in a unit of its own); `columns` says what each
    coefficient does with them. Their physics has two forms: :meth:`begin` computes them sample
    by sample, and every correction uses it, so live and from a log it has the same bits;
    :meth:`batch` computes those of a whole log at once, for simulation, comparison or fit. A NaN in
    its channel must not spoil its state: hold the last value.

    `cause`: what a diagnosis has added it for, as in ``findings.json``; empty where a fit or a person has.
    """

    remembers: ClassVar[bool] = True
    """True if regressors depend on earlier samples, too: then those of some rows need the whole log."""
    cause: str = ""

    def channels(self) -> tuple[str, ...]:
        """Return the names of the channels that it needs: parameters or other columns of a log."""
        return ()

    @abstractmethod
    def columns(self, field: float) -> FloatArray:
        """Return the contribution of coefficient k to each slot by regressor r, (K, r, 9); `field` is F_0."""

    @abstractmethod
    def begin(self, channels: tuple[str, ...], kernel: Kernel) -> Step:
        """Return a stepper with a fresh state, as at power-on.

        Parameters
        ----------
        channels : tuple of str
            Names of the values that it will be given with each sample: the parameters come first.
        kernel : Kernel
            That of the calibration.
        """

    def batch(self, series: LogSeries) -> FloatArray:
        """Return (r, n) regressors of a whole log, from a fresh state: by default those of :meth:`begin`."""
        # The stepper is the definition; effects with a faster array form override this method.
        step = self.begin(tuple(series.values), series.kernel)
        values = np.reshape([*series.values.values()], (-1, len(series.time))).T.tolist()
        times = series.time_us.astype(np.int64).tolist()
        samples = zip(times, *series.reading.T.tolist(), values, strict=True)
        return np.array([step(*sample) for sample in samples]).T


def full_order(parameters: int, order: int) -> tuple[Exponents, ...]:
    """Return all monomials of total degree up to `order`, cross terms included, the constant first."""
    return tuple(
        # each choice of `degree` parameters, with repetition, is one monomial
        tuple(picks.count(k) for k in range(parameters))
        for degree in range(order + 1)
        for picks in combinations_with_replacement(range(parameters), degree)
    )


def term_class(kind: str) -> type[Term]:
    """Look a term's class up by its name in :data:`TERMS` or among the entry points.

    CalibrationError: neither has that name.
    """
    # classes are imported only when a file names them
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
