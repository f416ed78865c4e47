"""Derivatives of the residual by every coefficient of a calibration: ``de/dc`` of :mod:`.problem`."""

from __future__ import annotations

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.compilation import coefficient_tensor
from magbridge.calibration.model import Calibration
from magbridge.estimation.residual import Samples, jacobian

__all__ = ["DERIVATIVE_ROWS", "derivatives"]

DERIVATIVE_ROWS = 8192
"""Rows at a time: the memory is bounded, whatever the log."""


def derivatives(calibration: Calibration, samples: Samples, g: FloatArray, L: FloatArray) -> FloatArray:
    """(n, q): derivatives of the residual by all coefficients, times L (K, q), in bounded memory."""
    tensor, _ = coefficient_tensor(calibration)  # C_krs of :mod:`.problem`
    M = np.tensordot(L.T, tensor, 1).reshape(L.shape[1], tensor[0].size).T
    out = np.empty((L.shape[1], len(g)))
    for start in range(0, len(g), DERIVATIVE_ROWS):
        rows = slice(start, start + DERIVATIVE_ROWS)
        out[:, rows] = (jacobian(samples.phi[rows], g[rows]) @ M).T
    return out.T
