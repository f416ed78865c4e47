"""The scalar residual of a calibration, its analytic Jacobian, and their normal equations.

Notes
-----
Noise sits in the reading, inside ``A(.)``: least squares on ``|A(H_r - T)| - H_e`` would shrink A and bias T.
The errors-in-variables residual (Sampson's; Kukush, Markovsky & Van Huffel 2004) is in the sensor's
own nanotesla::

    d = H_r - T,  b = A d,  F = |b|,  u = b / F,  w = A u
    e = (F - H_e) / s,   s^2 = kappa^2 + |w|^2          (kappa: noise of the reference over the sensor's)

    de = (u^T dA d - w^T dT) / s - (e / s^2) w^T dw
    w^T dw = w^T dA u + y^T dA d - y^T A dT,   y = (I - u u^T) A w / F

Each coefficient is a polynomial, so a row of the Jacobian is ``phi (x) g`` with g the derivative by the
nine. Noise with a memory is whitened within a run (:class:`Whitening`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dtbtrs

from magbridge.arrays import BoolArray, FloatArray, IndexArray
from magbridge.calibration.arithmetic import PAIRS
from magbridge.calibration.terms import symmetric

__all__ = [
    "NormalEquations", "Samples", "Whitening", "independent", "jacobian", "normal_equations", "residuals",
    "residuals_of", "rms", "robust_scale", "scales_and_offsets", "whiten",
]  # fmt: skip

CHUNK = 8192
"""Rows of the Jacobian at a time: bounded memory at any number of samples."""
SETTLED = 1e-13
"""Share of the variance by which a filter that has settled still changes."""


@dataclass(frozen=True, eq=False)
class Samples:
    """The samples that a fit compares with their reference."""

    field: FloatArray
    """(n, 3), nT, raw."""
    reference: FloatArray
    """(n,), nT, H_e."""
    phi: FloatArray
    """(n, m): Monomials of the positions."""
    steps: FloatArray
    """(n,): Sampling intervals since the previous sample; infinite where that belongs to another run."""
    F_0: float
    """nT, the total field that the coefficients of A refer to: ``A = I + a / F_0``."""
    kappa: float = 0.0
    """Noise of the reference divided by the sensor's."""

    def part(self, rows: slice | BoolArray | IndexArray) -> Samples:
        """Pick samples: an (n,) mask, places or a slice."""
        return Samples(
            self.field[rows], self.reference[rows], self.phi[rows], self.steps[rows], self.F_0, self.kappa
        )


class NormalEquations(NamedTuple):
    """``cost = sum weight e^2`` about a point: half its gradient, and Gauss-Newton's half Hessian."""

    hessian: FloatArray
    gradient: FloatArray
    cost: float


def residuals(samples: Samples, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the residual e (n,) in sensor nT, and its derivative by the nine coefficients (n, 9).

    Parameters
    ----------
    samples : Samples
        n of them, with m monomials.
    coefficients : (9 m,) array
        nT, monomial by monomial.
    """
    theta = samples.phi @ coefficients.reshape(-1, 9)
    A = np.eye(3) + symmetric(theta[:, :6] / samples.F_0)
    d = samples.field - theta[:, 6:]
    b = _times(A, d)
    F = np.sqrt((b * b).sum(axis=1))
    u = b / F[:, None]
    w = _times(A, u)
    s2 = samples.kappa**2 + (w * w).sum(axis=1)
    s = np.sqrt(s2)
    e = (F - samples.reference) / s
    v = _times(A, w)
    y = (v - u * (u * v).sum(axis=1)[:, None]) / F[:, None]
    k = (e / s2)[:, None]
    z = u / s[:, None] - k * y  # de = z^T dA d - (A z)^T dT - k w^T dA u
    g = np.empty((len(e), 9))
    for slot, (i, j) in enumerate(PAIRS):
        g[:, slot] = z[:, i] * d[:, j] - k[:, 0] * w[:, i] * u[:, j]
        if i != j:
            g[:, slot] += z[:, j] * d[:, i] - k[:, 0] * w[:, j] * u[:, i]
    g[:, :6] /= samples.F_0
    g[:, 6:] = -_times(A, z)
    return e, g


def jacobian(phi: FloatArray, g: FloatArray) -> FloatArray:
    """(n, 9 m) derivatives by all coefficients, ``phi (x) g``, of monomials (n, m) and those by the nine."""
    return np.asarray(phi[:, :, None] * g[:, None, :]).reshape(len(g), -1)


def residuals_of(samples: Samples, coefficients: FloatArray) -> FloatArray:
    """Residual e (n,) alone, in bounded memory; arguments as for :func:`residuals`."""
    pieces = [
        residuals(samples.part(slice(start, start + CHUNK)), coefficients)[0]
        for start in range(0, len(samples.field), CHUNK)
    ]
    return np.concatenate(pieces)


def rms(values: FloatArray) -> float:
    """Root mean square of the values (n,)."""
    return float(np.sqrt(np.mean(values**2)))


def robust_scale(values: FloatArray) -> float:
    """1-sigma of the bulk of values (n,) about zero, outliers or not: 1.48 times their median magnitude."""
    return 1.4826 * float(np.median(np.abs(values)))


def scales_and_offsets(samples: Samples, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Eigenvalues of A (n, 3) and size of T (n,), nT, at every sample."""
    theta = samples.phi @ coefficients.reshape(-1, 9)
    A = np.eye(3) + symmetric(theta) / samples.F_0
    return np.asarray(np.linalg.eigvalsh(A)), np.asarray(np.linalg.norm(theta[:, 6:], axis=1))


def _times(A: FloatArray, x: FloatArray) -> FloatArray:
    """(n, 3, 3) times (n, 3)."""
    return np.asarray(np.matmul(A, x[:, :, None])[:, :, 0])


def normal_equations(
    samples: Samples,
    coefficients: FloatArray,
    weight: FloatArray | None = None,
    rho: float = 0.0,
    white: float = 0.0,
) -> NormalEquations:
    """Sum up the normal equations of the whitened residual, in bounded memory.

    Parameters
    ----------
    samples : Samples
        n of them, with m monomials.
    coefficients : (9 m,) array
        nT, monomial by monomial: where to linearise.
    weight : (n,) array, optional
        Of each whitened residual (robust fits); 1 if not given.
    rho, white : float
        The noise's memory, as for :func:`whiten`.
    """
    size = coefficients.size
    hessian, gradient, cost = np.zeros((size, size)), np.zeros(size), 0.0
    whitening = Whitening(samples.steps, rho, white)
    for start in range(0, len(samples.field), CHUNK):
        part = samples.part(slice(start, start + CHUNK))
        e, g = residuals(part, coefficients)
        J = jacobian(part.phi, g)
        if rho:
            both = whitening.apply(np.column_stack([e, J]))
            e, J = both[:, 0], both[:, 1:]
        if weight is not None:
            root = np.sqrt(weight[start : start + CHUNK])
            e, J = e * root, J * root[:, None]
        hessian += J.T @ J
        gradient += J.T @ e
        cost += float(e @ e)
    return NormalEquations(hessian, gradient, cost)


class Whitening:
    """Whitens noise of unit variance: an AR(1) process, and white noise of the share `white` beside it.

    Parameters
    ----------
    steps : (n,) array
        Sampling intervals since the previous sample; infinite at the first of a run.
    rho : float
        Autocorrelation of the slow part at one sampling interval.
    white : float
        Share of the variance that is white.

    Notes
    -----
    The innovations of a Kalman filter that follows the slow part s, of variance ``1 - f`` beside the white
    noise's f, and predicts m (Harvey 1989, Forecasting, structural time series models, section 3.2)::

        v_t = y_t - m_t,   S_t = P_t + f,   K_t = P_t / S_t
        m_t+1 = r (m_t + K_t v_t),   P_t+1 = r^2 (1 - K_t) P_t + (1 - f)(1 - r^2),   r = rho^steps

    and ``v / sqrt(S)`` is white, of unit variance. With f = 0 it is ``(y_t - r y_t-1) / sqrt(1 - r^2)``.
    """

    def __init__(self, steps: FloatArray, rho: float, white: float = 0.0) -> None:
        self.decay = np.full(len(steps), rho)  # from the sample before
        others = np.flatnonzero(steps != 1)
        self.decay[others] = rho ** steps[others]
        self.variance, self.gain = _gains(self.decay, white)
        self._at = 0
        self._last: FloatArray | None = None  # the slow part at the row before, as far as known

    def apply(self, values: FloatArray) -> FloatArray:
        """Whiten the next rows (k, ...) of all n: a block at a time, in order."""
        rows = slice(self._at, self._at + len(values))
        y = values.reshape(len(values), -1)
        r, K, S = self.decay[rows, None], self.gain[rows, None], self.variance[rows, None]
        before = np.zeros(y.shape[1]) if self._last is None else self._last
        updated = y  # m_t + K_t v_t = (1 - K_t) m_t + K_t y_t
        if (K != 1.0).any():  # x_t - (1 - K_t) r_t x_t-1 = K_t y_t: two diagonals
            updated = K * y
            updated[0] += (1.0 - K[0]) * r[0] * before
            band = np.ones((2, len(y)))
            band[1, :-1] = -((1.0 - K) * r)[1:, 0]
            updated, _ = dtbtrs(band, updated, uplo="L", diag="U")
        v = np.empty_like(y)  # in place from here on: new memory costs more than the arithmetic
        v[0] = r[0] * before
        np.multiply(r[1:], updated[:-1], out=v[1:])
        np.subtract(y, v, out=v)
        v /= np.sqrt(S)
        self._at, self._last = rows.stop, updated[-1].copy()
        return v.reshape(values.shape)


def _gains(decay: FloatArray, white: float) -> tuple[FloatArray, FloatArray]:
    """Return S and K (n,) of the filter above, for the decay (n,) since the sample before."""
    if white == 0.0:
        return 1.0 - decay**2, np.ones(len(decay))
    variance = np.empty(len(decay))
    slow, after, last = 1.0 - white, 0.0, -1.0
    ends = np.flatnonzero(np.diff(decay, append=-1.0))  # until these the filter goes to its steady state
    start = 0
    for end in ends.tolist():
        for t in range(start, end + 1):
            ahead = decay[t] ** 2 * after + slow * (1.0 - decay[t] ** 2)
            variance[t] = ahead + white
            after = ahead * white / variance[t]
            if abs(after - last) < SETTLED * slow:
                variance[t : end + 1] = variance[t]
                break
            last = after
        start, last = end + 1, -1.0
    return variance, 1.0 - white / variance


def whiten(values: FloatArray, steps: FloatArray, rho: float, white: float = 0.0) -> FloatArray:
    """Whiten noise (n, ...), gaps too; see :class:`Whitening`."""
    return Whitening(steps, rho, white).apply(values)


def independent(rho: float, white: float = 0.0) -> float:
    """Share of the samples that are independent in a mean: ``1 / (f + (1 - f)(1 + rho) / (1 - rho))``."""
    return (1.0 - rho) / (white * (1.0 - rho) + (1.0 - white) * (1.0 + rho))
