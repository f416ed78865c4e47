"""A map continued to the vehicle's depth; the error of the continuation counts as map error."""

from __future__ import annotations

from math import hypot

import numpy as np
from msgspec.structs import replace
from numpy.typing import ArrayLike

from magbridge.field.continuation import continued
from magbridge.field.grid import AnomalyGrid
from magbridge.navigate.options import Options

__all__ = ["at_depth"]


def at_depth(grid: AnomalyGrid, options: Options, depth: ArrayLike) -> tuple[AnomalyGrid, Options]:
    """Return the map at the vehicle's depth, and options whose map error includes the continuation's.

    Parameters
    ----------
    grid : AnomalyGrid
        One of unknown altitude is returned as it is.
    options : Options
        Its map error is that of the map as it is.
    depth : array_like, (n,)
        m, the vehicle's; NaN is ignored, and without any depth the map is continued to the surface.

    Notes
    -----
    Independent errors of the map add their variances σᵢ² and the mean squares of their slopes, σᵢ²/Lᵢ², so
    that together 1/L² = Σ(σᵢ²/Lᵢ²) / Σσᵢ².
    """
    known = np.asarray(depth, float)
    known = known[np.isfinite(known)]
    there = continued(grid, known if known.size else 0.0)
    if there.sigma == 0.0:
        return there.grid, options
    sigma = hypot(options.map_sigma, there.sigma)
    steepness = hypot(options.map_sigma / options.map_length, there.sigma / there.length)
    return there.grid, replace(options, map_sigma=sigma, map_length=sigma / steepness)
