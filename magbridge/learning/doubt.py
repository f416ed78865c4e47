r"""Whether the model still explains the data, and which causes fit where it does not.

The estimator's innovations r are white, of variance S, while the model holds. A cause of amplitude a adds
:math:`\phi a` to them, :math:`\phi` its signature as the filter sees it: the signature f in the residual
and what the filter has already taken in of it (Willsky & Jones 1976, IEEE Trans. Automatic Control 21:108)

.. math:: \phi = f + h \Xi, \qquad \Xi \leftarrow \Xi - k \phi

With :math:`a \sim N(0, I)` in the unit :math:`\tau` of each cause, the log-likelihood ratio over 'nothing' is

.. math:: L = \tfrac12 y^T (I + M)^{-1} y - \tfrac12 \log \det(I + M), \quad
          M = \sum \phi \phi^T / S, \quad y = \sum \phi r / S

a mixture over all sizes, so none needs to be known. Of each cause several onsets are tested, begun anew
every 4, 16, 64 ... samples, and at the first sample that stands out. As L starts from 0, :math:`e^L` is a
martingale of mean 1 each time, and exceeds :math:`e^h` by chance with probability :math:`e^{-h}` at most.
"""

from __future__ import annotations

from math import log, sqrt
from typing import Final, NamedTuple

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.learning.estimator import Estimator

__all__ = ["CAUSES", "Alarm", "Doubt", "Signs"]

CAUSES: Final = {
    "offset_step": 20.0,
    "offset_drift": 20.0,
    "temperature_offset": 2.0,
    "unmodelled_actuator": 20.0,
    "current_field": 20.0,
    "clock_offset": 2.0,
    "map_error": 50.0,
}
"""Cause -> the unit of its amplitude: nT, nT/h, nT/degC, nT a half range, nT/A, s, nT. A bit each in
MAG_LEARNING."""
LEAST: Final = 18.0
"""h, from which on the data are no longer explained. With eight causes there are 2.7 onsets a sample: by
chance once in ``e^18 / 2.7`` samples at most, 3 years of 0.25 Hz, while the noise is as stated.
``tools/live.py`` counts."""
PERIODS: Final = np.array([4, 16, 64, 256, 1024, 4096])
"""Samples after which an onset is replaced by a new one."""
PROMISING: Final = 6.0
"""L from which on it is not."""
STANDS_OUT: Final = 3.0
"""Sigmas of an innovation at which the first onset begins anew."""
FROM_ZERO: Final = ("offset_step", "current_field", "clock_offset", "map_error")
"""Causes that add as much as their regressor, not as much as it has changed since the onset."""
RIVALS: Final = log(20.0)
"""How far behind the best a cause may be, and still fit."""
NOISIER_OVER: Final = 3000
"""Samples over which it is followed how much noisier the innovations are than their sigma."""


class Signs(NamedTuple):
    """What a sample's causes would do to its residual.

    Attributes
    ----------
    time : float
        s.
    offset : (3,) array
        Derivative of the residual by the offset of each axis.
    temperature : float
        degC; NaN where unknown.
    positions : tuple of float
        Parameters, scaled to their range.
    currents : tuple of float
        A; NaN where unknown.
    clock : float
        nT/s: how the residual changes with the telemetry's time.
    level : float
        By the reference's level.
    """

    time: float
    offset: FloatArray
    temperature: float
    positions: tuple[float, ...]
    currents: tuple[float, ...]
    clock: float
    level: float


class Alarm(NamedTuple):
    """The model no longer explains the data.

    Attributes
    ----------
    causes : tuple of str
        Which fit, the likeliest first.
    channels : tuple of str
        The telemetry that each follows; empty for none.
    since : float
        s, when the likeliest began.
    size : float
        nT, root mean square of what it adds to the total field.
    amplitude : float
        nT, of the offset that would be as large: what the estimator has to be opened by.
    strength : float
        L of the likeliest.
    """

    causes: tuple[str, ...]
    channels: tuple[str, ...]
    since: float
    size: float
    amplitude: float
    strength: float


class Doubt:
    """Tests every cause with every sample.

    Parameters
    ----------
    positions, currents : tuple of str
        Names of the parameters, and of telemetry in ampere.
    states : int
        The estimator's.
    """

    def __init__(self, positions: tuple[str, ...], currents: tuple[str, ...], states: int) -> None:
        causes = [("offset_step", ""), ("offset_drift", ""), ("temperature_offset", "sensor_temperature")]
        causes += [("unmodelled_actuator", name) for name in positions]
        causes += [("current_field", name) for name in currents]
        causes += [("clock_offset", ""), ("map_error", "")]
        self.rows = [cause for cause in causes for _ in PERIODS]
        self._period = np.tile(PERIODS, len(causes))
        self._unit = np.array([CAUSES[name] for name, _ in causes])
        self._since_onset = np.array([name not in FROM_ZERO for name, _ in causes], float)
        self._no_vector = np.array([name in ("clock_offset", "map_error") for name, _ in causes])
        self._states, self._noisier = states, 1.0
        self.restart()

    def restart(self) -> None:
        """Forget all evidence; what is known of the noise stays."""
        many = len(self.rows)
        self._M = np.zeros((many, 3, 3))
        self._raw = np.zeros((many, 3, 3))
        self._y = np.zeros((many, 3))
        self._state = np.zeros((self._states, many, 3))
        self._start = np.zeros(many)  # of each row's regressor
        self._onset = np.zeros(many)  # s
        self._count = np.full(many, self._period)
        self.statistic = np.zeros(many)

    def propagate(self, F: FloatArray) -> None:
        """Move what the filter has taken in, as the nuisance's transition F (3, 3) moves it."""
        tail = self._state[-len(F) :]
        self._state[-len(F) :] = np.tensordot(F, tail, 1)

    def test(self, estimator: Estimator, signs: Signs) -> Alarm | None:
        """Test the estimator's prediction; return what no longer fits, if anything."""
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
        amplitude = np.linalg.solve(W, self._y[:, :, None])[:, :, 0]
        self.statistic = 0.5 * np.sum(self._y * amplitude, axis=1) - 0.5 * np.log(np.linalg.det(W))
        if float(self.statistic.max()) > LEAST:
            return self._alarm(np.asarray(amplitude))
        return None

    def updated(self, gain: FloatArray) -> None:
        """Take note that the estimator was updated with `gain` (n,)."""
        self._state -= gain[:, None, None] * self._phi[None]

    def _signatures(self, signs: Signs, stands_out: bool) -> FloatArray:
        """(rows, 3) what one unit of each does to the residual; onsets whose time is over begin anew."""
        now = np.nan_to_num(
            np.array(
                [
                    1.0,
                    signs.time / 3600.0,
                    signs.temperature,
                    *signs.positions,
                    *signs.currents,
                    signs.clock,
                    signs.level,
                ]
            )
        )
        regressor = np.repeat(now, len(PERIODS))
        self._count += 1
        over = (self._count > self._period) & (self.statistic < PROMISING)
        if stands_out:
            over[:: len(PERIODS)] |= self.statistic[:: len(PERIODS)] < PROMISING
        begins = np.flatnonzero(over)
        if begins.size:
            self._M[begins] = self._raw[begins] = 0.0
            self._y[begins] = 0.0
            self._state[:, begins] = 0.0
            self._start[begins], self._onset[begins], self._count[begins] = regressor[begins], signs.time, 1
        regressor -= np.repeat(self._since_onset, len(PERIODS)) * self._start
        f = (regressor * np.repeat(self._unit, len(PERIODS)))[:, None] * signs.offset
        alone = np.repeat(self._no_vector, len(PERIODS))
        f[alone] = 0.0
        f[alone, 0] = (regressor * np.repeat(self._unit, len(PERIODS)))[alone]
        return np.asarray(f)

    def _alarm(self, amplitude: FloatArray) -> Alarm:
        order = np.argsort(-self.statistic, kind="stable").tolist()
        best = order[0]
        fits = [row for row in order if self.statistic[row] > self.statistic[best] - RIVALS]
        named = list(dict.fromkeys(self.rows[row] for row in fits))
        a, n = amplitude[best], float(self._count[best])
        size = sqrt(max(float(a @ self._raw[best] @ a) / n, 0.0))
        spread = float(np.linalg.norm(a)) * CAUSES[self.rows[best][0]]
        return Alarm(
            causes=tuple(dict.fromkeys(cause for cause, _ in named)),
            channels=tuple(channel for _, channel in named),
            since=float(self._onset[best]),
            size=size,
            amplitude=max(size, min(spread, 10.0 * size)),
            strength=float(self.statistic[best]),
        )
