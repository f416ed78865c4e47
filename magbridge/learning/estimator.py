"""A Kalman filter whose state is the calibration's coefficients and the nuisance of the reference field.

The state is the coefficients, the slope of the offset (nT/s, an axis), and the states of :class:`Nuisance`.

The filter uses the covariance form. The variance of every prediction, which comparison and alarm need with
each sample, is then a by-product. A singular prior needs no inverse, for example after a fit that could not
estimate some combinations. The state is relinearised at each sample.

If the crustal field could explain a sample as well as the coefficients, the filter *considers* the
coefficients and does not learn them (:mod:`magbridge.estimation.kalman`).
"""

from __future__ import annotations

from math import exp
from typing import Final

import numpy as np

from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.model import Noise
from magbridge.estimation.kalman import KalmanFilter
from magbridge.estimation.track_process import CORRELATION_LENGTH_M as LENGTH
from magbridge.estimation.track_process import TRACK_STATES as STATES
from magbridge.estimation.track_process import TrackProcess
from magbridge.learning.samples import Way

__all__ = ["EXTRA_STATES", "LENGTH", "SLOPE_STATES", "STATES", "Estimator", "Nuisance"]


class Nuisance(TrackProcess):
    """Dynamics of the reference's error for the samples of a calibration.

    Parameters
    ----------
    noise : Noise
        The calibration's noise model.
    spread, level : float
        1-sigma of the crustal field and of the reference's constant error, nT.
    length : float
        Correlation length of the crustal field, m.
    """

    def __init__(self, noise: Noise, spread: float, level: float = 0.0, length: float = LENGTH) -> None:
        super().__init__(
            noise.sensor, spread, level, length,
            noise.autocorrelation, noise.interval, noise.white, noise.reference,
        )  # fmt: skip


SLOPE_STATES: Final = 3
"""States of the offset's slope."""
EXTRA_STATES: Final = SLOPE_STATES + STATES
"""Number of states that are not coefficients."""
TELLING: Final = 0.01
"""Fraction of a prediction's variance that comes from the coefficients and varies along the track: from here
on the sample is informative about the coefficients."""
AVERAGING_DISTANCE_M: Final = 250.0
"""Averaging distance of the mean derivative, m: a quarter of the crustal field's correlation length. Faster
variations are not attributed to the crustal field."""
MEAN_SAMPLES: Final = 1000
"""Samples over which the mean derivative of the total field is averaged."""
CHANGED: Final = 2.0
"""Change of the level, in sigma, from which on it counts as a change."""
SLOPE_MEMORY_S: Final = 24.0 * 3600.0
"""Time in which the variance of a drift's slope grows by a factor of e, s. A drift changes, but a drift that
was estimated as zero does not restart by itself."""
STEEPEST: Final = 20.0 / 3600.0
"""Largest 1-sigma of a drift's slope, nT/s."""


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
    filter : KalmanFilter
        Its state.
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
        self.states = K + EXTRA_STATES
        # state: coefficients, slope of the offset, states of the nuisance
        P = np.zeros((self.states, self.states))
        P[:K, :K] = covariance
        P[-STATES:, -STATES:] = nuisance.initial
        self.filter = KalmanFilter(np.concatenate([coefficients, np.zeros(EXTRA_STATES)]), P)
        self.offsets, self.slope = offsets, np.arange(K, K + SLOPE_STATES)
        self._nuisance, self._creep = nuisance, creep
        self._sloping, self._lasting = False, SLOPE_MEMORY_S
        self._near: FloatArray | None = None
        self._mean, self._share, self._kept = np.zeros(K), 0.0, np.zeros(K)
        self._stay = 1.0
        self.telling = False

    def know(
        self, coefficients: FloatArray, nuisances: FloatArray, covariance: FloatArray, nuisance: Nuisance
    ) -> None:
        """Set the state and covariance to a fit's joint result for coefficients (K,) and nuisance (4,)."""
        self._nuisance = nuisance
        both = np.r_[: self.size, self.states - STATES : self.states]
        self.filter.mean[both] = np.concatenate([coefficients, nuisances])
        self.filter.covariance[:] = self._kept[:] = 0.0
        self.filter.covariance[np.ix_(both, both)] = covariance

    @property
    def coefficients(self) -> FloatArray:
        """The coefficients (K,) as learned so far."""
        return self.filter.mean[: self.size]

    @property
    def covariance(self) -> FloatArray:
        """Their covariance (K, K), symmetric and positive semidefinite."""
        P = self.filter.covariance[: self.size, : self.size]
        # rank-one addition: the level that was kept instead of the learned one
        kept = self._kept * float(self._mean @ P @ self._mean)  # the part not learned since keep_level
        P = P + np.outer(kept, kept)
        # rounding leaves small negative eigenvalues, which no calibration file may have
        values, vectors = np.linalg.eigh(0.5 * (P + P.T))
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        return np.asarray(root @ root.T)

    def follow(self, s: float) -> None:
        """Follow how the total field changes with the coefficients; s is the last residual's scale."""
        self._mean += (s * self.filter.row[: self.size] - self._mean) / MEAN_SAMPLES
        self._share += (1.0 - self._share) / MEAN_SAMPLES

    @property
    def mean(self) -> FloatArray:
        """The total field's mean derivative (K,) by the coefficients, so far."""
        return self._mean / self._share if self._share else self._mean

    def at_level_of(self, published: FloatArray) -> FloatArray:
        """Return the likeliest coefficients (K,) whose mean field is that of those `published` (K,).

        The crustal field and the reference hide the level. A learned change of the level is therefore not
        significant, and the published level is kept where the data allow it.
        """
        K = self.size
        # conditional mean of the coefficients, given their mean field: c + P m (m^T P m)^-1 (level)
        toward = self.filter.covariance[:K, :K] @ self._mean
        by = float(self._mean @ (published - self.coefficients))
        return np.asarray(self.coefficients + toward * (by / float(self._mean @ toward)))

    def keep_level(self, published: FloatArray) -> None:
        """Move the state to where the mean field is that of the coefficients `published` (K,).

        Unlike :meth:`at_level_of`, the nuisance states absorb the difference. The state is not moved if the
        level drifts or has changed significantly. The covariance to publish includes the difference until
        further samples reduce it; the filter's own covariance does not change.
        """
        K = self.size
        # the same conditional mean for the whole state; the nuisance takes up what the level loses
        toward = self.filter.covariance[:, :K] @ self._mean
        by, variance = float(self._mean @ (published - self.coefficients)), float(self._mean @ toward[:K])
        if not self._sloping and by * by < CHANGED * CHANGED * variance:
            self.filter.mean += toward * (by / variance)
            self._kept = toward[:K] * (by / variance**2)

    def open(self, variance: float, coefficients: IndexArray | None = None) -> None:
        """Add `variance` to the variance of `coefficients` (3,), by default the offsets."""
        coefficients = self.offsets if coefficients is None else coefficients
        self.filter.covariance[coefficients, coefficients] += variance

    def drift(self, rate: float, lasting: float) -> None:
        """Add an offset drift of `rate` (nT/s, 1-sigma an axis) with correlation time `lasting` (s)."""
        self.filter.covariance[self.slope, self.slope] += rate * rate
        self._sloping, self._lasting = True, lasting

    def shift(self, step: FloatArray, covariance: FloatArray) -> None:
        """Move the state by `step` (n,), which is known to a further `covariance` (n, n)."""
        self.filter.mean += step
        self.filter.covariance += covariance
        self._sloping = bool(self.filter.covariance[self.slope, self.slope].any())

    def advance(self, state: FloatArray, F: FloatArray, seconds: float) -> None:
        """Move `state` (n, ...) on in place, over a time; F (4, 4) is the nuisance's transition."""
        beside = state[-STATES:]
        beside[:] = (F @ beside.reshape(STATES, -1)).reshape(beside.shape)
        if self._sloping:
            state[self.offsets] += seconds * state[self.slope]

    def propagate(self, way: Way) -> FloatArray:
        """Propagate over the way to the next sample; return the transition (4, 4) of the nuisance."""
        metres, seconds, _ = way
        P = self.filter.covariance
        F, Q = self._nuisance.transition(*way)
        # mean F x and covariance F P F^T + Q: once by the rows, once by the columns
        self.advance(self.filter.mean, F, seconds)
        self.advance(P, F, seconds)
        self.advance(P.T, F, seconds)
        P[-STATES:, -STATES:] += Q
        # a drift's slope is forgotten: its variance grows by exponential forgetting, up to a bound
        if self._sloping:
            known = P[self.slope, self.slope]
            P[self.slope, self.slope] = np.where(
                known < STEEPEST * STEEPEST, known * (1.0 + seconds / self._lasting), known
            )
        self.open(self._creep * self._creep * seconds)
        self._stay = exp(-metres / AVERAGING_DISTANCE_M)
        return F

    def predict(self, e: float, s: float, by_coefficients: FloatArray) -> None:
        """Compute the innovation from a sample's residual and derivatives (K,) at these coefficients."""
        K = self.size
        h = np.concatenate([by_coefficients, np.zeros(SLOPE_STATES), self._nuisance.row(s)])
        # the derivative's running mean along the track: a constant one is hidden by the crustal field
        if self._near is None:
            self._near = by_coefficients.copy()
        else:
            self._near += (1.0 - self._stay) * (by_coefficients - self._near)
        # e is the residual at the present coefficients, so that they have no part in h^T x
        # innovation of h^T x, with the nuisance's mean
        known = e - float(by_coefficients @ self.coefficients)
        self.filter.innovate(known, h, self._nuisance.white_variance)
        # share of the variance S that the coefficients explain and the crustal field does not
        varying = by_coefficients - self._near
        self.telling = float(varying @ self.filter.covariance[:K, :K] @ varying) > TELLING * self.variance

    def update(self, *, learn: bool) -> FloatArray:
        """Update the state with the predicted sample; return the gain (n,).

        Parameters
        ----------
        learn : bool
            Whether coefficients and slope may learn from it; else they are considered.
        """
        return self.filter.update(None if learn else slice(None, -STATES))

    def leave_map(self, nuisance: Nuisance) -> None:
        """Replace the nuisance by `nuisance`, of a reference without a map, in its initial state."""
        # the nuisance starts again, uncorrelated with the coefficients
        self._nuisance = nuisance
        P, states = self.filter.covariance, slice(-STATES, None)
        self.filter.mean[states] = 0.0
        P[states] = P[:, states] = 0.0
        P[states, states] = nuisance.initial

    @property
    def crust(self) -> float:
        """Crustal field as estimated, nT."""
        return float(self.filter.mean[-STATES])

    @property
    def expected(self) -> float:
        """Expected residual of the last sample's successor from the nuisance states alone, nT."""
        return -float(self.filter.row[-STATES:] @ self.filter.mean[-STATES:])

    @property
    def residual(self) -> float:
        """Innovation of the last prediction, nT."""
        return self.filter.innovation

    @property
    def variance(self) -> float:
        """Variance of the innovation, nT²."""
        return self.filter.variance

    @property
    def sigma(self) -> float:
        """1-sigma of the innovation, nT."""
        return self.filter.sigma
