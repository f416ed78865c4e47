r"""The information that the data hold on every candidate at once.

Notes
-----
One matrix serves the whole search: the inner products of the whitened columns of *all* candidates, summed up
in chunks, at a cost linear in samples. From it come scores, Occam factors, which causes are confounded, and
the distribution of the largest score under no effect.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array

from magbridge.arrays import FloatArray, IndexArray
from magbridge.diagnose.compare.design_columns import Columns, parts, places, side_by_side, together
from magbridge.diagnose.compare.problem import Problem
from magbridge.diagnose.inference.design import ALL_PRODUCTS, normal
from magbridge.diagnose.inference.joint import Joint
from magbridge.diagnose.inference.noise import Noise

__all__ = ["Information", "information"]


@dataclass(frozen=True, eq=False)
class Information:
    """Score and information of all candidates' coefficients, with calibration (and model) projected out."""

    matrix: FloatArray
    """(m, m) Fisher information, in units of the prior widths."""
    score: FloatArray
    """(m,)."""
    shift: FloatArray
    """(q + k, m) by how much calibration and model decrease for one unit of each coefficient."""

    def moved(self, base: Joint, at: slice | IndexArray, taken: FloatArray) -> FloatArray:
        """Return the likeliest calibration and model (q + k,) if the coefficients `at` these are `taken`."""
        return np.append(base.z, base.coefficients) - self.shift[:, at] @ taken

    def without(self, index: IndexArray, prior: FloatArray) -> Information:
        """Project out the coefficients at `index` as well, with their prior precision (i,)."""
        S = self.matrix[np.ix_(index, index)] + np.diag(prior)
        K = np.linalg.solve(S, self.matrix[index])
        return Information(
            self.matrix - self.matrix[:, index] @ K, self.score - K.T @ self.score[index], self.shift
        )

    def fitted(self, base: Joint) -> Information:
        """Project out the model of `base` as well, whose columns are the last."""
        m = len(self.score) - base.coefficients.size
        prior = base.prior[len(base.z) :]
        K: FloatArray = np.asarray(
            np.linalg.solve(self.matrix[m:, m:] + np.diag(prior), self.matrix[m:, :m]), float
        )
        return Information(
            self.matrix[:m, :m] - self.matrix[:m, m:] @ K,
            self.score[:m] - K.T @ (self.score[m:] - prior * base.coefficients),
            np.vstack([self.shift[:, :m] - self.shift[:, m:] @ K, K]),
        )

    def instead(self, base: Joint, *places: slice) -> Information:
        """Remove the coefficients at these places from the model of `base`, and project out its others.

        The model's columns are the last. The scores are those of what `base` leaves and of what the
        coefficients at these places explain in it.
        """
        first, own = len(self.score) - base.coefficients.size, np.r_[*places]
        others = np.setdiff1d(np.arange(first, len(self.score)), own)
        alone = self.without(others, base.prior[len(base.z) + others - first])
        return replace(alone, score=alone.score + alone.matrix[:, own] @ base.coefficients[own - first])


def information(
    problem: Problem, noise: Noise, base: Joint, columns: Sequence[Columns], unshared: int = 0
) -> Information:
    """Sum up the information of columns at `base` under `noise`, only the calibration projected out.

    The first `unshared` of them share no parts with any other, and their products with each other are not
    computed.
    """
    q, shared = problem.calibration_jacobian.shape[1], together(columns).parts
    alone = places((sum(len(M) for _, M in parts(one)) for one in columns[:unshared]), q)
    others = slice(alone[-1].stop if alone else q, None)
    asked = [(slice(q), slice(None)), *zip(alone, alone, strict=True), (others, slice(q, None))]
    G, b = normal(
        lambda rows: side_by_side([problem.calibration_jacobian[rows], *(X(rows) for X, _ in shared)]),
        noise.response(base.residual),
        noise,
        asked if unshared else ALL_PRODUCTS,
    )
    pull = base.prior[:q] * (problem.centre - base.z)
    K = np.linalg.solve(G[:q, :q] + np.diag(base.prior[:q]), G[:q, q:])
    M = csr_array(np.concatenate([M for _, M in shared]))
    return Information(
        M.T @ (G[q:, q:] - G[q:, :q] @ K) @ M, M.T @ (b[q:] - K.T @ (b[:q] + pull)), np.asarray(K @ M)
    )
