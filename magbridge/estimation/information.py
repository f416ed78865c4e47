r"""Gaussian information: the log likelihood of Gaussian data as a quadratic in the unknowns.

Data :math:`y = J z + v`, with white noise v of unit variance, have the log likelihood

.. math:: \log L(z) = -\tfrac12 z^T \Lambda z + \eta^T z - \tfrac12 c - \tfrac{n}{2}\log 2\pi,
          \quad \Lambda = J^T J,\ \eta = J^T y,\ c = y^T y.

Information of independent data adds (:meth:`GaussianInformation.__add__`). Unknowns are eliminated by
Schur's complement, and the integral of the likelihood over a Gaussian prior is known in closed form
(Rasmussen & Williams 2006, Gaussian processes for machine learning, sections 2.1 and A.3; Bar-Shalom, Li &
Kirubarajan 2001, section 7.2).
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
    """c: the sum of squares at z = 0."""
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

    def condition(self, rows: IndexArray, values: FloatArray) -> GaussianInformation:
        """Return the information about the other unknowns if the unknowns `rows` (p,) are `values` (p,)."""
        keep = np.setdiff1d(np.arange(len(self.vector)), rows)
        # -1/2 z^T L z + eta^T z with z_rows fixed: a constant, and a change of the vector
        precision, given = self.precision, np.asarray(values, float)
        fixed = given @ precision[np.ix_(rows, rows)] @ given - 2.0 * self.vector[rows] @ given
        vector = self.vector[keep] - precision[np.ix_(keep, rows)] @ given
        return GaussianInformation(
            precision[np.ix_(keep, keep)], vector, self.constant + float(fixed), self.n
        )

    def marginalise(self, rows: IndexArray, prior_precision: FloatArray) -> GaussianInformation:
        """Return the information about the other unknowns, with the unknowns `rows` integrated out.

        `rows` (p,): unknowns to integrate out; their prior has mean 0. `prior_precision` (p, p): precision
        of that prior, positive definite.
        """
        keep = np.setdiff1d(np.arange(len(self.vector)), rows)
        inner = self.precision[np.ix_(rows, rows)] + prior_precision
        cross = self.precision[np.ix_(rows, keep)]
        # Schur's complement: L_kk - L_kr (L_rr + P)^-1 L_rk
        factor = cho_factor(inner, lower=True)
        solved = cho_solve(factor, np.column_stack([self.vector[rows], cross]))
        precision = self.precision[np.ix_(keep, keep)] - cross.T @ solved[:, 1:]
        vector = self.vector[keep] - cross.T @ solved[:, 0]
        # the determinants |P|^1/2 |L_rr + P|^-1/2 enter the constant
        log_dets = 2.0 * np.log(np.diag(factor[0])).sum() - np.linalg.slogdet(prior_precision)[1]
        constant = self.constant - self.vector[rows] @ solved[:, 0] + log_dets
        return GaussianInformation(0.5 * (precision + precision.T), vector, float(constant), self.n)

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
        return GaussianInformation(
            self.precision - np.outer(share, moved),
            self.vector - share * (direction @ self.vector),
            self.constant,
            self.n,
        )

    def posterior(self, prior_precision: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean (q,) and covariance (q, q) of z with a prior N(0, `prior_precision`^-1)."""
        covariance = covariance_of(self.precision + prior_precision)
        return np.asarray(covariance @ self.vector), covariance

    def log_evidence(self, prior_precision: FloatArray) -> float:
        """Return the logarithm of the likelihood integrated over a prior N(0, `prior_precision`^-1), (q, q).

        Notes
        -----
        ``-(c - eta^T (L + P)^-1 eta) / 2 - log|L + P| / 2 + log|P| / 2 - n log(2 pi) / 2``.
        """
        factor = cho_factor(self.precision + prior_precision, lower=True)
        # eta^T (L + P)^-1 eta, by one Cholesky factor that also gives the determinant.
        explained = self.vector @ cho_solve(factor, self.vector)
        log_dets = np.linalg.slogdet(prior_precision)[1] - 2.0 * np.log(np.diag(factor[0])).sum()
        return float(0.5 * (explained - self.constant) + 0.5 * log_dets - 0.5 * self.n * np.log(2.0 * np.pi))


def covariance_of(precision: FloatArray) -> FloatArray:
    """Return the inverse of a positive definite precision (q, q), symmetric to the last bit.

    CalibrationError: the precision is singular, so a combination of the unknowns is not determined.
    """
    # A precision with unit diagonal: unknowns in different units do not spoil the factorisation.
    scale = np.sqrt(np.diag(precision))
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
