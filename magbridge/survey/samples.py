"""Corrected samples of a survey, wherever they come from."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from magbridge.arrays import BoolArray, FloatArray, IndexArray

__all__ = ["Samples"]


@dataclass(frozen=True, eq=False)
class Samples:
    """What a map is made of."""

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
    """(n, r), nT, what 1-sigma of each of the calibration's uncertain combinations does to every sample."""
    level_sigma: float = 0.0
    """1-sigma of what all samples are off by, the reference's level, nT."""

    def __post_init__(self) -> None:
        n = len(self.value)
        if not len(self.weight):
            object.__setattr__(self, "weight", np.ones(n))
        if not len(self.modes):
            object.__setattr__(self, "modes", np.empty((n, 0)))

    def part(self, rows: BoolArray | IndexArray) -> Samples:
        """Pick samples: an (n,) mask, or places."""
        return Samples(
            self.place[rows], self.depth[rows], self.time[rows], self.value[rows], self.line[rows],
            self.tie[rows], self.origin, self.weight[rows], self.rho, self.modes[rows], self.level_sigma,
        )  # fmt: skip
