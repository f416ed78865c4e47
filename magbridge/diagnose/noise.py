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
from numpy.typing import NDArray
from scipy.special import gammaln

__all__ = ["Noise", "fit_noise", "memory_order"]

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

TAILS = (2.5, 3.0, 4.0, 5.0, 7.0, 12.0, 1e6)
BLOCK = 150
"""Samples over which the noise's level is taken as constant."""
ORDERS = (0, 1, 2, 3, 5)


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
        out = values[skip:].copy()
        past = self.past[rows]
        for k, a in enumerate(self.memory, start=1):
            late = max(k - skip, 0)  # the first rows of all have no past
            out[late:] -= (a * past[late:])[:, None] * values[skip + late - k : len(values) - k]
        factor = np.sqrt(self.kappa) * np.where(past, 1.0, self.share) / self.scale[rows]
        out *= factor[:, None]
        return out

    def response(self, residual: FloatArray) -> FloatArray:
        """(n,) y of the module's notes; far from where the noise was fitted, with its weights from there."""
        weight = (self.nu + 1.0) / (self.nu + self.innovations**2)
        return np.asarray(weight * self.filter(residual[:, None])[:, 0] / self.kappa)


def _past(follows: BoolArray, p: int) -> BoolArray:
    """Whether the p samples before are there, without a gap."""
    broken = np.flatnonzero(~follows)
    since = np.arange(len(follows)) - broken[np.searchsorted(broken, np.arange(len(follows)), "right") - 1]
    return (
        np.asarray(since >= p) if broken.size and not follows[0] else np.asarray(np.arange(len(follows)) >= p)
    )


def memory_order(residual: FloatArray, follows: BoolArray) -> int:
    """Choose p by the Bayesian information criterion, on a residual clipped against outliers."""
    scale = 1.4826 * np.median(np.abs(residual)) + 1e-12
    r = np.clip(residual, -6.0 * scale, 6.0 * scale)
    past = _past(follows, ORDERS[-1])
    n = int(past.sum())
    if n < 4 * FEW:
        return 1
    rows = np.flatnonzero(past)
    lags = np.stack([r[rows - k] for k in range(1, ORDERS[-1] + 1)], axis=1)
    costs = []
    for p in ORDERS:
        left = r[rows] - (lags[:, :p] @ np.linalg.lstsq(lags[:, :p], r[rows], rcond=None)[0] if p else 0.0)
        costs.append(n * np.log(left @ left / n + 1e-300) + 1.5 * p * np.log(n))
    return max(1, ORDERS[int(np.argmin(costs))])


FEW = 20


def fit_noise(
    residual: FloatArray,
    follows: BoolArray,
    order: int,
    *,
    blocks: bool | None = None,
    like: Noise | None = None,
    rounds: int = 3,
) -> Noise:
    """Fit the noise model.

    Parameters
    ----------
    residual : (n,) array
        nT.
    follows : (n,) bool array
    order : int
        p.
    blocks : bool, optional
        Let the level change from block to block; decided by the data if not given.
    like : Noise, optional
        One that it will resemble: begins from its level and tails.
    rounds : int
        Of the alternation between memory, tails and level.
    """
    past = _past(follows, order)
    n = len(residual)
    block = np.minimum(np.arange(n) // BLOCK, max(n // BLOCK - 1, 0))
    weight, nu = np.ones(n), 12.0 if like is None else like.nu
    scale = np.full(n, 1.4826 * np.median(np.abs(residual)) + 1e-12) if like is None else like.scale
    lags = np.zeros((order, n))
    for k in range(1, order + 1):
        lags[k - 1, k:] = residual[:-k]
    lags *= past
    memory, share, v = np.zeros(order), 1.0, residual
    for _ in range(rounds):
        if order and past.sum() > 2 * order:
            own = lags * (weight / scale**2)
            memory = _stable(np.asarray(np.linalg.lstsq(own @ lags.T, own @ residual, rcond=None)[0], float))
        v = residual - memory @ lags
        share = (
            min(1.0, float(np.sqrt(np.median(v[past] ** 2) / (np.median(residual**2) + 1e-300))))
            if order
            else 1.0
        )
        v[~past] *= share
        if blocks is None:
            blocks = _uneven(v, block)
        nu, scale = _tails(v, block if blocks else np.zeros(n, np.int64), nu)
        weight = (nu + 1.0) / (nu + (v / scale) ** 2)
    x = v / scale
    log_likelihood = float(np.sum(_log_t(x, nu) - np.log(scale)) + np.log(share) * np.sum(~past))
    return Noise(memory, scale, nu, share, past, log_likelihood, x)


def _log_t(x: FloatArray, nu: float) -> FloatArray:
    if nu > 1e5:
        return np.asarray(-0.5 * (x * x + np.log(2.0 * np.pi)))
    constant = gammaln((nu + 1.0) / 2.0) - gammaln(nu / 2.0) - 0.5 * np.log(nu * np.pi)
    return np.asarray(constant - 0.5 * (nu + 1.0) * np.log1p(x * x / nu))


def _stable(memory: FloatArray) -> FloatArray:
    """Pull roots that lie outside the unit circle back in."""
    roots = np.roots(np.append(1.0, -memory))
    size = np.abs(roots)
    if size.max(initial=0.0) < 0.9995:
        return memory
    return np.asarray(-np.real(np.poly(roots * np.where(size > 0.9995, 0.9995 / size, 1.0)))[1:])


def _uneven(v: FloatArray, block: NDArray[np.int64]) -> bool:
    """Tell whether the blocks' mean absolute values differ by more than their own scatter lets them."""
    count = np.bincount(block)
    if count.size < 4:
        return False
    clipped = np.minimum(np.abs(v), 5.0 * np.median(np.abs(v)))
    mean = np.bincount(block, clipped) / count
    expected = clipped.var() / count
    chi2 = float(np.sum((mean - clipped.mean()) ** 2 / expected))
    return bool(chi2 > count.size + 4.0 * np.sqrt(2.0 * count.size))


def _tails(v: FloatArray, block: NDArray[np.int64], nu: float) -> tuple[float, FloatArray]:
    """Find the best tails, uphill from `nu`, and the level of each block under them."""
    at = TAILS.index(nu)
    tried = {at: _levels(v, block, nu)}
    while True:
        for near in (at - 1, at + 1):
            if 0 <= near < len(TAILS) and near not in tried:
                tried[near] = _levels(v, block, TAILS[near])
        best = max((k for k in (at - 1, at, at + 1) if k in tried), key=lambda k: (tried[k][0], k == at))
        if best == at:
            return TAILS[at], tried[at][1]
        at = best


def _levels(v: FloatArray, block: NDArray[np.int64], nu: float) -> tuple[float, FloatArray]:
    """Log likelihood and level of every sample; blocks are drawn towards the common one by as much as ten samples."""
    count = np.bincount(block)
    level = np.full(count.size, float(np.median(np.abs(v))) * 1.4826 + 1e-12)
    square = v * v
    for _ in range(6 if nu < 1e5 else 2):
        weighted = (nu + 1.0) / (nu + square / level[block] ** 2) * square
        whole = float(np.sqrt(weighted.mean())) + 1e-12
        level = (
            np.sqrt((np.bincount(block, weighted) + 10.0 * whole**2) / (count + 10.0))
            if count.size > 1
            else np.array([whole])
        )
    scale = level[block]
    return float(np.sum(_log_t(v / scale, nu) - np.log(scale))), scale
