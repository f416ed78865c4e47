"""What the extended calibration gains, on dives that its fit has not seen (:mod:`.inference.left_out`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magbridge.arrays import BoolArray, FloatArray, IntArray

__all__ = ["LEVEL", "Improvement", "paired"]

DRAWS = 2000
"""Bootstrap samples: an end of the interval then scatters by 1.5 % of its width."""
QUANTILES = (0.025, 0.975)
"""Of the bootstrap samples: the ends of the interval."""
LEVEL = QUANTILES[1] - QUANTILES[0]
"""Of the interval."""


@dataclass(frozen=True)
class Improvement:
    """RMS before and after (nT, held out), their ratio and its interval over dives (:data:`LEVEL`)."""

    before: float
    after: float
    ratio: float
    interval: tuple[float, float]

    @property
    def shown(self) -> bool:
        """Whether the held-out dives show a gain: the interval lies below 1."""
        return self.interval[1] < 1.0


def paired(before: FloatArray, after: FloatArray, dive: IntArray, counts: BoolArray) -> Improvement:
    """Compare two residuals on the same samples.

    The interval comes from a bootstrap of whole dives, so correlation within a dive does no harm.

    Parameters
    ----------
    before, after : (n,) array
        nT.
    dive : (n,) int array
        Number of the dive that each sample belongs to.
    counts : (n,) bool array
        Samples that count.
    """
    number = np.unique(dive[counts], return_inverse=True)[1]
    b, a = np.bincount(number, before[counts] ** 2), np.bincount(number, after[counts] ** 2)
    rng = np.random.default_rng(20131213)  # the same answer every time
    drawn = rng.integers(0, b.size, (DRAWS, b.size))
    ratios = np.sqrt(a[drawn].sum(axis=1) / (b[drawn].sum(axis=1) + 1e-300))
    low, high = np.quantile(ratios, QUANTILES)
    n = int(counts.sum())
    return Improvement(
        float(np.sqrt(b.sum() / n)),
        float(np.sqrt(a.sum() / n)),
        float(np.sqrt(a.sum() / (b.sum() + 1e-300))),
        (float(low), float(high)),
    )
