"""Crossovers: places where a survey crosses its own lines, and the difference of the two readings there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magbridge.arrays import FloatArray, IndexArray

__all__ = ["Crossovers", "crossovers"]

SEGMENTS = 60_000
"""Largest number of segments of all lines: a longer track is processed in longer steps."""
MIN_SEGMENTS_BETWEEN = 20
"""Segments of one line between two that can be a crossover."""


@dataclass(frozen=True, eq=False)
class Crossovers:
    """Places where two lines cross."""

    place: FloatArray
    """(m, 2), m north and east."""
    first: IndexArray
    second: IndexArray
    """`first`, `second`, (m,): Samples that begin the two segments."""
    share: FloatArray
    """(m, 2): How far along each segment, 0 to 1."""
    step: int
    """Samples of a segment."""

    def misties(self, value: FloatArray) -> FloatArray:
        """Return the difference (m,) of `value` (n,) between the lines, the first minus the second."""

        def interpolate(start: IndexArray, share: FloatArray) -> FloatArray:
            end = np.minimum(start + self.step, len(value) - 1)
            return np.asarray((1.0 - share) * value[start] + share * value[end])

        return interpolate(self.first, self.share[:, 0]) - interpolate(self.second, self.share[:, 1])


def crossovers(place: FloatArray, line: IndexArray) -> Crossovers:
    """Find where the lines cross.

    Parameters
    ----------
    place : (n, 2) array
        m north and east.
    line : (n,) array
        Label of each sample's line.
    """
    # Segments of several samples: their number bounds the work.
    step = max(len(place) // SEGMENTS, 1)
    start = np.arange(0, len(place) - step, step)
    start = start[line[start] == line[start + step]]
    a, way = place[start], place[start + step] - place[start]
    i, j = _nearby_pairs(a, way, line[start])
    # Segments a + s w and b + t v meet where s = (b - a) x v / (w x v) and t = (b - a) x w / (w x v).
    cross = way[i, 0] * way[j, 1] - way[i, 1] * way[j, 0]
    off = a[j] - a[i]
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (off[:, 0] * way[j, 1] - off[:, 1] * way[j, 0]) / cross
        t = (off[:, 0] * way[i, 1] - off[:, 1] * way[i, 0]) / cross
    # Both parameters within the segments: they cross.
    met = (s >= 0.0) & (s < 1.0) & (t >= 0.0) & (t < 1.0)
    i, j, s, t = i[met], j[met], s[met], t[met]
    return Crossovers(a[i] + s[:, None] * way[i], start[i], start[j], np.stack([s, t], axis=1), step)


def _nearby_pairs(a: FloatArray, way: FloatArray, line: IndexArray) -> tuple[IndexArray, IndexArray]:
    """Return pairs of segments, from `a` (m, 2) along `way` (m, 2), in a cell, not adjacent on a line."""
    cell = max(float(np.quantile(np.abs(way).max(axis=1, initial=0.0), 0.99)), 1.0) if len(a) else 1.0
    # Hash the segments into cells of about their length; only those in one cell are compared.
    keys: list[IndexArray] = []
    of: list[IndexArray] = []
    for share in (0.0, 0.5, 1.0):  # the cells that a segment touches
        at = np.floor((a + share * way) / cell).astype(np.int64)
        for down in (-1, 0, 1) if share == 0.5 else (0,):
            for across in (-1, 0, 1) if share == 0.5 else (0,):
                keys.append((at[:, 0] + down) * 2_000_003 + at[:, 1] + across)
                of.append(np.arange(len(a)))
    key, segment = np.concatenate(keys), np.concatenate(of)
    order = np.lexsort((segment, key))
    key, segment = key[order], segment[order]
    pairs: list[IndexArray] = []
    edges = np.flatnonzero(np.diff(key, prepend=key[:1] - 1, append=key[-1:] + 1))
    for first, last in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        here = np.unique(segment[first:last])
        if len(here) < 2 or (here[-1] - here[0] < MIN_SEGMENTS_BETWEEN and line[here[0]] == line[here[-1]]):
            continue
        one, other = np.triu_indices(len(here), 1)
        one, other = here[one], here[other]
        apart = (line[one] != line[other]) | (other - one >= MIN_SEGMENTS_BETWEEN)
        pairs.append(np.stack([one[apart], other[apart]], axis=1).astype(np.intp))
    if not pairs:
        return np.empty(0, np.intp), np.empty(0, np.intp)
    found = np.unique(np.concatenate(pairs), axis=0)
    return found[:, 0], found[:, 1]
