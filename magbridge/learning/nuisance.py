r"""What moves the residual and is not the calibration's: the rock's field, and the noise's memory.

The field differs from its reference by a level, the same all over, for some rock is larger than any survey,
and by rock along the track. That is a Gauss-Markov process, of Matern's covariance with smoothness 3/2: its
value b and its slope b' are two states (Hartikainen & Sarkka 2010, MLSP, section 4.2), with
:math:`\lambda = \sqrt 3 / \ell`

.. math:: F = e^{-\lambda d}
          \begin{pmatrix} 1 + \lambda d & d \\ -\lambda^2 d & 1 - \lambda d \end{pmatrix}, \quad
          P_\infty = \sigma^2\, \mathrm{diag}(1, \lambda^2), \quad Q = P_\infty - F P_\infty F^T

The noise of the samples is white in the share f and an AR(1) process in the rest: that is the third state,
and the level the fourth.
"""

from __future__ import annotations

from math import exp, sqrt

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.model import Noise

__all__ = ["STATES", "Nuisance"]

STATES = 4
"""Rock's value (nT) and slope (nT/m), the slow part of the noise, and the level (nT)."""
LENGTH = 1_000.0
"""m over which rock changes: what a survey finds where it is not told (as :mod:`magbridge.survey` finds)."""
QUIETEST = 0.05
"""nT, 1-sigma: white noise that every sample has."""


class Nuisance:
    """The states' dynamics.

    Parameters
    ----------
    noise : Noise
        The calibration's.
    spread : float
        nT, 1-sigma of the rock.
    level : float
        nT, 1-sigma of the level.
    length : float
        m.

    Attributes
    ----------
    spread, level : float
        As given.
    initial : (4, 4) array
        Covariance at the start, and far from any sample.
    white : float
        nT², variance of the noise that has no memory.
    """

    def __init__(self, noise: Noise, spread: float, level: float = 0.0, length: float = LENGTH) -> None:
        slow = (1.0 - noise.white) * noise.sensor**2 if noise.autocorrelation > 0.0 else 0.0
        self.spread, self.level = spread, level
        self._decay = noise.autocorrelation, noise.interval or 1.0
        self._lambda = sqrt(3.0) / length
        self.initial = np.diag([spread**2, (spread * self._lambda) ** 2, slow, level**2])
        self.white = max(noise.sensor**2 - slow, QUIETEST**2) + noise.reference**2

    def over(self, metres: float, seconds: float) -> tuple[FloatArray, FloatArray]:
        """Return transition F and process noise Q, both (4, 4), over a way and a time."""
        rate = self._lambda
        x = min(rate * metres, 300.0)
        rho, interval = self._decay
        F = np.zeros((STATES, STATES))
        fall = exp(-x)
        F[0, 0], F[0, 1] = fall * (1.0 + x), fall * x / rate
        F[1, 0], F[1, 1] = -fall * rate * x, fall * (1.0 - x)
        F[2, 2] = rho ** min(seconds / interval, 1e4) if rho > 0.0 else 0.0
        F[3, 3] = 1.0
        Q = self.initial - F @ self.initial @ F.T
        return F, np.asarray(0.5 * (Q + Q.T))

    @staticmethod
    def row(s: float) -> FloatArray:
        """Return the residual's derivatives (4,) by the states, s being the residual's scale."""
        return np.array([-1.0 / s, 0.0, -1.0, -1.0 / s])
