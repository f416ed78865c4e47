r"""Whether a track distinguishes what changes with the place from what changes with time.

Notes
-----
A function of the place is the same on every pass. Of slow changes with time, a trend and a bend
``f = (x, x^2)``, x the time over the log, it can imitate the means of f over the cells of the track. With T
the covariance of f and W that within the cells, the smallest eigenvalue of ``T^-1 W`` is the least share of
the power of such a change that no function of the place imitates: one less the largest squared canonical
correlation (Hotelling 1936, Biometrika 28:321). It is 0 for a track that never returns, and for one that
goes there and back: a change that bends about the turning point is the same on both ways.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh

from magbridge.diagnose.compare.survey import Survey

__all__ = ["Returns", "returns"]

RETURN_CELL_M = 250.0
"""Side of the cells, m: crustal sources are seldom nearer, and a map's own grid is seldom finer."""
MIN_RETURN_TIME_S = 900.0
"""s after which passing a place again is a return."""
SEPARABLE = 0.1
"""Least fraction from which on place and time are distinguished: at S/N 10 it gives log odds of 5 (150:1)."""


class Returns(NamedTuple):
    """The returns of a track."""

    share: float
    """Fraction of the samples that lie where the track passes again."""
    longest: float
    """s, the longest time between two passes of one place."""
    separable: float
    """Least share of the power of a slow change with time that no function of the place imitates."""

    @property
    def distinguishable(self) -> bool:
        """Return True if the log distinguishes place from time."""
        return self.separable >= SEPARABLE

    @property
    def text(self) -> str:
        """Description of the track as a sentence."""
        both = "an error of the map and a slow change with time (a daily variation)"
        if not self.share:
            return f"The track never returns to a place: {both} cannot be distinguished."
        again = (
            f"The track passes {100.0 * self.share:.0f} % of its places again, up to "
            f"{self.longest / 3600.0:.1f} h later"
        )
        if self.distinguishable:
            return f"{again}: {both} can be distinguished."
        like = f"imitates {100.0 * (1.0 - self.separable):.0f} % of the other's power"
        return f"{again}, but at times at which one {like}: {both} cannot be distinguished."


def returns(survey: Survey) -> Returns | None:
    """Return where and when the track of a survey returns; None for a log without positions."""
    if survey.place is None:
        return None
    corner = np.floor(survey.place[:, :2] / RETURN_CELL_M).astype(int)
    cell = np.unique(corner, axis=0, return_inverse=True)[1].ravel()
    order = np.lexsort((survey.time, cell))
    of, time = cell[order], survey.time[order]
    again = (np.diff(of) == 0) & (np.diff(time) > MIN_RETURN_TIME_S)
    first, last = (
        np.searchsorted(of, np.arange(of[-1] + 1)),
        np.searchsorted(of, np.arange(of[-1] + 1), "right") - 1,
    )
    passed = np.bincount(of[1:], again, of[-1] + 1) > 0
    x = (time - time.min()) / max(float(np.ptp(time)), 1.0)
    f = np.stack([x, x * x], axis=1)
    f -= f.mean(axis=0)
    count = np.bincount(of)[:, None]
    means = np.stack([np.bincount(of, column) for column in f.T], axis=1) / count
    within = f - means[of]
    separable = float(eigh(within.T @ within, f.T @ f, eigvals_only=True)[0])
    longest = float(np.max(np.where(passed, time[last] - time[first], 0.0)))
    return Returns(float(np.mean(passed[of])), longest, float(np.clip(separable, 0.0, 1.0)))
