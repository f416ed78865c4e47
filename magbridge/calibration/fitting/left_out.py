"""What a fit is worth on parts that it has not seen.

Notes
-----
At the fit, ``g / sigma^2 + L z = 0`` (g: half the gradient of the cost, L: precision of the prior). Without
part k its Hessian and gradient are missing, so to first order::

    P_k = ((H - H_k) / sigma^2 + L)^-1,   z_k - z = P_k g_k / sigma^2
    e_i(z_k) = e_i + J_i (z_k - z),   s_i^2 = sigma^2 + J_i P_k J_i^T     for i in part k

If the model is right, ``e_i / s_i`` has the variance 1, whichever parts are left out: runs, or the samples of
like attitude, which tell how far the fit can be carried to attitudes that it has not seen. Its root mean
square is Birge's ratio R (Birge 1932, Phys. Rev. 40:207): where it is larger than chance allows, the model
lacks something of that size, and all sigmas are too small by R.

This check needs the normal equations only. To first order two different fits can agree, so to prefer one to
another each is fitted again without the part (:func:`error_between`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2

from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.fitting.solve import CoefficientPosterior, thinned_rows
from magbridge.estimation.information import covariance_of
from magbridge.estimation.noise import OUTLIER_SIGMA, effective_fraction
from magbridge.estimation.optimise import NormalEquations, gauss_newton, normal_equations
from magbridge.estimation.residual import ResidualSamples, jacobian, residuals, residuals_of, robust_scale

PARTS, BLOCKS = 10, 4
"""Number of parts of a log with runs, at most, and of blocks where it has fewer than three runs."""
ATTITUDES = 6
"""Number of groups of samples with similar field directions, each of which is left out, too."""
MAX_GROUP_AUTOCORRELATION = 0.98
"""Autocorrelation of neighbours up to which groups of like attitude are left out."""
FORWARD_PARTS = 4
"""Parts of a log in time, of which the earlier ones predict the next."""
REFIT_STEPS = 10
"""Largest number of Gauss-Newton steps of a fit without a part; it begins at the fit to all."""
TESTED = 20_000
"""Largest number of samples that are predicted."""
ISOLATED = 0.02
"""Fraction of the samples up to which outliers are single wrong samples and do not count."""
CHANCE = 2.0
"""Standard errors by which R^2 must exceed 1 before it counts."""


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Errors of the parts left out, each predicted from the others."""

    rms: float
    """RMS error in the sensor's units, nT; an outlier counts as five sigmas."""
    ratio: float
    """RMS of errors over claimed sigmas, of parts or of groups; 1 where not more than chance."""
    carried: float
    """RMS that includes later parts predicted from the earlier ones, nT."""


def leave_out(found: CoefficientPosterior, runs: NDArray[np.generic], *, attitudes: bool = False) -> LeftOut:
    """Predict each part of a fit's samples from the others, and later parts from the earlier ones.

    `runs` (n,): labels; whole runs are left out, or blocks of neighbours where there are few runs.
    `attitudes`: leave out groups of like attitude, too, where neighbours that stay do not predict the group.
    """
    # positions that come late in the log do not test the fit to its beginning
    left = _left_out(found, _parts(runs), forward=found.samples.phi.shape[1] == 1)
    if attitudes and found.noise.autocorrelation < MAX_GROUP_AUTOCORRELATION:
        apart = _left_out(found, _alike(found.samples))
        left = replace(left, ratio=max(left.ratio, apart.ratio))
    return left


def _left_out(found: CoefficientPosterior, parts: list[IndexArray], *, forward: bool = False) -> LeftOut:
    """Predict each of the `parts` from the others and, if `forward`, from the earlier ones."""
    samples, prior, noise, s2_fit = found.samples, found.prior, found.noise, found.weighted.sigma**2
    c = found.coefficients
    # Normal equations are sums over samples. Those without a part are the whole minus the part's, and one
    # Newton step from the common fit gives the coefficients without it: no fit is repeated.
    normals = [_normal(found, rows) for rows in parts]
    # at the minimum the whole gradient balances the prior, so the part's own gradient is missing
    hessian = np.sum([normal.hessian for normal in normals], axis=0)
    every = max(len(samples.field) // TESTED, 1)
    counted = np.ones(len(samples.field), bool)
    if noise.weight is not None and noise.rejected <= ISOLATED * len(counted):
        counted = noise.weight > 0.0
    missing = [(k, hessian - normal.hessian, normal.gradient) for k, normal in enumerate(normals)]
    # forward chaining: part k is predicted from the parts before it
    if forward:
        for k in range(1, len(parts)):
            later = np.sum([normal.gradient for normal in normals[k:]], axis=0)
            missing.append((k, np.sum([normal.hessian for normal in normals[:k]], axis=0), later))
    e, s2 = [], []
    for k, others, lacking in missing:
        P = covariance_of(others / s2_fit + prior.precision)
        tested = samples.part(parts[k][counted[parts[k]]][::every])
        off, g = residuals(tested, c)
        J = jacobian(tested.phi, g) @ prior.E
        # prediction error, and its variance: noise plus J P J^T
        e.append(off + J @ (P @ lacking / s2_fit))
        s2.append(noise.sigma**2 + ((J @ P) * J).sum(axis=1))
    # as many independent errors as the noise's memory allows
    count = len(samples.field) * effective_fraction(*noise.shape)
    among = _judged(np.concatenate(e[: len(parts)]), np.concatenate(s2[: len(parts)]), count)
    if not forward:
        return among
    return replace(_judged(np.concatenate(e), np.concatenate(s2), count), rms=among.rms)


def error_between(found: CoefficientPosterior, runs: NDArray[np.generic]) -> float:
    """Return the RMS error of the parts left out, nT, each predicted by a fit without it.

    The labels `runs` (n,) as for :func:`leave_out`. Prior and noise stay those of the fit to all. An outlier
    counts as five robust sigmas.
    """
    rows = np.arange(len(found.samples.field))
    return _refitted_error(found, [(np.delete(rows, part), part) for part in _parts(runs)])


def error_forward(found: CoefficientPosterior) -> float:
    """Return the RMS error, nT, of parts of a log that a fit to the earlier parts alone is carried to.

    Forward chaining (Hyndman & Athanasopoulos 2021, Forecasting, section 5.10): the first k of
    :data:`FORWARD_PARTS` parts predict the next one. Coefficients that the beginning of a log does not
    determine count here, and so do later changes; neither counts where parts between others are held out.
    """
    parts = np.array_split(thinned_rows(len(found.samples.field)), FORWARD_PARTS)
    return _refitted_error(found, [(np.concatenate(parts[:k]), parts[k]) for k in range(1, FORWARD_PARTS)])


def _refitted_error(found: CoefficientPosterior, splits: list[tuple[IndexArray, IndexArray]]) -> float:
    """Return the RMS error, nT, of the second rows of each split, predicted by a fit to the first ones."""
    samples, prior, noise = found.samples, found.prior, found.weighted
    weight = np.ones(len(samples.field)) if noise.weight is None else noise.weight
    errors = []
    for fitted, tested in splits:
        kept, own = _rows_of(samples, fitted), replace(noise, weight=weight[fitted])
        again = gauss_newton(kept, prior, own, found.z, steps=REFIT_STEPS)
        errors.append(residuals_of(samples.part(tested), prior.coefficients(again.z)))
    e = np.concatenate(errors)
    limit = OUTLIER_SIGMA * robust_scale(e)
    return float(np.sqrt(np.mean(np.clip(e, -limit, limit) ** 2)))


def _judged(e: FloatArray, s2: FloatArray, count: float) -> LeftOut:
    """Return the ratio of errors (n,) over their variances, of which `count` are independent."""
    ratio2 = 1.0
    for _ in range(20):  # an outlier counts as one just at the limit, and the limit grows with the ratio
        last, limit = ratio2, OUTLIER_SIGMA**2 * ratio2
        ratio2 = max(float(np.minimum(e * e / s2, limit).mean()), 1.0)
        if ratio2 < 1.01 * last:
            break
    rms = float(np.sqrt(np.minimum(e * e, OUTLIER_SIGMA**2 * ratio2 * s2).mean()))
    # a mean square of n independent errors scatters by sqrt(2 / n)
    chance = 1.0 + CHANCE * np.sqrt(2.0 / max(count, 1.0))
    return LeftOut(rms, float(np.sqrt(ratio2)) if ratio2 > chance else 1.0, rms)


def _parts(runs: NDArray[np.generic]) -> list[IndexArray]:
    """Return the rows of each part: runs, several in one where there are many; else blocks.

    Blocks, too, where one run is most of the log, since the rest says little about it.
    """
    _, first, label, count = np.unique(runs, return_index=True, return_inverse=True, return_counts=True)
    if len(first) < 3 or count.max() > len(runs) / 2:
        return np.array_split(np.arange(len(runs)), BLOCKS)
    # runs in the order of the log, several in one part where there are many
    order = np.argsort(np.argsort(first))  # labels in the order of the log
    part = order[label] * min(PARTS, len(first)) // len(first)
    return [np.flatnonzero(part == k) for k in range(part.max() + 1)]


def _alike(samples: ResidualSamples) -> list[IndexArray]:
    """Return the rows of each group of samples with similar field directions, by k-means."""
    u = samples.field / np.linalg.norm(samples.field, axis=1)[:, None]
    _, group = kmeans2(u, ATTITUDES, minit="++", rng=np.random.default_rng(1))
    return [rows for k in range(ATTITUDES) if len(rows := np.flatnonzero(group == k))]


def _normal(found: CoefficientPosterior, rows: IndexArray) -> NormalEquations:
    weight = None if found.weighted.weight is None else found.weighted.weight[rows]
    part = _rows_of(found.samples, rows)
    normal = normal_equations(part, found.coefficients, weight, *found.weighted.shape)
    return normal.reduced(found.prior.E)


def _rows_of(samples: ResidualSamples, rows: IndexArray) -> ResidualSamples:
    """Return these samples; neighbours across a gap are not successive."""
    part = samples.part(rows)
    part.steps[0] = np.inf
    part.steps[1:][np.diff(rows) > 1] = np.inf
    return part
