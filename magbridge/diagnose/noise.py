"""Model and fit of a residual's noise: autoregressive, with heavy tails and a level that may change.

Notes
-----
A residual r has p autoregressive coefficients a and innovations v, which have Student's
distribution of nu degrees of freedom and a scale s that may change from block to block::

    v_t = f_t (r_t - sum_k a_k r_(t-k)),   v_t / s_t ~ t_nu

Without a gap f is 1. After a gap the p samples before have other lags l. There a is the best predictor from
these lags, and ``1 / f`` the ratio of its error to that without a gap. Both follow from the autocovariance C
of the autoregression (Vecchia 1988, JRSS B 50:297),

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
from scipy.special import gammaln

from magbridge.arrays import FloatArray, IntArray
from magbridge.diagnose.columns import Columns
from magbridge.diagnose.problem import row_blocks
from magbridge.diagnose.survey import MAX_LAG, Past
from magbridge.estimation.residual import robust_scale

BAND = 32
"""Number of rows that one matrix product filters."""
SOLVED = 4096
"""Number of lag patterns whose predictors are computed at a time."""
TAILS = (2.5, 3.0, 4.0, 5.0, 7.0, 12.0, 1e6)
NOISE_BLOCK_SAMPLES = 150
"""Number of samples in a block of constant noise level."""
AR_ORDERS = (1, 2, 3, 5, 8, 13)
MAX_NOISE_ORDER = AR_ORDERS[-1]
GAUSSIAN = 1e5
"""Degrees of freedom above which the noise is treated as Gaussian."""
NOISE_ITERATIONS = 3
"""Largest number of alternating fits of autoregression, tails and level."""
ALTERNATIONS = 6
"""Largest number of alternations between the weights of the samples and the level."""
MIN_GAIN = 0.01
"""Gain in log likelihood below which the fit has converged."""
LOSS = 0.02
"""Largest ratio p / n of the order to the number of samples without a gap in their past: p / n is the
relative increase of the prediction's variance."""
MAX_PARTIAL_CORRELATION = 0.9999
"""Largest partial correlation of an autoregression, which keeps it stable."""
TIMES = 20.0
"""Least ratio of a log's length to the noise's time constant: slower noise would absorb slow effects."""
BRIEFEST, SLOWEST = 20.0, 2000.0
"""Longest allowed time constant in short and in long logs, in samples."""


@dataclass(frozen=True, eq=False)
class ResidualNoise:
    """Noise model fitted to a residual (module notes)."""

    ar: FloatArray
    """(p,) autoregressive coefficients."""
    scale: FloatArray
    """(n,) scale s of every sample, nT."""
    nu: float
    """Degrees of freedom of Student's distribution; 1e6 stands for a Gaussian."""
    past: Past
    """Lags of the samples before each sample."""
    log_likelihood: float
    innovations: FloatArray
    """(n,) normalised innovations v / s."""

    @property
    def kappa(self) -> float:
        """Fisher information of a location, relative to a Gaussian of the same scale."""
        return (self.nu + 1.0) / (self.nu + 3.0)

    @property
    def uneven(self) -> bool:
        """Return True if the level changes from block to block."""
        return bool(np.ptp(self.scale))

    @property
    def independent(self) -> float:
        """Equivalent number of independent samples for a constant: ``n (1 - sum a)^2 C(0)``."""
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
        """Return m rows of the whitened columns, (m, k), stored column by column."""
        first = max(rows.start - len(self.ar), 0)
        return self.filter(columns(slice(first, rows.stop)), first, rows.start - first)

    def filter(self, values: FloatArray, start: int = 0, skip: int = 0) -> FloatArray:
        """Return the whitened rows of `values` from log row `start` + `skip` on; earlier rows are a past."""
        # Band matrix of f (1, -a) in blocks of BAND rows: one dense product for each block
        p, k, own = len(self.ar), values.shape[1], len(values) - skip
        count = -(-own // BAND)
        V = np.asfortranarray(values).T[:, max(skip - p, 0) :]
        lacking = max(p - skip, 0), BAND * count - own
        if any(lacking):
            V = np.pad(V, ((0, 0), lacking))
        # Rows of the band matrix: (1, -a), or f (1, -a') after a gap, over the scale
        rows, past = slice(start + skip, start + len(values)), self.past
        weights = np.zeros((BAND * count, p + 1))
        weights[:own] = np.append(1.0, -self.ar)
        some = slice(*np.searchsorted(past.rows, [rows.start, rows.stop]))
        weights[past.rows[some] - rows.start] = self.near_gaps.weights[past.pattern[some]]
        weights[:own] *= (np.sqrt(self.kappa) / self.scale[rows])[:, None]
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

    def whiten(self, y: FloatArray) -> FloatArray:
        """Return a whole column y (n,) whitened (n,)."""
        return np.asarray(np.sqrt(self.kappa) * self.near_gaps.innovations(y) / self.scale)

    def filter_back(self, y: FloatArray) -> FloatArray:
        """Return y (n,) filtered backwards: the product with the transpose of :meth:`filter`'s matrix."""
        y = np.sqrt(self.kappa) * y / self.scale
        # Transposed filter: samples after a gap have weights of their own
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
        """Return y (n,) of the module notes for a residual (n,), nT, with the fitted weights of psi."""
        weight = (self.nu + 1.0) / (self.nu + self.innovations**2)
        return np.asarray(weight * self.whiten(residual) / self.kappa)


class Predictors:
    """Predictors of the samples shortly after a gap, for each of l patterns of lags.

    `a` (l, p) and `f` (l,) are defined in the module notes. `weights` (l, p + 1) are f and ``-f a``.
    """

    def __init__(self, history: Past, ar: FloatArray) -> None:
        self.past, self.ar, lags = history, ar, history.lags
        here = lags < MAX_LAG
        # G a = c for each pattern of lags; f from the variance of its error
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
        """Return the innovations v (n,), nT, of a residual (n,), nT."""
        past, p = self.past, len(self.ar)
        # a view of the p samples before each, which takes no memory
        lags = sliding_window_view(np.append(np.zeros(p), residual), p)[:-1, ::-1]
        v = np.asarray(residual - lags @ self.ar)
        # a is 0 for samples that do not exist
        own = residual[np.maximum(past.rows[:, None] - np.arange(p + 1), 0)]
        v[past.rows] = np.einsum("ij,ij->i", self.weights[past.pattern], own)
        return v


def autocovariance(ar: FloatArray, reach: int) -> FloatArray:
    """Return the autocovariance C (reach + 1,) of an autoregression with innovations of variance 1.

    The first p + 1 values solve the Yule-Walker equations ``C_i - sum_k a_k C_|i-k| = (i = 0)``. Each later
    value follows from the p values before it (Brockwell & Davis 1991, sec. 3.3).
    """
    p = len(ar)
    i, k = np.arange(p + 1)[:, None], np.arange(1, p + 1)
    A = np.eye(p + 1)
    np.subtract.at(A, (i, np.abs(i - k)), ar)
    C = np.zeros(max(p, reach) + 1)
    C[: p + 1] = np.linalg.solve(A, np.eye(p + 1)[0])
    if reach > p:
        tail = lfiltic([1.0], np.append(1.0, -ar), C[p:0:-1])
        C[p + 1 :] = lfilter([1.0], np.append(1.0, -ar), np.zeros(reach - p), zi=tail)[0]
    return C[: reach + 1]


def autoregressive_order(residual: FloatArray, slots: IntArray) -> int:
    """Return the autoregression's order by Akaike's criterion; `slots` (n,) are times in intervals."""
    n = len(residual)
    scale = robust_scale(residual) + 1e-12
    r = np.clip(residual, -6.0 * scale, 6.0 * scale)
    # Autocovariances of all pairs without a gap (Dunsmuir & Robinson 1981, J. Am. Stat. Assoc. 76:560)
    # Levinson: kappa_p = (c_p - sum_k a_k c_(p-k)) / v_(p-1), v_p = v_(p-1) (1 - kappa_p^2)
    c = np.array([_product(r, slots, k) for k in range(MAX_NOISE_ORDER + 1)])
    a, v, costs = np.zeros(0), c[0] + 1e-300, {}
    for p in range(1, MAX_NOISE_ORDER + 1):
        kappa = np.clip((c[p] - a @ c[p - 1 : 0 : -1]) / v, -MAX_PARTIAL_CORRELATION, MAX_PARTIAL_CORRELATION)
        a, v = np.append(a - kappa * a[::-1], kappa), v * (1.0 - kappa**2)
        costs[p] = n * np.log(v) + 2.0 * p
    determined = [p for p in AR_ORDERS if p <= LOSS * np.count_nonzero(slots[p:] - slots[:-p] == p)]
    return min(determined, key=lambda p: costs[p], default=1)


def _product(r: FloatArray, slots: IntArray, lag: int) -> float:
    """Return the mean product of samples of r (n,) at a distance of `lag` intervals; 0 if there are none."""
    before = np.searchsorted(slots, slots - lag)
    pair = slots[before] == slots - lag
    return float(np.mean(r[pair] * r[before[pair]])) if pair.any() else 0.0


def fit_noise(
    residual: FloatArray,
    history: Past,
    *,
    blocks: bool | None = None,
    like: ResidualNoise | None = None,
    brief: bool = False,
) -> ResidualNoise:
    """Fit the noise model to a residual (n,), nT, with an autoregression of the order of its `history`.

    The level changes from block to block if `blocks` is true; for None a test decides. The fit starts from
    the noise `like`. If `brief`, no time constant exceeds :data:`BRIEFEST` samples.
    """
    n, order, whole = len(residual), history.order, history.whole
    # Blocks of equal length, in each of which the level is constant
    count = np.full(max(n // NOISE_BLOCK_SAMPLES, 1), NOISE_BLOCK_SAMPLES)
    count[-1] += n - count.sum()
    # a view of the p samples before each, which takes no memory
    lags = sliding_window_view(np.append(np.zeros(order), residual), order)[:n, ::-1]
    # First weights: all equal, or those of the noise that this one will be like
    ar, nu = np.zeros(order), 12.0
    if like is None:
        weight, scale = np.ones(n), np.full(n, robust_scale(residual) + 1e-12)
    else:
        nu, scale = like.nu, like.scale
        weight = (nu + 1.0) / (nu + ((residual - lags @ like.ar) / scale) ** 2)
    v, log_likelihood = residual, -np.inf
    # In turn: autoregression by weighted least squares, innovations, tails and level, weights
    for _ in range(NOISE_ITERATIONS):
        if whole.sum() > 2 * order:
            ar = _stable(_regressed(lags, residual, whole * weight / scale**2), 0 if brief else n)
        near_gaps = Predictors(history, ar)
        v = near_gaps.innovations(residual)
        if blocks is None:
            blocks = _uneven(v, count)
        before = log_likelihood
        nu, scale, log_likelihood = _tails(v, count if blocks else np.array([n]), nu)
        log_likelihood += float(np.log(near_gaps.f)[history.pattern].sum())
        weight = (nu + 1.0) / (nu + (v / scale) ** 2)
        if abs(log_likelihood - before) < MIN_GAIN:
            break
    return ResidualNoise(ar, scale, nu, history, log_likelihood, v / scale)


def _regressed(lags: FloatArray, r: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the coefficients (p,) of weighted least squares of r (n,) on lags (n, p), in bounded memory."""
    p = lags.shape[1]
    P, b = np.zeros((p, p)), np.zeros(p)
    for rows in row_blocks(len(r)):
        X = np.ascontiguousarray(lags[rows])
        weighted = X * weight[rows, None]
        P += weighted.T @ X
        b += weighted.T @ r[rows]
    return np.asarray(np.linalg.lstsq(P, b, rcond=None)[0], float)


def _stable(ar: FloatArray, n: int) -> FloatArray:
    """Return the coefficients (p,) with all roots moved inside the circle that n samples allow."""
    # Roots beyond the longest allowed time constant are moved to it
    roots, longest = np.roots(np.append(1.0, -ar)), np.clip(n / TIMES, BRIEFEST, SLOWEST)
    size, largest = np.abs(roots), 1.0 - 1.0 / longest
    if size.max(initial=0.0) < largest:
        return ar
    return np.asarray(-np.real(np.poly(roots * np.where(size > largest, largest / size, 1.0)))[1:])


def _uneven(v: FloatArray, count: IntArray) -> bool:
    """Return True if the blocks' mean absolute values differ significantly."""
    if count.size < 4:
        return False
    size = np.abs(v)
    clipped = np.minimum(size, 5.0 * np.median(size))
    # Chi-square of the blocks' means, at four sigma
    mean = _sums(clipped, count) / count
    expected = clipped.var() / count
    chi2 = float(np.sum((mean - clipped.mean()) ** 2 / expected))
    return bool(chi2 > count.size + 4.0 * np.sqrt(2.0 * count.size))


def _sums(values: FloatArray, count: IntArray) -> FloatArray:
    """Return the sum of `values` (n,) over each block; `count` (b,) are the blocks' lengths."""
    return np.asarray(np.add.reduceat(values, np.cumsum(count) - count))


def _tails(v: FloatArray, count: IntArray, nu: float) -> tuple[float, FloatArray, float]:
    """Return the likeliest of :data:`TAILS`, the level of each sample (n,), nT, and the log likelihood."""
    # Hill climbing over the list of tails, which has one peak
    at = TAILS.index(nu)
    square = v * v
    start = np.full(count.size, robust_scale(v) + 1e-12)
    tried = {at: _levels(square, count, nu, start)}
    while True:
        for near in (at - 1, at + 1):
            if 0 <= near < len(TAILS) and near not in tried:
                tried[near] = _levels(square, count, TAILS[near], tried[at][1])
        best = max((k for k in (at - 1, at, at + 1) if k in tried), key=lambda k: (tried[k][0], k == at))
        if best == at:
            return TAILS[at], np.repeat(tried[at][1], count), tried[at][0]
        at = best


def _levels(square: FloatArray, count: IntArray, nu: float, level: FloatArray) -> tuple[float, FloatArray]:
    """Return the log likelihood and the likeliest level (b,), nT, of each block under tails `nu`."""
    n = len(square)
    power = level**2
    # Expectation maximisation of a Student scale, all blocks at once
    for _ in range(ALTERNATIONS):
        before, each = power, np.repeat(power, count)
        weighted = square if nu > GAUSSIAN else (nu + 1.0) * each * square / (nu * each + square)
        sums = _sums(weighted, count)
        # Shrunk towards the level of all blocks, with the weight of ten samples
        whole = float(sums.sum()) / n
        power = (sums + 10.0 * whole) / (count + 10.0) if count.size > 1 else sums / count
        power = power + 1e-24
        if nu > GAUSSIAN or np.abs(power / before - 1.0).max() < 1e-3:
            break
    x2 = square / np.repeat(power, count)
    if nu > GAUSSIAN:
        value = -0.5 * (float(x2.sum()) + n * np.log(2.0 * np.pi))
    else:
        constant = gammaln((nu + 1.0) / 2.0) - gammaln(nu / 2.0) - 0.5 * np.log(nu * np.pi)
        value = n * constant - 0.5 * (nu + 1.0) * float(np.log1p(x2 / nu).sum())
    return float(value - 0.5 * count @ np.log(power)), np.sqrt(power)
