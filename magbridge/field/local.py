"""A map around a place: value, slope and curvature, and what curvature does under a position's spread."""

from __future__ import annotations

from math import nan
from typing import Generic, NamedTuple, TypeVar

from magbridge.arrays import FloatArray

__all__ = ["OFF_THE_MAP", "Local", "T", "curvature"]

T = TypeVar("T", float, FloatArray)


class Local(NamedTuple, Generic[T]):
    """The map around one place or n places; NaN outside the map and in its holes.

    ``anomaly`` nT; ``north``, ``east`` nT/m, its gradient; ``north_north``, ``north_east``, ``east_east``
    nT/m², its Hessian; ``variance`` nT², of the map's own error there.
    """

    anomaly: T
    north: T
    east: T
    north_north: T
    north_east: T
    east_east: T
    variance: T


OFF_THE_MAP: Local[float] = Local(nan, nan, nan, nan, nan, nan, nan)


def curvature(local: Local[T], nn: T, ne: T, ee: T) -> tuple[T, T]:
    """Return what curvature adds to mean (nT) and variance (nT²) of the map under a position's spread.

    Parameters
    ----------
    local : Local
        The map at the position's mean.
    nn, ne, ee : float or (n,) array
        m², covariance P of the position.

    Notes
    -----
    ``tr(C P)/2`` and ``tr((C P)²)/2``, C the Hessian (second-order filter; Bar-Shalom et al. 2001, 10.3).
    """
    a, b = local.north_north * nn + local.north_east * ne, local.north_north * ne + local.north_east * ee
    c, d = local.north_east * nn + local.east_east * ne, local.north_east * ne + local.east_east * ee
    return 0.5 * (a + d), 0.5 * (a * a + 2.0 * b * c + d * d)
