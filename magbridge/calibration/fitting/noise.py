"""The noise of residuals: its size, its autocorrelation, and which samples are outliers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from magbridge.arrays import BoolArray, FloatArray
from magbridge.calibration.residual import Whitening, robust_scale, whiten

__all__ = ["OUTLIER", "NoiseModel", "estimate_noise", "memory"]

OUTLIER = 5.0
"""A residual beyond this many (robust) sigmas is left out; Gaussian noise practically never gets there."""
LASTING = 0.2
"""Autocorrelation of neighbours from which on noise may be a slow part and a white one."""
LIKELIER = 5.0
"""Nats by which both must be likelier than a slow part alone."""


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Noise of the residuals."""

    sigma: float
    """nT, in the sensor's own units, of a single sample."""
    autocorrelation: float = 0.0
    """Of successive samples in a run: rho of the slow part, AR(1)."""
    white: float = 0.0
    """Share of the variance that is white noise beside it."""
    weight: FloatArray | None = None
    """(n,): 1 for a sample that counts, 0 for an outlier; None when all count."""

    @property
    def shape(self) -> tuple[float, float]:
        """Autocorrelation and white share."""
        return self.autocorrelation, self.white

    @property
    def rejected(self) -> int:
        """How many samples are outliers."""
        return 0 if self.weight is None else int((self.weight == 0.0).sum())


def estimate_noise(
    e: FloatArray,
    steps: FloatArray,
    free: float,
    doubt: tuple[float, float] = (0.0, 0.0),
    shape: tuple[float, float] | None = None,
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
    shape : tuple of 2 float, optional
        Autocorrelation and white share, where they are known: see :func:`memory`.
    """
    if shape is None:
        shape = (_autocorrelation(_clipped(e), steps == 1, doubt), 0.0)
    white = whiten(e, steps, *shape)
    weight = (np.abs(white) <= OUTLIER * _robust(white)).astype(float)
    kept = weight.sum()
    sigma = float(np.sqrt((weight * white * white).sum() / max(kept - free, 1.0)))
    return NoiseModel(sigma or 1e-9, *shape, None if weight.all() else weight)


def _clipped(e: FloatArray) -> FloatArray:
    """Return the residuals with those beyond three robust sigmas there."""
    scale = _robust(e)
    return np.asarray(np.clip(e, -3.0 * scale, 3.0 * scale))


def memory(e: FloatArray, steps: FloatArray, noise: NoiseModel) -> NoiseModel:
    """Return the noise as a slow part and a white one, where that is likelier than the AR(1) given.

    The memory of noise is a time: where a log is sampled often, neighbours are nearly equal whatever is
    white between them, and one AR(1) then forgets too fast or knows no white noise.

    Parameters
    ----------
    e : (n,) array
        Residuals, nT.
    steps : (n,) array
        Sampling intervals since the previous sample.
    noise : NoiseModel
        As :func:`estimate_noise` found it.
    """
    if noise.autocorrelation < LASTING:
        return noise
    e, rho = _clipped(e), noise.autocorrelation
    longest = float(np.isfinite(steps).sum()) + 2.0

    def unlikely(rho: float, white: float) -> float:
        whitening = Whitening(steps, rho, white)
        v = whitening.apply(e)
        return float(0.5 * len(e) * np.log(v @ v) + 0.5 * np.log(whitening.variance).sum())

    def shape(x: FloatArray) -> tuple[float, float]:
        return float(np.exp(-np.exp(-x[0]))), float(1.0 / (1.0 + np.exp(-x[1])))

    bounds = [(np.log(1.0), np.log(longest)), (-12.0, 6.0)]
    best = min(
        (
            minimize(lambda x: unlikely(*shape(x)), np.log(start), method="L-BFGS-B", bounds=bounds)
            for start in ((-1.0 / np.log(rho), 0.05), (longest / 20.0, 0.3))
        ),
        key=lambda found: found.fun,
    )
    if best.fun > unlikely(rho, 0.0) - LIKELIER:
        return noise
    rho, white = shape(best.x)
    return replace(noise, autocorrelation=rho, white=white)


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
