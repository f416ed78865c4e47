"""Field lengths that a track can resolve, and the nodes of a field of such a length."""

from __future__ import annotations

import numpy as np

from magbridge.arrays import BoolArray, FloatArray
from magbridge.estimation.nodes import Nodes, nodes_near

__all__ = ["MAX_FIELD_NODES", "SMOOTH", "about_the_middle", "fine_enough", "ladder", "nodes_for"]

RUNGS = 7
"""Lengths that are tried first."""
NODES_PER_LENGTH = {2: 8.0, 3: 8.0, 4: 5.0}
SMOOTH, ENOUGH = 6, 3.0
"""Nodes a length by the power alpha, and from SMOOTH on: of a field 40 times the noise they leave out less
than that noise (rough ones on coarser nodes gave maps with errors of 5 to 8 sigmas)."""
PAD_LENGTHS = 1.0
"""Lengths around the track that have nodes."""
MAX_FIELD_NODES = 4_000
"""Nodes at most, unless more are asked for."""
SIDE = 1_500
"""Nodes along a side of the area's box at most, where it is a square."""
MIN_LENGTH_M = 60.0
"""Shortest correlation length, m; a twentieth of an area smaller than that."""


def fine_enough(nodes: Nodes, length: float, alpha: int, finer: float = 1.0) -> bool:
    """Return True if nodes are fine enough for a field of a `length`, m, and power alpha."""
    return 0.7 <= length / nodes.spacing / _nodes_per_length(alpha, finer) <= 1.5


def _nodes_per_length(alpha: int, finer: float) -> float:
    return max(NODES_PER_LENGTH.get(alpha, ENOUGH), finer * ENOUGH)


def nodes_for(
    place: FloatArray, length: float, alpha: int, most: int = MAX_FIELD_NODES, finer: float = 1.0
) -> Nodes:
    """Return the nodes of a field around places (n, 2), m; coarser if they are too many.

    Parameters
    ----------
    place : (n, 2) array
        m.
    length : float
        m, of the field.
    alpha : int
        Its smoothness: a rough one takes finer nodes.
    most : int
        Nodes at most, about.
    finer : float
        Factor of the nodes per length of a smooth field; the error of its splines falls as the fourth power.
    """
    box = np.ptp(place, axis=0) + 4.0 * PAD_LENGTHS * length
    spacing = max(length / _nodes_per_length(alpha, finer), float(np.sqrt(box.prod())) / SIDE)
    while (nodes := nodes_near(place, spacing, PAD_LENGTHS * length)).size > 1.05 * most:
        spacing *= (nodes.size / most) ** 0.5
    return nodes


def about_the_middle(place: FloatArray, number: int, wide: float = 0.0) -> BoolArray:
    """Return which of places (n, 2), m, are the `number` nearest to the middle one, or within `wide` m: (n,).

    They lie in a square, so that whole stretches of lines are among them.
    """
    if len(place) <= number:
        return np.ones(len(place), bool)
    from_middle = np.abs(place - np.nanmedian(place, axis=0)).max(axis=1)
    return np.asarray(from_middle <= max(np.partition(from_middle, number)[number], wide))


def ladder(place: FloatArray) -> FloatArray:
    """Return seven lengths to try, m: from the resolution of samples at places (n, 2), m, to the area."""
    known = place[np.isfinite(place).all(axis=1)]
    extent = float(np.hypot(*np.ptp(known, axis=0)))
    step = np.linalg.norm(np.diff(known, axis=0), axis=1)
    shortest = max(4.0 * float(np.median(step)), extent / 60.0, min(MIN_LENGTH_M, extent / 20.0))
    return np.asarray(np.geomspace(shortest, max(extent / 2.5, 1.5 * shortest), RUNGS))
