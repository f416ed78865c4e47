r"""Sequential test of a Kalman filter's innovations for changes of unknown onset, amplitude and kind.

While its model holds, a filter's innovations v are white, of variance S. A change of amplitude a adds
:math:`\phi^T a` to them. Here :math:`\phi` is the signature in the innovation. It is the signature f in the
residual plus the effect of the change :math:`\Xi` that the filter has already absorbed in its state (Willsky
& Jones 1976, IEEE Trans. Automatic Control 21:108),

.. math:: \phi = f + \Xi^T h, \qquad \Xi \leftarrow \Xi - k \phi^T

With :math:`a \sim N(0, I)` in the unit of each change, the log-likelihood ratio of 'change' over 'no change'
is

.. math:: L = \tfrac12 y^T (I + M)^{-1} y - \tfrac12 \log \det(I + M), \quad
          M = \sum \phi \phi^T / S, \quad y = \sum \phi v / S

It is a mixture over all amplitudes, so the test needs no amplitude. Each kind of change is tested with
several onsets at a time. They restart after 4, 16, 64 ... measurements. As L starts from 0, :math:`e^L` is a
martingale of mean 1 each time, and it exceeds :math:`e^h` by chance with a probability of at most
:math:`e^{-h}` (Ville's inequality). An onset that an outstanding innovation begins does not start with a mean
of 1, because it includes the innovation that chose it. :data:`ALARM_LOG_RATIO` allows for this.

Where S is known up to a factor c only, c has an inverse chi-squared distribution with :math:`\nu` degrees of
freedom, and the amplitude the conjugate prior :math:`a \sim N(0, c\,I)`: in noisier data, larger changes are
expected. The factor is then integrated out in closed form. With the n normalised squares
:math:`V = \sum v^2 / S` since the onset,

.. math:: L = \frac{\nu + n}{2} \log \frac{\nu + V}{\nu + V - y^T (I + M)^{-1} y}
          - \tfrac12 \log \det(I + M)

The estimated amplitude is :math:`\hat a = (I + M)^{-1} y`, of covariance :math:`(I + M)^{-1}`;
with an unknown factor, times its estimate :math:`(\nu + V - y^T \hat a) / (\nu + n)`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from magbridge.arrays import BoolArray, FloatArray, IndexArray
from magbridge.estimation.kalman import KalmanFilter

__all__ = ["ALARM_LOG_RATIO", "RESTART_PERIODS", "SequentialTest"]

ALARM_LOG_RATIO: Final = 18.0
"""Threshold h of L. Eight kinds of change start 2.7 scheduled onsets a measurement. Onsets at outstanding
innovations count up to 0.56 more for each kind, the largest mean of e^L at such a start. So false alarms
come at most once in ``e^18 / 7.1`` measurements, 1.1 years at 0.25 Hz, if the noise is as stated."""
RESTART_PERIODS: Final = np.array([4, 16, 64, 256, 1024, 4096])
"""Measurements after which an onset is replaced by a new one."""
PROMISING_LOG_RATIO: Final = 6.0
"""Smallest L at which an onset is not replaced."""
OUTSTANDING_SIGMA: Final = 3.0
"""Normalised innovation at which the shortest onset restarts."""
EXCESS_NOISE_SAMPLES: Final = 3000
"""Measurements over which the ratio of the innovations' variance to S is estimated."""
MAX_INNOVATION_SIGMA: Final = 8.0
"""Largest normalised innovation for which S is used as it is; for a larger one, S is increased."""
MAX_SQUARED_INNOVATION: Final = 9.0
"""Largest normalised squared innovation that enters the estimate of the ratio of variances."""


UNIT_MATRIX = np.eye(3)


class SequentialTest:
    """Sequential test for several kinds of change, each with several onsets.

    Parameters
    ----------
    since_onset : sequence of bool
        One for each kind of change: True if its effect is proportional to the regressor's change since the
        onset, False if it is proportional to the regressor.
    states : int
        Number of states n of the filter.
    retention_samples : float
        Measurements over which evidence is forgotten; infinite by default.
    noise_dof : float
        Degrees of freedom of the factor of S, if S is known up to a factor; 0 if S is known.

    Attributes
    ----------
    kind : (rows,) int array
        Kind of change of each row; each onset of a kind is a row.
    onset : (rows,) array
        Time of each row's onset, s.
    start : (rows,) array
        Regressor of each row at its onset; 0 where the effect is proportional to the regressor.
    log_ratio : (rows,) array
        L.
    amplitude : (rows, 3) array
        Estimated amplitudes.
    signature : (rows, 3) array
        f, the change of the last residual per unit of each component.
    absorbed : (n, rows, 3) array
        Xi, the change of the filter's state per unit of each component.
    """

    def __init__(
        self,
        since_onset: Sequence[bool],
        states: int,
        retention_samples: float = np.inf,
        noise_dof: float = 0.0,
    ) -> None:
        onsets = len(RESTART_PERIODS)
        self.kind: IndexArray = np.repeat(np.arange(len(since_onset)), onsets)
        self._since_onset = np.repeat(np.array(since_onset, bool), onsets)
        self._period = np.tile(RESTART_PERIODS, len(since_onset))
        self._states, self._keep = states, 1.0 - 1.0 / retention_samples
        self._excess, self._dof = 1.0, noise_dof
        self.restart()

    def restart(self, states: int | None = None) -> None:
        """Discard all evidence, but keep the estimate of the excess noise.

        `states`: new number of states of the filter; by default it stays.
        """
        self._states = self._states if states is None else states
        rows = len(self.kind)
        self._M, self._energy = np.zeros((rows, 3, 3)), np.zeros((rows, 3, 3))
        self._y = np.zeros((rows, 3))
        self._squares, self._samples = np.zeros(rows), np.zeros(rows)
        self.absorbed = np.zeros((self._states, rows, 3))
        self._phi, self.signature = np.zeros((rows, 3)), np.zeros((rows, 3))
        self.onset, self.start = np.zeros(rows), np.zeros(rows)
        self.count = self._period.copy()
        self.log_ratio = np.zeros(rows)
        self.amplitude = np.zeros((rows, 3))

    def test(
        self,
        estimator: KalmanFilter,
        time: float,
        regressors: FloatArray,
        effects: FloatArray,
    ) -> float:
        """Test the filter's innovation and return the largest L.

        `estimator`: the filter, after :meth:`.KalmanFilter.innovate` and before its update. `time`: time of
        the measurement, s. `regressors` (kinds,): regressor of each kind of change. `effects` (kinds, 3):
        change of the residual per unit of each component where the regressor is 1.
        """
        S, v = estimator.variance, estimator.innovation
        regressor, effect = regressors[self.kind], effects[self.kind]
        # response of the innovation to a unit change: the signature less what the filter has absorbed
        absorbed = np.dot(estimator.row[None], self.absorbed.reshape(self._states, -1)).reshape(-1, 3)
        phi = (regressor - self.start)[:, None] * effect + absorbed
        residual = v - np.sum(phi * self.amplitude, axis=1)
        begins = self._begin(time, residual / estimator.sigma)
        self.start = np.where(begins & self._since_onset, regressor, self.start)
        self.signature = (regressor - self.start)[:, None] * effect
        self._phi = phi = np.where(begins[:, None], self.signature, phi)
        if self._dof:
            S = max(S, (v / MAX_INNOVATION_SIGMA) ** 2)
        else:
            squared = min(v * v / S, MAX_SQUARED_INNOVATION)
            self._excess += (squared - self._excess) / EXCESS_NOISE_SAMPLES
            S *= max(1.0, self._excess)
        # exponential forgetting of old evidence
        if self._keep < 1.0:
            self._M *= self._keep
            self._y *= self._keep
            self._squares *= self._keep
            self._samples *= self._keep
        # information of each row's amplitude: M = sum phi phi^T / S, y = sum phi v / S
        self._M += phi[:, :, None] * phi[:, None, :] / S
        self._energy += self.signature[:, :, None] * self.signature[:, None, :]
        self._y += phi * (v / S)
        self._squares += v * v / S
        self._samples += 1.0
        self.amplitude, self.log_ratio = self._mixture()
        return float(self.log_ratio.max())

    def _begin(self, time: float, residual: FloatArray) -> BoolArray:
        """Restart the onsets whose period is over; return a mask (rows,) of the restarted rows.

        `residual` (rows,): innovation minus the effect of each row's change, normalised.
        """
        self.count += 1
        # an onset is replaced after its period, unless its change is likely; an innovation that no change
        # explains begins a new onset at once in the shortest period
        unpromising = self.log_ratio < PROMISING_LOG_RATIO
        outstanding = (np.abs(residual) > OUTSTANDING_SIGMA) & (self._period == RESTART_PERIODS[0])
        begins = ((self.count > self._period) | outstanding) & unpromising
        if begins.any():
            for evidence in (self._M, self._energy, self._y, self._squares, self._samples):
                evidence[begins] = 0.0
            self.absorbed[:, begins] = 0.0
            self.onset[begins], self.count[begins] = time, 1
        return np.asarray(begins)

    def _mixture(self) -> tuple[FloatArray, FloatArray]:
        """Return the estimated amplitudes (rows, 3) and L (rows,)."""
        W = self._M + UNIT_MATRIX
        amplitude = np.linalg.solve(W, self._y[:, :, None])[:, :, 0]
        explained = np.sum(self._y * amplitude, axis=1)
        if self._dof:
            squares = self._dof + self._squares
            ratio = (
                0.5 * (self._dof + self._samples) * np.log(squares / np.maximum(squares - explained, 1e-9))
            )
        else:
            ratio = 0.5 * explained
        return np.asarray(amplitude), np.asarray(ratio - 0.5 * np.log(np.linalg.det(W)))

    def update(self, gain: FloatArray) -> None:
        """Record that the filter was updated with `gain` (n,)."""
        self.absorbed -= gain[:, None, None] * self._phi[None]

    def covariance(self, row: int) -> FloatArray:
        """Return the covariance (3, 3) of a row's amplitude."""
        covariance = np.linalg.inv(self._M[row] + np.eye(3))
        if self._dof:  # the factor of S: its estimate from the innovations that the change leaves
            left = self._dof + self._squares[row] - self._y[row] @ self.amplitude[row]
            covariance *= left / (self._dof + self._samples[row])
        return np.asarray(covariance)

    def rms(self, row: int) -> float:
        """Return the root mean square of the effect of a row's change on the residual."""
        a = self.amplitude[row]
        return float(np.sqrt(max(float(a @ self._energy[row] @ a) / float(self.count[row]), 0.0)))

    def misfit(self, row: int) -> float:
        """Return the mean normalised square of innovations minus a row's change; 1 if only noise is left."""
        explained = float(self._y[row] @ self.amplitude[row])
        return (float(self._squares[row]) - explained) / max(float(self._samples[row]), 1.0)

    def competing(self, distance: float) -> tuple[list[int], FloatArray]:
        """Return the rows whose L is within `distance` of the largest, likeliest first, and weights (n,).

        The weights are the posterior probabilities of these rows, if all were equally likely before.
        """
        order = np.argsort(-self.log_ratio, kind="stable")
        rows = order[self.log_ratio[order] > self.log_ratio[order[0]] - distance]
        weights = np.exp(self.log_ratio[rows] - self.log_ratio[rows[0]])
        return rows.tolist(), np.asarray(weights / weights.sum())
