"""A calibration compiled into the table of its :class:`~magbridge.calibration.kernel.Kernel`.

Notes
-----
The nine coefficients become twelve in body axes: ``A' = R A`` (nine, R the boresight) and T. For the
covariance V of the corrected vector ``b = A' d, d = H_r - T``, write ``db = dA' d - A' dT``: V is quadratic
in d, and the table holds the covariance in just the combinations that V needs: 36 for the quadratic part Q,
27 for ``S_a'T``, 6 for ``S_TT`` (with the sensor's own noise, which acts like T's).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.kernel import TABLE_SUMS, Kernel
from magbridge.calibration.terms import Exponents
from magbridge.estimation.residual import PAIRS

if TYPE_CHECKING:
    from magbridge.calibration.model import Calibration

__all__ = ["coefficient_tensor", "compile_kernel"]

SLOT = ((0, 3, 4), (3, 1, 5), (4, 5, 2))
"""Index of ``A[i, k]`` among the nine coefficients."""


def compile_kernel(calibration: Calibration) -> Kernel:
    """Compile `calibration`; see the module's notes."""
    P, exponents = coefficient_tensor(calibration)
    row = {exponent: i for i, exponent in enumerate(exponents)}
    P[:, :, :6] /= calibration.reference.field
    W = np.tensordot(calibration.coefficients, P, 1)
    W[0, :3] += 1.0
    first, second, table = _table(P, W, calibration, exponents)
    return Kernel(
        centre=tuple(parameter.centre for parameter in calibration.parameters),
        scale=tuple(parameter.scale for parameter in calibration.parameters),
        field=calibration.reference.field,
        parents=tuple((row[_parent(e)[0]], _parent(e)[1]) for e in exponents[1:]),
        weights=W,
        first=first,
        second=second,
        table=np.ascontiguousarray(table.T),
    )


def coefficient_tensor(calibration: Calibration) -> tuple[FloatArray, list[Exponents]]:
    """Return what one unit of each coefficient adds to each regressor's nine slots, and the monomials.

    Returns
    -------
    tensor : (K, m, 9) array
        nT at F_0, as :class:`~magbridge.calibration.terms.Expansion`; the regressors are the monomials, then
        those of the effects.
    exponents : list of tuple of int
        The monomials in the kernel's order: each follows from one before it.
    """
    expansions = [term.expand(calibration.parameters) for term in calibration.terms]
    exponents = _closed({e for expansion in expansions for e in expansion.exponents}, calibration)
    row = {exponent: i for i, exponent in enumerate(exponents)}
    effects = [effect.columns(calibration.reference.field) for effect in calibration.effects]
    m = len(exponents) + sum(columns.shape[1] for columns in effects)
    tensor = np.zeros((calibration.coefficients.size, m, 9))
    k, r = 0, len(exponents)
    for expansion in expansions:
        rows = [row[exponent] for exponent in expansion.exponents]
        tensor[k : k + len(expansion.columns), rows] = expansion.columns
        k += len(expansion.columns)
    for columns in effects:
        tensor[k : k + columns.shape[0], r : r + columns.shape[1]] = columns
        k, r = k + columns.shape[0], r + columns.shape[1]
    return tensor, exponents


def _parent(exponent: Exponents) -> tuple[Exponents, int]:
    """Return the monomial that is lower by one power of one position, and the index of that position."""
    k = max(i for i, power in enumerate(exponent) if power)
    return (*exponent[:k], exponent[k] - 1, *exponent[k + 1 :]), k


def _closed(exponents: set[Exponents], calibration: Calibration) -> list[Exponents]:
    """Return `exponents` and all their parents, by degree: each follows from one before it."""
    todo = [*exponents, (0,) * len(calibration.parameters)]
    closed: set[Exponents] = set()
    while todo:
        exponent = todo.pop()
        if exponent not in closed:
            closed.add(exponent)
            if any(exponent):
                todo.append(_parent(exponent)[0])
    return sorted(closed, key=lambda e: (sum(e), [-power for power in e]))


def _body_axes(calibration: Calibration) -> FloatArray:
    """Return the matrix (9, 12) from A's six entries and T to the nine of ``R A``, row by row, and T."""
    R = np.eye(3) if calibration.boresight is None else calibration.boresight.matrix()
    B = np.zeros((9, 12))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                B[SLOT[j][k], 3 * i + k] += R[i, j]
    B[6:, 9:] = np.eye(3)
    return B


def _table(
    P: FloatArray, W: FloatArray, calibration: Calibration, exponents: list[Exponents]
) -> tuple[IndexArray, IndexArray, FloatArray]:
    """Return the two regressors of each product, (q,) and (q,), and each product's share of the 81 sums."""
    m, B = len(W), _body_axes(calibration)
    flat = (P @ B).reshape(len(P), -1)
    C = (flat.T @ calibration.covariance @ flat).reshape(m, 12, m, 12)

    def key(i: int, j: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
        powers = [np.array(exponents[r]) for r in (i, j) if r < len(exponents)]
        return tuple(np.sum(powers, axis=0).astype(int)) if powers else (), tuple(
            sorted(r for r in (i, j) if r >= len(exponents))
        )

    products: dict[tuple[tuple[int, ...], tuple[int, ...]], list[tuple[int, int]]] = {}
    for i in range(m):
        for j in range(i, m):
            products.setdefault(key(i, j), []).append((i, j))
    table = np.zeros((len(products), TABLE_SUMS))
    table[:m, :12] = W @ B
    for q, pairs in enumerate(products.values()):
        S = np.sum([C[i, :, j] + (C[j, :, i] if i != j else 0.0) for i, j in pairs], axis=0)
        if q == 0:  # the sensor's noise adds to the reading just as an error of T does
            S[9:, 9:] += calibration.noise.sensor**2 * np.eye(3)
        table[q, 12:] = _combinations(S)
    first, second = np.array([pairs[0] for pairs in products.values()]).T
    return first, second, table


def _combinations(S: FloatArray) -> FloatArray:
    """Return (69,): Q (V's six entries by the six products of d), ``S_a'T`` (9 x 3), ``S_TT`` (6)."""
    Q = [
        S[3 * i + k, 3 * j + l] + (S[3 * i + l, 3 * j + k] if k != l else 0.0)
        for i, j in PAIRS
        for k, l in PAIRS  # noqa: E741  (the index of the equation)
    ]
    return np.array([*Q, *S[:9, 9:].ravel(), *(S[9 + i, 9 + j] for i, j in PAIRS)])
