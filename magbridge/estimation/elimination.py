r"""The algebra of a joint fit: few dense unknowns z, many sparse ones w, noise that is correlated in time.

Linearised, the residual of every sample is :math:`e = y + D z + B w`: D dense (coefficients, level, slow
changes with time), B sparse (splines in place). With AR(1) noise of size :math:`\sigma` and autocorrelation
:math:`\rho`, and the prior precision :math:`Q / (r\sigma)^2` of w, r the field's size over the noise's,

.. math:: N = B^T R^{-1} B + Q / r^2, \quad H = D^T R^{-1} D - D^T R^{-1} B\, N^{-1} B^T R^{-1} D

is what remains for z when w is eliminated (Schur's complement): a quadratic as any other fit has it
(:class:`.GaussianInformation`). Its evidence gains :math:`\tfrac12 \log|Q / r^2| - \tfrac12 \log|N|`. The
noise's autocorrelation enters by two more sums over the samples, so that trying another costs nothing.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array, diags_array

from magbridge.arrays import BoolArray, FloatArray
from magbridge.estimation.gaussian_field import GaussianField
from magbridge.estimation.information import GaussianInformation
from magbridge.estimation.sparse import SparseFactor

__all__ = ["ColumnProducts", "FieldEliminated", "LinearisedRows", "SampleSums", "eliminate_field", "sum_rows"]

WORST = 1e16
"""Largest condition of a prior's precision: beyond it rounding changes the log evidence by 3 to 10, and the
maximisation followed such steps to fields of ten times the length."""


class LinearisedRows(NamedTuple):
    """Linearised samples: ``V = [y | D]`` (n, 1 + q), B (n, nodes), and which follow the one before (n,).

    The first row may be one that was counted already (`overlap`): then only its successor looks at it.
    """

    V: FloatArray
    B: csr_array
    follows: BoolArray
    overlap: bool = False


@dataclass(frozen=True, eq=False)
class ColumnProducts:
    """Inner products of weighted columns: ``V^T V``, ``V^T B``, ``B^T B``."""

    VV: FloatArray
    VB: FloatArray
    BB: csr_array

    def plus(self, products: ColumnProducts, factor: float = 1.0) -> ColumnProducts:
        """Return the sum with `factor` times another."""
        return ColumnProducts(
            self.VV + factor * products.VV,
            self.VB + factor * products.VB,
            csr_array(self.BB + factor * products.BB),
        )

    def times(self, factor: float) -> ColumnProducts:
        """Return them `factor` times."""
        return ColumnProducts(factor * self.VV, factor * self.VB, csr_array(factor * self.BB))

    @classmethod
    def from_rows(cls, V: FloatArray, B: csr_array, weight: FloatArray | None = None) -> ColumnProducts:
        """Return those of rows V (n, 1 + q) and B (n, nodes), each counted `weight` (n,) times."""
        if weight is None:
            return cls(V.T @ V, np.asarray((B.T @ V).T), csr_array(B.T @ B))
        C = csr_array(diags_array(weight) @ B)
        return cls(V.T @ (weight[:, None] * V), np.asarray((C.T @ V).T), csr_array(B.T @ C))


@dataclass(frozen=True, eq=False)
class SampleSums:
    r"""All samples in three sums, whatever their noise's autocorrelation.

    Attributes
    ----------
    every, ends, changes : ColumnProducts
        T of all samples; X of those that follow none, and of those that none follows (of one that is both,
        twice); C of the differences between a sample and the one it follows. With autocorrelation rho,

        .. math:: \sum r_i r_i^T = \frac{1}{1 + \rho}
                  \left[(1 - \rho)\, T + \rho\, X + \frac{\rho}{1 - \rho}\, C\right]

        of the whitened rows :math:`r_i = (v_i - \rho v_{i-1}) / \sqrt{1 - \rho^2}`, and v where none came
        before; nothing in it cancels.
    samples, pairs : int
    """

    every: ColumnProducts
    ends: ColumnProducts
    changes: ColumnProducts
    samples: int
    pairs: int

    def whitened(self, rho: float) -> ColumnProducts:
        """Return the products of the whitened rows."""
        if not rho:
            return self.every
        # The three terms of the formula above, for this rho.
        ends = self.every.times((1.0 - rho) / (1.0 + rho)).plus(self.ends, rho / (1.0 + rho))
        return ends.plus(self.changes, rho / (1.0 - rho * rho))


def sum_rows(pieces: Iterable[LinearisedRows]) -> SampleSums:
    """Add up pieces of a log in order."""
    total: list[ColumnProducts] | None = None
    samples = pairs = 0
    for V, B, followers, overlap in pieces:
        # Pieces overlap by one row, so that differences across their border count once.
        new, follows = slice(int(overlap), None), followers.copy()
        follows[0] = False
        ahead = np.append(follows[1:], False)
        # 1 for a sample with one neighbour, 2 for one with none, 0 inside a stretch.
        ends = 2.0 - follows - ahead
        if overlap:  # it was an end as long as nothing came after it
            ends[0] = -float(ahead[0])
        some, pair = np.flatnonzero(ends), np.flatnonzero(follows)
        found = [
            ColumnProducts.from_rows(V[new], B[new]),
            ColumnProducts.from_rows(V[some], B[some], ends[some]),
            ColumnProducts.from_rows(V[pair] - V[pair - 1], csr_array(B[pair] - B[pair - 1])),
        ]
        total = found if total is None else [a.plus(b) for a, b in zip(total, found, strict=True)]
        samples, pairs = samples + len(V) - int(overlap), pairs + len(pair)
    assert total is not None
    every, ends, changes = total
    return SampleSums(every, ends, changes, samples, pairs)


@dataclass(frozen=True, eq=False)
class FieldEliminated:
    """What remains for z, and how w follows from it."""

    quadratic: GaussianInformation
    """In z."""
    log_evidence: float
    """What eliminating w and whitening add to it."""
    precision: csr_array
    """N, in units of the noise's."""
    shift: FloatArray
    """(nodes,), w at z = 0."""
    follow: FloatArray
    """(nodes, q), dw/dz."""

    def field(self, z: FloatArray) -> FloatArray:
        """Return w (nodes,) at z (q,)."""
        return np.asarray(self.shift + self.follow @ z)


def eliminate_field(sums: SampleSums, field: GaussianField, ratio: float, rho: float) -> FieldEliminated:
    """Eliminate the field in place.

    `sums`: of the samples. `field`: the prior of w for a field of unit variance. `ratio`: the field's
    standard deviation over that of the noise. `rho`: autocorrelation of the noise.

    LinAlgError: the precision is not positive definite in the machine's numbers, or the prior's may not be.
    """
    if field.condition > WORST:
        raise np.linalg.LinAlgError("the nodes are too fine for so long a field")
    # Normal equations of (z, w) with the field's prior precision Q / ratio^2 on w.
    products = sums.whitened(rho)
    precision = csr_array(products.BB + field.precision / ratio**2)
    # Schur's complement: eliminate w, V^T V - V^T B N^-1 B^T V.
    factor = SparseFactor(precision)
    solved = -factor.solve(products.VB.T)
    left = products.VV + products.VB @ solved
    H = 0.5 * (left[1:, 1:] + left[1:, 1:].T)
    nodes = field.nodes.size
    # Evidence: log|Q / ratio^2| - log|N|, and the determinant of the whitening.
    gained = 0.5 * (field.log_determinant - 2.0 * nodes * np.log(ratio) - factor.log_determinant)
    whitening = -0.5 * sums.pairs * np.log(1.0 - rho * rho)
    quadratic = GaussianInformation(H, -left[1:, 0], float(left[0, 0]), float(sums.samples))
    return FieldEliminated(quadratic, float(gained + whitening), precision, solved[:, 0], solved[:, 1:])
