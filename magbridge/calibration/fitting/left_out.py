"""Errors of a fit on held-out parts of the data.

Notes
-----
At the fit, ``g / sigma^2 + L z = 0`` (g: half the gradient of the cost, H: half its Hessian, L: precision of
the prior). A fit without part k lacks the part's Hessian and gradient, so to first order::

    P_k = ((H - H_k) / sigma^2 + L)^-1,   z_k - z = P_k g_k / sigma^2
    e_i(z_k) = e_i + J_i (z_k - z),   s_i^2 = sigma^2 + J_i P_k J_i^T     for i in part k

If the model is right, ``e_i / s_i`` has the variance 1 for any held-out part. The parts are runs, or groups
of samples with similar attitude, which test the fit at attitudes outside its data. The root mean square of
``e_i / s_i`` is Birge's ratio R (Birge 1932, Phys. Rev. 40:207). If R exceeds 1 by more than chance allows,
the model is incomplete, and all sigmas are too small by the factor R.

This check needs the normal equations only. Two different fits may agree to first order, so a comparison of
fits repeats each fit without the part (:func:`error_between`, :func:`error_forward`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2

from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.fitting.solve import CoefficientPosterior, successive, thinned_rows
from magbridge.estimation.information import covariance_of
from magbridge.estimation.noise import OUTLIER_SIGMA, effective_fraction
from magbridge.estimation.optimise import gauss_newton, normal_equations
from magbridge.estimation.residual import ResidualSamples, jacobian, residuals, residuals_of, robust_scale

PARTS, BLOCKS = 10, 4
"""Largest number of parts of a log with runs, and number of blocks of a log with fewer than three runs."""
ATTITUDES = 6
"""Number of groups of samples with similar field directions, which are also held out."""
MAX_GROUP_AUTOCORRELATION = 0.98
"""Autocorrelation of successive residuals up to which groups of similar attitude are held out."""
FORWARD_PARTS = 4
"""Number of successive parts of a log, each predicted from the earlier parts."""
REFIT_STEPS = 10
"""Largest number of Gauss-Newton steps of a fit without a part; it starts at the fit to all samples."""
TESTED = 20_000
"""Approximate number of samples in all parts that are predicted."""
ISOLATED = 0.02
"""Largest fraction of outliers at which they count as single wrong samples and are not tested."""
CHANCE = 2.0
"""Number of standard errors by which R^2 must exceed 1 to be significant."""


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Errors of held-out parts, each predicted from the other parts."""

    rms: float
    """RMS error, nT as the sensor measures; an outlier counts as five sigmas."""
    ratio: float
    """RMS of errors over predicted sigmas, of parts or groups; 1 if it is not significantly larger."""
    carried: float
    """RMS error, nT, that also includes later parts predicted from the earlier parts."""


Split = tuple[list[int], int]
"""Indices of the parts that a prediction uses, and index of the part that it predicts."""


def leave_out(found: CoefficientPosterior, runs: NDArray[np.generic], *, attitudes: bool = False) -> LeftOut:
    """Return the errors of a fit on held-out parts, by linearised predictions from the other parts.

    `runs` (n,): labels of the samples' runs; a part consists of whole runs, or of successive samples if the
    log has few runs. `attitudes`: also hold out groups of similar attitude, unless the residuals are so
    correlated that the remaining samples predict the group.
    """
    # number of independent errors, which the autocorrelation of the noise reduces
    count = len(found.samples.field) * effective_fraction(*found.noise.shape)
    parts = _parts(runs)
    e, s2 = _predicted(found, parts, _all_others(parts))
    left = _judged(e, s2, count)
    # predict later parts only for fits without positions: new positions would dominate the errors
    if found.samples.phi.shape[1] == 1:
        later, later_s2 = _predicted(found, parts, _forward(parts))
        both = _judged(np.append(e, later), np.append(s2, later_s2), count)
        left = replace(both, rms=left.rms)
    if attitudes and found.noise.autocorrelation < MAX_GROUP_AUTOCORRELATION:
        groups = _alike(found.samples)
        apart = _judged(*_predicted(found, groups, _all_others(groups)), count)
        left = replace(left, ratio=max(left.ratio, apart.ratio))
    return left


def error_between(found: CoefficientPosterior, runs: NDArray[np.generic]) -> float:
    """Return the RMS error, nT, of held-out parts, each predicted by a new fit without the part.

    `runs` (n,): labels as for :func:`leave_out`. The new fits use the prior and noise of `found`. An outlier
    counts as five robust sigmas.
    """
    parts = _parts(runs)
    return _refitted_error(found, parts, _all_others(parts))


def error_forward(found: CoefficientPosterior) -> float:
    """Return the RMS error, nT, of parts of a log, each predicted by a new fit to the earlier parts.

    The method is forward chaining (Hyndman & Athanasopoulos 2021, Forecasting, section 5.10): the first k of
    :data:`FORWARD_PARTS` parts predict the next part. Unlike :func:`error_between`, this error includes
    coefficients that the beginning of a log does not determine, and later changes of the vehicle.
    """
    parts = np.array_split(thinned_rows(len(found.samples.field)), FORWARD_PARTS)
    return _refitted_error(found, parts, _forward(parts))


def _all_others(parts: list[IndexArray]) -> list[Split]:
    """Return splits that predict each part from all others."""
    return [([j for j in range(len(parts)) if j != k], k) for k in range(len(parts))]


def _forward(parts: list[IndexArray]) -> list[Split]:
    """Return splits that predict each part but the first from the earlier parts."""
    return [(list(range(k)), k) for k in range(1, len(parts))]


def _predicted(
    found: CoefficientPosterior, parts: list[IndexArray], splits: list[Split]
) -> tuple[FloatArray, FloatArray]:
    """Return the errors (m,), nT, of all splits by linearised predictions, and their variances (m,), nT²."""
    # both in the units of a sample at rest: samples next to a motion have a larger variance
    samples, prior, noise, s2_fit = found.samples, found.prior, found.noise, found.weighted.sigma**2
    c, weight = found.coefficients, found.weighted.weight
    # Normal equations are sums over samples, so one Newton step from the common fit gives the coefficients of
    # a fit to some of the parts: no fit is repeated.
    normals = [
        normal_equations(
            successive(samples, rows), c, None if weight is None else weight[rows], *found.weighted.shape
        ).reduced(prior.E)
        for rows in parts
    ]
    every = max(len(samples.field) // TESTED, 1)
    counted = np.ones(len(samples.field), bool)
    if noise.weight is not None and noise.rejected <= ISOLATED * len(counted):
        counted = noise.weight > 0.0
    e, s2 = [], []
    for fitted, k in splits:
        hessian = np.sum([normals[j].hessian for j in fitted], axis=0)
        # at the minimum the whole gradient balances the prior, so the other parts' gradients are missing
        lacking = np.sum([normals[j].gradient for j in range(len(parts)) if j not in fitted], axis=0)
        P = covariance_of(hessian / s2_fit + prior.precision)
        rows = parts[k][counted[parts[k]]][::every]
        tested, root = samples.part(rows), noise.root_weights(len(counted))[rows]
        off, g = residuals(tested, c)
        J = jacobian(tested.phi, g * root[:, None]) @ prior.E
        # prediction error, and its variance: noise plus J P J^T
        e.append(off * root + J @ (P @ lacking / s2_fit))
        s2.append(noise.sigma**2 + ((J @ P) * J).sum(axis=1))
    return np.concatenate(e), np.concatenate(s2)


def _refitted_error(found: CoefficientPosterior, parts: list[IndexArray], splits: list[Split]) -> float:
    """Return the RMS error, nT, over all splits, by new fits to the parts that a split uses."""
    samples, prior, noise = found.samples, found.prior, found.weighted
    weight = np.ones(len(samples.field)) if noise.weight is None else noise.weight
    errors = []
    for fitted, k in splits:
        rows = np.sort(np.concatenate([parts[j] for j in fitted]))
        own = replace(noise, weight=weight[rows])
        again = gauss_newton(successive(samples, rows), prior, own, found.z, steps=REFIT_STEPS)
        e = residuals_of(samples.part(parts[k]), prior.coefficients(again.z))
        errors.append(e * noise.root_weights(len(weight))[parts[k]])
    e = np.concatenate(errors)
    limit = OUTLIER_SIGMA * robust_scale(e)
    return float(np.sqrt(np.mean(np.clip(e, -limit, limit) ** 2)))


def _judged(e: FloatArray, s2: FloatArray, count: float) -> LeftOut:
    """Return RMS and ratio of `count` independent errors e (n,), nT, of the variances s2 (n,), nT²."""
    ratio2 = 1.0
    for _ in range(20):  # an outlier counts as an error at the limit, which grows with the ratio
        last, limit = ratio2, OUTLIER_SIGMA**2 * ratio2
        ratio2 = max(float(np.minimum(e * e / s2, limit).mean()), 1.0)
        if ratio2 < 1.01 * last:
            break
    rms = float(np.sqrt(np.minimum(e * e, OUTLIER_SIGMA**2 * ratio2 * s2).mean()))
    # a mean square of n independent errors scatters by sqrt(2 / n)
    chance = 1.0 + CHANCE * np.sqrt(2.0 / max(count, 1.0))
    return LeftOut(rms, float(np.sqrt(ratio2)) if ratio2 > chance else 1.0, rms)


def _parts(runs: NDArray[np.generic]) -> list[IndexArray]:
    """Return the rows of each part: one or several runs, or a block of successive samples."""
    # blocks if the log has fewer than three runs, or one run is more than half of it
    _, first, label, count = np.unique(runs, return_index=True, return_inverse=True, return_counts=True)
    if len(first) < 3 or count.max() > len(runs) / 2:
        return np.array_split(np.arange(len(runs)), BLOCKS)
    # runs in the order of the log; if there are many, a part has several runs
    order = np.argsort(np.argsort(first))  # labels in the order of the log
    part = order[label] * min(PARTS, len(first)) // len(first)
    return [np.flatnonzero(part == k) for k in range(part.max() + 1)]


def _alike(samples: ResidualSamples) -> list[IndexArray]:
    """Return the rows of each group of samples with similar field directions, by k-means."""
    u = samples.field / np.linalg.norm(samples.field, axis=1)[:, None]
    _, group = kmeans2(u, ATTITUDES, minit="++", rng=np.random.default_rng(1))
    return [rows for k in range(ATTITUDES) if len(rows := np.flatnonzero(group == k))]
