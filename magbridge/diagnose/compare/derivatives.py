"""Derivatives of the residual by every coefficient of a calibration: ``de/dc`` of :mod:`.problem`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magbridge.calibration.model import Calibration
from magbridge.calibration.residual import Samples

__all__ = ["CHUNK", "derivatives"]

FloatArray = NDArray[np.float64]

CHUNK = 8192
"""Rows at a time: the memory is bounded, whatever the log."""


def derivatives(calibration: Calibration, samples: Samples, g: FloatArray, L: FloatArray) -> FloatArray:
    """(n, q): derivatives of the residual by all coefficients, times L (K, q), in bounded memory."""
    tensor = _tensor(calibration)
    M = np.tensordot(L.T, tensor, 1).reshape(L.shape[1], tensor[0].size).T
    out = np.empty((L.shape[1], len(g)))
    for start in range(0, len(g), CHUNK):
        rows = slice(start, start + CHUNK)
        outer = samples.phi[rows, :, None] * g[rows, None, :]
        out[:, rows] = (outer.reshape(len(outer), -1) @ M).T
    return out.T


def _tensor(calibration: Calibration) -> FloatArray:
    """(K, m, 9) the tensor C_krs of :mod:`.problem`: coefficients, regressors, slots."""
    kernel = calibration.kernel
    exponents = [(0,) * len(calibration.parameters)]
    for parent, k in kernel.parents:
        e = exponents[parent]
        exponents.append((*e[:k], e[k] + 1, *e[k + 1 :]))
    tensor = np.zeros((calibration.coefficients.size, len(kernel.weights), 9))
    row, k = {exponent: i for i, exponent in enumerate(exponents)}, 0
    for term in calibration.terms:
        expansion = term.expand(calibration)
        tensor[k : k + term.size, [row[e] for e in expansion.exponents]] = expansion.columns
        k += term.size
    r = len(exponents)
    for effect in calibration.effects:
        columns = effect.columns(calibration.reference.field)
        tensor[k : k + effect.size, r : r + columns.shape[1]] = columns
        k, r = k + effect.size, r + columns.shape[1]
    return tensor
