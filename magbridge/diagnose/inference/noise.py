r"""The noise of a residual: autoregressive, heavy-tailed, and louder at some times than at others.

Notes
-----
A residual r has p autoregressive coefficients a and innovations v, which have Student's
distribution of nu degrees of freedom and a scale s that may change from block to block::

    v_t = f_t (r_t - sum_k a_k r_(t-k)),   v_t / s_t ~ t_nu

Without a gap f is 1. After a gap the p samples before have other lags l: there a are the best predictor from
those lags, and ``1 / f`` is by how much larger its error is, both from the autocovariance C of the
autoregression (Vecchia 1988, JRSS B 50:297),

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
from numpy.lib.stride_tricks import as_strided, sliding_window_view
from scipy.signal import lfilter, lfiltic

from magbridge.arrays import FloatArray
from magbridge.diagnose.compare.design_columns import Columns
from magbridge.diagnose.compare.past import MAX_LAG, Past

__all__ = ["Noise", "Predictors", "autocovariance"]

BAND = 32
"""Rows that are filtered by one product of matrices."""
SOLVED = 4096
"""Patterns of lags whose predictors are solved for at a time."""


@dataclass(frozen=True, eq=False)
class Noise:
    """Noise as fitted."""

    ar: FloatArray
    """(p,) autoregressive coefficients."""
    scale: FloatArray
    """(n,) nT, s of every sample."""
    nu: float
    """Degrees of freedom of the tails; 1e6 is Gaussian."""
    past: Past
    """The samples before each one."""
    log_likelihood: float
    innovations: FloatArray
    """(n,) v / s."""

    @property
    def kappa(self) -> float:
        """Fisher information of a location, against a Gaussian's of the same scale."""
        return (self.nu + 1.0) / (self.nu + 3.0)

    @property
    def uneven(self) -> bool:
        """Return True if its level changes: likelihoods are comparable only under one kind of noise."""
        return bool(np.ptp(self.scale))

    @property
    def independent(self) -> float:
        """Number of independent samples that determine a constant as well: ``n (1 - sum a)^2 C(0)``."""
        return float(len(self.scale) * (1.0 - self.ar.sum()) ** 2 * autocovariance(self.ar, 0)[0])

    @property
    def slowest(self) -> float:
        """Longest time constant of the autoregression, in samples."""
        size = np.abs(np.roots(np.append(1.0, -self.ar))).max(initial=0.0)
        return 1.0 / (1.0 - float(size))

    @cached_property
    def near_gaps(self) -> Predictors:
        """Predictors of the samples shortly after a gap."""
        return Predictors(self.past, self.ar)

    def whitened(self, columns: Columns, rows: slice) -> FloatArray:
        """(m, k) these rows of whitened columns, stored column by column."""
        first = max(rows.start - len(self.ar), 0)
        return self.filter(columns(slice(first, rows.stop)), first, rows.start - first)

    def filter(self, values: FloatArray, start: int = 0, skip: int = 0) -> FloatArray:
        """Whiten columns for least squares: a product with a band matrix, computed band by band.

        Parameters
        ----------
        values : (m, k) array
            Rows from `start` on of the whole log's columns, best stored column by column.
        start : int
            Place of the first row in the log.
        skip : int
            Rows at the beginning that serve only as the past of the others.

        Returns
        -------
        (m - skip, k) array
            Stored column by column.
        """
        p, k, own = len(self.ar), values.shape[1], len(values) - skip
        count = -(-own // BAND)
        V = np.asfortranarray(values).T[:, max(skip - p, 0) :]
        lacking = max(p - skip, 0), BAND * count - own
        if any(lacking):
            V = np.pad(V, ((0, 0), lacking))
        weights = np.zeros((BAND * count, p + 1))
        weights[:own] = self._weights(slice(start + skip, start + len(values)))
        bands = np.zeros((count, BAND + p, BAND))
        band, row, each = bands.strides
        diagonals = as_strided(bands, (count, BAND, p + 1), (band, row + each, row))
        diagonals[...] = weights[:, ::-1].reshape(diagonals.shape)
        out = np.empty((k, BAND * count))
        pieces, filtered = (
            as_strided(x, (count, k, wide), (BAND * each, x.strides[0], each))
            for x, wide in ((V, BAND + p), (out, BAND))
        )
        np.matmul(pieces, bands, out=filtered)
        return out[:, :own].T

    def _weights(self, rows: slice) -> FloatArray:
        """(m, p + 1) weights of each of `rows`, and of the p rows before it, in :meth:`filter`."""
        past, gaps = self.past, self.near_gaps
        weights = np.tile(np.append(1.0, -self.ar), (rows.stop - rows.start, 1))
        some = slice(*np.searchsorted(past.rows, [rows.start, rows.stop]))
        weights[past.rows[some] - rows.start] = gaps.weights[past.pattern[some]]
        weights *= (np.sqrt(self.kappa) / self.scale[rows])[:, None]
        return weights

    def whiten(self, y: FloatArray) -> FloatArray:
        """(n,) whitened y (n,): :meth:`filter` of a single whole column."""
        return np.asarray(np.sqrt(self.kappa) * self.near_gaps.innovations(y) / self.scale)

    def back(self, y: FloatArray) -> FloatArray:
        """(n,) y (n,) filtered backwards: the product with the transpose of :meth:`filter`'s matrix."""
        y = np.sqrt(self.kappa) * y / self.scale
        early, gaps = self.past.rows, self.near_gaps
        whole = np.where(self.past.whole, y, 0.0)
        out = whole.copy()
        out[early] = gaps.f[self.past.pattern] * y[early]
        for k, weight in enumerate(self.ar, 1):
            out[:-k] -= weight * whole[k:]
            # a is 0 for samples that do not exist
            out[early - k] -= (gaps.f * gaps.a[:, k - 1])[self.past.pattern] * y[early]
        return out

    def response(self, residual: FloatArray) -> FloatArray:
        """(n,) y of the module's notes; the weights of psi are those of the residual that was fitted."""
        weight = (self.nu + 1.0) / (self.nu + self.innovations**2)
        return np.asarray(weight * self.whiten(residual) / self.kappa)


class Predictors:
    """Predictors of the samples shortly after a gap.

    Parameters
    ----------
    past : Past
    ar : (p,) array

    Attributes
    ----------
    past, ar
    a : (l, p) array
        a of the module's notes, for each pattern of lags.
    f : (l,) array
        f of the module's notes.
    weights : (l, p + 1) array
        Of a sample, f, and of those before it, ``-f a``.
    """

    def __init__(self, past: Past, ar: FloatArray) -> None:
        self.past, self.ar, lags = past, ar, past.lags
        here = lags < MAX_LAG
        C = autocovariance(ar, int(lags[here].max(initial=0)))
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

    def innovations(self, residual: FloatArray) -> FloatArray:
        """(n,) innovations v of a residual (n,)."""
        past, p = self.past, len(self.ar)
        # a view of the p samples before each, which takes no memory
        lags = sliding_window_view(np.append(np.zeros(p), residual), p)[:-1, ::-1]
        v = np.asarray(residual - lags @ self.ar)
        # a is 0 for samples that do not exist
        own = residual[np.maximum(past.rows[:, None] - np.arange(p + 1), 0)]
        v[past.rows] = np.einsum("ij,ij->i", self.weights[past.pattern], own)
        return v


def autocovariance(ar: FloatArray, reach: int) -> FloatArray:
    """(reach + 1,) C of an autoregression whose innovations have variance 1.

    Levinson's recursion backwards gives the best coefficients for 0, 1, ... p samples (Brockwell & Davis
    1991, sec. 5.2).
    """
    p, shorter, variance = len(ar), [ar], 1.0
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
        tail = lfiltic([1.0], np.append(1.0, -ar), C[p:0:-1])
        C[p + 1 :] = lfilter([1.0], np.append(1.0, -ar), np.zeros(reach - p), zi=tail)[0]
    return C[: reach + 1]
