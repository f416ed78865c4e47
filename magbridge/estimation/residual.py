"""The scalar residual of a calibration, in errors-in-variables form, with its analytic derivatives.

Notes
-----
The reading H_r inside ``A(.)`` is noisy: least squares on ``|A(H_r - T)| - H_e`` would shrink A and bias T.
The errors-in-variables residual (Sampson's; Kukush, Markovsky & Van Huffel 2004) is in the sensor's
own nanotesla::

    d = H_r - T,  b = A d,  F = |b|,  u = b / F,  w = A u
    e = (F - H_e) / s,   s^2 = kappa^2 + |w|^2          (kappa: noise of the reference over the sensor's)

    de = (u^T dA d - w^T dT) / s - (e / s^2) w^T dw
    w^T dw = w^T dA u + y^T dA d - y^T A dT,   y = (I - u u^T) A w / F

Each coefficient is a polynomial in the positions of the masses. A row of the Jacobian is therefore
``phi (x) g``, with g the derivative by the nine numbers (a_xx, a_yy, a_zz, a_xy, a_xz, a_yz, t_x, t_y, t_z).
The module imports numpy only, because the live bridge uses it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magbridge.arrays import BoolArray, FloatArray, IndexArray

__all__ = [
    "CHUNK_ROWS", "PAIRS", "ResidualSamples", "jacobian", "residual_scale", "residuals", "residuals_of",
    "rms", "robust_scale", "scales_and_offsets", "symmetric",
]  # fmt: skip

CHUNK_ROWS = 8192
"""Rows of the Jacobian that are in memory at a time."""
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Row and column of each of the six entries of a symmetric matrix, in the order in which they are stored."""


@dataclass(frozen=True, eq=False)
class ResidualSamples:
    """Samples that a fit compares with their reference."""

    field: FloatArray
    """(n, 3): Raw field H_r, nT."""
    reference: FloatArray
    """(n,): Reference of the total field H_e, nT."""
    phi: FloatArray
    """(n, m): Monomials of the masses' positions."""
    steps: FloatArray
    """(n,): Sampling intervals since the previous sample; infinite at the first sample of a run."""
    F_0: float
    """Total field that the coefficients of A refer to, nT: ``A = I + a / F_0``."""
    kappa: float = 0.0
    """Noise of the reference divided by the sensor's."""
    moving: BoolArray | None = None
    """(n,): True for samples next to a motion of a mass, which have a larger error; None if all rest."""

    def part(self, rows: slice | BoolArray | IndexArray) -> ResidualSamples:
        """Return the samples `rows`, given as a mask (n,), indices or a slice."""
        moving = None if self.moving is None else self.moving[rows]
        columns = self.field[rows], self.reference[rows], self.phi[rows], self.steps[rows]
        return ResidualSamples(*columns, self.F_0, self.kappa, moving)


def residuals(samples: ResidualSamples, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the residual e (n,) in sensor nT, and its derivative by the nine coefficients (n, 9).

    Parameters
    ----------
    samples : ResidualSamples
        n samples with m monomials.
    coefficients : (9 m,) array
        Coefficients, nT, monomial by monomial.
    """
    # A and T at the positions of every sample, then the corrected vector b and its direction u; all by axes,
    # (9, n), (6, n) and (3, n), because operations on short rows are slow
    theta = coefficients.reshape(-1, 9).T @ samples.phi.T
    A = theta[:6] / samples.F_0
    A[:3] += 1.0
    d = samples.field.T - theta[6:]
    b = _times(A, d)
    F = np.sqrt((b * b).sum(axis=0))
    u = b / F
    # Sampson's weight: a channel's noise of 1 nT moves F by |A u| nT
    w = _times(A, u)
    s2 = samples.kappa**2 + (w * w).sum(axis=0)
    s = np.sqrt(s2)
    e = (F - samples.reference) / s
    # the derivative of the weight, y, and of the residual: de = z^T dA d - (A z)^T dT - k w^T dA u
    v = _times(A, w)
    y = (v - u * (u * v).sum(axis=0)) / F
    k = e / s2
    z = u / s - k * y
    kw = k * w
    g = np.empty((9, len(e)))
    for slot, (i, j) in enumerate(PAIRS):
        g[slot] = z[i] * d[j] - kw[i] * u[j]
        if i != j:
            g[slot] += z[j] * d[i] - kw[j] * u[i]
    g[:6] /= samples.F_0
    g[6:] = -_times(A, z)
    return e, np.ascontiguousarray(g.T)


def residual_scale(samples: ResidualSamples, coefficients: FloatArray) -> FloatArray:
    """Return ``s = sqrt(kappa^2 + |A u|^2)`` (n,), by which the residual divides errors of the total field.

    `coefficients` (9 m,): nT, monomial by monomial.
    """
    theta = coefficients.reshape(-1, 9).T @ samples.phi.T
    A = theta[:6] / samples.F_0
    A[:3] += 1.0
    b = _times(A, samples.field.T - theta[6:])
    w = _times(A, b) / np.linalg.norm(b, axis=0)
    return np.asarray(np.sqrt(samples.kappa**2 + (w * w).sum(axis=0)))


def jacobian(phi: FloatArray, g: FloatArray) -> FloatArray:
    """Return the derivatives (n, 9 m) by all coefficients: ``phi (x) g`` of phi (n, m) and g (n, 9)."""
    return np.asarray(phi[:, :, None] * g[:, None, :]).reshape(len(g), -1)


def residuals_of(samples: ResidualSamples, coefficients: FloatArray) -> FloatArray:
    """Return only the residual e (n,), in bounded memory; arguments as for :func:`residuals`."""
    # Chunks bound the memory of the Jacobian's intermediate arrays.
    pieces = [
        residuals(samples.part(slice(start, start + CHUNK_ROWS)), coefficients)[0]
        for start in range(0, len(samples.field), CHUNK_ROWS)
    ]
    return np.concatenate(pieces)


def rms(values: FloatArray) -> float:
    """Return the root mean square of the values (n,)."""
    return float(np.sqrt(np.mean(values**2)))


def robust_scale(values: FloatArray) -> float:
    """Return the 1-sigma of most values (n,) about zero: 1.48 times their median magnitude."""
    return 1.4826 * float(np.median(np.abs(values)))


def scales_and_offsets(samples: ResidualSamples, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the eigenvalues of A (n, 3) and the magnitude of T (n,), nT, at every sample."""
    theta = samples.phi @ coefficients.reshape(-1, 9)
    A = np.eye(3) + symmetric(theta) / samples.F_0
    return np.asarray(np.linalg.eigvalsh(A)), np.asarray(np.linalg.norm(theta[:, 6:], axis=1))


def _times(A: FloatArray, x: FloatArray) -> FloatArray:
    """Return the products (3, n) of symmetric matrices, given as entries (6, n), and vectors (3, n)."""
    xx, yy, zz, xy, xz, yz = A
    a, b, c = x
    return np.stack([xx * a + xy * b + xz * c, xy * a + yy * b + yz * c, xz * a + yz * b + zz * c])


def symmetric(entries: FloatArray) -> FloatArray:
    """Return (n, 3, 3) symmetric matrices from their six entries (n, 6 or more), ordered as :data:`PAIRS`."""
    return entries[:, [0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(-1, 3, 3)
