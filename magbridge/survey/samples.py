"""Corrected samples of a survey, wherever they come from."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from magbridge.arrays import BoolArray, FloatArray, IndexArray

__all__ = ["Samples"]


@dataclass(frozen=True, eq=False)
class Samples:
    """What a map is made of.

    Attributes
    ----------
    place : (n, 2) array
        m north and east of `origin`.
    depth : (n,) array
        m below the ellipsoid (negative: above).
    time : (n,) array
        s since 1970 UTC; NaN where not known.
    value : (n,) array
        nT, anomaly.
    line : (n,) array
        Label of the line, or of the log where there are no lines.
    tie : (n,) array
        Whether the line is a tie line.
    origin : tuple of 2 float
        deg, latitude and longitude.
    weight : (n,) array
        Noise of a sample over the typical one's.
    rho : float
        Autocorrelation of successive samples' noise.
    modes : (n, r) array
        nT, what 1-sigma of each of the calibration's uncertain combinations does to every sample.
    level_sigma : float
        nT, 1-sigma of what all samples are off by, the reference's level.
    """

    place: FloatArray
    depth: FloatArray
    time: FloatArray
    value: FloatArray
    line: IndexArray
    tie: BoolArray
    origin: tuple[float, float]
    weight: FloatArray = field(default_factory=lambda: np.empty(0))
    rho: float = 0.0
    modes: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    level_sigma: float = 0.0

    def __post_init__(self) -> None:
        n = len(self.value)
        if not len(self.weight):
            object.__setattr__(self, "weight", np.ones(n))
        if not len(self.modes):
            object.__setattr__(self, "modes", np.empty((n, 0)))

    def part(self, rows: BoolArray) -> Samples:
        """Pick samples: an (n,) mask."""
        return Samples(
            self.place[rows], self.depth[rows], self.time[rows], self.value[rows], self.line[rows],
            self.tie[rows], self.origin, self.weight[rows], self.rho, self.modes[rows], self.level_sigma,
        )  # fmt: skip
