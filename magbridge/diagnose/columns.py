"""Columns of a design matrix, and the candidates of causes, which are made of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate, pairwise
from typing import Any, Literal

import numpy as np

from magbridge.arrays import BoolArray, FloatArray
from magbridge.calibration.terms import Effect
from magbridge.diagnose.problem import Problem

Columns = Callable[[slice], FloatArray]
"""Slice of m rows -> (m, k) change of the residual per unit of each of k coefficients, column by column."""
AXIS_NAMES = ("x", "y", "z")
About = Literal["vehicle", "constant", "place", "time"]
Group = tuple[str, str | None]
"""A cause and its channel: candidates that share both are one grid."""


@dataclass(frozen=True, eq=False)
class Mixture:
    """Linear combinations ``sum_i X_i M_i`` of columns ``X_i`` that many hypotheses share."""

    parts: tuple[tuple[Columns, FloatArray], ...]
    """X_i and M_i."""

    def __call__(self, rows: slice) -> FloatArray:
        """Return these rows of the columns, (m, k)."""
        return np.asarray(sum(M.T @ X(rows).T for X, M in self.parts)).T


@dataclass(frozen=True)
class Since:
    """Columns set to zero in the rows where `fresh` (n,) is false."""

    columns: Columns
    fresh: BoolArray = field(compare=False)

    def __call__(self, rows: slice) -> FloatArray:
        """Return these rows of the columns, (m, k)."""
        return (self.columns(rows).T * self.fresh[rows]).T


def parts(columns: Columns) -> tuple[tuple[Columns, FloatArray], ...]:
    """Return the pairs (X_i, M_i (p_i, k)) of a mixture; other columns are their own only part, M = I."""
    if isinstance(columns, Mixture):
        return columns.parts
    return ((columns, np.eye(size_of(columns))),)


def size_of(columns: Columns) -> int:
    """Return the number of columns."""
    return len(columns(slice(0, 1)).T)


def places(sizes: Iterable[int], first: int = 0) -> list[slice]:
    """Return the slices of blocks of the given numbers of columns, from `first` on."""
    return [slice(*ends) for ends in pairwise(accumulate(sizes, initial=first))]


def join_columns(columns: Sequence[Columns]) -> Mixture:
    """Return all columns side by side as one mixture, in which shared parts occur once."""
    listed = [parts(one) for one in columns]
    sizes = [blocks[0][1].shape[1] for blocks in listed]
    # Parts that several columns share occur once, with the weights of all of them
    found: dict[Columns, FloatArray] = {}
    for blocks, own in zip(listed, places(sizes), strict=True):
        for X, M in blocks:
            found.setdefault(X, np.zeros((len(M), sum(sizes))))[:, own] += M
    return Mixture(tuple(found.items()))


@dataclass(frozen=True)
class Products:
    """Products of functions of time and derivatives, from which the columns of effects are made."""

    problem: Problem
    phi: Callable[[slice], FloatArray] | None
    """Rows -> (r, m) functions; 1 if there is none."""
    pairs: tuple[tuple[int, int], ...]
    """For each column, the place of its function and the slot of its slope."""

    def __call__(self, rows: slice) -> FloatArray:
        """Return these rows of the columns, (m, pairs)."""
        functions, slots = (list(places) for places in zip(*self.pairs, strict=True))
        jacobian = self.problem.jacobian.T[slots, rows]
        return np.asarray(jacobian if self.phi is None else self.phi(rows)[functions] * jacobian).T


def effect_columns(
    problem: Problem,
    effect: Effect,
    phi: FloatArray | Callable[[slice], FloatArray] | None = None,
    origin: float = 0.0,
    widths: float | FloatArray = 1.0,
) -> Mixture:
    """Return the columns of an effect's coefficients, in units of their `widths` (k,).

    Its regressors are `phi` less `origin`: (r, n), a function from m rows to (r, m), or the effect's own.
    """
    if phi is None and effect.remembers:
        # Single precision: a search tries dozens of histories, of 5 MB for a month each in double
        phi = effect.batch(problem.series(effect)).astype(np.float32)
    history = phi if isinstance(phi, np.ndarray) else None

    def regressors(rows: slice) -> FloatArray:
        if history is not None:
            return history[:, rows]
        return phi(rows) if callable(phi) else effect.batch(problem.series(effect, rows))

    # C_krs of the effect: only the pairs (r, s) of nonzero entries are computed
    tensor = -effect.columns(problem.calibration.reference.field)
    pairs = tuple((int(r), int(s)) for r, s in np.argwhere(tensor.any(axis=0)))
    M = np.stack([tensor[:, r, s] for r, s in pairs]) * widths
    # (phi - origin) C = phi C - origin C: one history serves every origin
    made = Products(problem, phi if callable(phi) else regressors, pairs)
    if not origin:
        return Mixture(((made, M),))
    return Mixture(((made, M), (Products(problem, None, pairs), -origin * M)))


@dataclass(frozen=True, eq=False)
class GridPoint:
    """The nonlinear parameters of a candidate: a point of its cause's grid, and what profiling made of it."""

    shape: Mapping[str, tuple[float, str]] = field(default_factory=dict)
    """Name -> (value, unit)."""
    rebuild: Callable[..., Candidate] | None = None
    """Shape's values -> the same candidate with those: for profiling."""
    likelier: float = 0.0
    """Log of its prior probability, relative to the mean of its grid."""
    narrow: float = 0.0
    """Log of how much narrower than their grid's cells the parameters are by the data."""
    cells: tuple[float, ...] = ()
    """Spacing of the grid's points, in each parameter."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """One hypothesis."""

    cause: str
    """As in ``findings.json``."""
    channel: str | None
    """Telemetry that it follows."""
    columns: Columns
    """What its coefficients add to the residual, each in units of its width."""
    width: FloatArray
    """(k,) plausible size (1-sigma) of each coefficient, in its unit."""
    names: tuple[str, ...]
    units: tuple[str, ...]
    """`names`, `units`: of the coefficients."""
    effects: tuple[Effect, ...] = ()
    """Effects to add to the calibration; empty if the reference is wrong, or the data of the fit."""
    point: GridPoint = GridPoint()
    """Its nonlinear parameters."""
    look_elsewhere: float = 1.0
    """Number of independent hypotheses that this one was picked from (frequencies searched)."""
    positive: bool = False
    """Its coefficients cannot be negative."""
    parts: tuple[Candidate, ...] = ()
    """Those that it was put together from, one after the other."""
    spectra: FloatArray | None = None
    """(l, k) alternatives for the prior variances of coefficients of one common free size (:mod:`.joint`)."""
    since: bool = False
    """It is absent from the logs that the calibration was fitted to."""
    regressors: Callable[[slice], FloatArray] | None = None
    """Rows -> regressors (r, m) of its effect by central differences, where the live ones contain noise."""
    about: About = "vehicle"
    """``vehicle`` with its sensor; or how the reference is wrong: ``constant``, by ``place`` or ``time``."""

    @property
    def group(self) -> Group:
        """The grid that it is a point of."""
        return self.cause, self.channel

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return len(self.width)

    @property
    def freedom(self) -> int:
        """Degrees of freedom of its test: coefficients of one common size are one."""
        return self.size if self.spectra is None else 1

    @property
    def tail(self) -> float:
        """Share of a chi-square's tail that counts: half where no size is negative (Self & Liang 1987)."""
        return 0.5 if self.positive or self.spectra is not None else 1.0

    @property
    def nonparametric(self) -> bool:
        """Return True for a Gaussian process: it has a flexible shape, and leaves no idealised remnant."""
        return self.spectra is not None and not self.effects

    @property
    def pieces(self) -> tuple[Candidate, ...]:
        """Its parts, or itself."""
        return self.parts or (self,)

    def joined_with(self, candidate: Candidate) -> Candidate:
        """Return both as one: a cause that takes more than one regressor to describe."""
        parts, one, two = (self, candidate), self.point, candidate.point
        # Names of the second piece are numbered, for people to tell them apart
        taken = self.names + tuple(one.shape)
        number = 2 + sum(name.startswith(f"{candidate.names[0]} (") for name in taken)
        mark = "" if set(taken).isdisjoint(candidate.names) else f" ({number})"
        return replace(
            self,
            columns=join_columns([part.columns for part in parts]),
            width=np.concatenate([part.width for part in parts]),
            names=self.names + tuple(name + mark for name in candidate.names),
            units=self.units + candidate.units,
            effects=self.effects + candidate.effects,
            point=GridPoint(
                {**one.shape, **{name + mark: value for name, value in two.shape.items()}},
                likelier=one.likelier + two.likelier,
                narrow=one.narrow + two.narrow,
                cells=one.cells,
            ),
            parts=(*self.pieces, *candidate.pieces),
        )


def slices(candidates: Sequence[Candidate], first: int = 0) -> list[slice]:
    """Return the places of each candidate's coefficients among those of all, from `first` on."""
    return places((candidate.size for candidate in candidates), first)


def absent_before(candidate: Candidate, learned: BoolArray) -> Candidate:
    """Return the same cause, absent from the samples (n,) that the calibration has `learned` from."""
    rebuild, fresh = candidate.point.rebuild, ~learned
    return replace(
        candidate,
        columns=Mixture(tuple((Since(X, fresh), M) for X, M in parts(candidate.columns))),
        point=replace(
            candidate.point, rebuild=rebuild and (lambda *shape: absent_before(rebuild(*shape), learned))
        ),
        since=True,
    )


def per(step: str, power: int = 1) -> str:
    """Return the unit of the coefficient of a power of something that is counted in units of `step`."""
    return f"nT per {step}" if power == 1 else f"nT per ({step})^{power}"


def of_effect(
    problem: Problem,
    effect: Effect,
    width: float | FloatArray,
    unit: str | Sequence[str],
    *,
    phi: FloatArray | Callable[[slice], FloatArray] | None = None,
    channel: str | None = None,
    names: tuple[str, ...] = (),
    origin: float = 0.0,
    **more: Any,
) -> Candidate:
    """Make a candidate of an effect; `phi` and `origin` are those of :func:`effect_columns`.

    `unit` is that of all its coefficients, or has one for each of as many equal parts of them.
    """
    widths = np.broadcast_to(np.asarray(width, float), effect.size)
    columns = effect_columns(problem, effect, phi, origin, widths)
    if not names:
        powers = effect.size // 3
        names = tuple(
            axis + (str(power + 1) if powers > 1 else "") for power in range(powers) for axis in AXIS_NAMES
        )
    parts = (unit,) if isinstance(unit, str) else unit
    units = tuple(part for part in parts for _ in range(effect.size // len(parts)))
    return Candidate(effect.cause, channel, columns, widths, names, units, (effect,), **more)


def of_reference(
    problem: Problem,
    cause: str,
    basis: Callable[[slice], FloatArray],
    width: FloatArray,
    names: tuple[str, ...],
    kind: About,
) -> Candidate:
    """Make a candidate of an error of the reference, ``sum_k b_k basis_k(t)``, nT; `basis` returns (m, k)."""
    columns = lambda rows: problem.reference_jacobian[rows, None] * basis(rows) * width  # noqa: E731 - a regressor is one line
    return Candidate(cause, None, columns, width, names, ("nT",) * len(width), about=kind)
