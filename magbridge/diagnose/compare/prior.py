"""The prior of a calibration's coefficients in a deployment.

It is the calibration's posterior without the information of samples that are compared here again, and with a
drift between days, which every instrument has.
"""

from __future__ import annotations

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.model import Calibration
from magbridge.calibration.terms import Polynomial
from magbridge.diagnose.compare.derivatives import derivatives
from magbridge.diagnose.compare.survey import Survey
from magbridge.estimation.noise import whiten
from magbridge.estimation.priors import HARD_IRON_SIGMA_NT, SOFT_IRON_SIGMA
from magbridge.estimation.residual import Samples, robust_scale

__all__ = ["FALL", "floor", "isotropic", "noise_sigma", "prior"]

BROADEST = 1e-3
"""Least precision, in units of the posterior's, of a direction that only the repeated logs determined."""
FALL = 0.3
"""Share of a coefficient's plausible size that remains from one power of a mass' position to the next."""
MIN_PRECISION = 0.1
"""Least precision, in units of the posterior's, of a direction that other logs determined, too."""
STABLE = 2e-5
"""Stability between days, as a fraction of the field: no fluxgate's scales, axes and offsets do better
than 20 ppm."""


def noise_sigma(calibration: Calibration, e: FloatArray) -> float:
    """Return the noise's 1-sigma, nT: the calibration's, or that of the residual e (n,)."""
    return calibration.noise.sensor or robust_scale(e) or 1.0


def floor(calibration: Calibration) -> FloatArray:
    """(K, K) covariance, nT², of how much the nine constants may have changed since the calibration.

    The posterior counts only the noise of its samples, and a few thousand samples average that down to a
    hundredth. The filters' lag in the turns of the calibration runs, and the drift between days, are larger.
    """
    spread = np.zeros(calibration.coefficients.size)
    for constants in _constants(calibration):
        spread[constants] = STABLE * calibration.reference.field
    return np.diag(spread**2)


def isotropic(calibration: Calibration) -> FloatArray:
    """(K,) change of the coefficients that raises the total field by 1 nT at any attitude: equal scales."""
    scale = np.zeros(calibration.coefficients.size)
    for constants in _constants(calibration)[:1]:
        scale[constants.start : constants.start + 3] = 1.0
    return scale


def _constants(calibration: Calibration) -> list[slice]:
    """Return the places of the nine constants (of exponents zero) of each polynomial that has them."""
    found, k, none = [], 0, (0,) * len(calibration.parameters)
    for term in calibration.terms:
        if isinstance(term, Polynomial) and none in term.exponents:
            first = k + 9 * term.exponents.index(none)
            found.append(slice(first, first + 9))
        k += term.size
    return found


def _factor(covariance: FloatArray) -> FloatArray:
    """L with ``L L^T`` the covariance, of as many columns as it has rank."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0)) + 1e-12
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    kept = values > 1e-12 * values[-1]
    return np.asarray(scale[:, None] * vectors[:, kept] * np.sqrt(values[kept]))


def prior(
    survey: Survey, calibration: Calibration, samples: Samples, e: FloatArray, g: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return L (K, q) and m (q,) of the prior ``c = c_0 + L z``, ``z ~ N(m, 1)``, :func:`floor` included."""
    L, centre = _without_repeats(survey, calibration, samples, e, g)
    broad = _factor(L @ L.T + floor(calibration))
    return broad, np.asarray(np.linalg.lstsq(broad, L @ centre, rcond=None)[0], float)


def _without_repeats(
    survey: Survey, calibration: Calibration, samples: Samples, e: FloatArray, g: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return L and m of the posterior without the information of samples that are compared here again.

    The information of the calibration's samples that are in the survey again (`survey.fitted`) is subtracted
    from its posterior: it would count twice. In the posterior's own units the precision left is
    ``P_0 = 1 - H`` with H the information of those samples, and since the gradient of the whole fit vanished
    at c_0, ``P_0 m = L^T J^T W e``, the sum over those samples.
    """
    L = _factor(calibration.covariance)
    centre = np.zeros(L.shape[1])
    repeated = np.flatnonzero(survey.fitted)
    if not repeated.size:
        return L, centre
    J = derivatives(calibration, samples.part(repeated), g[repeated], L)
    noise = calibration.noise
    steps = np.asarray(survey.steps[repeated] * (survey.interval / noise.interval if noise.interval else 1.0))
    white = np.column_stack([J, e[repeated]])
    white = whiten(white, steps, noise.autocorrelation, noise.white) / noise_sigma(calibration, e)
    A, y = white[:, :-1], white[:, -1]
    values, vectors = np.linalg.eigh(np.eye(len(centre)) - A.T @ A)
    held = (
        values > MIN_PRECISION
    )  # other directions were learned from the repeated samples alone, which count anyway
    pull = vectors @ np.where(held, vectors.T @ (A.T @ y), 0.0)
    bound = L / _physical(calibration)[:, None]
    values, vectors = np.linalg.eigh((vectors * np.where(held, values, 0.0)) @ vectors.T + bound.T @ bound)
    root = np.sqrt(np.maximum(values, BROADEST))
    return L @ (vectors / root), (vectors.T @ pull) / root


def _physical(calibration: Calibration) -> FloatArray:
    """(K,) nT, plausible size (1-sigma) of each coefficient on any vehicle; infinite where none is known.

    Soft iron is percents of the field, hard iron thousands of nanotesla, and both fall with the order. The
    bound is needed because, at a glider's few attitudes, scale and offset can cancel each other: without it
    they grow without end and fit the noise.
    """
    width, k = np.full(calibration.coefficients.size, np.inf), 0
    for term in calibration.terms:
        if isinstance(term, Polynomial):
            for i, exponents in enumerate(term.exponents):
                fall = FALL ** sum(exponents)
                width[k + 9 * i : k + 9 * i + 6] = SOFT_IRON_SIGMA * calibration.reference.field * fall
                width[k + 9 * i + 6 : k + 9 * i + 9] = HARD_IRON_SIGMA_NT * fall
        k += term.size
    return width
