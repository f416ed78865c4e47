r"""The uncertainty of nonlinear parameters, and its contribution to the covariance of all coefficients.

Notes
-----
*Within a cell of their grid* the likelihood has one peak. The nonlinear parameters s have the derivatives
``J_s = d(X b)/ds``. M is their information with calibration and effects projected out, and K is by how much
all other coefficients change for a unit of each (:mod:`.information`). With the prior N(0, 1) in units of a
cell, the covariance of the other coefficients is

.. math:: C + K (M + 1)^{-1} K^T

*Beyond that cell* there may be other peaks: those of an onset may differ by hours, each with a size of its
own. With d_k the difference of all coefficients at another point of the grid, C_k their covariance there, and
w_k that point's posterior weight, the mixture of all points has the covariance

.. math:: C + \sum_k w_k \left(d_k d_k^T + C_k - C\right)

A point's weight is its evidence. The estimate was profiled within its cell, so its evidence is reduced by the
log of the share of the cell that it holds (:attr:`~magbridge.diagnose.causes.candidates.GridPoint.narrow`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.diagnose.causes.candidates import Candidate, slices
from magbridge.diagnose.compare.design_columns import Columns
from magbridge.diagnose.compare.problem import Problem
from magbridge.diagnose.inference.evidence import score
from magbridge.diagnose.inference.information import Information, information
from magbridge.diagnose.inference.joint import Joint

__all__ = ["loosened"]

Placed = tuple[Candidate, slice]
"""A candidate, and where its columns are."""

STEP_CELL_FRACTION = 0.05
"""Fraction of a grid cell by which a parameter is moved for its derivative."""


def loosened(
    problem: Problem,
    model: Sequence[Candidate],
    columns: Sequence[Columns],
    fit: Joint,
    grid: Sequence[Candidate] = (),
) -> Joint:
    """Return the fit with the coefficients' covariance for nonlinear parameters that are free as well.

    Parameters
    ----------
    problem : Problem
        The survey.
    model : sequence of Candidate
        The causes found.
    columns : sequence of Columns
        Of the model, in this problem.
    fit : Joint
        Of the model, its nonlinear parameters held.
    grid : sequence of Candidate
        All candidates that were searched.
    """
    pieces = [piece for candidate in model for piece in candidate.pieces]
    if all(piece.point.rebuild is None for piece in pieces):
        return fit
    more = _within(problem, pieces, columns, fit) + _beyond(problem, pieces, columns, fit, grid)
    return replace(fit, covariance=fit.covariance + 0.5 * (more + more.T))


def _within(
    problem: Problem, pieces: Sequence[Candidate], columns: Sequence[Columns], fit: Joint
) -> FloatArray:
    """(q + k, q + k) covariance added by the parameters' uncertainty within their cells."""
    jacobian = [
        slope
        for piece, at in zip(pieces, slices(pieces), strict=True)
        for slope in _jacobian(piece, fit.coefficients[at])
    ]
    if not jacobian:
        return np.zeros_like(fit.covariance)
    info = information(problem, fit.noise, fit, [*jacobian, *columns]).fitted(fit)
    K = info.shift
    return np.asarray(K @ np.linalg.solve(info.matrix + np.eye(len(jacobian)), K.T))


def _jacobian(piece: Candidate, b: FloatArray) -> Iterator[Columns]:
    """Yield the derivative of the residual by each nonlinear parameter, in units of its cell."""
    if piece.point.rebuild is None:
        return
    values = [value for value, _ in piece.point.shape.values()]
    for k, cell in enumerate(piece.point.cells):
        near = [value + STEP_CELL_FRACTION * cell * (n == k) for n, value in enumerate(values)]
        moved = piece.point.rebuild(*near)

        def columns(rows: slice, moved: Candidate = moved) -> FloatArray:
            return np.asarray((moved.columns(rows) - piece.columns(rows)) @ b / STEP_CELL_FRACTION)[:, None]

        yield columns


def _beyond(
    problem: Problem,
    pieces: Sequence[Candidate],
    columns: Sequence[Columns],
    fit: Joint,
    grid: Sequence[Candidate],
) -> FloatArray:
    """(q + k, q + k) covariance added by all other cells."""
    more = np.zeros_like(fit.covariance)
    points = [
        [c for c in grid if piece.point.rebuild and (c.group, c.names) == (piece.group, piece.names)]
        for piece in pieces
    ]
    every = [candidate for some in points for candidate in some]
    if not every:
        return more
    info = information(problem, fit.noise, fit, [*(candidate.columns for candidate in every), *columns])
    places = iter(placed := list(zip([*every, *pieces], slices([*every, *pieces]), strict=True)))
    for placed_piece, some in zip(placed[len(every) :], points, strict=True):
        if some:
            more += _elsewhere(info, fit, placed_piece, [next(places) for _ in some])
    return more


def _elsewhere(info: Information, fit: Joint, placed_piece: Placed, points: Sequence[Placed]) -> FloatArray:
    """(q + k, q + k) covariance added by the other points of one piece's grid."""
    piece, own = placed_piece
    q, first = len(fit.z), len(info.score) - fit.coefficients.size
    here = slice(own.start - first, own.stop - first)
    rest = np.setdiff1d(np.arange(first, len(info.score)), np.r_[own])
    prior = np.diag(fit.prior[q + rest - first])
    K = np.linalg.solve(info.matrix[np.ix_(rest, rest)] + prior, info.matrix[rest])
    alone = info.instead(fit, own)

    def moments(candidate: Candidate, place: slice) -> tuple[float, FloatArray, FloatArray]:
        """Return evidence, all coefficients and their covariance, each up to a part common to all points."""
        s = score(alone, place, candidate)
        # the other causes change with this one, and the calibration with all of them
        way = np.zeros((len(fit.covariance), candidate.size))
        way[:q] = info.shift[:, rest] @ K[:, place] - info.shift[:, place]
        way[q + rest - first] = -K[:, place]
        way[q + here.start : q + here.stop] = np.eye(candidate.size)
        spread = np.linalg.inv(alone.matrix[place, place] + np.diag(fit.prior[q:][here]))
        return s.evidence, way @ s.estimate, way @ spread @ way.T

    evidence, c, C = moments(piece, own)
    others = [moments(candidate, place) for candidate, place in points]
    logs = np.array([evidence - piece.point.narrow, *(e for e, _, _ in others)])
    weight = np.exp(logs - logs.max())
    apart = zip(weight[1:] / weight.sum(), others, strict=True)
    return np.asarray(sum(w * (np.outer(c_k - c, c_k - c) + C_k - C) for w, (_, c_k, C_k) in apart))
