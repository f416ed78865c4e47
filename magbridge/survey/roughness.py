"""Roughness of the crustal field from place to place, from the field's second differences along the lines.

A single amplitude for a whole survey is too small over an intrusion that crops out, and too large elsewhere.
The field's second differences along the lines, smoothed over some of its lengths, show where it is rougher:
the field's amplitude is made proportional to their root mean square.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from magbridge.arrays import FloatArray
from magbridge.survey.samples import Samples

__all__ = ["Roughness"]

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
        """Return one that is the same everywhere."""
        return cls(np.zeros(2), 1.0, np.ones((1, 1)))

    @classmethod
    def from_samples(cls, samples: Samples, length: float) -> Roughness:
        """Return that of a survey whose field has a `length`, m."""
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
        u = (place - self.low) / self.cell - 0.5
        i = np.clip(np.floor(u).astype(int), 0, np.array(self.scale.shape) - 2)
        t = np.clip(u - i, 0.0, 1.0)
        # Bilinear interpolation between the centres of the cells.
        a = self.scale[i[:, 0], i[:, 1]] * (1 - t[:, 1]) + self.scale[i[:, 0], i[:, 1] + 1] * t[:, 1]
        b = self.scale[i[:, 0] + 1, i[:, 1]] * (1 - t[:, 1]) + self.scale[i[:, 0] + 1, i[:, 1] + 1] * t[:, 1]
        return np.asarray(a * (1 - t[:, 0]) + b * t[:, 0])


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
