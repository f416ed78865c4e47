"""Columns of a design matrix, made row by row; mixtures of columns that share parts; those of effects."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import accumulate, pairwise

import numpy as np
from scipy.sparse import csr_array

from magbridge.arrays import BoolArray, FloatArray
from magbridge.calibration.terms import Effect
from magbridge.diagnose.compare.problem import Problem

__all__ = [
    "Columns", "Interpolated", "Mixture", "Since", "effect_columns", "parts", "places", "side_by_side",
    "size_of", "times", "together",
]  # fmt: skip

Columns = Callable[[slice], FloatArray]
"""A function from a slice of m rows to (m, k): what one unit of each of k coefficients, if the calibration
lacks it, adds to the residual. Best stored column by column."""


@dataclass(frozen=True, eq=False)
class Mixture:
    r"""Columns that are linear combinations of further columns: :math:`\sum_i X_i M_i`.

    Many hypotheses share few parts: one lagged temperature serves all the origins that it is tried with.
    Sums over a log are therefore taken once for each different ``X_i``.
    """

    parts: tuple[tuple[Columns, FloatArray], ...]
    """X_i and M_i."""

    def __call__(self, rows: slice) -> FloatArray:
        """(m, k) these rows."""
        return np.asarray(sum(M.T @ X(rows).T for X, M in self.parts)).T

    def times(self, widths: FloatArray) -> Mixture:
        """Return the columns in units of `widths` (k,)."""
        return Mixture(tuple((X, M * widths) for X, M in self.parts))


@dataclass(frozen=True, eq=False)
class Interpolated:
    """Columns interpolated from their values at a few nodes: ``W V``."""

    weights: csr_array
    """(n, c) W, the weights of each row's nodes."""
    values: FloatArray
    """(c, k) V, the columns at the nodes."""

    def __call__(self, rows: slice) -> FloatArray:
        """(m, k) these rows."""
        return np.asarray(self.weights[rows] @ self.values)


@dataclass(frozen=True)
class Since:
    """Columns set to zero in the rows where `fresh` (n,) is false."""

    columns: Columns
    fresh: BoolArray = field(compare=False)

    def __call__(self, rows: slice) -> FloatArray:
        """(m, k) these rows."""
        return (self.columns(rows).T * self.fresh[rows]).T


def parts(columns: Columns) -> tuple[tuple[Columns, FloatArray], ...]:
    """Return the pairs (X_i, M_i (p_i, k)) of a mixture; other columns are their own only part, M = I."""
    if isinstance(columns, Mixture):
        return columns.parts
    return ((columns, np.eye(size_of(columns))),)


def size_of(columns: Columns) -> int:
    """Return how many columns there are."""
    return len(columns(slice(0, 1)).T)


def places(sizes: Iterable[int], first: int = 0) -> list[slice]:
    """Return where blocks of so many columns each stand side by side, from `first` on."""
    return [slice(*ends) for ends in pairwise(accumulate(sizes, initial=first))]


def times(columns: Columns, rows: slice, c: FloatArray) -> FloatArray:
    """(m,) product of the columns' rows and coefficients c (k,), without building all columns if possible."""
    if isinstance(columns, Mixture):
        return np.asarray(sum(times(X, rows, M @ c) for X, M in columns.parts))
    if isinstance(columns, Interpolated):
        return np.asarray(columns.weights[rows] @ (columns.values @ c))
    return np.asarray(columns(rows) @ c)


def together(columns: Sequence[Columns]) -> Mixture:
    """Return all columns side by side as one mixture, in which shared parts occur once."""
    listed = [parts(one) for one in columns]
    sizes = [blocks[0][1].shape[1] for blocks in listed]
    found: dict[Columns, FloatArray] = {}
    for blocks, own in zip(listed, places(sizes), strict=True):
        for X, M in blocks:
            found.setdefault(X, np.zeros((len(M), sum(sizes))))[:, own] += M
    return Mixture(tuple(found.items()))


def side_by_side(blocks: Sequence[FloatArray]) -> FloatArray:
    """(m, k) blocks of columns side by side, stored column by column."""
    out = np.empty((sum(block.shape[1] for block in blocks), len(blocks[0])))
    return np.concatenate([block.T for block in blocks], out=out).T


@dataclass(frozen=True)
class Products:
    """Products of functions of time and slopes, from which the columns of effects are made."""

    problem: Problem
    phi: Callable[[slice], FloatArray] | None
    """Rows -> (r, m) functions; 1 if there is none."""
    pairs: tuple[tuple[int, int], ...]
    """For each column, the place of its function and the slot of its slope."""

    def __call__(self, rows: slice) -> FloatArray:
        """(m, pairs) these rows."""
        functions, slots = zip(*self.pairs, strict=True)
        jacobian = self.problem.jacobian.T[_run(slots), rows]
        if self.phi is None:
            return np.asarray(jacobian).T
        shared = len(set(functions)) == 1
        return np.asarray(self.phi(rows)[_run(functions[:1] if shared else functions)] * jacobian).T


def _run(places: Sequence[int]) -> slice | list[int]:
    """Return consecutive places as a slice, which indexes without a copy."""
    run = range(places[0], places[0] + len(places))
    return slice(run.start, run.stop) if tuple(run) == tuple(places) else list(places)


def effect_columns(
    problem: Problem,
    effect: Effect,
    phi: FloatArray | Callable[[slice], FloatArray] | None = None,
    origin: float = 0.0,
) -> Mixture:
    """Return the columns of an effect's coefficients.

    Its regressors are `phi` less `origin`; `phi` is (r, n), or a function from m rows to (r, m); by default
    they are those of the effect's own array form.
    """
    if phi is None:
        whole = effect.batch(problem.series(effect)) if effect.remembers else None
        phi = whole if whole is not None else lambda rows: effect.batch(problem.series(effect, rows))
    tensor = -effect.columns(problem.calibration.reference.field)
    pairs = [(int(r), int(s)) for r, s in np.argwhere(tensor.any(axis=0))]
    M = np.stack([tensor[:, r, s] for r, s in pairs])
    made = Products(problem, phi if callable(phi) else _rows(phi), tuple(pairs))
    if not origin:
        return Mixture(((made, M),))
    return Mixture(((made, M), (Products(problem, None, tuple(pairs)), -origin * M)))


def _rows(phi: FloatArray) -> Callable[[slice], FloatArray]:
    return lambda rows: phi[:, rows]
