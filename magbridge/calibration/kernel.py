"""The live form of a calibration: one table, so that a sample costs a few microseconds.

Notes
-----
With regressors ``phi(x)`` (the monomials, and what effects add) the nine coefficients are
``theta = phi^T W``, and their covariance is ``sum_mn phi_m phi_n C_mn``, a sum over the *products* of
regressors. Many products coincide (``x^2 . x`` and ``x . x^2``): 28 remain of 55 for a cubic in two
positions. So both are one sum over products ``psi``::

    (theta, covariance of theta) = table psi

A matrix product rounds in an order that depends on its shape and on the machine. So psi and table are
split into a coarse and a fine part of 21 bits each: products of parts and their sums then fit a
double *exactly*, in whatever order (Ozaki et al. 2012, Numer. Algorithms 59:95), and one sample live
gives the same bits as a million in a batch, here and on any other computer. What the split leaves
out is 2e-13 of the largest: 1e-8 nT.

The table is made by :mod:`.compilation`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import frexp, ldexp, nan
from typing import Any

import numpy as np

from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.arithmetic import BITS, COARSE, FINE, largest, monomials, split

__all__ = ["COLUMNS", "FARTHEST", "Kernel"]

EXPONENT = 3
"""psi is kept below 2^3, scaled by a power of two where positions lie far outside the range seen. Then sums
of up to 256 products of 24 and 21 bits still fit a double's 53 bits."""
FARTHEST = 2.0**BITS
"""A regressor this large cannot be used: beside its square the constant 1 is below the split's last bit."""

COLUMNS = 81
"""Sums that the table gives: A' and T (12), then the 69 combinations of their covariance."""


@dataclass(frozen=True, eq=False)
class Kernel:
    """A calibration compiled to what :mod:`.correct` needs."""

    centre: tuple[float, ...]
    scale: tuple[float, ...]
    """`centre`, `scale`: Of each parameter."""
    field: float
    """nT, F_0."""
    parents: tuple[tuple[int, int], ...]
    """Monomial ``i + 1`` is monomial ``parents[i][0]`` times position ``parents[i][1]``."""
    weights: FloatArray
    """(m, 9): W, with ``A`` itself (not ``a``) in the first six; the rows of monomials, then those of
    effects."""
    units: tuple[float, ...] | None
    """Powers of two that the regressors are multiplied by; None where all are 1."""
    first: IndexArray
    second: IndexArray
    """`first`, `second`, (q,): Product q is ``phi[first[q]] * phi[second[q]]``, of regressors in their units;
    the first m products are the regressors themselves."""
    coarse: FloatArray
    fine: FloatArray
    """`coarse`, `fine`, (81, q): The table in two parts."""

    def sums(self, phi: FloatArray) -> FloatArray:
        """Return ``table psi`` (81, n) of many samples' regressors (m, n)."""
        if self.units is not None:
            phi = phi * np.array(self.units)[:, None]
        psi = np.empty((len(self.pairs), phi.shape[1]))
        for row, (i, j) in zip(psi, self.pairs, strict=True):
            np.multiply(phi[i], phi[j], out=row)
        size = max(float(phi.max()), -float(phi.min()))
        scale = None if size * size < 2.0**EXPONENT else _scales(phi)
        if scale is not None:
            psi *= scale
        coarse = psi + COARSE
        coarse -= COARSE
        fine = np.subtract(psi, coarse, out=psi)
        fine += FINE
        fine -= FINE
        found = self.fine @ coarse
        found += self.coarse @ fine
        found += self.coarse @ coarse
        return np.asarray(found if scale is None else found / scale)

    def sums_of_one(self, phi: list[float]) -> list[float]:
        """Return the same 81 sums for one sample's regressors, with few numpy calls for speed."""
        if self.units is not None:
            phi = [value * unit for value, unit in zip(phi, self.units, strict=True)]
        size = largest(phi)
        scale = ldexp(1.0, min(EXPONENT - frexp(size * size)[1], 0)) if size < FARTHEST else nan
        count = len(self.pairs)
        parts = np.fromiter(split(phi, self.pairs, scale), float, 2 * count)  # much faster than np.array
        found = self.crossed.dot(parts)
        found += self.coarse.dot(parts[count:])
        if scale != 1.0:
            found /= scale
        sums: list[float] = found.tolist()
        return sums

    @cached_property
    def pairs(self) -> list[tuple[int, int]]:
        """`first` and `second` as pairs of Python integers, by which lists are indexed fastest."""
        return list(zip(self.first.tolist(), self.second.tolist(), strict=True))

    @cached_property
    def crossed(self) -> FloatArray:
        """(81, 2 q) `coarse` beside `fine`, to multiply the fine parts of psi and then its coarse parts."""
        return np.concatenate([self.coarse, self.fine], axis=1)

    @property
    def position_weights(self) -> FloatArray:
        """(m, 9) rows of W that belong to the m monomials."""
        return self.weights[: len(self.parents) + 1]

    @property
    def rate_weights(self) -> FloatArray:
        """(m, 9) those rows in nT at F_0: times the monomials' rates, they give the nine coefficients'."""
        return np.asarray(self.position_weights * np.array([self.field] * 6 + [1.0] * 3))

    def monomials(self, values: Sequence[Any], one: Any) -> list[Any]:
        """Return the monomials, of floats or of arrays: the same multiplications in the same order."""
        return monomials(values, self.centre, self.scale, self.parents, one)

    def monomials_of(self, positions: FloatArray) -> FloatArray:
        """(m, n) monomials of (n, k) positions."""
        return np.stack(self.monomials(list(positions.T), np.ones(len(positions))))


def _scales(phi: FloatArray) -> FloatArray:
    """Return (n,) powers of two that keep each sample's products small enough; NaN: too far outside."""
    largest = np.abs(phi).max(axis=0)
    scales = np.ldexp(1.0, np.minimum(EXPONENT - np.frexp(largest * largest)[1], 0))
    return np.where(largest < FARTHEST, scales, np.nan)
