"""Wrong samples, and whether they are isolated."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg import solve_toeplitz
from scipy.special import gammaln
from scipy.stats import chi2, rankdata

from magbridge.arrays import FloatArray, IndexArray
from magbridge.diagnose.causes.candidates import Candidate
from magbridge.diagnose.inference.evidence import FALSE_ALARM_RATE, ODDS
from magbridge.diagnose.inference.fit_noise import TAILS
from magbridge.diagnose.inference.joint import Joint
from magbridge.estimation.residual import robust_scale

__all__ = ["LOST", "Outliers", "outliers", "switches"]

LOST, PLACES = 2, 6
"""Regressors of a model, and shifts of the level from which on the table has no cause for the signal."""
AFTERWARDS = 16
"""Samples beyond the noise's order in which a shift of the level is looked for."""


class Outliers(NamedTuple):
    """Wrong samples, and how surely they are isolated."""

    rows: IndexArray
    """(k,)."""
    ratio: float
    """Twice the gain in log likelihood."""
    p_value: float
    neighbours: float
    """Probability of errors as large as the neighbours' in good samples."""
    lasting: bool
    """From them on the level stays shifted: something switched."""

    @property
    def isolated(self) -> bool:
        """Return True if the neighbouring samples are good, which excludes transients and ringing."""
        return self.neighbours >= FALSE_ALARM_RATE and not self.lasting


def outliers(fit: Joint, causes: int) -> Outliers | None:
    """Test for wrong samples: a few innovations from a wide distribution of their own.

    Heavy tails alone are not outliers: the mixture ``(1 - eps) t_nu + eps N(0, S^2)`` must beat the
    best ``t_nu``.
    """
    v = fit.noise.innovations
    n = len(v)
    if np.abs(v).max() < 5.0:
        return None
    alone = max(_mixture(v, nu, 0.0)[0] for nu in TAILS)
    value, member = max((_mixture(v, nu, 3.0 / n) for nu in TAILS[1:]), key=lambda found: found[0])
    ratio = 2.0 * (value - alone)
    p_value = min(1.0, causes * float(chi2.sf(ratio, 2)))
    rows = np.flatnonzero(member > 0.5)
    if p_value >= FALSE_ALARM_RATE or not rows.size or rows.size > 0.05 * n:
        return None
    # through the noise's autoregression a wrong sample also spoils the innovations after it
    first = rows[np.insert(np.diff(rows) > 1, 0, True)]
    return Outliers(first, ratio, p_value, _neighbours(fit, first), _lasting(fit, first))


def switches(fit: Joint, model: Sequence[Candidate], causes: int) -> bool:
    """Return True if the level shifts at many places that a model's first few regressors do not explain."""
    if sum(len(candidate.pieces) for candidate in model) < LOST:
        return False
    off = outliers(fit, causes)
    return off is not None and off.lasting and off.rows.size > PLACES


def _lasting(fit: Joint, rows: IndexArray) -> bool:
    r"""Return True if shifts of the level at `rows` (k,) are likelier than impulses there.

    Notes
    -----
    Noise of a long memory absorbs switching signals, except for the switching itself. Whitened by the filter
    ``h = (1, -a)`` an impulse is h and a shift its running sum s; of either, x, with the innovations v from
    the row on (Chen & Liu 1993, J. Am. Stat. Assoc. 88:284),

    .. math:: \lambda_x = \left(\sum_l x_l v_{i+l}\right)^2 \Big/ \sum_l x_l^2
    """
    impulse = np.concatenate([[1.0], -fit.noise.ar, np.zeros(AFTERWARDS)])
    both = np.stack([impulse, np.cumsum(impulse)])
    v = np.append(fit.noise.innovations, np.zeros(impulse.size))[rows[:, None] + np.arange(impulse.size)]
    impulses, shifts = ((v @ both.T) ** 2 / np.sum(both**2, axis=1)).sum(axis=0)
    return bool(0.5 * (shifts - impulses) > ODDS)


def _neighbours(fit: Joint, rows: IndexArray) -> float:
    r"""Chance that the samples before and after `rows` (k,) are good: 1 where gaps leave none to ask.

    Notes
    -----
    A wrong sample i is an additive outlier, or one of the innovations, which the noise's correlation carries
    on (Fox 1972, JRSS B 34:350). In the first case three impulses c are fitted, at i - 1, i and i + 1. With h
    the whitening filter ``(1, -a)`` and v the innovations in units of the noise's scale,

    .. math:: G c = b, \qquad G_{jk} = \sum_l h_l h_{l+|j-k|}, \qquad b_j = \sum_l h_l v_{j+l}

    Then the outer c are noise if the neighbours are good; in the second case the innovations next to i are.
    In both cases each neighbour has as its p-value its rank among those of all samples, whatever the noise's
    tails; Fisher's method combines them, and each sample counts as the kind that has the better neighbours.
    """
    noise, p = fit.noise, len(fit.noise.ar)
    h = np.concatenate([[1.0], -noise.ar, np.zeros(2)])
    b, v = (
        sliding_window_view(x, 3).T
        for x in (noise.back(noise.whiten(fit.residual)) * noise.scale, noise.innovations)
    )
    c = solve_toeplitz([float(h[: len(h) - k] @ h[k:]) for k in range(3)], b)
    before = np.arange(b.shape[1])
    after = np.minimum(before + 2 + p, b.shape[1] + 1)  # the last sample that one of the impulses reaches
    whole = noise.past.whole[before] & noise.past.whole[after]
    asked = np.isin(before + 1, rows)[whole]
    if not asked.any():
        return 1.0
    # (kind, side, sample)
    ranked = -np.abs(np.stack([c[::2, whole], v[::2, whole]]))
    p_values = rankdata(ranked, "max", axis=2)[:, :, asked] / asked.size
    return float(chi2.sf(-2.0 * np.log(p_values).sum(axis=1).max(axis=0).sum(), 4 * asked.sum()))


def _mixture(v: FloatArray, nu: float, eps: float) -> tuple[float, FloatArray]:
    """Log likelihood of the mixture after expectation maximisation, and each sample's chance to be wrong."""
    s, wide = robust_scale(v), float(np.abs(v).max())
    at_zero = gammaln(0.5 * (nu + 1.0)) - gammaln(0.5 * nu) - 0.5 * np.log(np.pi * nu)
    member = np.zeros(len(v))
    value = -np.inf
    for _ in range(25):
        x = v / s
        log_t = at_zero - np.log(s) - 0.5 * (nu + 1.0) * np.log1p(x * x / nu)
        inside = np.exp(log_t) * (1.0 - eps)
        outside = eps * np.exp(-0.5 * (v / wide) ** 2) / (wide * np.sqrt(2 * np.pi))
        value = float(np.log(inside + outside + 1e-300).sum())
        if eps > 0.0:
            member = outside / (inside + outside + 1e-300)
            eps = max(float(member.mean()), 0.1 / len(v))
            wide = max(float(np.sqrt((member @ (v * v)) / (member.sum() + 1e-12))), 4.0 * s)
        weight = (1.0 - member) * (nu + 1.0) / (nu + x * x)
        s = float(np.sqrt((weight @ (v * v)) / (1.0 - member).sum()))
    return value, member
