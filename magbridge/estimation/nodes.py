"""Grid nodes near a track, and cubic B-splines on them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import binary_dilation
from scipy.sparse import csr_array

from magbridge.arrays import BoolArray, FloatArray, IndexArray
from magbridge.field.spline import weights

__all__ = ["Nodes", "nodes_near"]

MIN_BLOCK_NODES = 96
"""Fewest nodes of a block: smaller ones cost more in calls than in arithmetic."""
MAX_BOX_CELLS = 4_000_000
"""Largest number of cells in the box around a track; with more cells, the nodes are too fine."""


@dataclass(frozen=True, eq=False)
class Nodes:
    """Existing nodes of a square grid, numbered strip by strip along the longer side."""

    spacing: float
    """Spacing of the nodes, m."""
    low: FloatArray
    """(2,): North and east of the first node of the box, m."""
    number: IndexArray
    """(a, b): Number of each node in the box, -1 where no node exists."""
    turned: bool
    """True if strips run north (the box is longer to the east)."""

    @property
    def size(self) -> int:
        """Number of nodes."""
        return int(self.number.max()) + 1

    @cached_property
    def places(self) -> FloatArray:
        """North and east (n, 2) of every node, m."""
        strip, along = np.nonzero(self.number >= 0)
        at = np.stack([strip, along][:: -1 if self.turned else 1], axis=1)
        return np.asarray(self.low + self.spacing * at)

    def edges(self, reach: int) -> IndexArray:
        """Return the limits (b + 1,) of blocks of nodes that couple only to the next block.

        `reach`: largest distance between coupled nodes, in strips.
        """
        # Join strips until a block is as wide as the coupling reaches and large enough for dense algebra.
        count = (self.number >= 0).sum(axis=1)
        edges, nodes, strips = [0], 0, 0
        for here in count[count > 0].tolist():
            nodes, strips = nodes + here, strips + 1
            if strips >= reach and nodes >= MIN_BLOCK_NODES:
                edges.append(edges[-1] + nodes)
                nodes = strips = 0
        if nodes:  # a last block too narrow would couple beyond its neighbour
            edges = [*edges[:-1], self.size] if len(edges) > 1 else [0, self.size]
        return np.array(edges)

    def covers(self, place: FloatArray) -> BoolArray:
        """Return a mask (n,) of the places (n, 2), m, at which all nodes that a spline needs exist."""
        return np.asarray((self._around(place)[0] >= 0).all(axis=(1, 2)))

    def basis(self, place: FloatArray) -> csr_array:
        """Return the (n, nodes) splines at places (n, 2), m; rows are zero where nodes are missing."""
        return self._rows(place, 0, 0)

    def slopes(self, place: FloatArray) -> tuple[csr_array, csr_array]:
        """Return the splines' derivatives north and east, 1/m, at places (n, 2), m."""
        along, across = self._rows(place, 1, 0), self._rows(place, 0, 1)
        return (across, along) if self.turned else (along, across)

    def _around(self, place: FloatArray) -> tuple[IndexArray, FloatArray]:
        """Return the numbers (n, 4, 4) of the nodes around places (n, 2), or -1, and positions in cells."""
        # Position in cells; the 4 x 4 nodes around it carry the cubic B-splines that are not zero there.
        u = (place - self.low) / self.spacing
        u = u[:, ::-1] if self.turned else u
        corner = np.floor(np.nan_to_num(u, nan=-9.0)).astype(np.intp)
        steps = np.arange(-1, 3)
        i, j = corner[:, 0, None] + steps, corner[:, 1, None] + steps
        rows, columns = self.number.shape
        inside = np.empty((len(u), 4, 4), bool)
        inside[:] = ((i >= 0) & (i < rows)).reshape(-1, 4, 1)
        inside &= ((j >= 0) & (j < columns)).reshape(-1, 1, 4)
        i, j = np.clip(i, 0, rows - 1), np.clip(j, 0, columns - 1)
        return np.where(inside, self.number[i[:, :, None], j[:, None, :]], -1), u - corner

    def _rows(self, place: FloatArray, first: int, second: int) -> csr_array:
        number, share = self._around(place)
        good = np.asarray((number >= 0).all(axis=(1, 2)))
        n, share = len(place), np.where(good[:, None], share, 0.0)
        # Tensor product of the splines (or their derivatives) along both axes.
        by = weights(share[:, 0])[first][:, None, :] * weights(share[:, 1])[second][None, :, :]
        by = np.where(good, by, 0.0) / self.spacing ** (first + second)
        number = np.maximum(number, 0).reshape(16 * n)
        rows = csr_array(
            (by.reshape(16, n).T.ravel(), number, np.arange(0, 16 * n + 1, 16)), shape=(n, self.size)
        )
        rows.eliminate_zeros()
        return rows


def nodes_near(place: FloatArray, spacing: float, pad: float) -> Nodes:
    """Return the nodes within about `pad` m of `place` (n, 2), m north and east; ValueError: too many."""
    # Mark the cells of the track, dilate them by the pad, and number the marked cells, strip by strip.
    around = int(np.ceil(pad / spacing)) + 2
    cells = np.floor(place / spacing).astype(np.intp)
    low = cells.min(axis=0) - around - 1
    turned = bool(np.ptp(cells[:, 1]) > np.ptp(cells[:, 0]))
    at = cells - low
    shape = at.max(axis=0) + around + 3
    if int(shape[0]) * int(shape[1]) > MAX_BOX_CELLS:
        raise ValueError("nodes are too fine for so large an area")
    near = np.zeros(shape, bool)
    near[at[:, 0], at[:, 1]] = True
    near = binary_dilation(near, _disc(around))
    if turned:
        near = near.T
    number = np.where(near, np.cumsum(near.ravel()).reshape(near.shape) - 1, -1)
    return Nodes(spacing, spacing * low.astype(float), number, turned)


def _disc(radius: int) -> BoolArray:
    at = np.arange(-radius, radius + 1)
    return np.asarray(np.hypot(at[:, None], at) <= radius + 0.5)
