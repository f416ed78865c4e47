r"""Fit calibration and boresight to the direction of the reference field, in addition to its magnitude.

Notes
-----
A fit to the magnitude gives the coefficients as a Gaussian, ``c = c_0 + L z`` with z normal and ``L L^T``
their covariance. The corrected vector in body axes is ``v = R b``, with ``b = A(p) (H_r - T(p))`` and R the
boresight. The attitude gives rows Q of directions in body axes, in which the reference h is known::

    e = Q (R b - h)

With independent headings, h is the whole vector, and Q the two directions across it; the magnitude has been
used already. With roll and pitch alone, Q is the vertical ``down``, in which ``down . h`` is known at any
heading (Isezaki 1986; Korenaga 1995). Gauss-Newton over z and a small rotation delta minimises

.. math:: \frac{1}{2 \sigma^2} \sum_i w_i |e_i|^2 + \tfrac12 z^T z, \qquad
          de = Q (R\, db + \delta \times v).

Successive errors are correlated. So sigma^2 is the mean square of a row, times the number of samples that
count as one (:func:`~magbridge.estimation.noise.samples_per_independent`).
"""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.boresight import (
    LEAST_INFORMATION,
    MAX_ITERATIONS,
    MIN_BORESIGHT_SAMPLES,
    MIN_TILT_SIGMA_DEG,
    RUN_TILT_SIGMA_DEG,
    field_body,
    find_boresight,
    find_tilt_boresight,
    to_boresight,
)
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.result import Fit
from magbridge.errors import CalibrationError
from magbridge.estimation.noise import samples_per_independent
from magbridge.estimation.residual import PAIRS, residuals_of, rms, robust_scale, symmetric

MAX_DIRECTIONS = 20_000
"""Approximate number of samples whose direction is used; time and memory are proportional to it."""
CONVERGED = 1e-6
"""Length of a step, in standard deviations of z and in rad, below which the iterations have converged."""
CLIP_SIGMA = 3.0
"""Number of standard deviations beyond which the weight of a row falls (Huber's weights)."""


def with_direction(found: Fit, data: Observations, *, headings: bool) -> Fit:
    """Return a fit with coefficients, covariance and boresight updated by the direction of the field.

    `found`: fit to the magnitude, of polynomials without effects. `data`: its observations. `headings`: use
    headings, which must be independent of the magnetometer; else roll and pitch alone.

    CalibrationError: too few samples have attitude and reference direction, or the direction contradicts the
    corrected vector at any boresight.
    """
    calibration, F_0 = found.calibration, found.samples.F_0
    start = (find_boresight if headings else find_tilt_boresight)(calibration, data)
    if start is None:
        needed = "roll, pitch and heading" if headings else "roll and pitch"
        raise CalibrationError(f"direction: needs {needed} and a position in {MIN_BORESIGHT_SAMPLES} samples")
    known, attitude, reference = data.directed()
    step = max(len(attitude) // MAX_DIRECTIONS, 1)
    used, attitude, reference = np.flatnonzero(known)[::step], attitude[::step], reference[::step]
    samples, steps = found.samples.part(used), data.part(np.isin(np.arange(len(data)), used)).steps
    h = field_body(attitude, reference)
    Q = _across(h) if headings else _vertical(attitude)
    # c = c_0 + L z, from the eigenvectors: a covariance may have directions without variance
    values, vectors = np.linalg.eigh(calibration.covariance)
    L = vectors * np.sqrt(np.maximum(values, 0.0))
    z, rotation = np.zeros(len(L)), Rotation.from_matrix(start.matrix())
    prior = np.diag([*np.ones(len(z)), *np.full(3, LEAST_INFORMATION)])
    for _ in range(MAX_ITERATIONS):
        theta = samples.phi @ (calibration.coefficients + L @ z).reshape(-1, 9)
        A, d = np.eye(3) + symmetric(theta / F_0), samples.field - theta[:, 6:]
        v = rotation.apply(np.einsum("nij,nj->ni", A, d))
        e = np.einsum("nri,ni->nr", Q, v - h)
        # derivatives of b by the nine entries of A and T, then of e by all coefficients and by the rotation
        G = np.zeros((len(e), 3, 9))
        for slot, (i, j) in enumerate(PAIRS):
            G[:, i, slot] = d[:, j] / F_0
            G[:, j, slot] = d[:, i] / F_0
        G[:, :, 6:] = -A
        QG = Q @ rotation.as_matrix() @ G
        by_coefficients = np.einsum("nm,nrk->nrmk", samples.phi, QG).reshape(*e.shape, -1) @ L
        J = np.concatenate([by_coefficients, np.cross(v[:, None, :], Q)], axis=2)
        # noise of a row, with Huber's weights and the correlation of the contributions to the gradient
        sigma = max(robust_scale(e.ravel()), 1e-9)
        weight = np.minimum(1.0, CLIP_SIGMA * sigma / np.maximum(np.abs(e), 1e-300))
        rows = J.reshape(-1, J.shape[2])
        information = (rows * weight.reshape(-1, 1)).T @ rows / sigma**2
        pulls = ((weight * e)[:, :, None] * J).sum(axis=1)
        variance = samples_per_independent(pulls / np.sqrt(np.diag(information) + 1e-300), steps)
        precision = information / variance + prior
        gradient = pulls.sum(axis=0) / sigma**2 / variance
        move = -np.linalg.solve(precision, gradient + np.append(z, np.zeros(3)))
        z, rotation = z + move[:-3], Rotation.from_rotvec(move[-3:]) * rotation
        if np.linalg.norm(move) < CONVERGED:
            break
    # the vertical component, which does not depend on the heading, shows the errors of roll and pitch
    vertical = np.einsum("nri,ni->n", _vertical(attitude), v - h) / np.hypot(*reference[:, :2].T)
    tilt_sigma = max(float(np.degrees(rms(vertical))), MIN_TILT_SIGMA_DEG)
    covariance = np.linalg.inv(precision)
    # an error that all attitudes of the data share does not show in their scatter
    shared = np.radians(RUN_TILT_SIGMA_DEG) ** 2 * np.eye(3)
    c = calibration.coefficients + L @ z
    updated = replace(
        calibration,
        coefficients=c,
        covariance=L @ covariance[:-3, :-3] @ L.T,
        boresight=to_boresight(rotation, covariance[-3:, -3:] + shared, tilt_sigma),
    )
    # where magnitude and direction disagree, the residual of the magnitude grows, and its noise with it
    residual = residuals_of(found.samples, c)
    growth = max(robust_scale(residual) / robust_scale(found.residual), 1.0)
    noise = msgspec.structs.replace(updated.noise, sensor=updated.noise.sensor * growth)
    return replace(found, calibration=replace(updated, noise=noise), residual=residual)


def _across(h: FloatArray) -> FloatArray:
    """Return two unit vectors across each vector of h (n, 3), as (n, 2, 3)."""
    # the axis nearest to a right angle with h gives the first vector
    least = np.eye(3)[np.argmin(np.abs(h), axis=1)]
    one = np.cross(h, least)
    one /= np.linalg.norm(one, axis=1)[:, None]
    return np.stack([one, np.cross(h, one) / np.linalg.norm(h, axis=1)[:, None]], axis=1)


def _vertical(attitude: FloatArray) -> FloatArray:
    """Return the direction of gravity in body axes, (n, 1, 3), from attitudes (n, 3), rad."""
    return field_body(attitude, np.broadcast_to([0.0, 0.0, 1.0], attitude.shape))[:, None, :]
