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
from magbridge.calibration.fitting.left_out import leave_out
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.result import Fit, assemble
from magbridge.errors import NoSolutionError
from magbridge.estimation.information import covariance_of
from magbridge.estimation.noise import NoiseModel, effective_fraction, estimate_noise, fit_slow_and_white
from magbridge.estimation.optimise import gauss_newton
from magbridge.estimation.priors import GAIN_SIGMA, SOFT_IRON_SIGMA, WIDE_HARD_IRON_SIGMA, Prior
from magbridge.estimation.residual import Samples, residuals_of, scales_and_offsets

__all__ = ["check_scales", "fit_nominal", "nominal", "nominal_samples", "starts"]

ALL_AROUND = 0.05
"""Least variance of the field along any axis, over its square: 1/3 where all attitudes are seen, and 1 % on a
glider that never rolls."""


class Ellipsoid(NamedTuple):
    """Coefficients (9,) in nT, their covariance (9, 9) in nT², the noise; and z (q,) with its prior."""

    coefficients: FloatArray
    covariance: FloatArray
    noise: NoiseModel
    prior: Prior
    z: FloatArray


def fit_nominal(data: Observations, order: int = 0, **options: Any) -> Fit:  # noqa: ARG001  (one ellipsoid has none)
    """Return the fit of :func:`nominal` as a calibration without parameters."""
    one = nominal(data, **options)
    samples = nominal_samples(data)
    left = leave_out(samples, one.prior, one.z, one.noise, data.runs)
    return assemble(data, samples, (), ((),), one.coefficients, one.covariance, one.noise, "nominal", left)


def nominal_samples(data: Observations) -> Samples:
    """Return the samples of `data` with the constant monomial only."""
    return Samples(
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

    Parameters
    ----------
    data : Observations
        Its parameters are not used.
    axes_fixed : bool
        ``M = I``: no rotation, as the paper does.
    equal_xz : bool
        ``S_x = S_z``, as the paper does.
    scale_sigma, gain_sigma : float
        Prior 1-sigma of soft iron, and of the gain common to all axes.

    Raises
    ------
    NoSolutionError
        The fit collapsed or did not converge.
    """
    samples = nominal_samples(data)
    E = np.eye(9)
    if equal_xz:
        E[2, 0] = 1.0
    keep = [s for s in range(9) if not (axes_fixed and s in {3, 4, 5}) and not (equal_xz and s == 2)]
    E = E[:, keep]
    prior = Prior(_precision(E, scale_sigma, gain_sigma) / samples.F_0**2, E)
    best = None
    for start in starts(samples):
        z = np.asarray(np.linalg.lstsq(E, start, rcond=None)[0], float)
        noise = NoiseModel(1e-3 * samples.F_0)  # wide at first: far from the answer, residuals are not noise
        for _ in range(4):
            found = gauss_newton(samples, prior, noise, z)
            z = found.z
            # the moving masses are still in the residual: do not whiten, but count fewer samples
            noise = estimate_noise(residuals_of(samples, E @ z), samples.steps, len(keep))
            rho, noise = noise.autocorrelation, replace(noise, autocorrelation=0.0)
        value = found.normal.cost
        if found.settled and (best is None or value < 0.999 * best[0]):
            best = (value, found, noise, rho)
    if best is None:
        check_scales(samples, E @ z)  # a collapsing fit never converges, so report the collapse first
        raise NoSolutionError("nominal: no start converged; are the samples those of one sensor?")
    _, found, noise, rho = best
    noise = fit_slow_and_white(
        residuals_of(samples, E @ found.z), samples.steps, replace(noise, autocorrelation=rho)
    )
    precision = found.normal.hessian * effective_fraction(*noise.shape) / noise.sigma**2 + prior.precision
    covariance = E @ covariance_of(precision) @ E.T
    coefficients = E @ found.z
    check_scales(samples, coefficients)
    return Ellipsoid(coefficients, covariance, noise, prior, found.z)


def _precision(E: FloatArray, scale_sigma: float, gain_sigma: float) -> FloatArray:
    """Return the prior precision, in units of the field, of the numbers that E leaves free."""
    covariance = np.diag(np.array([scale_sigma] * 6 + [WIDE_HARD_IRON_SIGMA] * 3) ** 2)
    covariance[:3, :3] += gain_sigma**2
    return np.asarray(E.T @ np.linalg.inv(covariance) @ E)


def starts(samples: Samples) -> list[FloatArray]:
    """Return two starts (9,), nT: no iron at all, and the sphere that fits best by linear least squares.

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


def check_scales(samples: Samples, coefficients: FloatArray) -> None:
    """Refuse a collapsed fit; `coefficients` are (9 m,), nT.

    NoSolutionError: where the samples are, a scale of A outside 0.5 to 2; or a T above twice the field,
    where the attitudes do not separate it from a scale. With all attitudes, the noise alone limits T.
    """
    seen = samples.part(slice(None, None, max(len(samples.phi) // 1000, 1)))
    scales, T = scales_and_offsets(seen, coefficients)
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
