"""Calibration compiled into one table, with which correcting a sample takes a few microseconds.

Notes
-----
The regressors ``phi(x)`` are the monomials of the positions and the regressors of effects. The nine
coefficients (six of A, three of T) are ``theta = phi^T W``. Their covariance ``sum_mn phi_m phi_n C_mn`` is a
sum over the *products* of regressors. Many products coincide (``x^2 . x`` and ``x . x^2``): 28 remain of 55
for a cubic in two positions. One matrix times these products ``psi`` therefore gives both::

    (theta, covariance of theta) = table psi

With ``A' = R A`` and T at the sample's positions, R the boresight and Omega its covariance, V the covariance
of the corrected vector::

    d = H_r - T,  b = A' d,  F = |b|,  u = b / F
    V_ij = Q_ij . (d d^T) + L_ij . d + O_ij         (dA', dT and the sensor's noise carried through)
    sigma_F^2 = u^T V u,  sigma_i^2 = V_ii + ([b] Omega [b]^T)_ii

:func:`prepare` and :func:`apply` accept floats (one sample, :class:`.correct.Corrector`) and arrays (a log,
:func:`.correct.correct`). The two differ only in the order in which the product with the table is summed: by
less than 1e-12 of the field. The table is made by :mod:`.model`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import nan, sqrt
from typing import Any

import numpy as np

from magbridge.arrays import FloatArray, IndexArray
from magbridge.estimation.residual import PAIRS

TABLE_SUMS = 81
"""Number of sums that the table gives: A' and T (12), then 69 combinations of their covariance."""
MAX_REGRESSOR = 1e100
"""Largest regressor, in its own unit: beyond it the product with the table would overflow."""

Prepared = tuple[list[Any], list[list[Any]]]
"""Input of :func:`apply` at one set of positions: A' row by row, then T (12 numbers), and for each of V's
six entries Q (6), L (3) and O (1)."""
Numbers = tuple[float, float, float, float, float, float, float, float]
"""Total field, its sigma, the corrected vector x, y, z, and the sigmas of x, y, z; all nT."""


@dataclass(frozen=True, eq=False)
class Kernel:
    """Calibration compiled into the arrays with which :mod:`.correct` corrects samples."""

    centre: tuple[float, ...]
    scale: tuple[float, ...]
    """`centre`, `scale`: Of each parameter p, in its unit; scaled positions are ``(p - centre) / scale``."""
    field: float
    """Reference field F_0, nT."""
    parents: tuple[tuple[int, int], ...]
    """Monomial ``i + 1`` is monomial ``parents[i][0]`` times position ``parents[i][1]``."""
    weights: FloatArray
    """(m, 9): matrix W. Columns: the six entries of ``A`` itself (not ``a``), then T in nT. Rows: the
    monomials, then the regressors of effects."""
    first: IndexArray
    second: IndexArray
    """`first`, `second`, (q,): Product q is ``phi[first[q]] * phi[second[q]]``. The first m products equal
    the regressors, because the constant is one of their factors."""
    table: FloatArray
    """(81, q): Factor of each product in each sum."""

    def sums(self, phi: FloatArray) -> FloatArray:
        """Return the 81 sums ``table psi`` of n samples, (81, n), from their regressors (m, n)."""
        return np.asarray(self.table @ (phi[self.first] * phi[self.second]))

    def sums_of_one(self, phi: list[float]) -> list[float]:
        """Return the 81 sums ``table psi`` of one sample; all NaN if a regressor exceeds MAX_REGRESSOR.

        The function adds the rounded products in a fixed order, so that a replay on another computer gives
        the same bytes. The order in which a matrix product rounds depends on the processor.
        """
        # A product of larger regressors overflows; the caller flags a sample with NaN.
        if max(phi) > MAX_REGRESSOR or min(phi) < -MAX_REGRESSOR:
            return [nan] * TABLE_SUMS
        psi = np.fromiter([phi[i] * phi[j] for i, j in self.pairs], float, len(self.pairs))
        sums: list[float] = np.add.reduce(self.products * psi[:, None], axis=0).tolist()
        return sums

    @cached_property
    def products(self) -> FloatArray:
        """Transpose of `table`, (q, 81): one contiguous row for each product."""
        return np.ascontiguousarray(self.table.T)

    @cached_property
    def pairs(self) -> list[tuple[int, int]]:
        """`first` and `second` as pairs of Python integers, which index lists fastest."""
        return list(zip(self.first.tolist(), self.second.tolist(), strict=True))

    @property
    def position_weights(self) -> FloatArray:
        """Rows of W that belong to the m monomials, (m, 9)."""
        return self.weights[: len(self.parents) + 1]

    @cached_property
    def weight_rows(self) -> list[list[float]]:
        """`position_weights` as lists."""
        rows: list[list[float]] = self.position_weights.tolist()
        return rows

    @property
    def rate_weights(self) -> FloatArray:
        """`position_weights` with A times F_0, (m, 9): they turn the monomials' rates into rates in nT/s."""
        return np.asarray(self.position_weights * np.array([self.field] * 6 + [1.0] * 3))

    def monomials(self, values: Sequence[Any], unit: Any) -> list[Any]:
        """Return the m monomials of the scaled positions, each a float or an array as the `values` are.

        `values`: the positions in the parameters' units and order. Further values, the channels of effects,
        are ignored. `unit`: the constant monomial, 1.0 or an array of ones.
        """
        # strict=False: the channels of effects follow the positions and are ignored
        x = [
            (value - centre) / scale
            for value, centre, scale in zip(values, self.centre, self.scale, strict=False)
        ]
        # Each monomial is an earlier one times one position: one multiplication each.
        phi = [unit]
        for parent, k in self.parents:
            phi.append(phi[parent] * x[k])
        return phi

    def linear_at(self, positions: Sequence[float]) -> list[float]:
        """Return A's six entries xx, yy, zz, xy, xz, yz, and T (nT), at one set of positions, no effects.

        A loop over so few numbers takes half the time of numpy, and its bits do not depend on the processor.
        """
        xx = yy = zz = xy = xz = yz = tx = ty = tz = 0.0
        monomials = self.monomials(positions, 1.0)
        for phi, (a, b, c, d, e, f, g, h, i) in zip(monomials, self.weight_rows, strict=True):
            xx += phi * a
            yy += phi * b
            zz += phi * c
            xy += phi * d
            xz += phi * e
            yz += phi * f
            tx += phi * g
            ty += phi * h
            tz += phi * i
        return [xx, yy, zz, xy, xz, yz, tx, ty, tz]

    def monomials_of(self, positions: FloatArray) -> FloatArray:
        """Return the monomials (m, n) of n samples' positions (n, k), given in the parameters' units."""
        return np.stack(self.monomials(list(positions.T), np.ones(len(positions))))


def prepare(t: list[Any]) -> Prepared:
    """Return the input of :func:`apply` at one set of positions, computed from the table's 81 sums there.

    ``L_ij,k = -(G_ik,j + G_jk,i)`` with ``G = S_a'T A'^T``, and ``O = A' S_TT A'^T``. The sums contain the
    covariances ``S_a'T`` (of the entries of A' with T) and ``S_TT`` (of T).
    """
    xx, xy, xz, yx, yy, yz, zx, zy, zz = t[0:9]
    # G = S_a'T A'^T: covariance of the entries of A' with T, turned into body axes.
    G = []
    for k in range(48, 75, 3):
        x, y, z = t[k], t[k + 1], t[k + 2]
        G += [x * xx + y * xy + z * xz, x * yx + y * yy + z * yz, x * zx + y * zy + z * zz]
    sxx, syy, szz, sxy, sxz, syz = t[75:81]
    # A' S_TT, with the symmetric S_TT in six entries.
    AS = []
    for k in range(0, 9, 3):
        x, y, z = t[k], t[k + 1], t[k + 2]
        AS += [sxx * x + sxy * y + sxz * z, sxy * x + syy * y + syz * z, sxz * x + syz * y + szz * z]
    # For each entry of V: the quadratic form in d (Q, from the table), the linear part L and the constant O.
    V = []
    for e, (i, j) in enumerate(PAIRS):
        O = t[3 * i] * AS[3 * j] + t[3 * i + 1] * AS[3 * j + 1] + t[3 * i + 2] * AS[3 * j + 2]  # noqa: E741
        L = [-(G[9 * i + 3 * k + j] + G[9 * j + 3 * k + i]) for k in range(3)]
        V.append([*t[12 + 6 * e : 18 + 6 * e], *L, O])
    return t[:12], V


def variances(dx: Any, dy: Any, dz: Any, V: list[list[Any]]) -> list[Any]:
    """Return the corrected vector's covariance V, entries xx, yy, zz, xy, xz, yz, nT^2.

    ``V_ij = Q_ij . (d d^T) + L_ij . d + O_ij`` with d in nT, and `V` from :func:`prepare`.
    """
    exx, eyy, ezz, exy, exz, eyz = dx * dx, dy * dy, dz * dz, dx * dy, dx * dz, dy * dz
    return [
        q0 * exx + q1 * eyy + q2 * ezz + q3 * exy + q4 * exz + q5 * eyz + l0 * dx + l1 * dy + l2 * dz + o
        for q0, q1, q2, q3, q4, q5, l0, l1, l2, o in V
    ]


def apply(
    hx: Any,
    hy: Any,
    hz: Any,
    prepared: Prepared,
    omega: tuple[float, ...] | None,
    root: Callable[[Any], Any] = sqrt,
) -> Numbers:
    """Correct one sample (or arrays of samples); return total field, its sigma, the vector and its sigmas.

    `hx`, `hy`, `hz` (n,): nT, raw channels of the sensor. `prepared`: from :func:`prepare`, for the
    positions of the samples. `omega`: xx, yy, zz, xy, xz, yz of the boresight's covariance, rad^2; None
    without a boresight. `root`: square root function, ``np.sqrt`` if the samples are arrays.

    Notes
    -----
    The notes of the module give the equations.
    """
    (xx, xy, xz, yx, yy, yz, zx, zy, zz, tx, ty, tz), V = prepared
    # d = H_r - T and b = A' d
    dx, dy, dz = hx - tx, hy - ty, hz - tz
    bx = xx * dx + xy * dy + xz * dz
    by = yx * dx + yy * dy + yz * dz
    bz = zx * dx + zy * dy + zz * dz
    # F = |b| and its direction u
    F = root(bx * bx + by * by + bz * bz)
    over = 1.0 / (F + 1e-300)  # a vector of length zero has no direction, but must not raise
    ux, uy, uz = bx * over, by * over, bz * over
    # sigma_F^2 = u^T V u
    vxx, vyy, vzz, vxy, vxz, vyz = variances(dx, dy, dz, V)
    variance = (
        ux * ux * vxx + uy * uy * vyy + uz * uz * vzz
        + 2.0 * (ux * uy * vxy + ux * uz * vxz + uy * uz * vyz)
    )  # fmt: skip
    if omega is not None:  # its error turns the vector and leaves the length, so sigma_F stays
        oxx, oyy, ozz, oxy, oxz, oyz = omega
        vxx = vxx + (bz * bz * oyy + by * by * ozz - 2.0 * by * bz * oyz)
        vyy = vyy + (bz * bz * oxx + bx * bx * ozz - 2.0 * bx * bz * oxz)
        vzz = vzz + (by * by * oxx + bx * bx * oyy - 2.0 * bx * by * oxy)
    # abs: rounding may leave a variance of zero at -1e-12
    return F, root(abs(variance)), bx, by, bz, root(abs(vxx)), root(abs(vyy)), root(abs(vzz))
