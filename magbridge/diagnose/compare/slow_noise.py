r"""Flicker noise of a sensor: it grows towards low frequencies as 1/f, down to the length of the log.

Notes
-----
The autoregression of :mod:`~magbridge.diagnose.inference.noise` sees few samples and ends long before: it
leaves the lowest frequencies of 5,000 such samples five to nine times too much power, which passes for a slow
cause. So the noise of axis i may also have a slow part (Keshner 1982, Proc. IEEE 70:212),

.. math:: o_i(t) = \sum_k c_{ki} \cos(\pi k t / T), \qquad \operatorname{var} c_{ki} = g / k

of one common size g (:mod:`~magbridge.diagnose.inference.statistic`). It is that of many frequencies, of
which no slow cause has all. A random walk has 1/k^2 (:mod:`~magbridge.diagnose.accept`).
"""

from __future__ import annotations

import numpy as np

from magbridge.arrays import FloatArray

__all__ = ["slow_columns", "waves"]

EACH, LAST = 16, 64
"""Half waves per log along each axis, and further ones along the field alone."""


def waves() -> FloatArray:
    """(k,) k of each coefficient: each axis in turn, then along the field."""
    return np.append(np.repeat(np.arange(1.0, EACH + 1.0), 3), np.arange(EACH + 1.0, LAST + 1.0))


def slow_columns(slopes: FloatArray) -> FloatArray:
    """(n, k) what a nanotesla of each coefficient adds to a residual of `slopes` (n, 3) by the reading."""
    n, count = len(slopes), 3 * EACH
    wave = np.cos(np.pi * (np.arange(n)[:, None] + 0.5) / n * waves())
    along = np.linalg.norm(slopes, axis=1)[:, None]
    return np.concatenate([wave[:, :count] * np.tile(slopes, EACH), wave[:, count:] * along], axis=1)
