"""The level of the corrected field: the uncertainty from an unknown constant of the reference.

A part of a corrected sample's variance is common to all samples: the mean of the field at a site is only as
certain as its reference. A survey determines the rest. With j the mean slope of the corrected field by the
coefficients and P their covariance, the level's sigma is ``sqrt(j^T P j)``, and the coefficients move with it
by ``P j / sqrt(j^T P j)``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.correct import correct
from magbridge.calibration.model import LEVEL_STEP_SIGMA, Calibration, Reference
from magbridge.estimation.residual import ResidualSamples, jacobian, residuals, symmetric

__all__ = ["apart_from_level", "contradicts", "level_of", "sizes", "with_level"]

CONTRADICTS = 2.0
"""Largest departure of an estimated level from the reference's, in its 1-sigma, that is accepted."""
LEVEL_ROWS = 5_000
"""Samples that the mean is taken over, at most."""


def with_level(
    calibration: Calibration, samples: ResidualSamples, bias: float, bias_sigma: float
) -> Calibration:
    """Compute how much of a calibration's covariance is level.

    A level beyond :data:`CONTRADICTS` sigmas of its prior does not come from the log: a fit that claims to
    determine it has absorbed another effect, such as crustal anomalies that a long log's nodes leave out. The
    level is then the reference's, with the sigma of its prior: the coefficients move back by as much.

    `calibration`: as fitted. `samples`: those it was fitted to, without what its effects explain. `bias`,
    `bias_sigma`: nT, of the reference's level, as found and as expected.
    """
    part = samples.part(slice(None, None, max(len(samples.field) // LEVEL_ROWS, 1)))
    own = calibration.coefficients[: 9 * part.phi.shape[1]]
    # j: mean slope of the corrected field by the coefficients (the residual is over its size)
    _, g = residuals(part, own)
    j = np.zeros(len(calibration.coefficients))
    j[: len(own)] = (jacobian(part.phi, g) * sizes(part, own)[:, None]).mean(axis=0)
    Pj = calibration.covariance @ j
    sigma = float(np.sqrt(max(float(j @ Pj), 0.0)))
    # w: how the coefficients move together when the mean moves by its sigma
    w, covariance = Pj / max(sigma, 1e-300), calibration.covariance
    coefficients = calibration.coefficients
    if sigma and contradicts(bias, bias_sigma):
        # a step of w changes the mean of the corrected field by sigma
        coefficients = coefficients - w * (bias / sigma)
        wider = max(bias_sigma / sigma, 1.0)
        covariance = covariance + (wider**2 - 1.0) * np.outer(w, w)
        w, sigma, bias = w * wider, sigma * wider, 0.0
    known = calibration.reference
    reference = Reference(known.field, known.model, bias, bias_sigma, sigma)
    return replace(
        calibration, coefficients=coefficients, reference=reference, covariance=covariance,
        level=tuple(w.tolist()),
    )  # fmt: skip


def contradicts(bias: float, bias_sigma: float) -> bool:
    """Return True if a level found by a fit (nT) contradicts the reference's prior, of `bias_sigma` nT."""
    return abs(bias) > CONTRADICTS * bias_sigma


def apart_from_level(calibration: Calibration) -> Calibration:
    """Return the calibration with the covariance that is left where the level is known."""
    if not calibration.level:
        return calibration
    w = np.zeros(len(calibration.coefficients))
    w[: len(calibration.level)] = calibration.level
    return replace(calibration, covariance=calibration.covariance - np.outer(w, w))


def level_of(
    calibration: Calibration, field: FloatArray, channels: FloatArray, time: FloatArray
) -> FloatArray:
    """Return the part of each sample's sigma (n,), nT, that is level; arguments as for ``correct``."""
    if not calibration.level:
        return np.zeros(len(field))
    up, here = (correct(one, field, channels, time).total for one in (calibration.at_level(), calibration))
    return np.abs(up - here) / LEVEL_STEP_SIGMA


def sizes(samples: ResidualSamples, coefficients: FloatArray) -> FloatArray:
    """Return ``sqrt(kappa^2 + |A u|^2)`` (n,): nT of the corrected field in one of the sensor's."""
    theta = samples.phi @ coefficients.reshape(-1, 9)
    A = np.eye(3) + symmetric(theta[:, :6] / samples.F_0)
    b = np.matmul(A, (samples.field - theta[:, 6:])[:, :, None])
    w = np.matmul(A, b)[:, :, 0] / np.linalg.norm(b[:, :, 0], axis=1)[:, None]
    return np.asarray(np.sqrt(samples.kappa**2 + (w * w).sum(axis=1)))
