"""One hypothesis: filterpy's extended Kalman filter, wrapped once with its shapes fixed."""

from __future__ import annotations

from math import isnan, log, nan, pi
from typing import NamedTuple

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from magbridge.arrays import FloatArray
from magbridge.field.geodesy import metres_per_degree
from magbridge.field.grid import AnomalyGrid
from magbridge.field.local import curvature
from magbridge.navigate.model import N_STATES, Block, measurement_row

__all__ = ["Innovation", "Tracker"]


class Innovation(NamedTuple):
    """Innovation of a measurement: ``value`` nT (or m), ``variance``, log-likelihood, whether it was used.

    Off the map, where there is nothing to compare with, it is NaN and was not used.
    """

    value: float
    variance: float
    log_likelihood: float
    accepted: bool
    anomaly: float = nan  # nT, the map under the position


class Tracker:
    """Extended Kalman filter on the six states of :mod:`~magbridge.navigate.model`.

    ``x`` is (6,), because filterpy's default (6, 1) silently broadcasts a scalar innovation to (6, 6).
    filterpy's update is Joseph's form: the covariance stays symmetric and positive.
    """

    def __init__(self, grid: AnomalyGrid, x: FloatArray, P: FloatArray, gate: float) -> None:
        self._grid, self._gate = grid, gate
        self._filter = ExtendedKalmanFilter(dim_x=N_STATES, dim_z=1)
        self._filter.x, self._filter.P = x.copy(), P.copy()
        self.curvature_variance = 0.0
        """nT², variance that the map's curvature within the spread added to the last measurement's."""

    @property
    def x(self) -> FloatArray:
        """State, (6,)."""
        x: FloatArray = self._filter.x
        return x

    @property
    def P(self) -> FloatArray:  # noqa: N802  the name every filter gives it
        """Covariance, (6, 6)."""
        covariance: FloatArray = self._filter.P
        return covariance

    def predict(self, F: FloatArray, Q: FloatArray) -> None:
        """Propagate by one transition: F and the noise's covariance Q, (6, 6)."""
        self._filter.F, self._filter.Q = F, Q
        self._filter.predict()

    def update(self, block: Block) -> Innovation:
        """Update with one measurement of the field.

        Notes
        -----
        ``h = a(p) + ∇F·δ + b + e m`` and ``R = r + map variance``, both with the contribution of the map's
        curvature (:func:`~magbridge.field.local.curvature`); e as in
        :meth:`~magbridge.field.grid.AnomalyGrid.error`.
        """
        north, east = float(self.x[0]), float(self.x[1])
        per_latitude, per_longitude = metres_per_degree(block.latitude)
        local = self._grid.look_up(
            block.longitude + east / per_longitude, block.latitude + north / per_latitude, block.depth
        )
        if isnan(local.anomaly):
            return Innovation(nan, nan, 0.0, accepted=False)
        (pnn, pne), (_, pee) = self.P[:2, :2].tolist()
        bent, self.curvature_variance = curvature(local, pnn, pne, pee)
        expected = local.anomaly + block.slope_north * north + block.slope_east * east + bent
        errors, independent = self._grid.error(local.variance)
        variance = block.variance + independent + self.curvature_variance
        row = measurement_row(local.north + block.slope_north, local.east + block.slope_east, errors)
        expected += float(self.x[4] + errors * self.x[5])
        innovation = self._observe(block.anomaly, expected, row, variance)
        return innovation._replace(anomaly=local.anomaly)

    def update_position(self, north: float, east: float, sigma: float) -> None:
        """Update with a position fix, m from the dead-reckoned position, with its 1-sigma on each axis."""
        for axis, value in enumerate((north, east)):
            row = np.zeros((1, N_STATES))
            row[0, axis] = 1.0
            self._observe(value, float(self.x[axis]), row, sigma * sigma, gated=False)

    def _observe(
        self, value: float, expected: float, row: FloatArray, variance: float, *, gated: bool = True
    ) -> Innovation:
        y = value - expected
        s = float((row @ self.P @ row.T)[0, 0]) + variance
        accepted = not gated or y * y <= self._gate * s
        if accepted:
            self._filter.update(
                np.array([value]), lambda _: row, lambda _: np.array([expected]), np.array([[variance]])
            )
        likelihood = -0.5 * (min(y * y / s, self._gate) + log(2.0 * pi * s))
        return Innovation(y, s, likelihood, accepted)
