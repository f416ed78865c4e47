r"""The noise of a residual: autoregressive, heavy-tailed, and louder at some times than at others.

Notes
-----
A residual r with p coefficients a of memory, innovations v, Student tails of nu and a scale s that may
change from block to block::

    v_t = f_t (r_t - sum_k a_k r_(t-k)),   v_t / s_t ~ t_nu

Beside a gap the p samples before a sample were at other lags: there a are the best coefficients for those, and f is
how much less surely they predict, both from the autocovariance C of the memory a (Vecchia 1988, JRSS B 50:297),

    a = G^-1 c,   G_ij = C(|l_i - l_j|),   c_i = C(l_i),   f^-2 = C(0) - c^T a   in units of s^2

One step of Fisher scoring towards the maximum of the likelihood is then ordinary least squares of

    y_t = psi(v_t / s_t) / sqrt(kappa)   on   sqrt(kappa) f (X_t - sum_k a_k X_(t-k)) / s_t
    psi(x) = (nu + 1) x / (nu + x^2),   kappa = (nu + 1) / (nu + 3)

(kappa is the Fisher information of a t location: Lange, Little & Taylor 1989, JASA 84:881.)
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray
from scipy.signal import lfilter, lfiltic
from scipy.sparse import csr_array

from magbridge.diagnose.compare.past import FAR, Past

__all__ = ["Noise", "Predictors", "autocovariance"]

FloatArray = NDArray[np.float64]

BAND = 32
"""Rows that are filtered by one product of matrices."""
SOLVED = 4096
"""Patterns of lags whose coefficients are found at a time."""


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
    past : Past
        What came before each sample.
    log_likelihood : float
    innovations : (n,) array
        v / s.
    """

    memory: FloatArray
    scale: FloatArray
    nu: float
    past: Past
    log_likelihood: float
    innovations: FloatArray

    @property
    def kappa(self) -> float:
        """Fisher information of a location, against a Gaussian's of the same scale."""
        return (self.nu + 1.0) / (self.nu + 3.0)

    @property
    def independent(self) -> float:
        """How many independent samples say as much of a constant: ``n (1 - sum a)^2 C(0)``."""
        return float(len(self.scale) * (1.0 - self.memory.sum()) ** 2 * autocovariance(self.memory, 0)[0])

    @cached_property
    def beside_gaps(self) -> Predictors:
        """What predicts samples that have not all of their past."""
        return Predictors(self.past, self.memory)

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
        own, whitened = self.beside_gaps.whitened(values, start, skip)
        out[own] = whitened
        out *= (np.sqrt(self.kappa) / self.scale[rows])[:, None]
        return out

    def back(self, y: FloatArray) -> FloatArray:
        """(n,) of y (n,), filtered backwards: the transpose of :meth:`filter`."""
        y = np.sqrt(self.kappa) * y / self.scale
        early, gaps = self.past.rows, self.beside_gaps
        whole = np.where(self.past.whole, y, 0.0)
        out = whole.copy()
        out[early] = gaps.f[self.past.pattern] * y[early]
        for k, weight in enumerate(self.memory, 1):
            out[:-k] -= weight * whole[k:]
            # of samples that are not there a is 0
            out[early - k] -= (gaps.f * gaps.a[:, k - 1])[self.past.pattern] * y[early]
        return out

    def response(self, residual: FloatArray) -> FloatArray:
        """(n,) y of the module's notes; far from where the noise was fitted, with its weights from there."""
        weight = (self.nu + 1.0) / (self.nu + self.innovations**2)
        return np.asarray(weight * self.filter(residual[:, None])[:, 0] / self.kappa)


class Predictors:
    """Predictions of samples beside gaps.

    Parameters
    ----------
    past : Past
    memory : (p,) array

    Attributes
    ----------
    past : Past
    a : (l, p) array
        Of each of the patterns of lags.
    f : (l,) array
    weights : (l, p + 1) array
        Of a sample and of those before: f, and ``-f a``.
    """

    def __init__(self, past: Past, memory: FloatArray) -> None:
        self.past = past
        lags = past.lags
        here = lags < FAR
        C = autocovariance(memory, int(lags[here].max(initial=0)))
        self.a, self.f = np.zeros(lags.shape), np.ones(len(lags))
        own = np.arange(lags.shape[1])
        for start in range(0, len(lags), SOLVED):
            part = slice(start, start + SOLVED)
            l, there = np.where(here[part], lags[part], 0), here[part]  # noqa: E741 - as in the equation
            both = there[:, :, None] & there[:, None, :]
            G = np.where(both, C[np.abs(l[:, :, None] - l[:, None, :])], 0.0)
            G[:, own, own] = C[0]
            c = np.where(there, C[l], 0.0)
            self.a[part] = a = np.linalg.solve(G, c[:, :, None])[:, :, 0]
            self.f[part] = 1.0 / np.sqrt(np.maximum(C[0] - np.sum(a * c, axis=1), 1.0))
        self.weights = self.f[:, None] * np.hstack([np.ones((len(lags), 1)), -self.a])

    def whitened(
        self, values: FloatArray, start: int = 0, skip: int = 0
    ) -> tuple[NDArray[np.intp], FloatArray]:
        """Rows beside gaps, counted after the first `skip`, and v of each.

        Parameters
        ----------
        values : (m, ...) array
            Rows `start` and on of the whole.
        start, skip : int
        """
        rows, lags = self.past.rows, np.arange(self.past.order + 1)
        some = slice(*np.searchsorted(rows, [start + skip, start + len(values)]))
        at, pattern = rows[some] - start, self.past.pattern[some]
        before = np.maximum(at[:, None] - lags, 0)  # of samples that are not there a is 0
        ends = lags.size * np.arange(at.size + 1)
        W = csr_array((self.weights[pattern].ravel(), before.ravel(), ends), (at.size, len(values)))
        return at - skip, W @ values


def autocovariance(memory: FloatArray, reach: int) -> FloatArray:
    """(reach + 1,) C of an autoregression whose innovations have variance 1.

    Levinson's recursion backwards gives the best coefficients for 0, 1, ... p samples (Brockwell & Davis 1991, sec. 5.2).
    """
    p, shorter, variance = len(memory), [memory], 1.0
    while shorter[-1].size:
        a = shorter[-1]
        k = a[-1]
        shorter.append((a[:-1] + k * a[-2::-1]) / (1.0 - k * k))
        variance /= 1.0 - k * k
    C = np.zeros(max(p, reach) + 1)
    C[0] = variance
    for m in range(1, p + 1):
        C[m] = shorter[p - m] @ C[m - 1 :: -1][:m]
    if reach > p:
        tail = lfiltic([1.0], np.append(1.0, -memory), C[p:0:-1])
        C[p + 1 :] = lfilter([1.0], np.append(1.0, -memory), np.zeros(reach - p), zi=tail)[0]
    return C[: reach + 1]


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
