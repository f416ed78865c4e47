"""The arithmetic that corrects one sample, written so that it runs on floats and on arrays alike.

Notes
-----
With ``A' = R A`` and T at the sample's positions, R the boresight and Omega its covariance, V the covariance
of the corrected vector::

    d = H_r - T,  b = A' d,  F = |b|,  u = b / F
    V_ij = Q_ij . (d d^T) + L_ij . d + O_ij         (dA', dT and the sensor's noise carried through)
    sigma_F^2 = u^T V u,  sigma_i^2 = V_ii + ([b] Omega [b]^T)_ii

Every operation is elementwise IEEE arithmetic in one written order, on floats or on arrays, but for the
products of :class:`~magbridge.calibration.kernel.Kernel`, which are exact in any order: so a sample
corrected live, in a batch, or replayed on another computer gives identical bits.

When this module is compiled by mypyc, a ``float`` is a C double and an array in its place is refused. So
arrays go through :func:`for_arrays`, which loads this same source uncompiled.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import module_from_spec, spec_from_file_location
from math import sqrt
from pathlib import Path
from typing import Any, Final

import numpy as np

from magbridge.estimation.residual import PAIRS

__all__ = [
    "BITS", "COARSE", "FINE", "Linear", "Numbers", "Prepared", "apply", "for_arrays", "largest",
    "linear", "monomials", "prepare", "split",
]  # fmt: skip

BITS: Final = 21
COARSE: Final = 1.5 * 2.0 ** (52 - BITS)
FINE: Final = 1.5 * 2.0 ** (52 - 2 * BITS)
"""Adding and then subtracting COARSE rounds a number to a multiple of 2^-21; FINE, to a multiple of 2^-42."""

Prepared = tuple[list[float], list[list[float]]]
"""What :func:`apply` needs at one set of positions: A' row by row, then T (12 numbers); and for each of V's
six entries Q (6), L (3) and O (1)."""
Numbers = tuple[float, float, float, float, float, float, float, float]
Linear = tuple[float, float, float, float, float, float, float, float, float]
"""A's entries xx, yy, zz, xy, xz, yz; T's x, y, z."""


def for_arrays() -> Any:
    """Load this module's source uncompiled and with numpy's root: the functions below then accept arrays."""
    spec = spec_from_file_location(f"{__name__}_for_arrays", Path(__file__).with_name("arithmetic.py"))
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    vars(module)["sqrt"] = np.sqrt
    return module


def monomials(
    values: Sequence[Any],
    centres: tuple[float, ...],
    scales: tuple[float, ...],
    parents: tuple[tuple[int, int], ...],
    one: Any,
) -> list[Any]:
    """Return the monomials of positions (floats or arrays), each as its parent times one position.

    `values` may hold more channels than there are positions: those of effects, which follow, are ignored.
    """
    x = [(value - centre) / scale for value, centre, scale in zip(values, centres, scales)]  # noqa: B905
    phi = [one]
    for parent, k in parents:
        phi.append(phi[parent] * x[k])
    return phi


def largest(phi: list[float]) -> float:
    """Return the largest size among regressors."""
    found = 0.0
    for value in phi:
        found = max(found, abs(value))
    return found


def split(phi: list[float], pairs: list[tuple[int, int]], scale: float) -> list[float]:
    """Return the products of regressors, times `scale`: all fine parts (:mod:`.kernel`), then all coarse."""
    fine: list[float] = []
    coarse: list[float] = []
    for i, j in pairs:
        product = phi[i] * phi[j] * scale
        high = product + COARSE - COARSE
        coarse.append(high)
        fine.append(product - high + FINE - FINE)
    return fine + coarse


def linear(phi: list[float], weights: list[Linear]) -> Linear:
    """Return A's six entries and T: the sums of regressors times weights, in this order."""
    xx = yy = zz = xy = xz = yz = tx = ty = tz = 0.0
    for value, (a, b, c, d, e, f, g, h, i) in zip(phi, weights):  # noqa: B905 - the weights of effects are left aside
        xx += value * a
        yy += value * b
        zz += value * c
        xy += value * d
        xz += value * e
        yz += value * f
        tx += value * g
        ty += value * h
        tz += value * i
    return xx, yy, zz, xy, xz, yz, tx, ty, tz


def prepare(t: list[float]) -> Prepared:
    """Turn the table's 81 sums at one set of positions into what :func:`apply` needs there.

    ``L_ij,k = -(G_ik,j + G_jk,i)`` with ``G = S_a'T A'^T``, and ``O = A' S_TT A'^T``.
    """
    xx, xy, xz, yx, yy, yz, zx, zy, zz = t[0:9]
    G = []
    for k in range(48, 75, 3):
        x, y, z = t[k], t[k + 1], t[k + 2]
        G += [x * xx + y * xy + z * xz, x * yx + y * yy + z * yz, x * zx + y * zy + z * zz]
    sxx, syy, szz, sxy, sxz, syz = t[75:81]
    AS = []
    for k in range(0, 9, 3):
        x, y, z = t[k], t[k + 1], t[k + 2]
        AS += [sxx * x + sxy * y + sxz * z, sxy * x + syy * y + syz * z, sxz * x + syz * y + szz * z]
    V = []
    for e, (i, j) in enumerate(PAIRS):
        O = t[3 * i] * AS[3 * j] + t[3 * i + 1] * AS[3 * j + 1] + t[3 * i + 2] * AS[3 * j + 2]  # noqa: E741
        L = [-(G[9 * i + 3 * k + j] + G[9 * j + 3 * k + i]) for k in range(3)]
        V.append([*t[12 + 6 * e : 18 + 6 * e], *L, O])
    return t[:12], V


def apply(hx: float, hy: float, hz: float, prepared: Prepared, omega: tuple[float, ...] | None) -> Numbers:
    """Correct one sample (or arrays of them); return total, its sigma, the vector, and the vector's sigmas.

    `omega` holds xx, yy, zz, xy, xz, yz of the boresight's covariance; None where there is no boresight.
    """
    (xx, xy, xz, yx, yy, yz, zx, zy, zz, tx, ty, tz), V = prepared
    dx, dy, dz = hx - tx, hy - ty, hz - tz
    bx = xx * dx + xy * dy + xz * dz
    by = yx * dx + yy * dy + yz * dz
    bz = zx * dx + zy * dy + zz * dz
    F = sqrt(bx * bx + by * by + bz * bz)
    over = 1.0 / (F + 1e-300)  # a vector of length zero has no direction, but must not raise
    ux, uy, uz = bx * over, by * over, bz * over
    exx, eyy, ezz, exy, exz, eyz = dx * dx, dy * dy, dz * dz, dx * dy, dx * dz, dy * dz
    vxx, vyy, vzz, vxy, vxz, vyz = [
        q0 * exx + q1 * eyy + q2 * ezz + q3 * exy + q4 * exz + q5 * eyz + l0 * dx + l1 * dy + l2 * dz + o
        for q0, q1, q2, q3, q4, q5, l0, l1, l2, o in V
    ]
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
    return F, sqrt(abs(variance)), bx, by, bz, sqrt(abs(vxx)), sqrt(abs(vyy)), sqrt(abs(vzz))
