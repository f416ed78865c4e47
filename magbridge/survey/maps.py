"""From a gridded survey to an anomaly map on even longitudes and latitudes."""

from __future__ import annotations

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.field.continuation import continued, raised
from magbridge.field.geodesy import metres_per_degree
from magbridge.field.grid import AnomalyGrid
from magbridge.survey.gridded import Gridded
from magbridge.survey.samples import Samples

__all__ = ["anomaly_map"]

A_LENGTH = 8.0
"""Nodes of a map to one length of its field."""
MAX_MAP_NODES = 250_000
"""Nodes of a map at most, unless a spacing is asked for."""
DRAWN_FIELDS = 100
"""Fields by which the sigma of a continued map is found: to 7 %."""
MAX_SIGMA_FRACTION = 0.95
"""Fraction of the field's size at which the sigma counts as unknown, and the map has a hole."""


def anomaly_map(
    gridded: Gridded,
    samples: Samples,
    *,
    spacing: float | None = None,
    altitude: float | None = None,
    name: str = "survey",
) -> AnomalyGrid:
    """Return the map of a survey, at its own height or continued upward.

    Parameters
    ----------
    gridded : Gridded
        The survey.
    samples : Samples
        That it was made of.
    spacing : float, optional
        m between nodes; an eighth of the field's length if not given.
    altitude : float, optional
        m above the ellipsoid. Downward, what the series leaves out counts in the sigma.
    name : str
        Of the map.
    """
    places = gridded.field.nodes.places
    inner = places[gridded.field.nodes.covers(places)]
    low, high = inner.min(axis=0), inner.max(axis=0)
    step = spacing or max(
        gridded.field.length / A_LENGTH, float(np.sqrt(np.prod(np.maximum(high - low, 1.0)) / MAX_MAP_NODES))
    )
    north, east = (np.arange(low[k], max(high[k], low[k] + 3.5 * step) + step, step) for k in range(2))
    at = np.stack(np.meshgrid(north, east, indexing="ij"), axis=-1).reshape(-1, 2)
    anomaly, sigma = gridded.evaluate(at)
    size = gridded.size * gridded.roughness.evaluate(at)
    hole = ~gridded.field.nodes.covers(at) | (sigma > MAX_SIGMA_FRACTION * size)
    anomaly[hole] = sigma[hole] = np.nan
    shape = len(north), len(east)
    origin = samples.origin
    per_latitude, per_longitude = metres_per_degree(origin[0])
    grid = AnomalyGrid(
        origin[1] + east / per_longitude,
        origin[0] + north / per_latitude,
        anomaly.reshape(shape),
        sigma.reshape(shape),
        altitude=-gridded.middle,
        name=name,
        sigma_length=gridded.field.length,
        level_sigma=samples.level_sigma,
    )
    return grid if altitude is None else _continued(grid, gridded, at, altitude)


def _continued(grid: AnomalyGrid, gridded: Gridded, nodes: FloatArray, altitude: float) -> AnomalyGrid:
    """Return a map at another altitude, m; `nodes` (n, 2) are its nodes' places, m.

    Its sigma is the spread of fields that the data leave open, each continued: errors smaller than the height
    cancel, and what lies beyond the survey's edge comes in from as far as the height.
    """
    there, missing, _ = continued(grid, -altitude)
    rise = raised(grid, altitude)
    drawn = [
        (rise(one.reshape(grid.anomaly.shape)) - there.anomaly) ** 2
        for one in gridded.draw(nodes, DRAWN_FIELDS)
    ]
    return there.replaced(sigma=np.hypot(np.sqrt(np.mean(drawn, axis=0)), missing))
