"""The noise of residuals: how large, how long it remembers, and which samples are outliers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magbridge.calibration.residual import whiten

__all__ = ["OUTLIER", "NoiseModel", "estimate_noise"]

FloatArray = NDArray[np.float64]

OUTLIER = 5.0
"""A residual of more than so many (robust) sigmas takes no part; of pure noise none does."""


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Noise of the residuals.

    Attributes
    ----------
    sigma : float
        nT, in the sensor's own units, of a single sample.
    memory : float
        Correlation of neighbours in a run (AR(1)).
    weight : (n,) array or None
        1 for a sample that counts, 0 for an outlier; None when all count.
    """

    sigma: float
    memory: float = 0.0
    weight: FloatArray | None = None

    @property
    def rejected(self) -> int:
        """How many samples are outliers."""
        return 0 if self.weight is None else int((self.weight == 0.0).sum())


def estimate_noise(
    e: FloatArray, steps: FloatArray, free: float, doubt: tuple[float, float] = (0.0, 0.0)
) -> NoiseModel:
    """Noise model from the residuals of a fit.

    Parameters
    ----------
    e : (n,) array
        Residuals, nT.
    steps : (n,) array
        Intervals since the sample before.
    free : float
        How many numbers the data determined.
    doubt : tuple of 2 float
        nT², what the model's own uncertainty is at a sample, and what it shares with the next one.
        A fit takes just so much out of the residuals, the slow part of the noise before all:
        ``Cov e = R - J P J^T`` (R: the noise, P: posterior of the coefficients).
    """
    scale = _robust(e)
    memory = _memory(np.clip(e, -3.0 * scale, 3.0 * scale), steps == 1, doubt)
    white = whiten(e, steps, memory)
    weight = (np.abs(white) <= OUTLIER * _robust(white)).astype(float)
    kept = weight.sum()
    sigma = float(np.sqrt((weight * white * white).sum() / max(kept - free, 1.0)))
    return NoiseModel(sigma or 1e-9, memory, None if weight.all() else weight)


def _robust(e: FloatArray) -> float:
    """Scale of the bulk: 1.48 times the median size, which is sigma for a Gaussian."""
    return 1.4826 * float(np.median(np.abs(e))) or float(np.abs(e).mean()) or 1e-9


def _memory(e: FloatArray, follows: NDArray[np.bool_], doubt: tuple[float, float]) -> float:
    """Correlation of neighbours; what is within its own error of 0 is 0."""
    late, early = e[1:][follows[1:]], e[:-1][follows[1:]]
    if len(late) < 30:
        return 0.0
    n, (own, shared) = len(late), doubt
    squares = np.sqrt((late @ late + n * own) * (early @ early + n * own))
    rho = float((late @ early + n * shared) / (squares + 1e-300))
    return min(rho, 0.99) if rho > 3.0 / np.sqrt(len(late)) else 0.0
