r"""Continuation of a field to another height, with an error estimate.

A map is flown in the air, or continued to one altitude above the sea; the vehicle is below. Every wave of a
field whose sources lie deeper decays with height (Blakely 1995, eq. 12.8),

.. math:: \hat T(\mathbf k, z + h) = \hat T(\mathbf k, z)\, e^{-|\mathbf k| h} .

Downward, the inverse would amplify waves that the survey did not resolve. With p = 1 - exp(-|k| h) it is a
series, exp(|k| h) = 1 / (1 - p) = 1 + p + p² + ...: its first three terms, which are used, at most treble
the map's own noise; the terms after them are counted as error. Above and below the level reached, the field
is extrapolated by its vertical gradient, of spectrum |k| T.
"""

from __future__ import annotations

from collections.abc import Callable
from math import isfinite, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from magbridge.arrays import FloatArray
from magbridge.field.geodesy import metres_per_degree
from magbridge.field.grid import AnomalyGrid
from magbridge.field.spline import filled

__all__ = ["Continued", "continued", "raised", "smoothed"]

SURE, TERMS = 3, 10
"""Terms of the series that are used, and terms that stand for the true field when the error is estimated:
later ones are waves that no survey from above resolves."""
DEPTH_QUANTILES = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Quantiles of the depth at which the error is estimated."""


class Continued(NamedTuple):
    """A grid at another height, and the error of the continuation."""

    grid: AnomalyGrid
    sigma: float
    """1-sigma of what the continuation leaves out, nT; 0 upward to one level."""
    length: float
    """Correlation length of that error, m: at short distances its correlation falls as exp(-r²/2 length²)."""


def continued(grid: AnomalyGrid, depth: ArrayLike) -> Continued:
    """Return a grid continued to the mean depth, with its vertical gradient there; holes stay holes.

    `depth` (n,): all depths at which the grid will be used, m below the surface; negative is above. A grid of
    unknown altitude is returned unchanged.

    Notes
    -----
    The cosine transform mirrors the field at its edges, so that the wrap-around joins equal values. With the
    error's spectrum E(k), sigma² is the mean of |E|², and length² = 2 sigma² / mean of |k E|².
    """
    from scipy.fft import dctn, idctn  # noqa: PLC0415 - the live path runs without scipy

    used = np.asarray(depth, float)
    level = float(used.mean())
    # Continue to the mean depth, and keep the vertical slope for depths about it.
    height = grid.altitude + level  # downward
    if not isfinite(height):
        return Continued(grid, 0.0, float("inf"))
    # Laplace: a component of wave number k grows as exp(k h) downward.
    k = _wavenumber(grid)
    surveyed = dctn(filled(grid.anomaly), norm="ortho")
    gain = _growth(k, height, SURE)
    # Spectrum of the error: what the truncated series and the linear term leave, over quantiles of depth.
    error2 = np.zeros_like(k)
    for below in np.quantile(used, DEPTH_QUANTILES) - level:
        linear = gain * (1 + k * below)
        error2 += (surveyed * (_growth(k, height + below, TERMS) - linear)) ** 2 / len(DEPTH_QUANTILES)
    hole = np.isnan(grid.anomaly)
    anomaly, vertical = (np.where(hole, np.nan, idctn(surveyed * g, norm="ortho")) for g in (gain, k * gain))
    there = grid.replaced(anomaly=anomaly, altitude=-level, vertical=filled(vertical))
    # Parseval: mean square of the error and of its slope.
    sigma2, steepness2 = float(error2.mean()), float((k * k * error2).mean())
    return Continued(there, sqrt(sigma2), sqrt(2 * sigma2 / steepness2) if steepness2 else float("inf"))


def raised(grid: AnomalyGrid, altitude: float) -> Callable[[FloatArray], FloatArray]:
    """Return a function that continues values (ny, nx), nT, on a grid's nodes to another altitude, m."""
    from scipy.fft import dctn, idctn  # noqa: PLC0415 - the live path runs without scipy

    gain = _growth(_wavenumber(grid), grid.altitude - altitude, SURE)
    return lambda values: np.asarray(idctn(dctn(filled(values), norm="ortho") * gain, norm="ortho"))


SIGN_WAVELENGTH_FRACTION = 0.25
"""Fraction of the smoothed wavelength within which the removed part has one sign."""


def smoothed(grid: AnomalyGrid, wavelength: float) -> AnomalyGrid:
    """Return a grid without its short waves; the removed part counts as its sigma. Holes stay holes.

    A wave of `wavelength` (m) keeps half its amplitude, one of twice that 84 %, one of half that 6 %.

    Notes
    -----
    The cosine transform's terms are multiplied by ``2^-(k λ / 2π)²``, a Gaussian. The sigma added is the RMS
    of the removed part, over the map: around a node it is that of a wave or two, and chance.
    """
    from scipy.fft import dctn, idctn  # noqa: PLC0415 - the live path runs without scipy

    gain = np.exp2(-((_wavenumber(grid) * wavelength / (2.0 * np.pi)) ** 2))
    hole = np.isnan(grid.anomaly)
    anomaly = np.where(hole, np.nan, idctn(dctn(filled(grid.anomaly), norm="ortho") * gain, norm="ortho"))
    # The removed part is an error of the smoothed map, correlated over a fraction of the wavelength.
    removed = np.sqrt(np.nanmean((grid.anomaly - anomaly) ** 2))
    sigma = np.hypot(np.nan_to_num(grid.sigma), removed)
    length = max(grid.sigma_length, SIGN_WAVELENGTH_FRACTION * wavelength)
    return grid.replaced(anomaly=anomaly, sigma=sigma, vertical=None, sigma_length=length)


def _growth(k: FloatArray, height: float, terms: int) -> FloatArray:
    """Return exp(k height), downward the first `terms` of its series."""
    if height <= 0:
        return np.asarray(np.exp(k * height))
    # exp(k h) = 1 / (1 - p) = 1 + p + p^2 + ...: the first terms amplify noise least.
    p = -np.expm1(-k * height)
    return np.asarray((1 - p**terms) / (1 - p))


def _wavenumber(grid: AnomalyGrid) -> FloatArray:
    """Return |k| (ny, nx), rad/m, of the cosine transform's terms."""
    per_latitude, per_longitude = metres_per_degree(float(np.mean(grid.latitude)))
    ny, nx = grid.anomaly.shape
    # The cosine transform mirrors the grid: half waves over its sides.
    height = ny * per_latitude * (grid.latitude[1] - grid.latitude[0])
    width = nx * per_longitude * (grid.longitude[1] - grid.longitude[0])
    return np.asarray(np.hypot(np.pi / height * np.arange(ny)[:, None], np.pi / width * np.arange(nx)))
