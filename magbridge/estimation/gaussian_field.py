r"""Gaussian random field in space with a sparse precision, and upward continuation of a crustal field.

With coefficients w on nodes of spacing h and the nodes' Laplacian L,

.. math:: Q = v\, K^\alpha, \quad K = \kappa^2 h^2 I + L, \quad \kappa = \sqrt{2 \nu} / \ell

is the precision of a field with Matern's covariance of length :math:`\ell` and smoothness
:math:`\nu = \alpha - 1` (Lindgren, Rue & Lindstrom 2011); v makes the field's variance 1. A large
:math:`\nu` approximates a Gaussian covariance of the same length.

Sources at a depth d have the spectrum :math:`e^{-2 |k| d}` (Spector & Grant 1970). By the product
:math:`\cosh 2 k d = \prod_i (1 + k^2 / \kappa_i^2),\ \kappa_i = (2 i - 1) \pi / 4 d`, their precision has
factors with kappas in the ratio 1 : 3 : 5 : 7.

Above its sources, a wave of the field with wave number |k| decreases upwards as :math:`e^{-|k| z}`. No sparse
matrix has this effect on w. So w is written as :math:`w = (p I + L) u`, and u has the precision
:math:`(p I + L)\, Q\, (p I + L)`. At a depth d below the nodes the field is

.. math:: e^{|k| d}\, w \approx (p I + L + b_1 L + b_2 L^2)\, u,

with b from least squares over the field's spectrum. The constant part of a field is thus the same at every
depth. The error is up to 2 % of the field for d up to a sixth of its length (4 % on fine nodes), and a sixth
of this after :meth:`GaussianField.lacking`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, reduce
from operator import matmul

import numpy as np
from scipy.linalg import solve_triangular
from scipy.sparse import csr_array, diags_array, eye_array
from scipy.sparse.linalg import matrix_power

from magbridge.arrays import FloatArray, IndexArray
from magbridge.estimation.blocks import in_chunks
from magbridge.estimation.nodes import Nodes
from magbridge.estimation.residual import rms
from magbridge.estimation.sparse import SparseFactor

__all__ = ["BURIED_FACTORS", "SMOOTHNESS_POWERS", "GaussianField"]

SMOOTHNESS_POWERS = (2, 3, 4, 6, 10, 16)
"""Powers alpha that a fit tries, from a rough field to nearly a Gaussian covariance."""
BURIED_FACTORS, FIRST = 4, 0.6705
"""Number of factors for sources at a depth, and their first kappa times the length. With this value the
correlation begins to decrease like a Gaussian of the length."""
SPLINE, FALLING = 4, 8
"""Number of strips of nodes that a spline spans, and that a spline with upward continuation spans."""
POLE = 0.05
"""Pole p: with this value the approximation is good for three to eight nodes per correlation length."""
MORE_POLES = 0.04, 12.0, 4
"""Smallest, largest and number of the poles, in units of p, of a more accurate continuation."""
MOST_LACKING = 0.5
"""Largest part of the field's change with depth that may be lacking."""
MAX_LAPLACIAN_EIGENVALUE = 8.0
"""The Laplacian's largest eigenvalue."""
DEPTHS = 33
"""Number of depths, between the shallowest and the deepest, at which b is computed."""
WAVES = 96
"""Number of wave numbers along each axis at which a spectrum is summed."""


@dataclass(frozen=True, eq=False)
class GaussianField:
    """Gaussian random field of unit variance, given by coefficients on nodes."""

    nodes: Nodes
    length: float
    """Correlation length (Matern's), m."""
    alpha: int
    """One of :data:`SMOOTHNESS_POWERS`."""
    harmonic: bool = False
    """True if the field decreases upwards by Laplace's equation; False if it is the same at every depth."""
    buried: bool = False
    """True if the spectrum is that of sources at a depth, with alpha factors; False if it is Matern's."""

    @property
    def _kappa2(self) -> FloatArray:
        """``kappa² h²`` of each of the precision's factors (alpha,)."""
        if self.buried:
            return np.asarray(
                (FIRST * np.arange(1, 2 * self.alpha, 2) * self.nodes.spacing / self.length) ** 2
            )
        return np.full(self.alpha, 2.0 * (self.alpha - 1) * (self.nodes.spacing / self.length) ** 2)

    @cached_property
    def _spectrum(self) -> tuple[FloatArray, FloatArray]:
        """Eigenvalues of the Laplacian, and the field's power at each, before scaling to unit variance."""
        theta = np.pi * (np.arange(WAVES) + 0.5) / WAVES
        one = 4.0 * np.sin(0.5 * theta) ** 2
        # Power of a cubic B-spline at these wave numbers (Fourier transform of its values at the nodes).
        spline = ((2.0 + np.cos(theta)) / 3.0) ** 2
        waves = one[:, None] + one
        power = np.prod([kappa2 + waves for kappa2 in self._kappa2], axis=0)
        return waves, spline[:, None] * spline / power

    @property
    def _wave_numbers(self) -> FloatArray:
        """Wave numbers of the spectrum, 1/m."""
        theta2 = (np.pi * (np.arange(WAVES) + 0.5) / WAVES) ** 2
        return np.asarray(np.sqrt(theta2[:, None] + theta2).ravel() / self.nodes.spacing)

    @cached_property
    def _laplacian(self) -> csr_array:
        number = self.nodes.number
        pairs = [
            (number[:-1, :], number[1:, :]),
            (number[:, :-1], number[:, 1:]),
        ]
        # Graph Laplacian: neighbours along both axes of the box, where both nodes exist.
        a = np.concatenate([one[(one >= 0) & (other >= 0)] for one, other in pairs])
        b = np.concatenate([other[(one >= 0) & (other >= 0)] for one, other in pairs])
        n = self.nodes.size
        linked = csr_array((np.ones(len(a)), (a, b)), shape=(n, n))
        linked = linked + linked.T
        return csr_array(diags_array(np.asarray(linked.sum(axis=1)).ravel()) - linked)

    @cached_property
    def _roots(self) -> list[tuple[csr_array, int]]:
        """Distinct factors of the precision, and the multiplicity of each."""
        kappas, times = np.unique(self._kappa2, return_counts=True)
        same = eye_array(self.nodes.size)
        return [
            (csr_array(k * same + self._laplacian), m) for k, m in zip(kappas, times.tolist(), strict=True)
        ]

    @property
    def condition(self) -> float:
        """Ratio of the precision's largest eigenvalue to its smallest."""
        lifted = (1.0 + MAX_LAPLACIAN_EIGENVALUE / POLE) ** 2 if self.harmonic else 1.0
        return float(np.prod(1.0 + MAX_LAPLACIAN_EIGENVALUE / self._kappa2)) * lifted

    @cached_property
    def _lift(self) -> csr_array:
        """Matrix ``p I + L`` (nodes, nodes)."""
        return csr_array(POLE * eye_array(self.nodes.size) + self._laplacian)

    @cached_property
    def precision(self) -> csr_array:
        """Precision (nodes, nodes) of the coefficients."""
        power = reduce(matmul, (matrix_power(root, times) for root, times in self._roots))
        if self.harmonic:
            power = self._lift @ power @ self._lift
        return csr_array(float(self._spectrum[1].mean()) * power)

    def edges(self, precision: csr_array) -> IndexArray:
        """Return the limits (b + 1,) of blocks of nodes that a `precision` couples only to the next block.

        `precision` (nodes, nodes): prior's, or posterior's, which also couples the nodes of two samples whose
        noise is correlated.
        """
        strip, coupled = np.nonzero(self.nodes.number >= 0)[0], precision.tocoo()
        reach = np.abs(strip[coupled.row] - strip[coupled.col]).max()
        return self.nodes.edges(max(int(reach), FALLING if self.harmonic else SPLINE))

    @cached_property
    def log_determinant(self) -> float:
        """Log-determinant of the precision."""
        n, variance = self.nodes.size, float(self._spectrum[1].mean())
        lifted = 2.0 * SparseFactor(self._lift).log_determinant if self.harmonic else 0.0
        roots = sum(times * SparseFactor(root).log_determinant for root, times in self._roots)
        return float(n * np.log(variance) + roots + lifted)

    def basis(self, place: FloatArray, deeper: FloatArray | float = 0.0) -> csr_array:
        """Return the field (n, nodes) per coefficient at `place` (n, 2), m, `deeper` (m) below the nodes."""
        flat = self.nodes.basis(place)
        if not self.harmonic:
            return flat
        # Downward continuation as a polynomial in the Laplacian: exp(k d) ~ 1 + (b1 L + b2 L^2) / (p + L).
        waves = self._spectrum[0].ravel()
        design = np.stack([waves**i / (POLE + waves) for i in (1, 2)], axis=1)
        b = self._continuation(np.broadcast_to(np.asarray(deeper, float), len(place)), design)
        terms = csr_array(flat @ self._laplacian)
        rows = POLE * flat + terms
        for one in b:
            rows = rows + diags_array(one) @ terms
            terms = csr_array(terms @ self._laplacian)
        return csr_array(rows)

    def lacking(self, place: FloatArray, deeper: FloatArray, u: FloatArray) -> FloatArray:
        """Return what :meth:`basis` lacks of the field (n,) of coefficients `u`; arguments as there.

        With more poles q, ``exp(k d) ~ 1 + c_1 L + sum c_q L / (q + L)``, the error is smaller. The precision
        of their coefficients would be singular to rounding, but a given field needs only a few solutions.
        """
        if not (self.harmonic and deeper.any()):
            return np.zeros(len(place))
        waves, poles = self._spectrum[0].ravel(), POLE * np.geomspace(*MORE_POLES)
        shares = [waves, *(waves / (q + waves) for q in poles)]
        c = self._continuation(deeper, np.stack(shares, axis=1))
        w = self._lift @ u
        Lw, same = self._laplacian @ w, eye_array(self.nodes.size)
        solved = [SparseFactor(csr_array(q * same + self._laplacian)).solve(Lw) for q in poles]
        parts = np.stack([Lw, *solved], axis=1)

        def lacking_rows(rows: slice) -> FloatArray:
            flat = self.nodes.basis(place[rows])
            change = ((flat @ parts) * c[:, rows].T).sum(axis=1)
            return np.stack([change, flat @ w + change - self.basis(place[rows], deeper[rows]) @ u], axis=1)

        # Coefficients that the samples do not determine may be large: then neither continuation holds.
        change, lacking = in_chunks(len(place), lacking_rows).T
        return lacking if rms(lacking) < MOST_LACKING * rms(change) else np.zeros(len(place))

    def slopes(self, place: FloatArray) -> tuple[csr_array, csr_array]:
        """Return the basis' derivatives north and east, 1/m, at `place` (n, 2), m, at the nodes' depth."""
        north, east = self.nodes.slopes(place)
        if not self.harmonic:
            return north, east
        return csr_array(north @ self._lift), csr_array(east @ self._lift)

    def _continuation(self, deeper: FloatArray, design: FloatArray) -> FloatArray:
        """Return b (m, n) at `deeper` (n,), m below the nodes, interpolated between some depths.

        b is the least squares solution of ``exp(k d) - 1 = design b``, weighted by the field's power at each
        wave number; `design` is (waves, m).
        """
        some = np.linspace(min(deeper.min(), 0.0), max(deeper.max(), 0.0), DEPTHS) if deeper.any() else [0.0]
        some = np.unique(np.append(some, 0.0))
        power = self._spectrum[1].ravel()
        root = np.sqrt(power / power.sum())[:, None]
        growth = np.expm1(self._wave_numbers[:, None] * some) * root
        Q, R = np.linalg.qr(root * design)
        found = solve_triangular(R, Q.T @ growth)
        return np.stack([np.interp(deeper, some, one) for one in found])
