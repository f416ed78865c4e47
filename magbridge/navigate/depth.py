"""Continue a map to the vehicle's depth; the errors of continuation and interpolation count as map error."""

from __future__ import annotations

from math import hypot

import numpy as np
from msgspec.structs import replace
from numpy.typing import ArrayLike

from magbridge.field.continuation import continued
from magbridge.field.grid import AnomalyGrid
from magbridge.navigate.options import NavigationOptions, with_level

__all__ = ["at_depth", "lasting_errors"]

NEGLIGIBLE_FRACTION = 0.1
"""Fraction of the map error below which what lies between the nodes changes it by less than 1 %."""


def at_depth(
    grid: AnomalyGrid, options: NavigationOptions, depth: ArrayLike
) -> tuple[AnomalyGrid, NavigationOptions]:
    """Return the map at the vehicle's depth, and options whose map error includes what that and nodes cost.

    Parameters
    ----------
    grid : AnomalyGrid
        One of unknown altitude is returned as it is.
    options : NavigationOptions
        Its map error is that of the map as it is.
    depth : array_like, (n,)
        m, the vehicle's; NaN is ignored, and without any depth the map is continued to the surface.

    Notes
    -----
    Independent errors of the map add their variances σᵢ² and the mean squares of their slopes, σᵢ²/Lᵢ², so
    that together 1/L² = Σ(σᵢ²/Lᵢ²) / Σσᵢ². The error between nodes is as long as half their spacing.
    """
    known = np.asarray(depth, float)
    known = known[np.isfinite(known)]
    # Errors of the continued map add to the map's own error as independent ones.
    there = continued(grid, known if known.size else 0.0)
    errors = [(there.sigma, there.length)] if there.sigma else []
    if grid.interpolation_sigma > NEGLIGIBLE_FRACTION * options.map_sigma:
        errors.append((grid.interpolation_sigma, 0.5 * grid.spacing))
    return lasting_errors(there.grid, _added(options, errors) if errors else options)


def lasting_errors(grid: AnomalyGrid, options: NavigationOptions) -> tuple[AnomalyGrid, NavigationOptions]:
    """Return the map and options whose map error has the sigma that lasts from sample to sample.

    A sigma with a ``sigma_length`` is correlated along the track, as the filter's map error is, and the noise
    of a measurement is not. The state is a typical error, the map's median and that of the options; by how
    much it counts at a node, the map's sigma there says, with that of the options in it. The map's level is
    a bias.
    """
    options = with_level(options, grid.level_sigma)
    if grid.level_sigma:
        grid = grid.replaced(level_sigma=0.0)
    typical = float(np.median(grid.sigma[np.isfinite(grid.anomaly)]))
    if not (grid.sigma_length and typical):
        return grid, options
    known = _added(options, [(typical, grid.sigma_length)])
    sigma = np.hypot(grid.sigma, options.map_sigma)
    return grid.replaced(sigma=sigma, sigma_length=0.0, typical_error=known.map_sigma), known


def _added(options: NavigationOptions, errors: list[tuple[float, float]]) -> NavigationOptions:
    """Return options whose map error includes others, of a sigma, nT, and a length, m."""
    whole = [*errors, (options.map_sigma, options.map_length)]
    sigma = hypot(*(sigma for sigma, _ in whole))
    # sigma^2 = sum s_i^2 and (sigma / L)^2 = sum (s_i / L_i)^2.
    steepness = hypot(*(sigma / length for sigma, length in whole))
    return replace(options, map_sigma=sigma, map_length=sigma / steepness)
