"""The main field near a place by a quadratic fit, for filters that need it at every sample.

The IGRF's shortest wave is 3,000 km, so over some tens of kilometres and a dive a quadratic is exact to a
thousandth of a nanotesla, at a hundredth of the cost of the series.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from magbridge.field.geodesy import offset, separation
from magbridge.field.igrf import coverage, total_field

__all__ = ["HeldField", "NearbyField"]


BOX_HALF_WIDTH_M = 20_000.0
"""m from the middle of the box to its edge."""
DEEP = 2_000.0
"""Depth up to which it is fitted, m."""
FITTED_TIME_S = 20 * 86_400.0
"""s before and after the time that it is fitted at."""


CACHE_TIME_US = 1_000_000
"""Time after which the field at the same place is computed again, µs."""


class HeldField:
    """Intensity of the main field at a vehicle's positions as they come: live and ashore the same bits."""

    def __init__(self) -> None:
        self._model = NearbyField()
        self._where = (np.nan, np.nan, np.nan)
        self._when_us, self._field = 0, np.nan

    def field_at(self, position: tuple[float, float, float], utc_us: int) -> float:
        """Return the total field in nT; a value computed for this place less than a second ago is reused.

        Parameters
        ----------
        position : tuple of 3 float
            deg, deg, m: latitude, longitude, depth.
        utc_us : int
            µs since 1970 UTC.

        Raises
        ------
        OutOfRange
            As :func:`~magbridge.field.igrf.total_field`.
        """
        if position != self._where or abs(utc_us - self._when_us) > CACHE_TIME_US:
            self._field = self._model.field_and_slopes(*position, utc_us * 1e-6)[0]
            self._where, self._when_us = position, utc_us
        return self._field


class NearbyField:
    """Intensity of the main field around a moving vehicle; :meth:`field_and_slopes` refits it on the way."""

    def __init__(self) -> None:
        self._middle = (np.nan, np.nan, np.nan)  # latitude, longitude, time
        self._c = [0.0] * 11

    def field_and_slopes(
        self, latitude: float, longitude: float, depth: float, time: float
    ) -> tuple[float, float, float]:
        """Return the total field (nT) and its slopes north and east (nT/m).

        Parameters
        ----------
        latitude, longitude : float
            deg.
        depth : float
            m below the surface.
        time : float
            s since 1970 UTC.

        Raises
        ------
        OutOfRange
            As :func:`~magbridge.field.igrf.total_field`.
        """
        north, east = separation(self._middle[0], self._middle[1], latitude, longitude)
        later = time - self._middle[2]
        if not (
            abs(north) < BOX_HALF_WIDTH_M and abs(east) < BOX_HALF_WIDTH_M and abs(later) < FITTED_TIME_S
        ):
            self._fit(latitude, longitude, time)
            north = east = later = 0.0
        # Quadratic in north, east and depth, linear in time; all scaled to the box.
        n, e, d, t = north / BOX_HALF_WIDTH_M, east / BOX_HALF_WIDTH_M, depth / DEEP, later / FITTED_TIME_S
        c0, cn, ce, cd, ct, cnn, cee, cdd, cne, cnd, ced = self._c
        field = (
            c0 + n * (cn + n * cnn + e * cne + d * cnd) + e * (ce + e * cee + d * ced) + d * (cd + d * cdd)
        )
        # Partial derivatives of the polynomial.
        slope_north = cn + 2.0 * n * cnn + e * cne + d * cnd
        slope_east = ce + 2.0 * e * cee + n * cne + d * ced
        return field + t * ct, slope_north / BOX_HALF_WIDTH_M, slope_east / BOX_HALF_WIDTH_M

    def _fit(self, latitude: float, longitude: float, time: float) -> None:
        """Fit the eleven coefficients to the series on 81 nodes."""
        # Least squares on a 3 x 3 x 3 x 3 lattice.
        nodes = np.array(list(product((-1.0, 0.0, 1.0), repeat=4)))
        n, e, d, t = nodes.T
        places = np.array(
            [offset(latitude, longitude, a * BOX_HALF_WIDTH_M, b * BOX_HALF_WIDTH_M) for a, b in nodes[:, :2]]
        )
        times = (
            np.clip(time + t * FITTED_TIME_S, *coverage()) if coverage()[0] <= time <= coverage()[1] else time
        )
        field = total_field(places[:, 1], np.clip(places[:, 0], -90.0, 90.0), d * DEEP, times)
        later = (times - time) / FITTED_TIME_S
        design = np.stack([n**0, n, e, d, later, n * n, e * e, d * d, n * e, n * d, e * d], axis=1)
        self._c = np.linalg.lstsq(design, field, rcond=None)[0].tolist()
        self._middle = (latitude, longitude, time)
