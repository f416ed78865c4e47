r"""Eliminate the sparse unknowns w of a joint fit, which leaves information about the few dense unknowns z.

The linearised residual of a sample is :math:`e = y + D z + B w`, with D dense (coefficients, bias, slow
changes with time) and B sparse (splines in space). The AR(1) noise has the standard deviation :math:`\sigma`,
the autocorrelation :math:`\rho` and the correlation matrix R. The prior precision of w is
:math:`Q / (r\sigma)^2`, with r the ratio of the field's standard deviation to the noise's. By Schur's
complement the information about z (:class:`.GaussianInformation`) has the matrix H in

.. math:: N = B^T R^{-1} B + Q / r^2, \quad H = D^T R^{-1} D - D^T R^{-1} B\, N^{-1} B^T R^{-1} D

The elimination adds :math:`\tfrac12 \log|Q / r^2| - \tfrac12 \log|N|` to the log evidence. Three sums over
the samples serve every autocorrelation, so a fit can try several values at little cost.
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

__all__ = [
    "MAX_CONDITION", "ColumnProducts", "FieldEliminated", "LinearisedRows", "SampleSums", "eliminate_field",
    "sum_rows",
]  # fmt: skip

MAX_CONDITION = 1e16
"""Largest condition number of a prior's precision. Beyond it, rounding changes the log evidence by 3 to 10,
which can lead the maximisation to a field of ten times the length."""


class LinearisedRows(NamedTuple):
    """Linearised samples: ``V = [y | D]`` (n, 1 + q), B (n, nodes), and `follows` (n,).

    `follows`: True for a sample one interval after the previous row. `overlap`: True if the first row repeats
    the last row of the previous piece and serves only as predecessor of the second.
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
        """Return these products plus `factor` times the other `products`."""
        return ColumnProducts(
            self.VV + factor * products.VV,
            self.VB + factor * products.VB,
            csr_array(self.BB + factor * products.BB),
        )

    def times(self, factor: float) -> ColumnProducts:
        """Return these products multiplied by `factor`."""
        return ColumnProducts(factor * self.VV, factor * self.VB, csr_array(factor * self.BB))

    @classmethod
    def from_rows(cls, V: FloatArray, B: csr_array, weight: FloatArray | None = None) -> ColumnProducts:
        """Return the products of rows V (n, 1 + q) and B (n, nodes), each counted `weight` (n,) times."""
        if weight is None:
            return cls(V.T @ V, np.asarray((B.T @ V).T), csr_array(B.T @ B))
        C = csr_array(diags_array(weight) @ B)
        return cls(V.T @ (weight[:, None] * V), np.asarray((C.T @ V).T), csr_array(B.T @ C))


@dataclass(frozen=True, eq=False)
class SampleSums:
    r"""Three sums over all samples, from which the products follow for any autocorrelation of the noise.

    Attributes
    ----------
    every, ends, changes : ColumnProducts
        T of all samples; X of the first and last sample of each run, twice of a single sample; C of the
        differences between successive samples of a run. With autocorrelation rho,

        .. math:: \sum r_i r_i^T = \frac{1}{1 + \rho}
                  \left[(1 - \rho)\, T + \rho\, X + \frac{\rho}{1 - \rho}\, C\right]

        for the whitened rows :math:`r_i = (v_i - \rho v_{i-1}) / \sqrt{1 - \rho^2}`, and :math:`r_i = v_i` at
        the first sample of a run. No large terms cancel.
    samples, pairs : int
        Number of samples, and of pairs of successive samples.
    """

    every: ColumnProducts
    ends: ColumnProducts
    changes: ColumnProducts
    samples: int
    pairs: int

    def whitened(self, rho: float) -> ColumnProducts:
        """Return the products of the rows whitened with autocorrelation `rho`."""
        if not rho:
            return self.every
        # The three terms of the formula above, for this rho.
        ends = self.every.times((1.0 - rho) / (1.0 + rho)).plus(self.ends, rho / (1.0 + rho))
        return ends.plus(self.changes, rho / (1.0 - rho * rho))


def sum_rows(pieces: Iterable[LinearisedRows]) -> SampleSums:
    """Return the sums over the pieces of a log, given in order."""
    total: list[ColumnProducts] | None = None
    samples = pairs = 0
    for V, B, followers, overlap in pieces:
        # Pieces overlap by one row, so that differences across their border count once.
        new, follows = slice(int(overlap), None), followers.copy()
        follows[0] = False
        ahead = np.append(follows[1:], False)
        # 1 for a sample with one neighbour, 2 for one with none, 0 inside a stretch.
        ends = 2.0 - follows - ahead
        if overlap:  # the previous piece counted this row as an end
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
    """Result of the elimination: information about z, and w as a function of z."""

    quadratic: GaussianInformation
    """Information about z (q,)."""
    log_evidence: float
    """Contribution of the elimination of w and of whitening to the log evidence."""
    precision: csr_array
    """(nodes, nodes): N, the precision of w given z, in units of the noise's precision."""
    shift: FloatArray
    """(nodes,): w at z = 0."""
    follow: FloatArray
    """(nodes, q): dw/dz."""

    def field(self, z: FloatArray) -> FloatArray:
        """Return w (nodes,) at z (q,)."""
        return np.asarray(self.shift + self.follow @ z)


def eliminate_field(sums: SampleSums, field: GaussianField, ratio: float, rho: float) -> FieldEliminated:
    """Eliminate w, the coefficients of the field in space, from a joint fit.

    `sums`: sums over the samples. `field`: prior of w for unit variance. `ratio`: standard deviation of the
    field divided by that of the noise. `rho`: autocorrelation of the noise.

    LinAlgError: a precision is not positive definite in floating point, or too badly conditioned.
    """
    if field.condition > MAX_CONDITION:
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
