r"""The noise of a residual: autoregressive, heavy-tailed, and louder at some times than at others.

Notes
-----
A residual r with p coefficients a of memory, innovations v, Student tails of nu and a scale s that may
change from block to block::

    v_t = f_t (r_t - sum_k a_k r_(t-k)),   v_t / s_t ~ t_nu

After a gap there is no past to look at: there ``v_t = f r_t``, f the innovations' share of the whole
standard deviation. One step of Fisher scoring towards the maximum of the likelihood is then ordinary
least squares of

    y_t = psi(v_t / s_t) / sqrt(kappa)   on   sqrt(kappa) f (X_t - sum_k a_k X_(t-k)) / s_t
    psi(x) = (nu + 1) x / (nu + x^2),   kappa = (nu + 1) / (nu + 3)

(kappa is the Fisher information of a t location: Lange, Little & Taylor 1989, JASA 84:881.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

__all__ = ["Noise"]

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

BAND = 32
"""Rows that are filtered by one product of matrices."""


@dataclass(frozen=True, eq=False)
class Noise:
    """Noise as fitted.

    Attributes
    ----------
    memory : (p,) array
        Autoregressive coefficients.
    scale : (n,) array
        nT, s of every sample.
    nu : float
        Degrees of freedom of the tails; 1e6 is Gaussian.
    share : float
        f where there is no past.
    past : (n,) bool array
        The p samples before are there.
    log_likelihood : float
    innovations : (n,) array
        v / s.
    """

    memory: FloatArray
    scale: FloatArray
    nu: float
    share: float
    past: BoolArray
    log_likelihood: float
    innovations: FloatArray

    @property
    def kappa(self) -> float:
        """Fisher information of a location, against a Gaussian's of the same scale."""
        return (self.nu + 1.0) / (self.nu + 3.0)

    @property
    def independent(self) -> float:
        """How many independent samples say as much of a constant: ``n (1 - sum a)^2 / f^2``."""
        return float(len(self.scale) * (1.0 - self.memory.sum()) ** 2 / max(self.share, 1e-6) ** 2)

    def filter(self, values: FloatArray, start: int = 0, skip: int = 0) -> FloatArray:
        """Whiten columns for least squares.

        Parameters
        ----------
        values : (m, k) array
            Rows `start` and on of the whole.
        start : int
        skip : int
            Rows at the beginning that serve as the past only.

        Returns
        -------
        (m - skip, k) array
        """
        rows = slice(start + skip, start + len(values))
        out = _filtered(values, self.memory, skip)
        past = self.past[rows]
        lone = np.flatnonzero(~past)
        out[lone] = values[skip:][lone]
        out *= (np.sqrt(self.kappa) * np.where(past, 1.0, self.share) / self.scale[rows])[:, None]
        return out

    def response(self, residual: FloatArray) -> FloatArray:
        """(n,) y of the module's notes; far from where the noise was fitted, with its weights from there."""
        weight = (self.nu + 1.0) / (self.nu + self.innovations**2)
        return np.asarray(weight * self.filter(residual[:, None])[:, 0] / self.kappa)


def _filtered(values: FloatArray, memory: FloatArray, skip: int) -> FloatArray:
    """``x_t - sum_k a_k x_(t-k)`` of the rows from `skip` on, zero before the first: a band matrix, band by band."""
    p, k = len(memory), values.shape[1]
    m = len(values) - skip
    if skip < p:
        values, skip = np.vstack([np.zeros((p - skip, k)), values]), p
    values = np.ascontiguousarray(values[skip - p :])
    count = m // BAND
    band = np.zeros((BAND, BAND + p))
    for lag, a in enumerate(np.append(-1.0, memory)):
        band[np.arange(BAND), np.arange(BAND) + p - lag] = -a
    step, each = values.strides
    pieces = as_strided(values, (count, BAND + p, k), (BAND * step, step, each), writeable=False)
    out = np.empty((m, k))
    np.matmul(band, pieces, out=out[: count * BAND].reshape(count, BAND, k))
    rest = m - count * BAND
    out[count * BAND :] = band[:rest, : rest + p] @ values[count * BAND :]
    return out
