r"""Kalman filter in covariance form, for scalar measurements and with considered states.

A measurement y of the state x has the residual :math:`r = e + h^T x`, of which e is known and h is the row of
derivatives. With the covariance P and the noise variance R, innovation v, its variance S and the gain k are

.. math:: v = e + h^T x, \quad S = h^T P h + R, \quad k = P h / S, \quad x \leftarrow x - k v

A state is *considered* (Schmidt 1966, Advances in Control Systems 3:293) if its gain is set to zero: its
uncertainty stays in S, but the measurement does not change it. The covariance update holds for any gain; it
is Joseph's form (Bar-Shalom, Li & Kirubarajan 2001, eq. 5.2.3-18) multiplied out::

    P <- P - k (P h)^T - (P h) k^T + k S k^T

It takes n^2 operations, but variances can cancel in it, unlike in Joseph's form itself. A measurement that
reduces a variance by a factor q leaves a relative error of up to 1e-16 q. So a variance before a measurement
may exceed the noise variance by a factor of up to 1e10.

Covariance form needs no inverse of a prior that is certain of some combinations of states, and the variance
of every prediction is a by-product.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from magbridge.arrays import FloatArray, IndexArray

__all__ = ["KalmanFilter"]


class KalmanFilter:
    """Kalman filter that estimates a state from scalar residuals.

    Parameters
    ----------
    mean : (n,) array
        State at the start.
    covariance : (n, n) array
        Covariance of `mean`.

    Attributes
    ----------
    mean, covariance : (n,), (n, n) arrays
        State and its covariance after the last step.
    innovation, variance : float
        Innovation v of the last measurement and its variance S.
    row : (n,) array
        Derivatives h of the last residual by the state.
    """

    def __init__(self, mean: FloatArray, covariance: FloatArray) -> None:
        self.mean = np.array(mean, float)
        self.covariance = np.array(covariance, float)
        self.innovation, self.variance = 0.0, 1.0
        self.row = np.zeros(len(self.mean))
        self._Ph = np.zeros(len(self.mean))

    def predict(
        self,
        transition: FloatArray,
        noise: FloatArray | None = None,
        states: slice | IndexArray | None = None,
    ) -> None:
        """Propagate some states in time, by ``x <- F x`` and ``P <- F P F^T + Q``.

        `transition` (m, m): F, of the `states`. `noise` (m, m): Q, covariance of the process noise. `states`
        (m,): the states that F moves; by default all.
        """
        chosen = slice(None) if states is None else states
        # Only the rows and columns of the chosen states change; the others are constant.
        P = self.covariance
        self.mean[chosen] = transition @ self.mean[chosen]
        P[chosen] = transition @ P[chosen]
        P[:, chosen] = P[:, chosen] @ transition.T
        if noise is not None:
            block = np.ix_(states, states) if isinstance(states, np.ndarray) else (chosen, chosen)
            P[block] += noise

    def innovate(self, residual: float, row: FloatArray, noise: float) -> float:
        """Compare a measurement with its prediction; set innovation and variance, and return the innovation.

        `residual`: e, the part of the residual that does not depend on the state linearly. `row` (n,): h,
        derivatives of the residual by the state. `noise`: R, variance of the measurement's noise.
        """
        self.row = row
        # S = h^T P h + R and v = e + h^T x; P h serves the gain as well.
        self._Ph = self.covariance @ row
        self.variance = float(row @ self._Ph) + noise
        self.innovation = residual + float(row @ self.mean)
        return self.innovation

    def update(self, considered: slice | IndexArray | None = None) -> FloatArray:
        """Update the state with the last measurement and return the gain (n,).

        `considered`: states that the measurement must not change.
        """
        # K = P h / S; considered states keep their mean, but their covariance stays in S (Schmidt 1966).
        gain = self._Ph / self.variance
        if considered is not None:
            gain[considered] = 0.0
        self.mean -= gain * self.innovation
        # Joseph's form multiplied out: it holds for a gain that is not the optimal one
        cross = np.outer(gain, self._Ph)
        self.covariance -= cross
        self.covariance -= cross.T
        self.covariance += np.outer(self.variance * gain, gain)
        return np.asarray(gain)

    @property
    def sigma(self) -> float:
        """1-sigma of the innovation, in the measurement's unit."""
        return sqrt(self.variance)
