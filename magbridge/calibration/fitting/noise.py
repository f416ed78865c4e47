"""The noise of residuals: its size, its autocorrelation, and which samples are outliers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magbridge.arrays import BoolArray, FloatArray
from magbridge.calibration.residual import robust_scale, whiten

__all__ = ["OUTLIER", "NoiseModel", "estimate_noise"]

OUTLIER = 5.0
"""A residual beyond this many (robust) sigmas is left out; Gaussian noise practically never gets there."""


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Noise of the residuals.

    Attributes
    ----------
    sigma : float
        nT, in the sensor's own units, of a single sample.
    autocorrelation : float
        Of successive samples in a run: rho of AR(1).
    weight : (n,) array or None
        1 for a sample that counts, 0 for an outlier; None when all count.
    """

    sigma: float
    autocorrelation: float = 0.0
    weight: FloatArray | None = None

    @property
    def rejected(self) -> int:
        """How many samples are outliers."""
        return 0 if self.weight is None else int((self.weight == 0.0).sum())


def estimate_noise(
    e: FloatArray, steps: FloatArray, free: float, doubt: tuple[float, float] = (0.0, 0.0)
) -> NoiseModel:
    """Estimate the noise model from the residuals of a fit.

    Parameters
    ----------
    e : (n,) array
        Residuals, nT.
    steps : (n,) array
        Sampling intervals since the previous sample.
    free : float
        How many numbers the data determined.
    doubt : tuple of 2 float
        nT², the fitted model's variance at a sample, and its covariance with the next one. A fit absorbs just
        that much of the noise, its slow part above all: ``Cov e = R - J P J^T`` (R: covariance of the noise,
        P: posterior covariance of the coefficients).
    """
    scale = _robust(e)
    rho = _autocorrelation(np.clip(e, -3.0 * scale, 3.0 * scale), steps == 1, doubt)
    white = whiten(e, steps, rho)
    weight = (np.abs(white) <= OUTLIER * _robust(white)).astype(float)
    kept = weight.sum()
    sigma = float(np.sqrt((weight * white * white).sum() / max(kept - free, 1.0)))
    return NoiseModel(sigma or 1e-9, rho, None if weight.all() else weight)


def _robust(e: FloatArray) -> float:
    """Return :func:`robust_scale`, or the mean magnitude where more than half are zero."""
    return robust_scale(e) or float(np.abs(e).mean()) or 1e-9


def _autocorrelation(e: FloatArray, follows: BoolArray, doubt: tuple[float, float]) -> float:
    """Return that of successive residuals; 0 if it is below three of its standard errors."""
    late, early = e[1:][follows[1:]], e[:-1][follows[1:]]
    if len(late) < 30:
        return 0.0
    n, (own, shared) = len(late), doubt
    squares = np.sqrt((late @ late + n * own) * (early @ early + n * own))
    rho = float((late @ early + n * shared) / (squares + 1e-300))
    return min(rho, 0.99) if rho > 3.0 / np.sqrt(len(late)) else 0.0
