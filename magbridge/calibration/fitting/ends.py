"""The ends of a log that are not its flight: a crash, handling on the ground, another mounting."""

from __future__ import annotations

import numpy as np

from magbridge.arrays import BoolArray, FloatArray
from magbridge.estimation.noise import OUTLIER_SIGMA
from magbridge.estimation.residual import robust_scale

__all__ = ["flown"]

SHORTEST = 20
"""Samples: fewer outliers at an end are outliers as any others."""
MOSTLY = 0.7
"""Share of an end's samples that are outliers."""


def flown(residual: FloatArray) -> BoolArray:
    """Return which samples (n,) are not part of an end of the log that the others contradict.

    Parameters
    ----------
    residual : (n,) array
        Of a robust fit, in the order of the log, nT.
    """
    off = np.abs(residual) > OUTLIER_SIGMA * robust_scale(residual)
    kept = np.ones(len(off), bool)
    kept[: _end(off)] = False
    kept[len(off) - _end(off[::-1]) :] = False
    return kept if kept.sum() > len(kept) / 2 else np.ones(len(off), bool)


def _end(off: BoolArray) -> int:
    """Return how many samples of the start are mostly outliers; 0 if those are few."""
    share = np.cumsum(off) / np.arange(1, len(off) + 1)
    until = np.flatnonzero((share > MOSTLY) & off)
    return int(until[-1]) + 1 if until.size and until[-1] + 1 >= SHORTEST else 0
