r"""The uncertainty of nonlinear parameters, and what it adds to the covariance of all coefficients.

Notes
-----
With the parameters' derivatives ``J_s = d(X b)/ds`` beside the columns of calibration and effects, their information is the
matrix M of what is left of ``J_s`` when those are projected out, and these give way to a unit of each by K
(:mod:`.information`). So with a prior of a cell of their grid, N(0, 1) in its units, all others' covariance is

.. math:: C + K (M + 1)^{-1} K^T
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magbridge.diagnose.causes.candidates import Candidate
from magbridge.diagnose.compare.columns import Columns
from magbridge.diagnose.compare.problem import Problem
from magbridge.diagnose.inference.information import information
from magbridge.diagnose.inference.joint import Joint

__all__ = ["loosened"]

FloatArray = NDArray[np.float64]

SHARE = 0.05
"""Fraction of a grid cell by which a parameter is moved for its derivative."""


def loosened(problem: Problem, model: Sequence[Candidate], columns: Sequence[Columns], fit: Joint) -> Joint:
    """Return the fit with the covariance that its coefficients have when the nonlinear parameters are free, too.

    Parameters
    ----------
    problem : Problem
    model : sequence of Candidate
    columns : sequence of Columns
        Theirs, in this problem.
    fit : Joint
    """
    slopes: list[Columns] = []
    at = 0
    for piece in (piece for candidate in model for piece in candidate.pieces):
        slopes += _slopes(piece, fit.coefficients[at : at + piece.size])
        at += piece.size
    if not slopes:
        return fit
    info = information(problem, fit.noise, fit, [*slopes, *columns]).fitted(fit)
    K = info.shift
    given: FloatArray = np.asarray(np.linalg.solve(info.matrix + np.eye(len(slopes)), K.T), float)
    more = K @ given
    return replace(fit, covariance=fit.covariance + 0.5 * (more + more.T))


def _slopes(piece: Candidate, b: FloatArray) -> Iterator[Columns]:
    """Yield what a cell of each nonlinear parameter does to the residual."""
    if piece.again is None:
        return
    values = [value for value, _ in piece.shape.values()]
    for k, cell in enumerate(piece.cells):
        near = [value + SHARE * cell * (n == k) for n, value in enumerate(values)]
        moved = piece.again(*near)

        def columns(rows: slice, moved: Candidate = moved) -> FloatArray:
            return np.asarray((moved.columns(rows) - piece.columns(rows)) @ b / SHARE)[:, None]

        yield columns
