r"""Test whether the model still explains the data, and which causes fit if it does not.

The estimator's innovations r are white, of variance S, while the model holds. A cause of amplitude a adds
:math:`\phi a` to them, :math:`\phi` its signature as the filter sees it: the signature f in the residual
and the part that the filter has already absorbed (Willsky & Jones 1976, IEEE Trans. Automatic Control 21:108)

.. math:: \phi = f + h \Xi, \qquad \Xi \leftarrow \Xi - k \phi

With :math:`a \sim N(0, I)` in the unit :math:`\tau` of each cause, the log-likelihood ratio over 'nothing' is

.. math:: L = \tfrac12 y^T (I + M)^{-1} y - \tfrac12 \log \det(I + M), \quad
          M = \sum \phi \phi^T / S, \quad y = \sum \phi r / S

a mixture over all amplitudes, so none needs to be known. Several onsets are tested for each cause. They
restart every 4, 16, 64 ... samples, and at the first outlying sample. As L starts from 0, :math:`e^L` is a
martingale of mean 1 each time, and exceeds :math:`e^h` by chance with probability :math:`e^{-h}` at most.

A cause is learned by passing the result of its test to the estimator: the amplitude is
:math:`\hat a = (I + M)^{-1} y`, of covariance :math:`(I + M)^{-1}`, and moves the state by
:math:`-G \hat a`, where G contains the part that the filter has absorbed, :math:`\Xi`, and the cause's own
coefficients (Friedland 1969, IEEE Trans. Automatic Control 14:359). If several causes fit, each has a weight
proportional to :math:`e^L`.
"""

from __future__ import annotations

from math import log, sqrt
from typing import Final

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.learning.causes import CAUSE_UNITS, FROM_ZERO, NO_COEFFICIENT, Alarm, Cause, Signs
from magbridge.learning.estimator import Estimator
from magbridge.learning.model import TEMPERATURE, Model

__all__ = ["LEARNING_ALARM_LOG_RATIO", "Doubt"]

LEARNING_ALARM_LOG_RATIO: Final = 18.0
"""Alarm threshold h of the log-likelihood ratio. With eight causes there are 2.7 onsets a sample, so false
alarms come at most once in ``e^18 / 2.7`` samples (3 years of 0.25 Hz) if the noise is as stated.
``tools/live.py`` counts them."""
ONSET_PERIODS: Final = np.array([4, 16, 64, 256, 1024, 4096])
"""Samples after which an onset is replaced by a new one."""
PROMISING: Final = 6.0
"""Log-likelihood ratio L from which on an onset is kept."""
STANDS_OUT: Final = 3.0
"""Size of an innovation, in sigma, at which the first onset restarts."""
MAX_CAUSE_LOG_RATIO: Final = log(20.0)
"""Largest difference of L from the best cause at which another cause still fits."""
NOISIER_OVER: Final = 3000
"""Averaging length, in samples, of the ratio of the innovations' variance to the predicted one."""


class Doubt:
    """Tests every cause with every sample.

    Parameters
    ----------
    model : Model
    estimator : Estimator
        Estimator whose innovations are tested; another that learns from the same samples may replace it.
    """

    def __init__(self, model: Model, estimator: Estimator) -> None:
        self._offsets, self._states, self._origin = estimator.offsets, estimator.states, model.origin
        causes = [
            Cause("offset_step", "", estimator.offsets),
            Cause("offset_drift", "", estimator.slope),
            *(Cause("unmodelled_actuator", name, model.slots(name)) for name in model.parameters),
            Cause("temperature_offset", TEMPERATURE, model.slots(TEMPERATURE)),
            *(Cause("current_field", name, model.slots(name)) for name in model.watched[1:]),
            Cause("clock_offset", "", None),
            Cause("map_error", "", None),
        ]
        self._causes = [cause for cause in causes for _ in ONSET_PERIODS]
        names = [cause.name for cause in self._causes]
        self._period = np.tile(ONSET_PERIODS, len(causes))
        self._unit = np.array([CAUSE_UNITS[name] for name in names])
        self._since_onset = np.array([name not in FROM_ZERO for name in names], float)
        self._no_vector = np.array([name in NO_COEFFICIENT for name in names])
        self._noisier = 1.0
        self.restart()

    def restart(self) -> None:
        """Discard all evidence, but keep the estimate of the noise."""
        many = len(self._causes)
        self._M = np.zeros((many, 3, 3))
        self._raw = np.zeros((many, 3, 3))
        self._y = np.zeros((many, 3))
        self._state = np.zeros((self._states, many, 3))
        self._start = np.zeros(many)  # of each row's regressor
        self._onset = np.zeros(many)  # s
        self._count = np.full(many, self._period)
        self._now = 0.0
        self.statistic = np.zeros(many)
        self._amplitude = np.zeros((many, 3))

    def propagate(self, estimator: Estimator, F: FloatArray, seconds: float) -> None:
        """Propagate the absorbed part by `F` (4, 4), the transition of :meth:`.Estimator.propagate`."""
        estimator.advance(self._state, F, seconds)

    def test(self, estimator: Estimator, signs: Signs) -> Alarm | None:
        """Test the estimator's prediction; return an alarm if a cause exceeds the threshold."""
        S = estimator.variance
        u = estimator.residual / sqrt(S)
        f = self._signatures(signs, abs(u) > STANDS_OUT)
        phi = estimator.response(f.ravel(), self._state.reshape(self._states, -1)).reshape(f.shape)
        self._phi = phi
        self._noisier += (min(u * u, 9.0) - self._noisier) / NOISIER_OVER
        S *= max(1.0, self._noisier)
        self._M += phi[:, :, None] * phi[:, None, :] / S
        self._raw += f[:, :, None] * f[:, None, :]
        self._y += phi * (estimator.residual / S)
        W = self._M + np.eye(3)
        self._amplitude = np.asarray(np.linalg.solve(W, self._y[:, :, None])[:, :, 0])
        self.statistic = 0.5 * np.sum(self._y * self._amplitude, axis=1) - 0.5 * np.log(np.linalg.det(W))
        return self._alarm() if float(self.statistic.max()) > LEARNING_ALARM_LOG_RATIO else None

    def updated(self, gain: FloatArray) -> None:
        """Subtract the part that the estimator absorbed in its update with `gain` (n,)."""
        self._state -= gain[:, None, None] * self._phi[None]

    def _signatures(self, signs: Signs, stands_out: bool) -> FloatArray:
        """Return (rows, 3) residual of one unit of each cause; restart the onsets that have expired."""
        self._now = signs.time
        now = [1.0, signs.time / 3600.0, *signs.positions, *signs.watched, signs.clock, signs.level]
        regressor = np.repeat(np.nan_to_num(np.array(now)), len(ONSET_PERIODS))
        self._count += 1
        over = (self._count > self._period) & (self.statistic < PROMISING)
        if stands_out:
            over[:: len(ONSET_PERIODS)] |= self.statistic[:: len(ONSET_PERIODS)] < PROMISING
        begins = np.flatnonzero(over)
        if begins.size:
            self._M[begins] = self._raw[begins] = 0.0
            self._y[begins] = 0.0
            self._state[:, begins] = 0.0
            self._start[begins], self._onset[begins], self._count[begins] = regressor[begins], signs.time, 1
        amount = (regressor - self._since_onset * self._start) * self._unit
        f = amount[:, None] * signs.offset
        f[self._no_vector] = 0.0
        f[self._no_vector, 0] = amount[self._no_vector]
        return np.asarray(f)

    @property
    def _fitting(self) -> list[int]:
        """The rows that fit, the likeliest first."""
        order = np.argsort(-self.statistic, kind="stable").tolist()
        return [row for row in order if self.statistic[row] > self.statistic[order[0]] - MAX_CAUSE_LOG_RATIO]

    def _alarm(self) -> Alarm:
        fits = self._fitting
        best = fits[0]
        named = list(dict.fromkeys(self._causes[row][:2] for row in fits))
        a, n = self._amplitude[best], float(self._count[best])
        return Alarm(
            causes=tuple(dict.fromkeys(cause for cause, _ in named)),
            channels=tuple(channel for _, channel in named),
            since=float(self._onset[best]),
            size=sqrt(max(float(a @ self._raw[best] @ a) / n, 0.0)),
            strength=float(self.statistic[best]),
        )

    def learned(self) -> tuple[FloatArray, FloatArray] | None:
        """Return the state's shift (n,) by the causes that fit, and its additional covariance (n, n).

        Return None if no coefficient can represent the likeliest cause.
        """
        fits = self._fitting
        if self._causes[fits[0]].states is None:
            return None
        share = np.exp(self.statistic[fits] - self.statistic[fits[0]])
        share /= share.sum()
        by, covariance = np.zeros(self._states), np.zeros((self._states, self._states))
        for weight, row in zip(share.tolist(), fits, strict=True):
            if self._causes[row].states is None:  # it moves no coefficient
                continue
            G, a = self._moves(row), self._amplitude[row]
            V = np.linalg.inv(self._M[row] + np.eye(3)) + np.outer(a, a)
            covariance += weight * G @ V @ G.T
            by -= weight * G @ a
        return by, np.asarray(covariance - np.outer(by, by))

    def _moves(self, row: int) -> FloatArray:
        """(n, 3) G: by what one unit of a row's cause has moved the filter from the truth."""
        cause, unit, start = self._causes[row], float(self._unit[row]), float(self._start[row])
        G = self._state[:, row].copy()
        assert cause.states is not None
        if cause.name == "offset_drift":
            G[cause.states, range(3)] += unit / 3600.0
            G[self._offsets, range(3)] += unit * (self._now / 3600.0 - start)
            return np.asarray(G)
        G[cause.states, range(3)] += unit
        if self._since_onset[row]:
            G[self._offsets, range(3)] -= unit * (start - self._origin(cause.channel))
        return np.asarray(G)
