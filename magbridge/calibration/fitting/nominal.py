"""The nominal fit: one ellipsoid for all samples, nine numbers (paper, section 2.1).

Notes
-----
On a glider's narrow range of attitudes a free ellipsoid fit can collapse: ``A -> 0`` with ``T -> infinity``
makes every residual zero. So scale and soft iron have a prior of physical width, residuals are reported in
the sensor's own nT, and a fit that collapsed all the same is refused.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.left_out import LeftOut, leave_out
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.result import Fit, assemble
from magbridge.errors import NoSolutionError
from magbridge.estimation.information import covariance_of
from magbridge.estimation.noise import CLIP_SIGMA, NoiseModel, estimate_noise, samples_per_independent
from magbridge.estimation.optimise import Solution, gauss_newton
from magbridge.estimation.priors import GAIN_SIGMA, SOFT_IRON_SIGMA, WIDE_HARD_IRON_SIGMA, Prior
from magbridge.estimation.residual import ResidualSamples, residuals, scales_and_offsets

__all__ = ["check_scales", "fit_nominal", "nominal", "nominal_samples", "starts"]

WEIGHT_ITERATIONS = 5
"""Fits, each with the noise and the number of independent samples that the last one left."""
SAME_WEIGHT = 0.02
"""Relative change of the weights below which they have converged."""
CHOOSING_SAMPLES, MAX_ELLIPSOID_SAMPLES = 3_000, 50_000
"""Samples at most that choose the prior and the start, and that are fitted in the end."""
WIDTH_FACTORS = (1.0, 2.0, 4.0, 8.0)
"""Factors of the prior widths of gain and soft iron. Fluxgates have scales within a few per cent of 1, some
compasses of 0.8 to 1.5; parts left out, later ones predicted from earlier ones among them, choose one."""
WORTHWHILE_ERROR_RATIO = 0.7
"""Share of the error on parts left out, below which a wider prior is taken."""
CONVERGED_LOG_LIKELIHOOD_GAIN = 0.02
"""Gain in log likelihood of one more step, below which a fit has converged."""
ALL_AROUND = 0.05
"""Least variance of the field along any axis, over its square: 1/3 where all attitudes are seen, and 1 % on a
glider that never rolls."""


class Ellipsoid(NamedTuple):
    """Coefficients (9,) in nT, their covariance (9, 9) in nT², the noise; and z (q,) with its prior.

    `weighted` is the noise with which the samples are weighed: where so many residuals in a row count as one,
    it is larger than that of a sample by the root of their number.
    """

    coefficients: FloatArray
    covariance: FloatArray
    noise: NoiseModel
    prior: Prior
    z: FloatArray
    weighted: NoiseModel


def fit_nominal(data: Observations, order: int = 0, **options: Any) -> Fit:  # noqa: ARG001  (one ellipsoid has none)
    """Return the fit of :func:`nominal` as a calibration without parameters."""
    one, left = _chosen(data, **options)
    samples = nominal_samples(data)
    # a prior that the fit contradicts matters only where the samples do not overrule it
    before = one.prior.E @ np.linalg.inv(one.prior.precision) @ one.prior.E.T
    known = np.diag(one.covariance)[:6] / np.maximum(np.diag(before)[:6], 1e-300)
    details = {
        "prior_chi_squared": float(one.z @ one.prior.precision @ one.z),
        "scale_sigma_ratio": float(np.sqrt(known.max())),
    }
    return assemble(
        data,
        samples,
        (),
        ((),),
        one.coefficients,
        one.covariance,
        one.noise,
        "nominal",
        left,
        details=details,
    )


def nominal_samples(data: Observations) -> ResidualSamples:
    """Return the samples of `data` with the constant monomial only."""
    return ResidualSamples(
        data.field, data.reference, np.ones((len(data), 1)), data.steps, float(data.reference.mean())
    )


def nominal(
    data: Observations,
    *,
    axes_fixed: bool = False,
    equal_xz: bool = False,
    scale_sigma: float = SOFT_IRON_SIGMA,
    gain_sigma: float = GAIN_SIGMA,
) -> Ellipsoid:
    """Fit one ellipsoid.

    `data`: its parameters are not used. `axes_fixed`: ``M = I``: no rotation, as the paper does. `equal_xz`:
    ``S_x = S_z``, as the paper does. `scale_sigma`, `gain_sigma`: prior 1-sigma of soft iron, and of the
    gain common to all axes.

    NoSolutionError: the fit collapsed or did not converge.
    """
    return _chosen(
        data, axes_fixed=axes_fixed, equal_xz=equal_xz, scale_sigma=scale_sigma, gain_sigma=gain_sigma
    )[0]


def _chosen(
    data: Observations,
    *,
    axes_fixed: bool = False,
    equal_xz: bool = False,
    scale_sigma: float = SOFT_IRON_SIGMA,
    gain_sigma: float = GAIN_SIGMA,
) -> tuple[Ellipsoid, LeftOut]:
    """Return the ellipsoid of :func:`nominal`, and its errors on parts left out."""
    samples = nominal_samples(data)
    # Constraints of the paper as c = E z: S_x = S_z shares a column, M = I leaves the rotations out
    E = np.eye(9)
    if equal_xz:
        E[2, 0] = 1.0
    keep = [s for s in range(9) if not (axes_fixed and s in {3, 4, 5}) and not (equal_xz and s == 2)]
    E = E[:, keep]
    # a part of the samples chooses the prior and the start
    step = max(-(-len(data) // CHOOSING_SAMPLES), 1)
    few = _every(samples, step)
    factors = WIDTH_FACTORS[:1] if axes_fixed or equal_xz else WIDTH_FACTORS
    best: tuple[Ellipsoid, LeftOut] | None = None
    failure: NoSolutionError | None = None
    for factor in factors:
        prior = Prior(_precision(E, factor * scale_sigma, factor * gain_sigma) / samples.F_0**2, E)
        try:
            one = _fitted(few, prior)
        except NoSolutionError as error:
            failure = failure or error
            continue
        left = leave_out(few, prior, one.z, one.noise, data.runs[::step], weighted=one.weighted)
        if best is None or left.carried < WORTHWHILE_ERROR_RATIO * best[1].carried:
            best = one, left
    if best is None:
        assert failure is not None
        raise failure
    if step == 1:
        return best
    return _fitted(
        _every(samples, max(len(data) // MAX_ELLIPSOID_SAMPLES, 1)), best[0].prior, best[0].z
    ), best[1]


def _every(samples: ResidualSamples, step: int) -> ResidualSamples:
    """Return every k-th sample; intervals are counted in units of k samples."""
    if step == 1:
        return samples
    part = samples.part(np.arange(0, len(samples.field), step))
    # intervals between the samples that stay, in units of `step`, within each run
    begins = np.isinf(samples.steps)
    run, slot = np.cumsum(begins)[::step], np.cumsum(np.where(begins, 0.0, samples.steps))[::step]
    part.steps[:] = np.inf
    same = run[1:] == run[:-1]
    part.steps[1:][same] = np.maximum(np.rint(np.diff(slot)[same] / step), 1.0)
    return part


def _fitted(samples: ResidualSamples, prior: Prior, start_z: FloatArray | None = None) -> Ellipsoid:
    """Return the fit with a prior, from the better one of two starts or from `start_z` (q,) its minimum.

    NoSolutionError: the fit collapsed or did not converge.
    """
    best = None
    begun = [np.asarray(np.linalg.lstsq(prior.E, start, rcond=None)[0], float) for start in starts(samples)]
    for first in begun if start_z is None else [start_z]:
        z = first
        noise = weighted = NoiseModel(1e-3 * samples.F_0)  # wide at first: residuals are not noise yet
        for _ in range(WEIGHT_ITERATIONS):
            found = gauss_newton(samples, prior, weighted, z, tolerance=CONVERGED_LOG_LIKELIHOOD_GAIN)
            z = found.z
            last, (noise, weighted) = weighted, _weighted(samples, prior, found, weighted)
            if abs(weighted.sigma - last.sigma) < SAME_WEIGHT * last.sigma:
                break
        # negative log posterior, by which the starts are compared
        value = 0.5 * found.normal.cost / weighted.sigma**2 + 0.5 * float(z @ prior.precision @ z)
        if found.settled and (best is None or value < 0.999 * best[0]):
            best = (value, found, noise, weighted)
    if best is None:
        check_scales(samples, prior.coefficients(z))  # a collapsing fit never converges: report the collapse
        raise NoSolutionError("nominal: no start converged; are the samples those of one sensor?")
    _, found, noise, weighted = best
    precision = found.normal.hessian / weighted.sigma**2 + prior.precision
    covariance = prior.E @ covariance_of(precision) @ prior.E.T
    coefficients = prior.coefficients(found.z)
    check_scales(samples, coefficients)
    return Ellipsoid(coefficients, covariance, noise, prior, found.z, weighted)


def _weighted(
    samples: ResidualSamples, prior: Prior, found: Solution, weighted: NoiseModel
) -> tuple[NoiseModel, NoiseModel]:
    """Return the noise of a sample, and the noise with which each is weighed in the next fit.

    The error of the model is in the residuals: it lasts, and is not whitened, but fewer samples are counted
    (Newey & West 1987, Econometrica 55:703, with one factor for all coefficients). The noise of a sample is
    the sum of white noise and of an AR(1) process: together they have as many independent samples, and the
    autocorrelation of neighbours that the residuals show.
    """
    e, g = residuals(samples, prior.coefficients(found.z))
    noise = estimate_noise(e, samples.steps, len(found.z), shape=(0.0, 0.0))
    limit = CLIP_SIGMA * noise.sigma
    # scale the gradient by the posterior's root, so that all nine coefficients have equal weight
    root = np.linalg.cholesky(covariance_of(found.normal.hessian / weighted.sigma**2 + prior.precision))
    pulls = np.clip(e, -limit, limit)[:, None] * (g @ (prior.E @ root))
    repeats = samples_per_independent(pulls, samples.steps)
    weighted = replace(noise, sigma=noise.sigma * np.sqrt(repeats))
    neighbours = estimate_noise(e, samples.steps, len(found.z)).autocorrelation
    rho, white = _slow_and_white(0.5 * (repeats - 1.0), neighbours)
    return replace(noise, autocorrelation=rho, white=white), weighted


def _slow_and_white(lasting: float, neighbours: float) -> tuple[float, float]:
    """Return autocorrelation rho and white fraction w of white noise and an AR(1) process.

    `lasting` is the sum of the autocorrelations at all lags, ``(1 - w) rho / (1 - rho)``, and `neighbours` is
    the autocorrelation of neighbours, ``(1 - w) rho``.
    """
    if not 0.0 < neighbours < lasting:  # no slow part, or none that lasts beyond the next sample
        return max(lasting / (1.0 + lasting), 0.0), 0.0
    rho = 1.0 - neighbours / lasting
    return (rho, 1.0 - neighbours / rho) if neighbours < rho else (lasting / (1.0 + lasting), 0.0)


def _precision(E: FloatArray, scale_sigma: float, gain_sigma: float) -> FloatArray:
    """Return the prior precision, in units of the field, of the numbers that E leaves free."""
    # independent soft iron and hard iron, plus a gain that is common to the three axes
    covariance = np.diag(np.array([scale_sigma] * 6 + [WIDE_HARD_IRON_SIGMA] * 3) ** 2)
    covariance[:3, :3] += gain_sigma**2
    return np.asarray(E.T @ np.linalg.inv(covariance) @ E)


def starts(samples: ResidualSamples) -> list[FloatArray]:
    """Return two starts (9,), nT: without iron, and the best sphere by linear least squares.

    ``|h|^2 = 2 h^T T + (F^2 - |T|^2)`` is linear in T and one constant.
    """
    h = samples.field
    design = np.column_stack([2.0 * h, np.full(len(h), samples.F_0)])
    scale = np.abs(design).max(axis=0) + 1e-300
    right = (h * h).sum(axis=1) - samples.reference**2
    # a weak ridge holds the directions that the samples do not determine
    damp = np.diag(np.full(4, 1e-2 * np.sqrt(len(h))))
    solved = np.linalg.lstsq(np.vstack([design / scale, damp]), np.append(right, np.zeros(4)), rcond=None)[0]
    sphere = np.concatenate([np.zeros(6), (solved / scale)[:3]])
    return [np.zeros(9), sphere]


def check_scales(samples: ResidualSamples, coefficients: FloatArray) -> None:
    """Refuse a collapsed fit; `coefficients` are (9 m,), nT.

    NoSolutionError: where the samples are, a scale of A outside 0.5 to 2; or a T above twice the field,
    where the attitudes do not separate it from a scale. With all attitudes, the noise alone limits T.
    """
    seen = samples.part(slice(None, None, max(len(samples.phi) // 1000, 1)))
    scales, T = scales_and_offsets(seen, coefficients)
    # the sample with the most unlikely scale or offset
    worst = int(
        np.argmax(np.maximum(np.abs(np.log2(np.maximum(scales, 1e-3))).max(axis=1), T / (2.0 * samples.F_0)))
    )
    narrow = float(np.linalg.eigvalsh(np.cov(seen.field.T))[0]) < ALL_AROUND * samples.F_0**2
    if scales[worst, 0] < 0.5 or scales[worst, 2] > 2.0 or (narrow and T[worst] / samples.F_0 > 2.0):
        listed = ", ".join(f"{value:.3g}" for value in scales[worst])
        alike = scales[worst, 2] < 1.2 * scales[worst, 0]
        counts = f"a reading counts {scales[worst].mean():.3g} nT, or " if alike else ""
        raise NoSolutionError(
            f"the fit collapsed: scales {listed} (expected near 1), offset {T[worst]:.0f} nT in a field of "
            f"{samples.F_0:.0f} nT; {counts}there are too few attitudes to separate scale and offset"
        )
