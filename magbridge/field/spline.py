"""Cubic B-splines through the nodes of a uniform grid without holes: their coefficients and weights."""

from __future__ import annotations

import numpy as np

from magbridge.arrays import FloatArray

__all__ = ["WEIGHTS", "coefficients", "filled", "weights"]

PAD_NODES = 16
"""Number of mirrored nodes beyond each edge; over them the edge's influence on a spline falls to 1e-9."""

# Cubic B-spline on a uniform axis: weights of four nodes as cubics in the fraction t, powers t⁰ t¹ t² t³.
VALUE = np.array([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]]) / 6.0
SPLINE_SLOPE = np.array([[-3, 6, -3, 0], [0, -12, 9, 0], [3, 6, -9, 0], [0, 0, 3, 0]]) / 6.0
SPLINE_CURVATURE = np.array([[6, -6, 0, 0], [-12, 18, 0, 0], [6, -18, 0, 0], [0, 6, 0, 0]]) / 6.0
WEIGHTS = np.concatenate([VALUE, SPLINE_SLOPE, SPLINE_CURVATURE])
"""Matrix (12, 4) from the powers of t to the weights of four nodes for value, slope and curvature."""


def filled(values: FloatArray) -> FloatArray:
    """Return values (ny, nx) with each hole (NaN) filled from the nearest node."""
    hole = np.isnan(values)
    if not hole.any():
        return values
    from scipy.ndimage import distance_transform_edt  # noqa: PLC0415  the live path runs without scipy

    nearest = distance_transform_edt(hole, return_distances=False, return_indices=True)
    patched: FloatArray = values[tuple(nearest)]
    return patched


def coefficients(values: FloatArray) -> FloatArray:
    """Return B-spline coefficients (ny + 2, nx + 2) of values (ny, nx), with zero curvature at the edges."""
    from scipy.ndimage import spline_filter  # noqa: PLC0415  the live path runs without scipy

    pad = [(min(PAD_NODES, n - 1),) * 2 for n in values.shape]
    padded = np.pad(values, pad, mode="reflect", reflect_type="odd")
    found: FloatArray = spline_filter(padded, order=3, mode="mirror")
    (a, _), (b, _) = pad
    return np.ascontiguousarray(found[a - 1 : -a + 1 or None, b - 1 : -b + 1 or None])


def weights(t: FloatArray) -> FloatArray:
    """Return weights (3, 4, n) of four nodes for value, slope and curvature at cell fractions t (n,)."""
    found: FloatArray = (WEIGHTS @ np.stack([np.ones_like(t), t, t * t, t * t * t])).reshape(3, 4, -1)
    return found
