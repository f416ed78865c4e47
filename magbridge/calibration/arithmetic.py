"""The arithmetic of one corrected sample, of floats or of arrays: equations as code.

Notes
-----
With ``A, T`` at the sample's positions and V the covariance of the corrected vector::

    d = H_r - T,  b = A d,  F = |b|,  u = b / F
    V_ij = Q_ij . (d d^T) + L_ij . d + O_ij         (dA, dT and the sensor's noise carried through)
    sigma_F^2 = u^T V u

Every operation is elementwise IEEE arithmetic in one written order, on floats or on arrays, but for the
products of :class:`~magbridge.calibration.kernel.Kernel`, which are exact in any order: so a sample
corrected live, in a batch, or replayed on another computer gives identical bits.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

__all__ = ["apply", "prepare"]


def prepare(t: Sequence[Any]) -> tuple[Any, ...]:
    """From the table's 69 sums to what a sample needs, at one set of positions.

    ``L_ij,k = -(G_ik,j + G_jk,i)`` with ``G = S_aT A``, and ``O = A S_TT A``.
    """
    xx, yy, zz, xy, xz, yz = t[:6]
    G = []
    for s in range(45, 63, 3):
        x, y, z = t[s : s + 3]
        G.append((x * xx + y * xy + z * xz, x * xy + y * yy + z * yz, x * xz + y * yz + z * zz))
    gxx, gyy, gzz, gxy, gxz, gyz = G
    L = (
        (-2.0 * gxx[0], -2.0 * gxy[0], -2.0 * gxz[0]),
        (-2.0 * gxy[1], -2.0 * gyy[1], -2.0 * gyz[1]),
        (-2.0 * gxz[2], -2.0 * gyz[2], -2.0 * gzz[2]),
        (-(gxx[1] + gxy[0]), -(gxy[1] + gyy[0]), -(gxz[1] + gyz[0])),
        (-(gxx[2] + gxz[0]), -(gxy[2] + gyz[0]), -(gxz[2] + gzz[0])),
        (-(gxy[2] + gxz[1]), -(gyy[2] + gyz[1]), -(gyz[2] + gzz[1])),
    )
    a, b, c, d, e, f = t[63:69]  # S_TT: xx yy zz xy xz yz
    px, py, pz = a * xx + d * xy + e * xz, d * xx + b * xy + f * xz, e * xx + f * xy + c * xz
    qx, qy, qz = a * xy + d * yy + e * yz, d * xy + b * yy + f * yz, e * xy + f * yy + c * yz
    rx, ry, rz = a * xz + d * yz + e * zz, d * xz + b * yz + f * zz, e * xz + f * yz + c * zz
    O = (  # noqa: E741  (the notes' letter)
        xx * px + xy * py + xz * pz,
        xy * qx + yy * qy + yz * qz,
        xz * rx + yz * ry + zz * rz,
        xx * qx + xy * qy + xz * qz,
        xx * rx + xy * ry + xz * rz,
        xy * rx + yy * ry + yz * rz,
    )
    V = tuple((*t[9 + 6 * i : 15 + 6 * i], *L[i], O[i]) for i in range(6))
    return (*t[:9], V)


def apply(
    hx: Any, hy: Any, hz: Any, prepared: tuple[Any, ...], sight: tuple[float, ...] | None, root: Any
) -> tuple[Any, ...]:
    """One sample (or arrays of them): total, sigma, vector, sigmas of the vector."""
    xx, yy, zz, xy, xz, yz, tx, ty, tz, V = prepared
    dx, dy, dz = hx - tx, hy - ty, hz - tz
    bx = xx * dx + xy * dy + xz * dz
    by = xy * dx + yy * dy + yz * dz
    bz = xz * dx + yz * dy + zz * dz
    F = root(bx * bx + by * by + bz * bz)
    over = 1.0 / (F + 1e-300)  # a vector of exactly nothing has no direction, and must not raise
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
    # abs: rounding may leave a variance of nothing at -1e-12
    if sight is None:
        return F, root(abs(variance)), bx, by, bz, root(abs(vxx)), root(abs(vyy)), root(abs(vzz))
    return (F, root(abs(variance)), *rotate(bx, by, bz, vxx, vyy, vzz, vxy, vxz, vyz, sight, root))


def rotate(
    bx: Any, by: Any, bz: Any, vxx: Any, vyy: Any, vzz: Any, vxy: Any, vxz: Any, vyz: Any,
    sight: tuple[float, ...], root: Any,
) -> tuple[Any, ...]:  # fmt: skip
    """Into body axes: ``b' = R b``, ``V' = R V R^T + [b'] Omega [b']^T``, Omega the boresight's own."""
    oxx, oyy, ozz, oxy, oxz, oyz = sight[9:]
    rows = (sight[0:3], sight[3:6], sight[6:9])
    px, py, pz = [rx * bx + ry * by + rz * bz for rx, ry, rz in rows]
    wx, wy, wz = [
        rx * rx * vxx + ry * ry * vyy + rz * rz * vzz
        + 2.0 * (rx * ry * vxy + rx * rz * vxz + ry * rz * vyz)
        for rx, ry, rz in rows
    ]  # fmt: skip
    wx = wx + (pz * pz * oyy + py * py * ozz - 2.0 * py * pz * oyz)
    wy = wy + (pz * pz * oxx + px * px * ozz - 2.0 * px * pz * oxz)
    wz = wz + (py * py * oxx + px * px * oyy - 2.0 * px * py * oxy)
    return px, py, pz, root(abs(wx)), root(abs(wy)), root(abs(wz))
