r"""The prior of a field in place: Matern's covariance as a sparse precision, and how rock falls off upwards.

Of coefficients w on nodes h apart, with the nodes' Laplacian L,

.. math:: Q = v\, K^\alpha, \quad K = \kappa^2 h^2 I + L, \quad \kappa = \sqrt{2 \nu} / \ell

is the precision of a field with Matern's covariance of length :math:`\ell` and smoothness
:math:`\nu = \alpha - 1` (Lindgren, Rue & Lindstrom 2011); v makes the field's variance 1. Large
:math:`\nu` comes near a Gaussian of the same length.

Above its sources every wave of the field falls off upwards as :math:`e^{-|k| z}`, |k| its wave number. |k|
itself is not sparse; ``a_0 + a_1 L`` comes near it where the field has its power.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array, diags_array, eye_array

from magbridge.arrays import FloatArray, IndexArray
from magbridge.field.place.blocks import Factor
from magbridge.field.place.nodes import Nodes

__all__ = ["SMOOTHNESS", "Matern"]

SMOOTHNESS = (2, 3, 4, 6, 10, 16)
"""Powers alpha that are tried: from rough to as good as a Gaussian."""
SPLINE, FALLING = 4, 6
"""Strips of nodes that a spline reaches across, and those that a slope with depth widens."""
WAVES = 96
"""Wave numbers an axis at which a spectrum is summed."""


@dataclass(frozen=True, eq=False)
class Matern:
    """A field of unit variance on nodes.

    Attributes
    ----------
    nodes : Nodes
    length : float
        m, over which the correlation falls (Matern's).
    alpha : int
        One of :data:`SMOOTHNESS`.
    harmonic : bool
        Whether it falls off upwards as Laplace's equation demands; else it is the same at every depth.
    """

    nodes: Nodes
    length: float
    alpha: int
    harmonic: bool = False

    @property
    def _kappa2(self) -> float:
        """``kappa² h²``."""
        return float(2.0 * (self.alpha - 1) * (self.nodes.spacing / self.length) ** 2)

    @cached_property
    def _spectrum(self) -> tuple[FloatArray, FloatArray]:
        """The Laplacian's eigenvalues, and the power of the field there before it is scaled to 1."""
        theta = np.pi * (np.arange(WAVES) + 0.5) / WAVES
        one = 4.0 * np.sin(0.5 * theta) ** 2
        spline = ((2.0 + np.cos(theta)) / 3.0) ** 2
        waves = one[:, None] + one
        return waves, spline[:, None] * spline / (self._kappa2 + waves) ** self.alpha

    @cached_property
    def _laplacian(self) -> csr_array:
        number = self.nodes.number
        pairs = [
            (number[:-1, :], number[1:, :]),
            (number[:, :-1], number[:, 1:]),
        ]
        a = np.concatenate([one[(one >= 0) & (other >= 0)] for one, other in pairs])
        b = np.concatenate([other[(one >= 0) & (other >= 0)] for one, other in pairs])
        n = self.nodes.size
        linked = csr_array((np.ones(len(a)), (a, b)), shape=(n, n))
        linked = linked + linked.T
        return csr_array(diags_array(np.asarray(linked.sum(axis=1)).ravel()) - linked)

    @cached_property
    def _root(self) -> csr_array:
        return csr_array(self._kappa2 * eye_array(self.nodes.size) + self._laplacian)

    @cached_property
    def precision(self) -> csr_array:
        """(nodes, nodes) precision of the coefficients."""
        power = self._root
        for _ in range(self.alpha - 1):
            power = power @ self._root
        return csr_array(float(self._spectrum[1].mean()) * power)

    @property
    def edges(self) -> IndexArray:
        """(b + 1,) where blocks of nodes begin that couple to the next one only."""
        return self.nodes.edges(max(self.alpha, FALLING if self.harmonic else SPLINE))

    @cached_property
    def log_determinant(self) -> float:
        """Of the precision."""
        n, variance = self.nodes.size, float(self._spectrum[1].mean())
        return float(n * np.log(variance)) + self.alpha * Factor(self._root).log_determinant

    def basis(self, place: FloatArray, deeper: FloatArray | float = 0.0) -> csr_array:
        """Return the splines at places (n, 2), m, so many m below the nodes' level: (n, nodes).

        Notes
        -----
        ``exp(|k| d) = 1 + |k| d + |k|² d²/2 + ...``; its first two terms.
        """
        flat = self.nodes.basis(place)
        deeper = np.broadcast_to(np.asarray(deeper, float), len(place))
        if not (self.harmonic and deeper.any()):
            return flat
        constant, slope = self._falling()
        down = flat * constant + (flat @ self._laplacian) * slope
        return csr_array(flat + diags_array(deeper) @ down)

    def _falling(self) -> tuple[float, float]:
        """Return ``a_0``, ``a_1``, 1/m: the least squares, weighted by the field's power, to |k|."""
        waves, power = (one.ravel() for one in self._spectrum)
        design = np.stack([np.ones_like(waves), waves], axis=1) * np.sqrt(power)[:, None]
        found = np.linalg.lstsq(design, np.sqrt(waves * power), rcond=None)[0] / self.nodes.spacing
        return float(found[0]), float(found[1])
