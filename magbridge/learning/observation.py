"""One sample against its reference: the residual in the sensor's own nanotesla, and its derivatives.

The equations are those of :mod:`magbridge.estimation.residual`, for one sample and without scipy: the live
path runs here.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.records import Vector

__all__ = ["Observation", "observe"]


class Observation(NamedTuple):
    """Residual ``e = (|A (H_r - T)| - H_e) / s`` (nT), s, and de by the nine coefficients (9,)."""

    e: float
    s: float
    by_nine: FloatArray

    @property
    def direction(self) -> FloatArray:
        """Direction of the field in sensor axes (3,), up to the soft iron."""
        return -self.s * self.by_nine[6:]


def observe(field: Vector, nine: FloatArray, F_0: float, reference: float, kappa: float = 0.0) -> Observation:
    """Compare one sample with its reference.

    Parameters
    ----------
    field : tuple of 3 float
        nT, raw, sensor axes.
    nine : (9,) array
        nT, the coefficients of A (as ``(A - I) F_0``) and of T at the sample's positions.
    F_0 : float
        nT, the total field that they refer to.
    reference : float
        nT, H_e.
    kappa : float
        Noise of the reference over the sensor's.
    """
    axx, ayy, azz, axy, axz, ayz, tx, ty, tz = nine.tolist()
    xx, yy, zz = 1.0 + axx / F_0, 1.0 + ayy / F_0, 1.0 + azz / F_0
    xy, xz, yz = axy / F_0, axz / F_0, ayz / F_0
    dx, dy, dz = field[0] - tx, field[1] - ty, field[2] - tz
    bx, by, bz = xx * dx + xy * dy + xz * dz, xy * dx + yy * dy + yz * dz, xz * dx + yz * dy + zz * dz
    F = sqrt(bx * bx + by * by + bz * bz)
    ux, uy, uz = bx / F, by / F, bz / F
    wx, wy, wz = xx * ux + xy * uy + xz * uz, xy * ux + yy * uy + yz * uz, xz * ux + yz * uy + zz * uz
    s2 = kappa * kappa + wx * wx + wy * wy + wz * wz
    s = sqrt(s2)
    e = (F - reference) / s
    vx, vy, vz = xx * wx + xy * wy + xz * wz, xy * wx + yy * wy + yz * wz, xz * wx + yz * wy + zz * wz
    along = ux * vx + uy * vy + uz * vz
    k = e / s2
    kF = k / F
    zx, zy, zz_ = (
        ux / s - kF * (vx - ux * along),
        uy / s - kF * (vy - uy * along),
        uz / s - kF * (vz - uz * along),
    )
    by_nine = np.array(
        (
            (zx * dx - k * wx * ux) / F_0,
            (zy * dy - k * wy * uy) / F_0,
            (zz_ * dz - k * wz * uz) / F_0,
            (zx * dy + zy * dx - k * (wx * uy + wy * ux)) / F_0,
            (zx * dz + zz_ * dx - k * (wx * uz + wz * ux)) / F_0,
            (zy * dz + zz_ * dy - k * (wy * uz + wz * uy)) / F_0,
            -(xx * zx + xy * zy + xz * zz_),
            -(xy * zx + yy * zy + yz * zz_),
            -(xz * zx + yz * zy + zz * zz_),
        )
    )
    return Observation(e, s, by_nine)
