r"""Compute solutions, determinant and part of the inverse of sparse precision matrices.

Solutions and determinant come from a Cholesky factor in a band, because nodes that are numbered strip by
strip couple only to nodes of the next strips (20 ms for 4,000 nodes; SuperLU takes 80 ms). Variances need
blocks of the inverse. Such a matrix has blocks that couple only to the next block. With blocks :math:`D_i` on
the diagonal and :math:`E_i` below it,

.. math:: L_i L_i^T = D_i - M_i M_i^T, \quad M_i = E_i L_{i-1}^{-T}, \quad G_i = L_i^{-T} M_{i+1}^T

.. math:: \Sigma_{i,i+1} = -G_i \Sigma_{i+1,i+1}, \quad
          \Sigma_{ii} = (L_i L_i^T)^{-1} + G_i \Sigma_{i+1,i+1} G_i^T

(Takahashi et al. 1973; Rue & Martino 2007).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpbtrf, dpbtrs, dpotrf, dtbtrs
from scipy.sparse import csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from magbridge.arrays import FloatArray, IndexArray

__all__ = ["InverseBlocks", "SparseFactor", "inverse_blocks"]


class SparseFactor:
    """Cholesky factor, in a band, of a symmetric positive definite sparse matrix (n, n).

    LinAlgError: the matrix is not positive definite.
    """

    def __init__(self, matrix: csr_array) -> None:
        n = matrix.shape[0]
        row, column = np.repeat(np.arange(n), np.diff(matrix.indptr)), matrix.indices
        self._order = self._rank = np.arange(n)
        # On a square of s x s nodes whose coupling reaches r strips, the band is r s wide, and nnz = 2 r² s².
        # A track along a strip has a wider band: reverse Cuthill-McKee numbers nodes along the track.
        if np.abs(row - column).max() > matrix.nnz**0.5:
            self._order = reverse_cuthill_mckee(matrix, symmetric_mode=True)
            self._rank = np.argsort(self._order)
            row, column = self._rank[row], self._rank[column]
        # LAPACK keeps the element (i, j) of the lower triangle at (i - j, j).
        lower = row >= column
        below, column = (row - column)[lower], column[lower]
        band = np.zeros((below.max() + 1, n), order="F")
        band[below, column] = matrix.data[lower]
        self._band, info = dpbtrf(band, lower=True, overwrite_ab=True)
        if info or not (self._band[0] > 0.0).all():
            raise np.linalg.LinAlgError("not positive definite")
        self.log_determinant = 2.0 * float(np.log(self._band[0]).sum())

    def solve(self, right: FloatArray) -> FloatArray:
        """Return the inverse of the matrix times `right`, (n,) or (n, r)."""
        return np.asarray(dpbtrs(self._band, right[self._order], lower=True)[0][self._rank])

    def draw(self, white: FloatArray) -> FloatArray:
        """Return random vectors (n, k) with the inverse as covariance, from `white` (n, k) ~ N(0, 1).

        For the matrix ``P^T L L^T P`` it is ``P^T L^-T white`` (Rue & Held 2005, section 2.4).
        """
        return np.asarray(dtbtrs(self._band, white, uplo="L", trans="T")[0][self._rank])


@dataclass(frozen=True, eq=False)
class InverseBlocks:
    """Blocks of an inverse between `edges` (b + 1,): `own` on the diagonal, `off_diagonal` right of it."""

    edges: IndexArray
    own: tuple[FloatArray, ...]
    off_diagonal: tuple[FloatArray, ...]

    def variances(self, rows: csr_array) -> FloatArray:
        """Return the variance (m,) of each combination in `rows` (m, n), which may span two blocks."""
        out = np.zeros(rows.shape[0])
        some = np.diff(rows.indptr) > 0
        if not some.any():
            return out
        first = np.zeros(rows.shape[0], np.intp)
        first[some] = np.minimum.reduceat(rows.indices, rows.indptr[:-1][some])
        at = np.searchsorted(self.edges, first, side="right") - 1
        for i in np.unique(at[some]).tolist():
            of = np.flatnonzero((at == i) & some)
            mine = rows[of]
            here = mine[:, self.edges[i] : self.edges[i + 1]].toarray()
            out[of] = np.einsum("mi,mi->m", here @ self.own[i], here)
            if i + 1 < len(self.own):
                there = mine[:, self.edges[i + 1] : self.edges[i + 2]].toarray()
                out[of] += np.einsum(
                    "mi,mi->m", 2.0 * here @ self.off_diagonal[i] + there @ self.own[i + 1], there
                )
        return out


def inverse_blocks(matrix: csr_array, edges: IndexArray) -> InverseBlocks:
    """Return the blocks on and next to the diagonal of the inverse of a block-tridiagonal matrix (n, n).

    LinAlgError: the matrix is not positive definite.
    """
    # Block Cholesky forward: D_i - M_i M_i^T = L_i L_i^T with M_i = B_i L_(i-1)^-T.
    diagonal: list[FloatArray] = []
    below: list[FloatArray] = []
    for i in range(len(edges) - 1):
        rows = matrix[edges[i] : edges[i + 1]]
        D = rows[:, edges[i] : edges[i + 1]].toarray()
        if i:
            M = _lower(diagonal[-1], rows[:, edges[i - 1] : edges[i]].toarray().T).T
            below.append(M)
            D -= M @ M.T
        L, info = dpotrf(D, lower=True, clean=True)
        if info:
            raise np.linalg.LinAlgError("not positive definite")
        diagonal.append(L)
    # Backward recursion for the blocks of the inverse (Takahashi; Rue & Held 2005, section 2.4).
    own: list[FloatArray] = [np.empty(0)] * len(diagonal)
    off_diagonal: list[FloatArray] = [np.empty(0)] * len(below)
    for i in reversed(range(len(diagonal))):
        inverse = _lower(diagonal[i], np.eye(len(diagonal[i])))
        own[i] = inverse.T @ inverse
        diagonal[i] = np.empty(0)
        if i < len(below):
            G = inverse.T @ below[i].T
            below[i] = np.empty(0)  # large, and not needed again
            off_diagonal[i] = -G @ own[i + 1]
            own[i] -= off_diagonal[i] @ G.T
    return InverseBlocks(np.asarray(edges), tuple(own), tuple(off_diagonal))


def _lower(L: FloatArray, right: FloatArray) -> FloatArray:
    return np.asarray(solve_triangular(L, right, lower=True, check_finite=False))
