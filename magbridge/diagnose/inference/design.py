"""The columns of a hypothesis, and their sums over a log of any length."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from threading import current_thread
from typing import TypeVar

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.diagnose.compare.design_columns import Columns, places, side_by_side, size_of, times
from magbridge.diagnose.compare.problem import Problem
from magbridge.diagnose.inference.noise import Noise

__all__ = ["ALL_PRODUCTS", "Design", "in_threads", "normal", "pieces", "precomputed"]

S = TypeVar("S")
T = TypeVar("T")

WHITENED_ROWS = 2048
"""Rows that are whitened at a time, few enough for the processor's cache."""
MAX_STORED_NUMBERS = 12_500_000
"""Most numbers of columns that are kept in memory: 100 MB."""
ALL_PRODUCTS = ((slice(None), slice(None)),)
"""Products of every column with every other."""
THREADS, LONG, POOL = 2, 32768, "diagnose"
"""Threads that share the work on a log, rows from which they are worth their while, and their name."""


def precomputed(n: int, columns: Sequence[Columns]) -> list[Columns]:
    """Return the columns of n rows precomputed, or unchanged where that would fill the memory."""
    if n * sum(map(size_of, columns)) > MAX_STORED_NUMBERS:
        return list(columns)

    def whole(column: Columns) -> FloatArray:
        return np.concatenate([column(rows).T for rows in pieces(n)], axis=1).T

    return [made.__getitem__ for made in in_threads(n, whole, columns)]


def pieces(n: int) -> list[slice]:
    """Return the pieces in which n rows are processed."""
    return [slice(start, min(start + WHITENED_ROWS, n)) for start in range(0, n, WHITENED_ROWS)]


class Design:
    """The columns of a hypothesis, the calibration's and the effects'.

    Parameters
    ----------
    problem : Problem
    columns : sequence of Columns
        The effects'.
    """

    def __init__(self, problem: Problem, columns: Sequence[Columns]) -> None:
        self.calibration_jacobian, self.columns = problem.calibration_jacobian, columns
        self.pieces = pieces(len(problem))
        sizes = [size_of(column) for column in columns]
        self.at, self.effects = places(sizes, self.calibration_jacobian.shape[1]), sum(sizes)

    def rows(self, rows: slice) -> FloatArray:
        """(m, q + k) rows of all columns."""
        return side_by_side([self.calibration_jacobian[rows], *(column(rows) for column in self.columns)])

    def times(self, c: FloatArray) -> FloatArray:
        """(n,) ``X c``, the product of all columns and coefficients c (q + k,)."""
        asked = [(own, column) for own, column in zip(self.at, self.columns, strict=True) if c[own].any()]

        def piece(rows: slice) -> FloatArray:
            out = np.asarray(self.calibration_jacobian[rows] @ c[: self.calibration_jacobian.shape[1]])
            for own, column in asked:
                out += times(column, rows, c[own])
            return out

        return np.concatenate(in_threads(len(self.calibration_jacobian), piece, self.pieces))


def normal(
    X: Columns, y: FloatArray, noise: Noise | None = None, asked: Sequence[tuple[slice, slice]] = ALL_PRODUCTS
) -> tuple[FloatArray, FloatArray]:
    """Return ``X^T X`` (k, k) and ``X^T y`` (k,), X whitened if a noise is given.

    They are summed up in pieces that fit the processor's cache. Long logs are shared out among threads,
    always in the same way, so any machine returns the same numbers. Of ``X^T X`` only the blocks that are
    `asked` for are computed, and their transposes; the others are zero.
    """
    k = size_of(X)

    def share(some: Sequence[slice]) -> tuple[FloatArray, FloatArray]:
        P, b = np.zeros((k, k)), np.zeros(k)
        for rows in some:
            A = X(rows) if noise is None else noise.whitened(X, rows)
            for own, others in asked:
                P[own, others] += A[:, own].T @ A[:, others]
            b += A.T @ y[rows]
        return P, b

    every = pieces(len(y))
    each = -(-len(every) // THREADS) if len(y) > LONG else len(every)
    shares = in_threads(len(y), share, [every[n : n + each] for n in range(0, len(every), each)])
    P = np.asarray(sum(P for P, _ in shares))
    for own, others in asked:
        P[others, own] = P[own, others].T
    return P, np.asarray(sum(b for _, b in shares))


def in_threads(n: int, function: Callable[[S], T], given: Iterable[S]) -> list[T]:
    """Return the function's results for each argument `given`.

    For a log of many rows n the calls are shared out among threads, but not from within one of those.
    """
    if n <= LONG or current_thread().name.startswith(POOL):
        return [function(one) for one in given]
    return list(_pool().map(function, given))


@cache
def _pool() -> ThreadPoolExecutor:
    # the same threads all the time: the memory that new ones allocate would not be released
    return ThreadPoolExecutor(THREADS, POOL)
