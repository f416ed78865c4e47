"""Forward model: from the true field to the readings.

Notes
-----
``H_r = A^-1 R^T H + T``, the inverse of :mod:`.correct`. Effects that depend on the reading itself are
solved for by iteration; all others are exact in the first pass.
"""

from __future__ import annotations

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.correct import regressors
from magbridge.calibration.model import Calibration
from magbridge.estimation.residual import symmetric

__all__ = ["forward"]


def _coefficients_at(
    calibration: Calibration, field: FloatArray, channels: FloatArray, time: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return ``A`` (n, 3, 3) and ``T`` (n, 3) of every sample, with effects; arguments as in `correct`."""
    phi = regressors(calibration, np.asarray(field, float), np.asarray(channels, float), time)
    theta = phi.T @ calibration.kernel.weights
    return symmetric(theta), theta[:, 6:]


def forward(
    calibration: Calibration, field_body: FloatArray, channels: FloatArray, time: FloatArray
) -> FloatArray:
    """Return the noiseless readings in a true field.

    Parameters
    ----------
    calibration : Calibration
        Of the simulated sensor.
    field_body : (n, 3) array
        nT, the true field in body axes (in the calibration's sensor axes if it has no boresight).
    channels : (n, k) array
        ``calibration.channels``, in that order.
    time : (n,) array
        s.

    Returns
    -------
    (n, 3) array
        nT, raw channels.
    """
    truth = np.asarray(field_body, float)
    if calibration.boresight is not None:
        truth = truth @ calibration.boresight.matrix()
    reading = truth
    # the first pass is exact unless effects depend on the reading; each further one then gains two digits
    for _ in range(6 if calibration.effects else 1):
        A, T = _coefficients_at(calibration, reading, channels, time)
        reading = np.linalg.solve(A, truth[:, :, None])[:, :, 0] + T
    return reading
