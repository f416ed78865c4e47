"""Columns of the design matrix of a linear problem, and candidates of causes as sets of columns."""

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
"""Function of m rows: (m, k) change of the residual per unit of k coefficients, stored column by column."""
AXIS_NAMES = ("x", "y", "z")
About = Literal["vehicle", "constant", "place", "time"]
Group = tuple[str, str | None]
"""Cause and telemetry channel of a candidate. Candidates with an equal pair are the points of one grid."""


@dataclass(frozen=True, eq=False)
class Mixture:
    """Linear combinations ``sum_i X_i M_i`` of columns ``X_i`` that many hypotheses share."""

    parts: tuple[tuple[Columns, FloatArray], ...]
    """Pairs of columns X_i (p_i of them) and weights M_i (p_i, k)."""

    def __call__(self, rows: slice) -> FloatArray:
        """Return these rows of the columns, (m, k)."""
        return np.asarray(sum(M.T @ X(rows).T for X, M in self.parts)).T


@dataclass(frozen=True)
class Since:
    """Columns that are set to zero in the rows where `fresh` (n,) is false."""

    columns: Columns
    fresh: BoolArray = field(compare=False)

    def __call__(self, rows: slice) -> FloatArray:
        """Return these rows of the columns, (m, k)."""
        return (self.columns(rows).T * self.fresh[rows]).T


def parts(columns: Columns) -> tuple[tuple[Columns, FloatArray], ...]:
    """Return the pairs (X_i, M_i (p_i, k)) of a mixture; for other columns X, the single pair (X, 1)."""
    if isinstance(columns, Mixture):
        return columns.parts
    return ((columns, np.eye(size_of(columns))),)


def size_of(columns: Columns) -> int:
    """Return the number k of columns."""
    return len(columns(slice(0, 1)).T)


def places(sizes: Iterable[int], first: int = 0) -> list[slice]:
    """Return the slices of adjacent blocks of the given `sizes`, the first of which begins at `first`."""
    return [slice(*ends) for ends in pairwise(accumulate(sizes, initial=first))]


def join_columns(columns: Sequence[Columns]) -> Mixture:
    """Return several sets of columns side by side as one mixture, in which a shared part occurs once."""
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
    """Columns ``phi_r(t) g_s(t)``: an effect's regressor times a derivative of the residual."""

    problem: Problem
    phi: Callable[[slice], FloatArray] | None
    """Function of m rows that returns the regressors (r, m); None for a single regressor of 1."""
    pairs: tuple[tuple[int, int], ...]
    """Index of the regressor, and of the derivative (0 to 8, by the nine coefficients), for each column."""

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

    The regressors are `phi` less `origin`. `phi` is (r, n) or a function from m rows to (r, m); None stands
    for the regressors that the effect itself computes.
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
    """Nonlinear parameters of a candidate: a point of its cause's grid, or its maximum after profiling."""

    shape: Mapping[str, tuple[float, str]] = field(default_factory=dict)
    """Value and unit of each parameter, by name."""
    rebuild: Callable[..., Candidate] | None = None
    """Function that returns the candidate at other values of the parameters; None if there are none."""
    likelier: float = 0.0
    """Log of the prior probability of this point, relative to the mean of its grid."""
    narrow: float = 0.0
    """Log of the ratio of a grid cell's width to the width of the likelihood, summed over the parameters."""
    cells: tuple[float, ...] = ()
    """Spacing of the grid's points in each parameter, in its unit; empty before profiling."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A hypothesis: one cause, at one point of the grid of its nonlinear parameters."""

    cause: str
    """Name of the cause, as in ``findings.json``."""
    channel: str | None
    """Telemetry channel that the effect follows; None if it follows none or several."""
    columns: Columns
    """Changes of the residual, nT, by each coefficient, which is in units of its width."""
    width: FloatArray
    """(k,) plausible size (1-sigma) of each coefficient, in its unit."""
    names: tuple[str, ...]
    units: tuple[str, ...]
    """`names`, `units`: name and unit of each coefficient."""
    effects: tuple[Effect, ...] = ()
    """Effects to add to the calibration; empty for an error of the reference or of the calibration's logs."""
    point: GridPoint = GridPoint()
    """Nonlinear parameters of the candidate."""
    look_elsewhere: float = 1.0
    """Number of independent hypotheses from which this one was picked, such as frequencies searched."""
    positive: bool = False
    """True if the coefficients cannot be negative."""
    parts: tuple[Candidate, ...] = ()
    """Candidates that this one joins, in the order of their coefficients; empty for a single candidate."""
    spectra: FloatArray | None = None
    """(l, k) alternative prior variances up to a common factor (:mod:`.joint`); None: free coefficients."""
    since: bool = False
    """True if the effect is zero in the logs that the calibration was fitted to."""
    regressors: Callable[[slice], FloatArray] | None = None
    """Function of m rows: regressors (r, m) of the effect with less noise than the live ones; or None."""
    about: About = "vehicle"
    """``vehicle`` (with sensor), or an error of the reference: ``constant``, by ``place`` or ``time``."""

    @property
    def group(self) -> Group:
        """Cause and channel, which identify the grid of this candidate."""
        return self.cause, self.channel

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return len(self.width)

    @property
    def freedom(self) -> int:
        """Degrees of freedom of the test: 1 for coefficients of one common size, else their number."""
        return self.size if self.spectra is None else 1

    @property
    def tail(self) -> float:
        """Factor on a chi-square's tail: 0.5 for a size that cannot be negative (Self & Liang 1987)."""
        return 0.5 if self.positive or self.spectra is not None else 1.0

    @property
    def nonparametric(self) -> bool:
        """Return True for a Gaussian process, whose shape is flexible and so leaves no remnant."""
        return self.spectra is not None and not self.effects

    @property
    def pieces(self) -> tuple[Candidate, ...]:
        """Candidates that this one joins; the candidate itself if it joins none."""
        return self.parts or (self,)

    def joined_with(self, candidate: Candidate) -> Candidate:
        """Return this candidate and another one of the same cause as one candidate with all coefficients."""
        parts, one, two = (self, candidate), self.point, candidate.point
        # Names of the second piece are numbered, so that people can distinguish them
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
    """Return the slice of each candidate's coefficients in the vector of all, which begins at `first`."""
    return places((candidate.size for candidate in candidates), first)


def absent_before(candidate: Candidate, learned: BoolArray) -> Candidate:
    """Return the candidate with zero effect in the samples (n,) of the calibration's own logs, `learned`."""
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
    """Return the unit of a coefficient of ``(x / step)^power``: per("2 mm", 2) is ``nT per (2 mm)^2``."""
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
    """Return the candidate of an effect; `phi` and `origin` are arguments of :func:`effect_columns`.

    `width` is the plausible size of the coefficients. `unit` is their common unit, or a sequence of units,
    one for each of equal parts of the coefficients.
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
    """Return the candidate of an error of the reference, ``sum_k b_k basis_k(t)``, nT."""
    columns = lambda rows: problem.reference_jacobian[rows, None] * basis(rows) * width  # noqa: E731 - a regressor is one line
    return Candidate(cause, None, columns, width, names, ("nT",) * len(width), about=kind)
