r"""The algebra of a joint fit: few dense unknowns z, many sparse ones w, noise that is correlated in time.

Linearised, the residual of every sample is :math:`e = y + D z + B w`: D dense (coefficients, level, slow
changes with time), B sparse (splines in place). With AR(1) noise of size :math:`\sigma` and autocorrelation
:math:`\rho`, and the prior precision :math:`Q / (r\sigma)^2` of w, r the field's size over the noise's,

.. math:: N = B^T R^{-1} B + Q / r^2, \quad H = D^T R^{-1} D - D^T R^{-1} B\, N^{-1} B^T R^{-1} D

is what remains for z when w is eliminated (Schur's complement): a quadratic as any other fit has it
(:mod:`.evidence`), whose evidence gains :math:`\tfrac12 \log|Q / r^2| - \tfrac12 \log|N|`. The noise's
autocorrelation enters by three sums over the samples, so that it costs nothing to try another.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from magbridge.arrays import BoolArray, FloatArray
from magbridge.calibration.fitting.evidence import Quadratic
from magbridge.field.place.blocks import Factor
from magbridge.field.place.matern import Matern

__all__ = ["Linear", "Products", "Reduced", "Sums", "add_up", "eliminate"]


class Linear(NamedTuple):
    """Linearised samples: ``V = [y | D]`` (n, 1 + q), B (n, nodes), and which follow the one before (n,).

    The first row may be one that was counted already (`overlap`): then only its successor looks at it.
    """

    V: FloatArray
    B: csr_array
    follows: BoolArray
    overlap: bool = False


@dataclass(frozen=True, eq=False)
class Products:
    """Inner products of the whitened columns: ``V^T V``, ``V^T B``, ``B^T B``."""

    VV: FloatArray
    VB: FloatArray
    BB: csr_array

    def plus(self, other: Products, factor: float = 1.0) -> Products:
        """Return the sum with `factor` times another."""
        return Products(
            self.VV + factor * other.VV, self.VB + factor * other.VB, csr_array(self.BB + factor * other.BB)
        )

    @classmethod
    def of(
        cls, a: Linear, rows: BoolArray, b: Linear | None = None, before: BoolArray | None = None
    ) -> Products:
        """Return the symmetric products of some rows (n,) with themselves, or with others, `before` (n,)."""
        V, B = a.V[rows], a.B[np.flatnonzero(rows)]
        if b is None or before is None:
            return cls(V.T @ V, np.asarray((B.T @ V).T), csr_array(B.T @ B))
        W, C = b.V[before], b.B[np.flatnonzero(before)]
        VV, BB = V.T @ W, B.T @ C
        return cls(VV + VV.T, np.asarray((C.T @ V + B.T @ W).T), csr_array(BB + BB.T))


@dataclass(frozen=True, eq=False)
class Sums:
    """All samples in four sums, whatever their noise's autocorrelation.

    Attributes
    ----------
    fresh : Products
        Of samples that follow none.
    here, before, across : Products
        Of those that follow another: theirs, the ones before, and one with the other.
    samples, pairs : int
    """

    fresh: Products
    here: Products
    before: Products
    across: Products
    samples: int
    pairs: int

    def whitened(self, rho: float) -> Products:
        """Return the products of ``(v_i - rho v_(i-1)) / sqrt(1 - rho^2)``, and v where none came before."""
        if not rho:
            return self.fresh.plus(self.here)
        inner = self.here.plus(self.before, rho * rho).plus(self.across, -rho)
        return self.fresh.plus(inner, 1.0 / (1.0 - rho * rho))


def add_up(pieces: Iterable[Linear]) -> Sums:
    """Add up pieces of a log in order."""
    total: list[Products] | None = None
    samples = pairs = 0
    for piece in pieces:
        counted = np.ones(len(piece.V), bool)
        counted[0] = not piece.overlap
        follows = piece.follows & counted
        follows[0] = False
        ahead = np.append(follows[1:], False)
        found = [
            Products.of(piece, counted & ~follows),
            Products.of(piece, follows),
            Products.of(piece, ahead),
            Products.of(piece, follows, piece, ahead),
        ]
        total = found if total is None else [a.plus(b) for a, b in zip(total, found, strict=True)]
        samples, pairs = samples + int(counted.sum()), pairs + int(follows.sum())
    assert total is not None
    fresh, here, before, across = total
    return Sums(fresh, here, before, across, samples, pairs)


@dataclass(frozen=True, eq=False)
class Reduced:
    """What remains for z, and how w follows from it.

    Attributes
    ----------
    quadratic : Quadratic
        In z.
    log_evidence : float
        What eliminating w and whitening add to it.
    factor : Factor
        Of N.
    precision : csr_array
        N, in units of the noise's.
    shift : (nodes,) array
        w at z = 0.
    follow : (nodes, q) array
        dw/dz.
    """

    quadratic: Quadratic
    log_evidence: float
    factor: Factor
    precision: csr_array
    shift: FloatArray
    follow: FloatArray

    def field(self, z: FloatArray) -> FloatArray:
        """Return w (nodes,) at z (q,)."""
        return np.asarray(self.shift + self.follow @ z)


def eliminate(sums: Sums, field: Matern, ratio: float, rho: float) -> Reduced:
    """Eliminate the field in place.

    Parameters
    ----------
    sums : Sums
        Of the samples.
    field : Matern
        The prior of w for a field of unit variance.
    ratio : float
        The field's standard deviation over that of the noise.
    rho : float
        Autocorrelation of the noise.

    Raises
    ------
    LinAlgError
        The precision is not positive definite in the machine's numbers.
    """
    products = sums.whitened(rho)
    precision = csr_array(products.BB + field.precision / ratio**2)
    factor = Factor(precision)
    solved = -factor.solve(products.VB.T)
    left = products.VV + products.VB @ solved
    H = 0.5 * (left[1:, 1:] + left[1:, 1:].T)
    nodes = field.nodes.size
    gained = 0.5 * (field.log_determinant - 2.0 * nodes * np.log(ratio) - factor.log_determinant)
    whitening = -0.5 * sums.pairs * np.log(1.0 - rho * rho)
    quadratic = Quadratic(H, -left[1:, 0], float(left[0, 0]), float(sums.samples))
    return Reduced(quadratic, float(gained + whitening), factor, precision, solved[:, 0], solved[:, 1:])
