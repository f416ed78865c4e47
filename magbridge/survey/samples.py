"""Corrected samples of a survey: roughness of their field, rows in a linear model, crossovers of lines.

A single amplitude for a whole survey is too small over an outcropping intrusion, and too large elsewhere.
Where the field is rougher, its second differences along the lines are larger. The field's amplitude is
therefore proportional to their root mean square, smoothed over some correlation lengths.
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
from magbridge.diagnostics import Diagnostic
from magbridge.estimation.blocks import BLOCK_ROWS, BlockColumns, ParameterBlock, in_chunks
from magbridge.estimation.elimination import LinearisedRows, SampleSums, sum_rows
from magbridge.estimation.gaussian_field import GaussianField

__all__ = ["Crossovers", "Roughness", "Rows", "Samples", "crossovers"]


@dataclass(frozen=True, eq=False)
class Samples:
    """Corrected samples of a survey, from which a map is computed."""

    place: FloatArray
    """Positions (n, 2), m north and east of `origin`."""
    depth: FloatArray
    """Depth (n,) below the ellipsoid, m; negative is above."""
    time: FloatArray
    """Time (n,), s since 1970 UTC; NaN where unknown."""
    value: FloatArray
    """Anomaly (n,), nT."""
    line: IndexArray
    """Label (n,) of the sample's line, or of its log if the log is not divided into lines."""
    tie: BoolArray
    """True (n,) for samples of a tie line."""
    origin: tuple[float, float]
    """Latitude and longitude of the origin, deg."""
    weight: FloatArray = field(default_factory=lambda: np.empty(0))
    """Noise (n,) of each sample, as a multiple of the typical sample's."""
    rho: float | None = 0.0
    """Autocorrelation of the noise of successive samples; None if unknown."""
    modes: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    """Change (n, r), nT, of every sample with 1-sigma of each uncertain combination of coefficients."""
    level_sigma: float = 0.0
    """1-sigma of the constant error of all samples (reference bias, variation in time), nT."""
    left_out: tuple[Diagnostic, ...] = ()
    """Why samples of the logs are not among these."""
    line_names: tuple[str, ...] = ()
    """Number or name of each label's line in the log; empty for the labels themselves."""

    def __post_init__(self) -> None:
        n = len(self.value)
        if not len(self.weight):
            object.__setattr__(self, "weight", np.ones(n))
        if not len(self.modes):
            object.__setattr__(self, "modes", np.empty((n, 0)))

    def names(self) -> tuple[str, ...]:
        """Return the number or name of the line of every label, by which the log and people know it."""
        return self.line_names or tuple(map(str, range(int(self.line.max(initial=-1)) + 1)))

    def followed(self, gap: tuple[float, float]) -> BoolArray:
        """Return True (m,) for samples followed by one on the same line and not across a `gap`.

        A gap is longer than a number of median steps, and than a number of s (ignored without times).
        """
        timed = np.isfinite(self.time).all()
        step = np.diff(self.time) if timed else np.linalg.norm(np.diff(self.place, axis=0), axis=1)
        usual = float(np.median(step[step > 0.0])) if (step > 0.0).any() else np.inf
        return np.asarray((np.diff(self.line) == 0) & (step <= max(gap[0] * usual, gap[1] * timed)))

    def part(self, rows: BoolArray | IndexArray) -> Samples:
        """Return the samples that `rows` selects, an (n,) mask or indices."""
        arrays: dict[str, Any] = {
            name: value[rows] for name, value in vars(self).items() if isinstance(value, np.ndarray)
        }
        return replace(self, **arrays)


LAG, REACH = 0.5, 2.0
"""Lag of the second differences, and sigma of the smoothing, in correlation lengths."""
LEAST, LARGEST = 0.2, 6.0
"""Smallest and largest roughness, relative to the typical one."""
MAX_CELLS_PER_SIDE = 400
"""Largest number of cells along a side of the survey."""
PRIOR = 0.1
"""Weight of the typical roughness in a cell, relative to the samples of an average cell."""


@dataclass(frozen=True, eq=False)
class Roughness:
    """Local amplitude of the field, relative to its typical amplitude, on a grid of cells."""

    low: FloatArray
    """South-western corner (2,) of the grid, m north and east."""
    cell: float
    """Side of a cell, m."""
    scale: FloatArray
    """Relative amplitude (a, b) in each cell."""

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
        # Levels and slow changes cancel in second differences, whose mean square is that of the roughness.
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
    """Return the second difference (n,), nT, of the anomaly at a lag of `lag` m along each line.

    It is NaN at the ends of a line.
    """
    y, line, place = samples.value, samples.line, samples.place
    # y(s + lag) - 2 y(s) + y(s - lag) along one line.
    step = float(np.median(np.linalg.norm(np.diff(place, axis=0), axis=1)))
    m = max(round(lag / max(step, 1e-3)), 1)
    out = np.full(len(y), np.nan)
    if len(y) > 2 * m:
        whole = (line[2 * m :] == line[m:-m]) & (line[: -2 * m] == line[m:-m])
        out[m:-m][whole] = (y[2 * m :] - 2.0 * y[m:-m] + y[: -2 * m])[whole]
    return out


NOISE_GAP, TRACK_GAP = (3.0, 0.0), (20.0, 60.0)
"""Gaps across which noise is not correlated, and across which the track is unknown: longest step between
samples, in median steps of time (of place without time) and at least in s."""


class Rows:
    """Samples of a survey as rows of a linear model: field, blocks of parameters `groups`, and noise.

    Samples that are False in `kept` (n,) are left out of the sums.
    """

    def __init__(self, samples: Samples, groups: tuple[ParameterBlock, ...], roughness: Roughness) -> None:
        self.samples, self.groups = samples, groups
        self.mean = float(np.median(samples.value))
        self.middle = float(np.nanmedian(samples.depth))
        self.deeper = np.nan_to_num(samples.depth - self.middle)
        self.D = BlockColumns(groups)
        self.lacking = np.zeros(len(samples.value))
        """What :meth:`basis` lacks of the field at each sample (n,), nT."""
        self.scale = roughness.evaluate(samples.place)
        self.kept = np.ones(len(samples.value), bool)
        # Noise is correlated between neighbours on one line only, and not across a gap.
        self.next = samples.followed(NOISE_GAP)

    def basis(self, field: GaussianField, rows: IndexArray | slice) -> csr_array:
        """Return the matrix (m, nodes) from the field's coefficients to the anomaly at the samples `rows`."""
        # Splines at the samples, times the roughness there.
        known = field.basis(self.samples.place[rows], self.deeper[rows])
        return csr_array(diags_array(self.scale[rows]) @ known)

    def mean_over_samples(self, field: GaussianField) -> FloatArray:
        """Return the row (nodes,) from the field's coefficients to the mean anomaly of the kept samples."""
        kept, total = np.flatnonzero(self.kept), np.zeros(field.nodes.size)
        for start in range(0, len(kept), BLOCK_ROWS):
            total += self.basis(field, kept[start : start + BLOCK_ROWS]).sum(axis=0)
        return total / len(kept)

    def correct(self, field: GaussianField, w: FloatArray) -> None:
        """Compute what :meth:`basis` lacks of the field of coefficients w (nodes,)."""
        self.lacking = self.scale * field.lacking(self.samples.place, self.deeper, w)

    def rock(self, field: GaussianField, w: FloatArray) -> FloatArray:
        """Return the crustal field (n,), nT, at every sample, given its coefficients w (nodes,)."""
        return in_chunks(len(self.kept), lambda rows: self.basis(field, rows) @ w) + self.lacking

    def sums(self, field: GaussianField, rows: IndexArray, modes: bool = False) -> SampleSums:
        """Return the sums of the model's rows over the kept ones of the samples `rows` (m,).

        With `modes`, the calibration's modes are further columns.
        """
        return sum_rows(self._pieces(field, rows, modes))

    def _pieces(self, field: GaussianField, rows: IndexArray, modes: bool) -> Iterator[LinearisedRows]:
        s = self.samples
        rows = rows[self.kept[rows]]
        follows = np.zeros(len(rows), bool)
        follows[1:] = (np.diff(rows) == 1) & self.next[rows[:-1]]
        for start in range(0, len(rows), BLOCK_ROWS):
            # One row of overlap: a row's noise is correlated with the noise of the row before.
            first = max(start - 1, 0)
            mine = rows[first : start + BLOCK_ROWS]
            weight = -1.0 / s.weight[mine]
            V = [(s.value[mine] - self.mean - self.lacking[mine])[:, None], self.D[mine]]
            if modes:
                V.append(s.modes[mine])
            rows_of = np.concatenate(V, axis=1)
            rows_of[:, 1:] *= weight[:, None]
            rows_of[:, 0] *= -weight
            B = csr_array(diags_array(weight) @ self.basis(field, mine))
            yield LinearisedRows(rows_of, B, follows[first : start + BLOCK_ROWS], overlap=start > 0)


SEGMENTS = 60_000
"""Largest number of segments of all lines; longer tracks are divided into longer segments."""
LONGEST_SEGMENT_QUANTILE = 0.99
"""Quantile of the segments' lengths that limits the search for crossovers; longer segments are gaps."""
MIN_SEGMENTS_BETWEEN = 20
"""Smallest number of segments along one line between two segments that may be a crossover."""


@dataclass(frozen=True, eq=False)
class Crossovers:
    """The m places where two lines cross, each on two segments of several samples."""

    place: FloatArray
    """Positions (m, 2), m north and east."""
    first: IndexArray
    second: IndexArray
    """`first`, `second`: indices (m,) of the samples at which the two segments begin."""
    share: FloatArray
    """Position (m, 2) of the crossover along each of the two segments, 0 to 1."""
    step: int
    """Number of samples from the beginning of a segment to its end."""

    def misties(self, value: FloatArray) -> FloatArray:
        """Return the mis-ties (m,): `value` (n,) of the first line minus that of the second, interpolated."""

        def interpolate(start: IndexArray, share: FloatArray) -> FloatArray:
            end = np.minimum(start + self.step, len(value) - 1)
            return np.asarray((1.0 - share) * value[start] + share * value[end])

        return interpolate(self.first, self.share[:, 0]) - interpolate(self.second, self.share[:, 1])


def crossovers(samples: Samples) -> Crossovers:
    """Return the crossovers of the samples' lines; a gap in a log is not part of a line."""
    place, line = samples.place, samples.line
    # Segments of several samples: their number limits the computing time.
    step = max(len(place) // SEGMENTS, 1)
    start = np.arange(0, len(place) - step, step)
    # A segment lies within one piece of a line without a gap.
    whole = np.concatenate([[0], np.cumsum(~samples.followed(TRACK_GAP))])
    start = start[whole[start] == whole[start + step]]
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
    """Return index pairs of segments that may cross; each begins at `a` (m, 2) and extends by `way` (m, 2).

    Segments close to each other on one `line` (m,) are left out.
    """
    if len(a) < 2:
        return np.empty(0, np.intp), np.empty(0, np.intp)
    # The middles of segments that meet are within the mean of their lengths.
    longest = max(float(np.quantile(np.linalg.norm(way, axis=1), LONGEST_SEGMENT_QUANTILE)), 1.0)
    pairs = cKDTree(a + 0.5 * way).query_pairs(longest, output_type="ndarray")
    i, j = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].T
    distant = (line[i] != line[j]) | (j - i >= MIN_SEGMENTS_BETWEEN)
    return i[distant], j[distant]
