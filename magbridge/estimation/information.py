r"""Gaussian information: the log likelihood of Gaussian data as a quadratic in the unknowns.

Data :math:`y = J z + v`, with white noise v of unit variance, have the log likelihood

.. math:: \log L(z) = -\tfrac12 z^T \Lambda z + \eta^T z - \tfrac12 c - \tfrac{n}{2}\log 2\pi,
          \quad \Lambda = J^T J,\ \eta = J^T y,\ c = y^T y.

Information of independent data adds (:meth:`GaussianInformation.__add__`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from magbridge.arrays import FloatArray, IndexArray
from magbridge.errors import CalibrationError

__all__ = ["GaussianInformation", "covariance_of"]


@dataclass(frozen=True, eq=False)
class GaussianInformation:
    """Information of data about q unknowns z; see the module's notes."""

    precision: FloatArray
    """(q, q): Lambda, which may be singular."""
    vector: FloatArray
    """(q,): eta."""
    constant: float = 0.0
    """c: the sum of squares at z = 0, in units of the noise; the noise's determinant is not part of it."""
    n: float = 0.0
    """Number of samples."""

    @classmethod
    def from_derivatives(
        cls, z: FloatArray, hessian: FloatArray, gradient: FloatArray, cost: float, n: float
    ) -> GaussianInformation:
        """Return the quadratic with this cost, half gradient (q,) and half Hessian (q, q) at `z` (q,)."""
        constant = float(cost - 2.0 * gradient @ z + z @ hessian @ z)
        return cls(hessian, hessian @ z - gradient, constant, n)

    @classmethod
    def from_posterior(
        cls, mean: FloatArray, covariance: FloatArray, prior_mean: FloatArray, prior_covariance: FloatArray
    ) -> GaussianInformation:
        """Return the information of the data that moved a Gaussian prior to a Gaussian posterior.

        `mean` (q,), `covariance` (q, q): the posterior. `prior_mean` (q,), `prior_covariance` (q, q): the
        prior. Directions in which the posterior is not narrower than the prior have no information.
        """
        # work in units of the posterior's standard deviations, where both precisions are near 1
        scale = np.sqrt(np.diag(covariance))
        known = _scaled_inverse(prior_covariance, scale)
        found = _scaled_inverse(covariance, scale)
        # Posterior precision = prior precision + data precision. Rounding can make the difference slightly
        # negative where the data have no information: set such eigenvalues to zero.
        values, vectors = np.linalg.eigh(found - known)
        precision = (vectors * np.maximum(values, 0.0)) @ vectors.T
        vector = found @ (mean / scale) - known @ (prior_mean / scale)
        return cls(precision / np.outer(scale, scale), vector / scale)

    def __add__(self, other: GaussianInformation) -> GaussianInformation:
        """Return the information of both sets of independent data."""
        return GaussianInformation(
            self.precision + other.precision,
            self.vector + other.vector,
            self.constant + other.constant,
            self.n + other.n,
        )

    def divided(self, sigma: float) -> GaussianInformation:
        """Return the information of the same data if their noise has the 1-sigma `sigma` instead of 1."""
        factor = sigma**-2
        return GaussianInformation(
            factor * self.precision, factor * self.vector, factor * self.constant, self.n
        )

    def part(self, rows: IndexArray) -> GaussianInformation:
        """Return the information about the unknowns `rows` (p,), the others being zero."""
        return GaussianInformation(
            self.precision[np.ix_(rows, rows)], self.vector[rows], self.constant, self.n
        )

    def blurred(self, direction: FloatArray, sigma: float) -> GaussianInformation:
        """Return the information after adding `direction` (q,) times a ~ N(0, `sigma`²) to the unknowns.

        Notes
        -----
        By the matrix inversion lemma the precision becomes
        ``L - L d (sigma^-2 + d^T L d)^-1 d^T L``.
        """
        # Rank-one downdate: d is the direction, L d the change of the gradient along it.
        moved = self.precision @ direction
        share = moved / (sigma**-2 + direction @ moved)
        along = direction @ self.vector
        return GaussianInformation(
            self.precision - np.outer(share, moved),
            self.vector - share * along,
            float(self.constant - along**2 / (sigma**-2 + direction @ moved)),
            self.n,
        )


def covariance_of(precision: FloatArray) -> FloatArray:
    """Return the inverse of a positive definite precision (q, q), symmetric to the last bit.

    CalibrationError: the precision is singular, so a combination of the unknowns is not determined.
    """
    # A precision with unit diagonal: unknowns in different units do not spoil the factorisation.
    scale = np.sqrt(np.diag(precision))
    scale = np.where(scale > 0.0, scale, 1.0)
    try:
        factor, lower = cho_factor(precision / np.outer(scale, scale), lower=True)
    except np.linalg.LinAlgError as problem:
        raise CalibrationError("the data and the prior leave a combination of coefficients free") from problem
    root = solve_triangular(factor, np.eye(len(scale)), lower=lower) / scale
    return np.asarray(root.T @ root)


def _scaled_inverse(covariance: FloatArray, scale: FloatArray) -> FloatArray:
    """Return the inverse of a covariance (q, q) in units of `scale` (q,)."""
    scaled = covariance / np.outer(scale, scale)
    own = np.sqrt(np.diag(scaled))
    inverse = cho_solve(cho_factor(scaled / np.outer(own, own)), np.eye(len(own))) / np.outer(own, own)
    return np.asarray(0.5 * (inverse + inverse.T))
