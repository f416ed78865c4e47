"""Corrected samples of a survey: roughness of their field, rows in a linear model, crossovers of lines.

A single amplitude for a whole survey is too small over an intrusion that crops out, and too large elsewhere.
The field's second differences along the lines, smoothed over some of its lengths, show where it is rougher:
the field's amplitude is made proportional to their root mean square.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.sparse import csr_array, diags_array
from scipy.spatial import cKDTree

from magbridge.arrays import BoolArray, FloatArray, IndexArray
from magbridge.estimation.blocks import BLOCK_ROWS, BlockColumns, ParameterBlock, in_chunks
from magbridge.estimation.elimination import LinearisedRows, SampleSums, sum_rows
from magbridge.estimation.gaussian_field import GaussianField

__all__ = ["Crossovers", "Roughness", "Rows", "Samples", "crossovers"]


@dataclass(frozen=True, eq=False)
class Samples:
    """Corrected samples of a survey, from which a map is computed."""

    place: FloatArray
    """(n, 2), m north and east of `origin`."""
    depth: FloatArray
    """(n,), m below the ellipsoid (negative: above)."""
    time: FloatArray
    """(n,), s since 1970 UTC; NaN where not known."""
    value: FloatArray
    """(n,), nT, anomaly."""
    line: IndexArray
    """(n,): Label of the line, or of the log if it is not divided into lines."""
    tie: BoolArray
    """(n,): Whether the line is a tie line."""
    origin: tuple[float, float]
    """Latitude and longitude of the origin, deg."""
    weight: FloatArray = field(default_factory=lambda: np.empty(0))
    """(n,): Noise of a sample over the typical one's."""
    rho: float | None = 0.0
    """Autocorrelation of successive samples' noise; None: not known."""
    modes: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    """(n, r), nT, change of every sample by 1-sigma of each uncertain combination of coefficients."""
    level_sigma: float = 0.0
    """1-sigma of the error that all samples share, the reference's level, nT."""

    def __post_init__(self) -> None:
        n = len(self.value)
        if not len(self.weight):
            object.__setattr__(self, "weight", np.ones(n))
        if not len(self.modes):
            object.__setattr__(self, "modes", np.empty((n, 0)))

    def part(self, rows: BoolArray | IndexArray) -> Samples:
        """Return the samples `rows`: an (n,) mask, or indices."""
        arrays: dict[str, Any] = {
            name: value[rows] for name, value in vars(self).items() if isinstance(value, np.ndarray)
        }
        return replace(self, **arrays)


LAG, REACH = 0.5, 2.0
"""Lengths between the samples of a second difference, and of the smoothing's sigma."""
LEAST, LARGEST = 0.2, 6.0
"""Limits of a roughness, relative to the typical one."""
MAX_CELLS_PER_SIDE = 400
"""Most cells a side."""
PRIOR = 0.1
"""Weight of the typical roughness, over that of the average cell's samples."""


@dataclass(frozen=True, eq=False)
class Roughness:
    """The size of the field over the typical one, on a grid of cells."""

    low: FloatArray
    """(2,), m north and east."""
    cell: float
    """Side of a cell, m."""
    scale: FloatArray
    """(a, b)."""

    @classmethod
    def uniform(cls) -> Roughness:
        """Return a roughness of 1 everywhere."""
        return cls(np.zeros(2), 1.0, np.ones((1, 1)))

    @classmethod
    def from_samples(cls, samples: Samples, length: float) -> Roughness:
        """Return the roughness of a survey whose field has the correlation length `length`, m."""
        place = samples.place
        low, extent = place.min(axis=0), np.ptp(place, axis=0)
        # Cells of a fraction of the smoothing length, limited in number.
        cell = max(float(extent.max()) / MAX_CELLS_PER_SIDE, REACH * length / 4.0)
        # Second differences are free of levels and slow changes; their mean square follows the roughness.
        bent = _bends(samples, LAG * length)
        known = np.isfinite(bent)
        if known.sum() < 50:
            return cls.uniform()
        at = np.floor((place[known] - low) / cell).astype(int)
        shape = np.floor(extent / cell).astype(int) + 1
        power, count = np.zeros(shape), np.zeros(shape)
        np.add.at(power, (at[:, 0], at[:, 1]), bent[known] ** 2)
        np.add.at(count, (at[:, 0], at[:, 1]), 1.0)
        power, count = (
            gaussian_filter(one, REACH * length / cell, mode="constant") for one in (power, count)
        )
        # Shrink cells with few samples to the typical power.
        typical2 = float(np.median((power / np.maximum(count, 1e-12))[count > PRIOR * count.mean()]))
        few = PRIOR * count.mean()
        scale = np.sqrt((power + few * typical2) / ((count + few) * max(typical2, 1e-12)))
        return cls(low, cell, np.clip(scale, LEAST, LARGEST))

    def evaluate(self, place: FloatArray) -> FloatArray:
        """Return the roughness (n,) at places (n, 2), m."""
        if min(self.scale.shape) < 2:
            return np.full(len(place), float(self.scale.mean()))
        # Bilinear interpolation between the centres of the cells, constant beyond them.
        u = (place - self.low) / self.cell - 0.5
        return np.asarray(map_coordinates(self.scale, u.T, order=1, mode="nearest"))


def _bends(samples: Samples, lag: float) -> FloatArray:
    """Return the second difference (n,) of the field over `lag` m along the line, nT; NaN at its ends."""
    y, line, place = samples.value, samples.line, samples.place
    # y(s + lag) - 2 y(s) + y(s - lag) along one line.
    step = float(np.median(np.linalg.norm(np.diff(place, axis=0), axis=1)))
    m = max(round(lag / max(step, 1e-3)), 1)
    out = np.full(len(y), np.nan)
    if len(y) > 2 * m:
        whole = (line[2 * m :] == line[m:-m]) & (line[: -2 * m] == line[m:-m])
        out[m:-m][whole] = (y[2 * m :] - 2.0 * y[m:-m] + y[: -2 * m])[whole]
    return out


class Rows:
    """The samples of a survey as rows of a linear model."""

    def __init__(self, samples: Samples, groups: tuple[ParameterBlock, ...], roughness: Roughness) -> None:
        self.samples, self.groups = samples, groups
        self.mean = float(np.median(samples.value))
        self.middle = float(np.nanmedian(samples.depth))
        self.deeper = np.nan_to_num(samples.depth - self.middle)
        self.D = BlockColumns(groups)
        self.scale = roughness.evaluate(samples.place)
        self.kept = np.ones(len(samples.value), bool)

    def basis(self, field: GaussianField, rows: IndexArray | slice) -> csr_array:
        """Return the contribution of the field's coefficients to the samples `rows`, (m, nodes)."""
        # Splines at the samples, times the roughness there.
        known = field.basis(self.samples.place[rows], self.deeper[rows])
        return csr_array(diags_array(self.scale[rows]) @ known)

    def mean_over_samples(self, field: GaussianField) -> FloatArray:
        """Return the contribution of each of the field's coefficients to the samples' mean, (nodes,)."""
        kept, total = np.flatnonzero(self.kept), np.zeros(field.nodes.size)
        for start in range(0, len(kept), BLOCK_ROWS):
            total += self.basis(field, kept[start : start + BLOCK_ROWS]).sum(axis=0)
        return total / len(kept)

    def rock(self, field: GaussianField, w: FloatArray) -> FloatArray:
        """Return the field of coefficients w (nodes,) at every sample, (n,), nT."""
        return in_chunks(len(self.kept), lambda rows: self.basis(field, rows) @ w)

    def sums(self, field: GaussianField, rows: IndexArray, modes: bool = False) -> SampleSums:
        """Return the sums of the samples `rows` (m,), of them the kept; with the calibration's modes."""
        return sum_rows(self._pieces(field, rows, modes))

    def _pieces(self, field: GaussianField, rows: IndexArray, modes: bool) -> Iterator[LinearisedRows]:
        s = self.samples
        rows = rows[self.kept[rows]]
        # Noise is correlated between neighbours on one line only.
        follows = np.zeros(len(rows), bool)
        follows[1:] = (np.diff(rows) == 1) & (s.line[rows][1:] == s.line[rows][:-1])
        for start in range(0, len(rows), BLOCK_ROWS):
            # One row of overlap: the noise is correlated with that of the row before.
            first = max(start - 1, 0)
            mine = rows[first : start + BLOCK_ROWS]
            weight = -1.0 / s.weight[mine]
            V = [(s.value[mine] - self.mean)[:, None], self.D[mine]]
            if modes:
                V.append(s.modes[mine])
            rows_of = np.concatenate(V, axis=1)
            rows_of[:, 1:] *= weight[:, None]
            rows_of[:, 0] *= -weight
            B = csr_array(diags_array(weight) @ self.basis(field, mine))
            yield LinearisedRows(rows_of, B, follows[first : start + BLOCK_ROWS], overlap=start > 0)


SEGMENTS = 60_000
"""Largest number of segments of all lines: a longer track is processed in longer steps."""
LONGEST_SEGMENT_QUANTILE = 0.99
"""Quantile of the segments' lengths up to which crossovers are sought."""
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
    """Return where lines cross, by the samples' `place` (n, 2), m north and east, and label `line` (n,)."""
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
    """Return pairs of segments that may meet, from `a` (m, 2) along `way` (m, 2), not adjacent on a line."""
    if len(a) < 2:
        return np.empty(0, np.intp), np.empty(0, np.intp)
    # Segments that meet have their middles within the mean of their lengths; longer ones are gaps of a track.
    longest = max(float(np.quantile(np.linalg.norm(way, axis=1), LONGEST_SEGMENT_QUANTILE)), 1.0)
    pairs = cKDTree(a + 0.5 * way).query_pairs(longest, output_type="ndarray")
    i, j = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].T
    distant = (line[i] != line[j]) | (j - i >= MIN_SEGMENTS_BETWEEN)
    return i[distant], j[distant]
