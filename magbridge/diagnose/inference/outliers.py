"""Isolated wrong samples."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import gammaln
from scipy.stats import chi2

from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.residual import robust_scale
from magbridge.diagnose.inference.evidence import LEVEL
from magbridge.diagnose.inference.fit_noise import TAILS
from magbridge.diagnose.inference.joint import Joint

__all__ = ["Outliers", "outliers"]


class Outliers(NamedTuple):
    """Isolated wrong samples: which, twice the gain in log likelihood, and its p-value."""

    rows: IndexArray
    ratio: float
    p_value: float


def outliers(fit: Joint, causes: int) -> Outliers | None:
    """Test for isolated wrong samples: a few innovations from a wide distribution of their own.

    Heavy tails alone are no outliers: the mixture ``(1 - eps) t_nu + eps N(0, S^2)`` must beat the
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
    if p_value >= LEVEL or not rows.size or rows.size > 0.05 * n:
        return None
    # through the noise's autoregression a wrong sample also spoils the innovations after it
    first = rows[np.insert(np.diff(rows) > 1, 0, True)]
    return Outliers(first, ratio, p_value)


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
