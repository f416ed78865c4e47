"""The calibration's coefficients as the state of a Kalman filter, beside what is not the calibration's.

The state is the coefficients, the slope of the offset (nT/s, an axis), and those of :mod:`.nuisance`.

Covariance form: the variance of every prediction, which judging and doubt need with each sample, is then a
by-product, and a prior that is certain of some combinations (as a fit that could not estimate them, or an
effect that nothing speaks for) needs no inverse; the state is relinearised at each sample.

Where a sample says little about the coefficients that rock could not explain as well, they are
*considered*, not learned: their gain is zero, and their uncertainty stays in the variance (Schmidt 1966;
Joseph's form holds for any gain)::

    P <- P - k (h P) - (P h^T) k^T + k S k^T
"""

from __future__ import annotations

from math import exp, sqrt
from typing import Final

import numpy as np

from magbridge.arrays import FloatArray, IndexArray
from magbridge.learning.nuisance import STATES, Nuisance

__all__ = ["BESIDE", "SLOPE", "Estimator"]

SLOPE: Final = 3
"""States of the offset's slope."""
BESIDE: Final = SLOPE + STATES
"""States that are no coefficients."""
TELLING: Final = 0.01
"""Share of a prediction's variance that comes from the coefficients and varies along the track: from here on
the sample tells something of them."""
NEAR: Final = 250.0
"""m over which the mean derivative is followed, a quarter of the rock's length: what varies within is not
rock."""
LONG: Final = 1000
"""Samples over which the mean derivative of the total field is followed."""
CHANGED: Final = 2.0
"""Sigmas by which the level has changed."""
LASTING: Final = 24.0 * 3600.0
"""s over which what is known of a drift's slope gets less certain by a factor of e in variance: a drift
changes, but what was found to be none does not begin anew by itself."""
STEEPEST: Final = 20.0 / 3600.0
"""nT/s: no drift's slope gets less certain than that."""


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
        self.states = K + BESIDE
        self._x = np.concatenate([coefficients, np.zeros(BESIDE)])
        self._P = np.zeros((self.states, self.states))
        self._P[:K, :K] = covariance
        self._P[-STATES:, -STATES:] = nuisance.initial
        self.offsets, self.slope = offsets, np.arange(K, K + SLOPE)
        self._nuisance, self._creep = nuisance, creep
        self._sloping, self._lasting = False, LASTING
        self._near: FloatArray | None = None
        self._mean, self._share, self._kept = np.zeros(K), 0.0, np.zeros(K)
        self._stay = 1.0
        self.residual, self.variance, self.telling = 0.0, 1.0, False
        self._h = np.zeros(self.states)
        self._Ph = np.zeros(self.states)

    def know(
        self, coefficients: FloatArray, nuisances: FloatArray, covariance: FloatArray, nuisance: Nuisance
    ) -> None:
        """Take what a fit says for all that is known of coefficients (K,) and nuisance (4,), jointly."""
        self._nuisance = nuisance
        both = np.r_[: self.size, self.states - STATES : self.states]
        self._x[both] = np.concatenate([coefficients, nuisances])
        self._P[:] = self._kept[:] = 0.0
        self._P[np.ix_(both, both)] = covariance

    @property
    def coefficients(self) -> FloatArray:
        """The coefficients (K,) as learned so far."""
        return self._x[: self.size]

    @property
    def covariance(self) -> FloatArray:
        """Their covariance (K, K), symmetric and positive semidefinite."""
        P = self._P[: self.size, : self.size]
        kept = self._kept * float(self._mean @ P @ self._mean)  # what has not been learned since
        P = P + np.outer(kept, kept)
        values, vectors = np.linalg.eigh(0.5 * (P + P.T))
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        return np.asarray(root @ root.T)

    def follow(self, s: float) -> None:
        """Follow how the total field changes with the coefficients; s is the last residual's scale."""
        self._mean += (s * self._h[: self.size] - self._mean) / LONG
        self._share += (1.0 - self._share) / LONG

    @property
    def mean(self) -> FloatArray:
        """The total field's mean derivative (K,) by the coefficients, so far."""
        return self._mean / self._share if self._share else self._mean

    def at_level_of(self, published: FloatArray) -> FloatArray:
        """Return the likeliest coefficients (K,) whose mean field is that of those `published` (K,).

        Rock and reference hide the level, so that what is learned of it is chance: what need not, shall not
        change it.
        """
        K = self.size
        toward = self._P[:K, :K] @ self._mean
        by = float(self._mean @ (published - self.coefficients))
        return np.asarray(self.coefficients + toward * (by / float(self._mean @ toward)))

    def keep_level(self, published: FloatArray) -> None:
        """Move the state to where the mean field is that of the coefficients `published` (K,).

        As :meth:`at_level_of`, with rock that takes up what the coefficients give; but not where the level
        drifts, or has changed beyond chance. It may have changed by so much all the same: the covariance of
        what is published says so, as far as that is not learned since; the filter is not let loose.
        """
        K = self.size
        toward = self._P[:, :K] @ self._mean
        by, variance = float(self._mean @ (published - self.coefficients)), float(self._mean @ toward[:K])
        if not self._sloping and by * by < CHANGED * CHANGED * variance:
            self._x += toward * (by / variance)
            self._kept = toward[:K] * (by / variance**2)

    def open(self, variance: float, which: IndexArray | None = None) -> None:
        """Let coefficients `which` (3,), by default the offsets, be unknown by a further `variance` each."""
        which = self.offsets if which is None else which
        self._P[which, which] += variance

    def drift(self, rate: float, lasting: float) -> None:
        """Let the offsets drift by `rate` (nT/s, 1-sigma an axis), which changes within `lasting` (s)."""
        self._P[self.slope, self.slope] += rate * rate
        self._sloping, self._lasting = True, lasting

    def shift(self, by: FloatArray, covariance: FloatArray) -> None:
        """Move the state by `by` (n,), which is known to a further `covariance` (n, n)."""
        self._x += by
        self._P += covariance
        self._sloping = bool(self._P[self.slope, self.slope].any())

    def advance(self, state: FloatArray, F: FloatArray, seconds: float) -> None:
        """Move `state` (n, ...) on in place, over a time; F (4, 4) is the nuisance's transition."""
        beside = state[-STATES:]
        beside[:] = (F @ beside.reshape(STATES, -1)).reshape(beside.shape)
        if self._sloping:
            state[self.offsets] += seconds * state[self.slope]

    def propagate(self, metres: float, seconds: float) -> FloatArray:
        """Move on by a way and a time; return the transition (4, 4) of what is not the calibration's."""
        P = self._P
        F, Q = self._nuisance.transition(metres, seconds)
        self.advance(self._x, F, seconds)
        self.advance(P, F, seconds)
        self.advance(P.T, F, seconds)
        P[-STATES:, -STATES:] += Q
        if self._sloping:
            known = P[self.slope, self.slope]
            P[self.slope, self.slope] = np.where(
                known < STEEPEST * STEEPEST, known * (1.0 + seconds / self._lasting), known
            )
        self.open(self._creep * self._creep * seconds)
        self._stay = exp(-metres / NEAR)
        return F

    def predict(self, e: float, s: float, by_coefficients: FloatArray) -> None:
        """Take a sample's residual at the present coefficients, its derivatives (K,): set the innovation."""
        K, h = self.size, self._h
        h[:K] = by_coefficients
        h[-STATES:] = self._nuisance.row(s)
        if self._near is None:
            self._near = by_coefficients.copy()
        else:
            self._near += (1.0 - self._stay) * (by_coefficients - self._near)
        self._Ph = self._P @ h
        self.variance = float(h @ self._Ph) + self._nuisance.white_variance
        self.residual = e + float(h[-STATES:] @ self._x[-STATES:])
        varying = by_coefficients - self._near
        self.telling = float(varying @ self._P[:K, :K] @ varying) > TELLING * self.variance

    def update(self, *, learn: bool) -> FloatArray:
        """Take the predicted sample in; return the gain (n,).

        Parameters
        ----------
        learn : bool
            Whether coefficients and slope may learn from it; else they are considered.
        """
        S, P, Ph = self.variance, self._P, self._Ph
        gain = Ph / S
        if not learn:
            gain[:-STATES] = 0.0
        self._x -= gain * self.residual
        cross = np.outer(gain, Ph)
        P -= cross
        P -= cross.T
        P += np.outer(S * gain, gain)
        return np.asarray(gain)

    def leave_map(self, nuisance: Nuisance) -> None:
        """Let rock be as `nuisance` says, which is without a map, and nothing be known of it."""
        self._nuisance = nuisance
        P, states = self._P, slice(-STATES, None)
        self._x[states] = 0.0
        P[states] = P[:, states] = 0.0
        P[states, states] = nuisance.initial

    @property
    def rock(self) -> float:
        """The rock's field as learned, nT."""
        return float(self._x[-STATES])

    @property
    def expected(self) -> float:
        """The residual, nT, that what is not the calibration's lets expect of a sample like the last one."""
        return -float(self._h[-STATES:] @ self._x[-STATES:])

    def response(self, signature: FloatArray, state: FloatArray) -> FloatArray:
        """Return how the innovation (q,) answers signatures (q,) that have moved the state by (n, q)."""
        return np.asarray(signature + self._h @ state)

    @property
    def sigma(self) -> float:
        """1-sigma of the innovation, nT."""
        return sqrt(self.variance)
