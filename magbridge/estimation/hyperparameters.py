"""Compute and maximise the marginal likelihood (evidence) of the prior's widths and of the noise.

Notes
-----
Near the best coefficients the log likelihood is quadratic in z: ``-(c_0 - 2 b.z + z^T H z) / 2 sigma^2``.
With a Gaussian prior of widths ``w = exp(constant + design . eta)`` the evidence is known in closed form.
With ``W = diag(w)``, ``M = I + W H W / sigma^2`` and ``y = M^-1 W b / sigma^2`` (so the posterior
mean is ``W y``)::

    log Z = -n log sigma - c_0 / 2 sigma^2 + y.(W b) / 2 sigma^2 - log|M| / 2 + log p(eta)
    d log Z / d log w_i = y_i^2 + (M^-1)_ii - 1                                     (MacKay 1992)
    d log Z / d log sigma = -n + cost(W y) / sigma^2 + q - tr M^-1
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs
from scipy.optimize import minimize

from magbridge.arrays import FloatArray
from magbridge.estimation.information import GaussianInformation
from magbridge.estimation.priors import PriorFamily

__all__ = ["Hyperparameters", "log_evidence", "maximise_evidence"]

MAX_PRIOR_SIGMA = 10.0
"""Largest distance of eta from its prior mean, in prior sigmas, and of log sigma from its start. Beyond it no
value is physical, and exp could overflow."""
LOG_SIGMA_SCALE = 0.1
"""Scale of log sigma in the maximisation; the scale of eta is its prior sigma."""


@dataclass(frozen=True, eq=False)
class Hyperparameters:
    """Maximum of the evidence: eta (h,), the noise's standard deviation `sigma` (sensor nT), and log Z."""

    eta: FloatArray
    sigma: float
    log_evidence: float
    determined: float
    """Number of unknowns that the data, not the prior, determined: ``q - tr M^-1``."""


def log_evidence(
    information: GaussianInformation, family: PriorFamily, eta: FloatArray, log_sigma: float
) -> tuple[float, FloatArray, float]:
    """Return log evidence, its gradient by (eta, log sigma), and `Hyperparameters.determined`.

    `eta` is (h,), the gradient (h + 1,). `log_sigma`: logarithm of the noise's standard deviation in sensor
    nT. If the evidence is not finite, the first result is -inf and the others are zero.
    """
    # M = I + W H W / sigma^2, factorised in place.
    w = family.widths(eta)
    s2 = np.exp(2.0 * log_sigma)
    M = (w[:, None] * information.precision * w) / s2
    M.flat[:: len(w) + 1] += 1.0
    factor, info = dpotrf(M, overwrite_a=True)
    if info:
        return -np.inf, np.zeros(len(eta) + 1), 0.0
    Wb = w * information.vector / s2
    # y = M^-1 W b / sigma^2; log Z as in the module's notes, with the prior of eta.
    y = dpotrs(factor, Wb)[0]
    off = (eta - family.centre) / family.spread
    value = (
        -information.n * log_sigma
        - 0.5 * information.constant / s2
        + 0.5 * Wb @ y
        - np.log(np.diag(factor)).sum()
        - 0.5 * off @ off
    )
    # The diagonal of M^-1 gives the gradient by the log widths and the number of determined unknowns.
    inverse = np.diag(dpotri(factor, overwrite_c=True)[0])
    z = w * y
    cost = information.constant - 2.0 * information.vector @ z + z @ information.precision @ z
    determined = float(len(w) - inverse.sum())
    by_eta = family.design.T @ (y * y + inverse - 1.0) - off / family.spread
    return float(value), np.append(by_eta, -information.n + cost / s2 + determined), determined


def maximise_evidence(
    information: GaussianInformation, family: PriorFamily, eta: FloatArray, sigma: float
) -> Hyperparameters:
    """Maximise the evidence, starting from `eta` (h,) and `sigma` (sensor nT)."""
    # Climb in units of the hyperparameters' prior sigmas, so that BFGS starts from a good metric.
    middle = np.append(family.centre, np.log(sigma))
    scale = np.append(family.spread, LOG_SIGMA_SCALE)

    def downhill(x: FloatArray) -> tuple[float, FloatArray]:
        # bounds: as sigma vanishes, the cost is rounding error and the evidence grows without limit
        if np.abs(x[:-1]).max(initial=0.0) > MAX_PRIOR_SIGMA or abs(scale[-1] * x[-1]) > MAX_PRIOR_SIGMA:
            return 1e300, 0.0 * x
        at = middle + scale * x
        value, slope, _ = log_evidence(information, family, at[:-1], at[-1])
        return (-value if np.isfinite(value) else 1e300), -slope * scale

    start = np.append((eta - family.centre) / family.spread, 0.0)
    x = middle + scale * minimize(downhill, start, jac=True, method="BFGS", options={"gtol": 1e-2}).x
    value, _, determined = log_evidence(information, family, x[:-1], x[-1])
    return Hyperparameters(x[:-1], float(np.exp(x[-1])), value, determined)
