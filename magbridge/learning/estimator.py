r"""Estimate the coefficients: one Kalman filter for each hypothesis, and a batch fit at the start.

The state of an :class:`Estimator` consists of the coefficients, the offset's slope (nT/s, each axis), and the
states of :class:`Nuisance`, the error of the reference. The filter is relinearised at each sample. If the
crustal field could explain a sample as well as the coefficients, the filter *considers* the coefficients and
does not update them (:mod:`magbridge.estimation.kalman`).

Without a hypothesis, a change is learned only once its test is significant. Until then, the estimator
attributes the change to the wrong coefficients, which is hard to undo. For example, it attributes a change of
temperature to the turn-on offset, or a drift to a step. The baseline estimator of the :class:`EstimatorBank`
assumes no change. Further estimators assume from the start that

- the offset follows the sensor's temperature;
- the offset drifts, at a rate that changes within hours;
- the map, if there is one, does not show the crustal field. A map error no larger than the crustal field
  hardly changes single samples, so no test of innovations detects the error. If this estimator predicts
  significantly better, the bank selects it until it loses its lead.

The selection is dynamic model selection (Raftery, Karny & Ettler 2010, Technometrics 52:52): with each
innovation v of variance S,

.. math:: \log w \leftarrow \alpha \log w - \tfrac12 (v^2 / S + \log S)

A vehicle's hard iron moves the reading by thousands of nanotesla, over which the field's magnitude is not
linear: a Kalman filter that was linearised at a wrong guess stays wrong. While the calibration is too
uncertain, a :class:`BatchFit` therefore stores the samples and refits them by Gauss-Newton when their number
has doubled. Residuals and derivatives are whitened by the filter of :class:`Nuisance`; with
:math:`c = c_0 + L z, z \sim N(0, I)`, a step solves

.. math:: (I + L^T J^T J L)\, z = -L^T J^T (r + J (c_0 - c))
"""

from __future__ import annotations

from copy import deepcopy
from math import exp, log
from typing import Final

import numpy as np

from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.model import Calibration, Noise, Parameter, Reference
from magbridge.calibration.terms import Polynomial, full_order
from magbridge.columns import TEMPERATURE
from magbridge.estimation.kalman import KalmanFilter
from magbridge.estimation.priors import polynomial_prior
from magbridge.estimation.sequential import ALARM_LOG_RATIO
from magbridge.estimation.track_process import CORRELATION_LENGTH_M, TRACK_STATES, TrackProcess
from magbridge.learning.samples import LearnedTerms, Way, observe
from magbridge.records import Vector


class Nuisance(TrackProcess):
    """Model of the reference's error: crustal field, constant error, and the calibration's `noise`.

    `spread` and `level` are the 1-sigma of the crustal field and of the reference's constant error, nT.
    `length` is the crustal field's correlation length, m.
    """

    def __init__(
        self, noise: Noise, spread: float, level: float = 0.0, length: float = CORRELATION_LENGTH_M
    ) -> None:
        super().__init__(
            noise.sensor, spread, level, length,
            noise.autocorrelation, noise.interval, noise.white, noise.reference,
        )  # fmt: skip


SLOPE_STATES: Final = 3
"""Number of states of the offset's slope."""
EXTRA_STATES: Final = SLOPE_STATES + TRACK_STATES
"""Number of states that are not coefficients."""
MIN_INFORMATIVE_SHARE: Final = 0.01
"""Smallest fraction of a prediction's variance, from effects of the coefficients that vary along the track,
at which the sample is informative about the coefficients."""
AVERAGING_DISTANCE_M: Final = 250.0
"""Averaging distance of the mean derivative, m: a quarter of the crustal field's correlation length. Faster
variations are not attributed to the crustal field."""
MEAN_SAMPLES: Final = 1000
"""Averaging time of the total field's mean derivative by the coefficients, in samples."""
CHANGED: Final = 2.0
"""Smallest significant change of the mean field, in sigmas."""
SLOPE_MEMORY_S: Final = 24.0 * 3600.0
"""Time in which the variance of a drift's slope grows by a factor of e, s. A drift changes, but a drift that
was estimated as zero does not restart by itself."""
STEEPEST: Final = 20.0 / 3600.0
"""Largest 1-sigma of a drift's slope, nT/s."""


class Estimator:
    """Kalman filter that estimates coefficients sample by sample, from a prior (K,) of covariance (K, K).

    The states of `filter` with the indices `offsets` (3,) are the constant offset, a random walk of `creep`
    (nT per square root of a second). The states with the indices `slope` (3,) are the offset's slope, nT/s.
    `is_informative` is True if the last sample contributes to the coefficients.
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
        P[-TRACK_STATES:, -TRACK_STATES:] = nuisance.initial
        self.filter = KalmanFilter(np.concatenate([coefficients, np.zeros(EXTRA_STATES)]), P)
        self.offsets, self.slope = offsets, np.arange(K, K + SLOPE_STATES)
        self._nuisance, self._creep = nuisance, creep
        self._sloping, self._lasting = False, SLOPE_MEMORY_S
        self._near: FloatArray | None = None
        self._mean, self._share, self._kept = np.zeros(K), 0.0, np.zeros(K)
        self._stay = 1.0
        self.is_informative = False

    def know(
        self, coefficients: FloatArray, nuisances: FloatArray, covariance: FloatArray, nuisance: Nuisance
    ) -> None:
        """Set the state to a batch fit's joint estimate of coefficients (K,) and `nuisances` (4,)."""
        self._nuisance = nuisance
        both = np.r_[: self.size, self.states - TRACK_STATES : self.states]
        self.filter.mean[both] = np.concatenate([coefficients, nuisances])
        self.filter.covariance[:] = self._kept[:] = 0.0
        self.filter.covariance[np.ix_(both, both)] = covariance

    @property
    def coefficients(self) -> FloatArray:
        """The coefficients (K,) as learned so far."""
        return self.filter.mean[: self.size]

    @property
    def covariance(self) -> FloatArray:
        """Covariance (K, K) of the coefficients, symmetric and positive semidefinite."""
        P = self.filter.covariance[: self.size, : self.size]
        # rank-one addition: the level that keep_level restored instead of the learned one
        kept = self._kept * float(self._mean @ P @ self._mean)  # the part not learned since keep_level
        P = P + np.outer(kept, kept)
        # rounding leaves small negative eigenvalues, which no calibration file may have
        values, vectors = np.linalg.eigh(0.5 * (P + P.T))
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        return np.asarray(root @ root.T)

    def follow(self, s: float) -> None:
        """Add the last sample to the total field's mean derivative; `s` is the scale of its residual."""
        self._mean += (s * self.filter.row[: self.size] - self._mean) / MEAN_SAMPLES
        self._share += (1.0 - self._share) / MEAN_SAMPLES

    @property
    def mean(self) -> FloatArray:
        """The total field's mean derivative (K,) by the coefficients, so far."""
        return self._mean / self._share if self._share else self._mean

    def at_level_of(self, published: FloatArray) -> FloatArray:
        """Return the likeliest coefficients (K,) with the mean field of the coefficients `published` (K,).

        The crustal field and the reference's constant error hide the mean field. A learned change of the mean
        field is therefore not significant, and the published mean field is kept.
        """
        K = self.size
        # conditional mean of the coefficients, given their mean field: c + P m (m^T P m)^-1 (level)
        toward = self.filter.covariance[:K, :K] @ self._mean
        by = float(self._mean @ (published - self.coefficients))
        return np.asarray(self.coefficients + toward * (by / float(self._mean @ toward)))

    def keep_level(self, published: FloatArray) -> None:
        """Shift the state so that its mean field equals that of the coefficients `published` (K,).

        Unlike :meth:`at_level_of`, the nuisance states absorb the difference. The state is not moved if the
        level drifts or has changed significantly. The covariance to publish includes the difference until
        further samples reduce it; the filter's own covariance does not change.
        """
        K = self.size
        # the same conditional mean for the whole state; the nuisance states absorb the difference
        toward = self.filter.covariance[:, :K] @ self._mean
        by, variance = float(self._mean @ (published - self.coefficients)), float(self._mean @ toward[:K])
        if not self._sloping and by * by < CHANGED * CHANGED * variance:
            self.filter.mean += toward * (by / variance)
            self._kept = toward[:K] * (by / variance**2)

    def open(self, variance: float, coefficients: IndexArray | None = None) -> None:
        """Add `variance` to that of the states of indices `coefficients` (3,), by default the offsets."""
        coefficients = self.offsets if coefficients is None else coefficients
        self.filter.covariance[coefficients, coefficients] += variance

    def drift(self, rate: float, lasting: float) -> None:
        """Add an offset drift of `rate` (nT/s, 1-sigma an axis) with correlation time `lasting` (s)."""
        self.filter.covariance[self.slope, self.slope] += rate * rate
        self._sloping, self._lasting = True, lasting

    def shift(self, step: FloatArray, covariance: FloatArray) -> None:
        """Move the state by `step` (n,), and add the step's `covariance` (n, n)."""
        self.filter.mean += step
        self.filter.covariance += covariance
        self._sloping = bool(self.filter.covariance[self.slope, self.slope].any())

    def advance(self, state: FloatArray, F: FloatArray, seconds: float) -> None:
        """Propagate `state` (n, ...) in place by `seconds`; `F` (4, 4) is the transition of the nuisance."""
        beside = state[-TRACK_STATES:]
        beside[:] = (F @ beside.reshape(TRACK_STATES, -1)).reshape(beside.shape)
        if self._sloping:
            state[self.offsets] += seconds * state[self.slope]

    def propagate(self, way: Way) -> FloatArray:
        """Propagate the filter to the next sample; return the transition (4, 4) of the nuisance states."""
        metres, seconds, _ = way
        P = self.filter.covariance
        F, Q = self._nuisance.transition(*way)
        # mean F x and covariance F P F^T + Q: once by the rows, once by the columns
        self.advance(self.filter.mean, F, seconds)
        self.advance(P, F, seconds)
        self.advance(P.T, F, seconds)
        P[-TRACK_STATES:, -TRACK_STATES:] += Q
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
        """Compute a sample's innovation from its residual `e` (nT), scale `s` and derivatives (K,)."""
        K = self.size
        h = np.concatenate([by_coefficients, np.zeros(SLOPE_STATES), self._nuisance.row(s)])
        # running mean of the derivative along the track: the crustal field hides a constant derivative
        if self._near is None:
            self._near = by_coefficients.copy()
        else:
            self._near += (1.0 - self._stay) * (by_coefficients - self._near)
        # e is the residual at the present coefficients: subtract their part of h^T x
        known = e - float(by_coefficients @ self.coefficients)
        self.filter.innovate(known, h, self._nuisance.white_variance)
        # share of the variance S that the coefficients explain and the crustal field does not
        varying = by_coefficients - self._near
        self.is_informative = (
            float(varying @ self.filter.covariance[:K, :K] @ varying)
            > MIN_INFORMATIVE_SHARE * self.filter.variance
        )

    def update(self, *, learn: bool) -> FloatArray:
        """Update the state with the predicted sample; return the gain (n,).

        Without `learn`, the coefficients and the slope are considered, but not changed.
        """
        return self.filter.update(None if learn else slice(None, -TRACK_STATES))

    def leave_map(self, nuisance: Nuisance) -> None:
        """Continue without a map: replace the model of the reference's error, and reset its states."""
        # the nuisance starts again, uncorrelated with the coefficients
        self._nuisance = nuisance
        P, states = self.filter.covariance, slice(-TRACK_STATES, None)
        self.filter.mean[states] = 0.0
        P[states] = P[:, states] = 0.0
        P[states, states] = nuisance.initial

    @property
    def crust(self) -> float:
        """Estimated crustal field, nT."""
        return float(self.filter.mean[-TRACK_STATES])

    @property
    def expected(self) -> float:
        """Expected residual of the last sample's successor from the nuisance states alone, nT."""
        return -float(self.filter.row[-TRACK_STATES:] @ self.filter.mean[-TRACK_STATES:])


BEYOND_CHANCE: Final = 13.5
"""Log-likelihood ratio that is exceeded by chance once in 30 days at 0.25 Hz (Ville's inequality)."""
BANK_MEMORY_SAMPLES: Final = 2000.0
"""Time constant, in samples, of the exponential forgetting of predictions."""
MIN_LEAD: Final = 3.0
"""Lead in log w that changes the selected estimator. Only a lead of :data:`BEYOND_CHANCE` replaces the
baseline estimator, because quantities that no test observes, such as the level, depend on the hypothesis."""
MAX_BANK_SQUARE: Final = 25.0
"""Largest v²/S that one sample contributes: an outlier does not distinguish the estimators."""
MAX_DEFICIT: Final = 10.0
"""Largest deficit of log w against an alarm's ratio, which is the best of dozens of onsets and causes."""
PER_DEGREE: Final = 2.0
"""Prior 1-sigma of the offset's change with temperature, nT/degC on each axis."""
DRIFT_SIGMA_NT_S: Final = 5.0 / 3600.0
"""Prior 1-sigma of the offset's drift, nT/s on each axis."""
DRIFT_CORRELATION_TIME_S: Final = 2.0 * 3600.0
"""Correlation time of the drift rate, s."""


class EstimatorBank:
    """Estimators of the coefficients, one for each hypothesis.

    The baseline is the first of `all`. If the reference is a map, the last is `without_map`, which does not
    use the map. `map_doubted` is True while `without_map` is selected, because it predicts significantly
    better. `map_lead` is its lead in log w; `map_since` (s) is the time since when it has led.
    """

    def __init__(self, model: LearnedTerms, quiet: Estimator, mapless: Nuisance | None = None) -> None:
        self._model, self.all, self._mapless = model, [quiet], mapless
        self._weights, self._best, self._warm = [0.0], 0, 0
        self.without_map: Estimator | None = None
        self.map_doubted, self.map_since, self.map_lead = False, 0.0, 0.0

    @property
    def quiet(self) -> Estimator:
        """Baseline estimator, which assumes no change."""
        return self.all[0]

    @property
    def best(self) -> Estimator:
        """Selected estimator: the one with the highest recent predictive likelihood."""
        if self.map_doubted and self.without_map is not None:
            return self.without_map
        return self.all[self._best]

    def suppose(self) -> None:
        """Add an estimator for every other hypothesis, starting from the baseline's state."""
        slots = self._model.slots(TEMPERATURE)
        if TEMPERATURE in self._model.further and slots is not None:
            warm = deepcopy(self.quiet)
            warm.open(PER_DEGREE**2, slots)
            self._warm = len(self.all)
            self.all.append(warm)
        # a drift of unknown rate, which is forgotten within hours
        drifting = deepcopy(self.quiet)
        drifting.drift(DRIFT_SIGMA_NT_S, DRIFT_CORRELATION_TIME_S)
        self.all.append(drifting)
        if self._mapless is not None:
            self.without_map = deepcopy(self.quiet)
            self.without_map.leave_map(self._mapless)
            self.all.append(self.without_map)
        self._weights = [0.0] * len(self.all)

    def open(self, variance: float) -> None:
        """Increase the variance of the offsets of all estimators by `variance` (nT²) on each axis."""
        for one in self.all:
            one.open(variance)

    def judge(self, time: float) -> None:
        """Score each estimator's prediction at a time (s), and select the best."""
        # log w of the module, with a bounded innovation
        for k, one in enumerate(self.all):
            v, S = one.filter.innovation, one.filter.variance
            self._weights[k] *= 1.0 - 1.0 / BANK_MEMORY_SAMPLES
            self._weights[k] -= 0.5 * (min(v * v / S, MAX_BANK_SQUARE) + log(S))
        # the map has its own test below, because without_map assumes another reference error
        with_map = [k for k, one in enumerate(self.all) if one is not self.without_map]
        ahead = max(with_map, key=self._weights.__getitem__)
        if self._weights[ahead] > self._weights[self._best] + (MIN_LEAD if self._best else BEYOND_CHANCE):
            self._best = ahead
        if self.without_map is None:
            return
        self.map_lead = self._weights[-1] - self._weights[ahead]
        if self.map_lead <= 0.0:
            self.map_doubted, self.map_since = False, time
        self.map_doubted = self.map_doubted or self.map_lead > ALARM_LOG_RATIO

    def take_over(self, strength: float) -> bool:
        """Replace the baseline by the estimator that follows the temperature; return True if it is replaced.

        The replacement needs significantly better predictions, and a log-likelihood not much lower than an
        alarm's, `strength`. An estimator that followed the temperature from the start is more exact.
        """
        warm = self._warm
        if self._weights[warm] - self._weights[0] < max(BEYOND_CHANCE, strength - MAX_DEFICIT):
            return False
        # the warm estimator continues as well, for comparison with its copy
        self.all[0], self._weights[0], self._best = deepcopy(self.all[warm]), self._weights[warm], 0
        return True

    def explained(self, step: FloatArray, covariance: FloatArray, strength: float) -> None:
        """Move the baseline's state by `step` (n,), of additional covariance `covariance` (n, n).

        `step` and its log-likelihood ratio `strength` come from the alarm's cause; `strength` is added to the
        baseline's score.
        """
        # with the cause, the baseline's score would have been higher by the log-likelihood ratio
        self.quiet.shift(step, covariance)
        self._weights[0] += strength
        if self._weights[0] > self._weights[self._best] + MIN_LEAD:
            self._best = 0


FIRST_FIT_SAMPLES: Final = 32
LAST_FIT_SAMPLES: Final = 4096
"""Number of samples of the first and the last fit: 2 minutes and 4.5 hours at 0.25 Hz."""
MAX_GAUSS_NEWTON_STEPS: Final = 12
MIN_STEP_SIGMA: Final = 0.01
"""Step below which the iteration ends, in sigmas of the prior."""
START_NOISE_NT: Final = 2.0
"""1-sigma of a channel's noise until it is estimated, nT."""
MIN_SAMPLES_FOR_NOISE: Final = 256
"""Number of samples from which on the fit estimates the noise."""


def class_prior(parameters: tuple[Parameter, ...], field: float = 50_000.0, order: int = 3) -> Calibration:
    """Return the prior of any vehicle with these moving masses: an identity and its uncertainty.

    `field` is the reference field F_0 (nT), `order` the highest total degree of the polynomials. The prior
    variances are the means of squared log-normal widths, with which the fit begins
    (:mod:`magbridge.estimation.priors`).
    """
    exponents = full_order(len(parameters), order)
    family = polynomial_prior(exponents, tuple(one.name for one in parameters), field)
    # mean of the square of a log-normal width: exp(2 mu + 2 sigma^2)
    square = np.exp(2.0 * (family.constant + family.design @ family.centre))
    square *= np.exp(2.0 * ((family.design * family.spread) ** 2).sum(axis=1))
    return Calibration(
        parameters=parameters,
        terms=(Polynomial(exponents=exponents),),
        coefficients=np.zeros(len(square)),
        covariance=(family.E * square) @ family.E.T,
        noise=Noise(START_NOISE_NT),
        reference=Reference(field),
        method="none",
    )


class BatchFit:
    """Batch fit of all samples since the start, from a prior (K,) of covariance (K, K)."""

    def __init__(self, model: LearnedTerms, coefficients: FloatArray, covariance: FloatArray) -> None:
        self._model, self._prior = model, coefficients
        values, vectors = np.linalg.eigh(covariance)
        # square root L of a prior that may be singular
        seen = values > values[-1] * 1e-14
        self._root = vectors[:, seen] * np.sqrt(values[seen])
        self._samples: list[tuple[Vector, FloatArray, float, Way]] = []
        self._next = FIRST_FIT_SAMPLES

    def add(self, field: Vector, phi: FloatArray, reference: float, way: Way) -> bool:
        """Store a sample with regressors (m,), reference (nT) and way; return True if a fit is due."""
        self._samples.append((field, phi, reference, way))
        if len(self._samples) < self._next:
            return False
        self._next *= 2
        return True

    @property
    def fitted(self) -> bool:
        """Return True if a fit was made; before the fit, the filter is linearised at the prior."""
        return self._next > FIRST_FIT_SAMPLES

    @property
    def is_over(self) -> bool:
        """Return True if there are enough samples to continue with the filters instead."""
        return len(self._samples) >= LAST_FIT_SAMPLES

    def fit(
        self, coefficients: FloatArray, nuisance: Nuisance
    ) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        """Fit all samples, beginning at `coefficients` (K,).

        Return the coefficients (K,), the nuisance after the last sample (4,), the covariance of both
        together, and the 1-sigma noise of a channel, nT.
        """
        c, z = coefficients, np.full(self._root.shape[1], np.inf)
        for _ in range(MAX_GAUSS_NEWTON_STEPS):
            # Gauss-Newton step in the whitened prior's coordinates z, as in the module
            r, J, nuisances, B, Pb = self._whitened(c, nuisance)
            JL = J @ self._root
            H = np.eye(JL.shape[1]) + JL.T @ JL
            before, z = z, np.asarray(np.linalg.solve(H, -JL.T @ (r + J @ (self._prior - c))))
            step = self._prior + self._root @ z - c
            c, nuisances, r = c + step, nuisances + B @ step, r + J @ step
            if float(np.abs(z - before).max()) < MIN_STEP_SIGMA:
                break
        rms = float(np.sqrt(np.mean(r * r)))
        noise = float(np.sqrt(nuisance.white_variance)) * (rms if len(r) >= MIN_SAMPLES_FOR_NOISE else 1.0)
        # joint covariance: the nuisance depends on the coefficients by B, and has Pb of its own
        both = np.vstack([np.eye(len(c)), B])  # coefficients, and the nuisance as it depends on them
        covariance = both @ (self._root @ np.linalg.solve(H, self._root.T)) @ both.T
        covariance[-TRACK_STATES:, -TRACK_STATES:] += Pb
        return c, nuisances, covariance, noise

    def _whitened(
        self, c: FloatArray, nuisance: Nuisance
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return white residuals (n,) and derivatives (n, K); nuisance states, derivatives and covariance."""
        weights = self._model.weights(c)
        n, K = len(self._samples), len(c)
        out = np.empty((n, K + 1))
        states, P = np.zeros((TRACK_STATES, K + 1)), nuisance.initial.copy()
        for k, (field, phi, reference, way) in enumerate(self._samples):
            F, Q = nuisance.transition(*way)
            one = observe(field, phi @ weights, self._model.field, reference)
            row = np.concatenate([[one.e], self._model.derivative(phi, one.by_nine)])
            h = nuisance.row(one.s)
            # Kalman filter of the residual and of every column of J: innovations are white
            P, states = F @ P @ F.T + Q, F @ states
            Ph = P @ h
            S = float(h @ Ph) + nuisance.white_variance
            row += h @ states
            states -= np.outer(Ph / S, row)
            P -= np.outer(Ph / S, Ph)
            out[k] = row / np.sqrt(S)
        return out[:, 0], out[:, 1:], states[:, 0], states[:, 1:], P
