r"""Error of a reference along a track, and autoregressive noise, as states of a Kalman filter.

The field differs from its reference by a constant and by a crustal field along the track. The latter is a
Gauss-Markov process of Matern covariance with smoothness 3/2: its value b and slope b' are two states
(Hartikainen & Sarkka 2010, MLSP, section 4.2). With :math:`\lambda = \sqrt 3 / \ell`,

.. math:: F = e^{-\lambda d}
          \begin{pmatrix} 1 + \lambda d & d \\ -\lambda^2 d & 1 - \lambda d \end{pmatrix}, \quad
          P_\infty = \sigma^2\, \mathrm{diag}(1, \lambda^2), \quad Q = P_\infty - F P_\infty F^T

A fraction of the samples' noise is white; the rest is an AR(1) process, which is the third state. The
constant is the fourth state.

Where the course changes by :math:`\psi`, the slope along the track becomes
:math:`b' \cos\psi + g \sin\psi`. The slope g across the track has the variance of b', and is independent of
b and b' in an isotropic field. So the second column of F is multiplied by :math:`\cos\psi`.
"""

from __future__ import annotations

from math import atan2, cos, exp, hypot, isfinite, nan, sin, sqrt

import numpy as np

from magbridge.arrays import FloatArray

__all__ = [
    "CORRELATION_LENGTH_M",
    "TRACK_STATES",
    "Course",
    "ReferenceSteps",
    "TrackProcess",
    "matern_transition",
]

TRACK_STATES = 4
"""Number of states: crustal field (nT), its slope (nT/m), slow noise (nT), and the constant (nT)."""
CORRELATION_LENGTH_M = 1_000.0
"""Correlation length of the crustal field if no survey provides it."""
MIN_WHITE_NT = 0.05
"""1-sigma of the white noise that every sample has."""
COURSE_LENGTH_M = 10.0
"""Distance over which a course is measured."""


class Course:
    """The course of a track, measured from its displacements.

    `angle`: course over the last completed :data:`COURSE_LENGTH_M`, rad; NaN before the first.
    """

    def __init__(self) -> None:
        self.angle = nan
        self._north = self._east = 0.0

    def move(self, north: float, east: float) -> float:
        """Add a displacement, m; return the change of course, rad, per completed course length, else 0."""
        if not isfinite(north + east):
            return 0.0
        self._north += north
        self._east += east
        if hypot(self._north, self._east) < COURSE_LENGTH_M:
            return 0.0
        before, self.angle = self.angle, atan2(self._east, self._north)
        self._north = self._east = 0.0
        return self.angle - before if isfinite(before) else 0.0


MAX_REFERENCE_STEP_NT = 20.0
STEP_TIME_US = 60_000_000
"""`MAX_REFERENCE_STEP_NT`, `STEP_TIME_US`: The main field changes by less than this step in this time."""


class ReferenceSteps:
    """Detector of steps in a reference along a track that the field lacks, as between two sheets of a map.

    `reference`: the last known reference, nT; NaN before the first.
    `total`: sum of the detected steps, nT.
    """

    def __init__(self) -> None:
        self.reference, self.total = nan, 0.0
        self._time_us = 0

    def follow(self, time_us: int, reference: float) -> None:
        """Compare a sample's reference, nT (NaN if unknown), with the last known; add a step to `total`."""
        if not isfinite(reference):
            return
        step, elapsed_us = reference - self.reference, time_us - self._time_us
        if abs(step) > MAX_REFERENCE_STEP_NT * max(elapsed_us / STEP_TIME_US, 1.0):
            self.total += step
        self.reference, self._time_us = reference, time_us


def matern_transition(rate: float, metres: float) -> tuple[float, float, float, float]:
    """Return the four entries of F of the module's notes, row by row, for `rate` lambda, 1/m."""
    x = min(rate * metres, 300.0)
    fall = exp(-x)
    # lambda = 0: a field that is the same everywhere, as of a flat map
    slope = fall * x / rate if rate else metres
    return fall * (1.0 + x), slope, -fall * rate * x, fall * (1.0 - x)


class TrackProcess:
    """Dynamics of the reference's error along a track.

    Parameters
    ----------
    sensor : float
        1-sigma of a channel's noise, nT.
    spread : float
        1-sigma of the crustal field, nT.
    constant : float
        1-sigma of the constant difference between field and reference, nT.
    length : float
        Correlation length of the crustal field, m.
    autocorrelation, interval : float
        Autocorrelation of the slow noise after `interval` (s); 0 if all noise is white.
    white : float
        Fraction of the noise's variance that is white.
    reference : float
        1-sigma of the reference's own white noise, nT.

    Attributes
    ----------
    spread, constant : float
        1-sigma of the crustal field and of the constant, nT.
    initial : (4, 4) array
        Covariance of the states at the start, and far from any sample.
    white_variance : float
        Variance of the white noise, nT².
    """

    def __init__(
        self,
        sensor: float,
        spread: float,
        constant: float = 0.0,
        length: float = CORRELATION_LENGTH_M,
        autocorrelation: float = 0.0,
        interval: float = 1.0,
        white: float = 0.0,
        reference: float = 0.0,
    ) -> None:
        slow = (1.0 - white) * sensor**2 if autocorrelation > 0.0 else 0.0
        self.spread, self.constant = spread, constant
        self._decay = autocorrelation, interval or 1.0
        self._lambda = sqrt(3.0) / length
        self.initial = np.diag([spread**2, (spread * self._lambda) ** 2, slow, constant**2])
        self.white_variance = max(sensor**2 - slow, MIN_WHITE_NT**2) + reference**2

    def transition(
        self, metres: float, seconds: float, turn: float = 0.0, stretch: float = 1.0
    ) -> tuple[FloatArray, FloatArray]:
        """Return transition F and process noise Q, both (4, 4), over a distance and a time.

        `metres`, `seconds`: distance and time. `turn`: change of course before the distance, rad.
        `stretch`: ratio of `metres` to the true distance, if it is scaled to the field's roughness.
        """
        rho, interval = self._decay
        F = np.zeros((TRACK_STATES, TRACK_STATES))
        F[0, 0], F[0, 1], F[1, 0], F[1, 1] = matern_transition(self._lambda, metres)
        # The slope per scaled metre of a field that is smoother than assumed may be steeper than b'.
        steeper = self.initial[1, 1] * max(stretch**-2 - 1.0, 0.0) * sin(turn) ** 2
        steep = steeper * np.outer(F[:, 1], F[:, 1])
        # Only the slope along the new course is known after a turn.
        F[:, 1] *= cos(turn)
        F[2, 2] = rho ** min(seconds / interval, 1e4) if rho > 0.0 else 0.0
        F[3, 3] = 1.0
        # A stationary process: the process noise restores the initial covariance.
        Q = self.initial - F @ self.initial @ F.T + steep
        return F, np.asarray(0.5 * (Q + Q.T))

    @staticmethod
    def row(scale: float) -> FloatArray:
        """Return the derivatives (4,) of a residual ``(total field - reference) / scale`` by the states."""
        return np.array([-1.0 / scale, 0.0, -1.0, -1.0 / scale])
