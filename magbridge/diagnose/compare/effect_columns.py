"""The columns of an effect: products of functions of time and slopes of the residual."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.terms import Effect
from magbridge.diagnose.compare.design_columns import Mixture
from magbridge.diagnose.compare.problem import Problem

__all__ = ["effect_columns"]


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
