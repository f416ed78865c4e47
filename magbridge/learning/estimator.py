"""The calibration's coefficients as the state of a Kalman filter, beside what is not the calibration's.

Covariance form: the variance of every prediction, which judging and doubt need with each sample, is then a
by-product, and a prior that is certain of some combinations (as a fit that could not estimate them) needs no
inverse; the state is relinearised at each sample.

Where a sample says little about the coefficients that rock could not explain as well, they are
*considered*, not learned: their gain is zero, and their uncertainty stays in the variance (Schmidt 1966;
Joseph's form holds for any gain)::

    P <- P - k (h P) - (P h^T) k^T + k S k^T
"""

from __future__ import annotations

from math import exp, sqrt

import numpy as np

from magbridge.arrays import FloatArray, IndexArray
from magbridge.errors import CalibrationError
from magbridge.learning.nuisance import STATES, Nuisance

__all__ = ["Estimator", "constant_offsets"]

TELLING = 0.01
"""Share of a prediction's variance that comes from the coefficients and varies along the track: from here on
the sample tells something of them."""
NEAR = 250.0
"""m over which the mean derivative is followed, a quarter of the rock's length: what varies within is not
rock."""


class Estimator:
    """Learns coefficients sample by sample.

    Parameters
    ----------
    coefficients, covariance : (K,), (K, K) arrays
        The prior.
    offsets : (3,) int array
        Which coefficients are the sensor's constant offset: they creep.
    nuisance : Nuisance
    creep : float
        nT per square root of a second, by which offsets walk.

    Attributes
    ----------
    coefficients : (K,) array
        As learned so far.
    residual, variance : float
        Innovation (nT) and its variance of the last prediction.
    telling : bool
        Whether the last sample says something of the coefficients.
    """

    def __init__(
        self,
        coefficients: FloatArray,
        covariance: FloatArray,
        offsets: IndexArray,
        nuisance: Nuisance,
        creep: float,
    ) -> None:
        self.size = K = len(coefficients)
        self._x = np.concatenate([coefficients, np.zeros(STATES)])
        self._P = np.zeros((K + STATES, K + STATES))
        self._P[:K, :K] = covariance
        self._P[K:, K:] = nuisance.initial
        self._offsets, self._nuisance = offsets, nuisance
        self.creep = creep
        self._near: FloatArray | None = None
        self.residual, self.variance, self.telling = 0.0, 1.0, False
        self._h = np.zeros(K + STATES)
        self._Ph = np.zeros(K + STATES)

    @property
    def coefficients(self) -> FloatArray:
        """The coefficients (K,) as learned so far."""
        return self._x[: self.size]

    @property
    def beside(self) -> FloatArray:
        """The states (3,) of what is not the calibration's."""
        return self._x[self.size :]

    @property
    def covariance(self) -> FloatArray:
        """Their covariance (K, K), symmetric and positive semidefinite."""
        P = self._P[: self.size, : self.size]
        values, vectors = np.linalg.eigh(0.5 * (P + P.T))
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        return np.asarray(root @ root.T)

    def open(self, variance: float) -> None:
        """Let the offsets be unknown by a further `variance` (nT²) an axis."""
        self._P[self._offsets, self._offsets] += variance

    def propagate(self, metres: float, seconds: float) -> FloatArray:
        """Move on by a way and a time; return the transition (3, 3) of what is not the calibration's."""
        K, P = self.size, self._P
        F, Q = self._nuisance.over(metres, seconds)
        self._x[K:] = F @ self._x[K:]
        P[K:] = F @ P[K:]
        P[:, K:] = P[:, K:] @ F.T
        P[K:, K:] += Q
        self.open(self.creep * self.creep * seconds)
        if self._near is not None:
            self._stay = exp(-metres / NEAR)
        return F

    def predict(self, e: float, s: float, by_coefficients: FloatArray) -> None:
        """Take a sample's residual at the present coefficients, its derivatives (K,): set the innovation."""
        K, h = self.size, self._h
        h[:K] = by_coefficients
        h[K], h[K + 1], h[K + 2] = -1.0 / s, 0.0, -1.0
        if self._near is None:
            self._near = by_coefficients.copy()
        else:
            self._near += (1.0 - self._stay) * (by_coefficients - self._near)
        self._Ph = self._P @ h
        self.variance = float(h @ self._Ph) + self._nuisance.white
        self.residual = e + float(h[K:] @ self._x[K:])
        varying = by_coefficients - self._near
        P = self._P[:K, :K]
        self.telling = float(varying @ P @ varying) > TELLING * self.variance

    def update(self, *, learn: bool) -> FloatArray:
        """Take the predicted sample in; return the gain (K + 3,).

        Parameters
        ----------
        learn : bool
            Whether the coefficients may learn from it; else they are considered.
        """
        S, P, Ph = self.variance, self._P, self._Ph
        gain = Ph / S
        if not learn:
            gain[: self.size] = 0.0
        self._x -= gain * self.residual
        cross = np.outer(gain, Ph)
        P -= cross
        P -= cross.T
        P += np.outer(S * gain, gain)
        return np.asarray(gain)

    def response(self, signature: FloatArray, state: FloatArray) -> FloatArray:
        """Return how the innovation (q,) answers signatures (q,) that have moved the state by (n, q)."""
        return np.asarray(signature + self._h @ state)

    @property
    def sigma(self) -> float:
        """1-sigma of the innovation, nT."""
        return sqrt(self.variance)


def constant_offsets(tensor: FloatArray) -> IndexArray:
    """Return which coefficients are the constant offset of x, y and z, and nothing else.

    Parameters
    ----------
    tensor : (K, m, 9) array
        As :func:`~magbridge.calibration.compilation.coefficient_tensor`.

    Raises
    ------
    CalibrationError
        There is none for an axis.
    """
    found = []
    for axis in range(3):
        only = np.zeros(tensor.shape[1:])
        only[0, 6 + axis] = 1.0
        same = np.flatnonzero((tensor == only).all(axis=(1, 2)))
        if not same.size:
            raise CalibrationError("a calibration without a constant offset is not learned")
        found.append(int(same[0]))
    return np.array(found)
