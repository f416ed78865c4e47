r"""Correct the direction of the vector for the lag of the sensor's anti-alias filter, sample by sample.

A first-order filter of cutoff frequency :math:`f_c` gives y with
:math:`\mathbf y + \tau \dot{\mathbf y} = \mathbf x`, :math:`\tau = 1 / (2 \pi f_c)`. A calibration is linear
in the reading, so the corrected vector has the same lag. In a turn of rate :math:`\omega`, the lag changes
the heading by :math:`\omega \tau`, and to first order does not change the length. The correction adds
:math:`\tau \dot{\mathbf y}_\perp`, the component of the derivative perpendicular to the vector, and restores
the length. It does not change the noise along the field.

The derivative is that of a parabola at its last sample. The parabola is fitted by weighted least squares to
means of blocks of samples over the last :data:`SPAN_TIME_CONSTANTS` time constants (at least three blocks).
The weights are the numbers of samples in the blocks: :math:`W_i = n_i (N^{-1} a_i)_1`,
:math:`a_i = (1, t_i, t_i^2)`, with the normal matrix N of the parabola and times relative to the last sample.
After an abrupt change of attitude the parabola overshoots. So the derivative d is multiplied by
:math:`k = \max(0, 1 - |\Delta \mathbf d|^2 / |\mathbf d|^2)`, where :math:`\Delta \mathbf d` is its change
since the last sample. Sigma includes the omitted part.
"""

from __future__ import annotations

from collections import deque
from math import inf, pi, sqrt
from typing import Final

from magbridge.records import Vector

__all__ = ["LagCorrection"]

SPAN_TIME_CONSTANTS: Final = 4.0
"""Time span of the parabola, in time constants; shorter spans give a noisier derivative."""
BLOCKS: Final = 12
"""Number of blocks of samples in that span."""
MIN_PARABOLA_BLOCKS: Final = 3
"""Smallest number of blocks, also if the sample interval is longer than a block."""
MAX_INTERVAL_RATIO: Final = 10.0
"""Ratio of an interval to the one before it, from which it is a gap; the fit starts again after a gap."""


class LagCorrection:
    """Correction for the lag of a first-order low-pass filter with cutoff frequency `cutoff_hz`.

    `time_constant` is the filter's time constant, s; `variance` (nT²) is the variance of each component of
    the last vector due to the uncertainty of the lag.
    """

    def __init__(self, cutoff_hz: float) -> None:
        self.time_constant = 1.0 / (2.0 * pi * cutoff_hz)
        self.variance = 0.0
        self._block_s = SPAN_TIME_CONSTANTS * self.time_constant / BLOCKS
        # of each block: number of samples, the sums of time (s) and field (nT), and its first time (s)
        self._blocks: deque[list[float]] = deque()
        self._begin_us = self._last_us = 0
        self._step_s = 0.0
        self._rate: Vector = (0.0, 0.0, 0.0)

    def undo(self, time_us: int, field: Vector, delay_s: float = 0.0) -> Vector:
        """Return the calibrated vector `field` (nT) at `time_us` (µs), corrected for the lag.

        A vector that is zero or not finite is returned unchanged. `delay_s` is the part of the filter's delay
        for which `time_us` is already corrected.
        """
        x, y, z = field
        length2 = x * x + y * y + z * z
        self.variance = 0.0
        if not 0.0 < length2 < inf:
            return field
        step_s = (time_us - self._last_us) * 1e-6
        if not 0.0 < step_s <= MAX_INTERVAL_RATIO * max(self._step_s or step_s, self.time_constant):
            self._blocks.clear()
            self._begin_us, step_s, self._rate = time_us, 0.0, (0.0, 0.0, 0.0)
        self._last_us, self._step_s = time_us, step_s
        self._add((time_us - self._begin_us) * 1e-6, field)
        p, q, r = self._derivative()
        along = (p * x + q * y + r * z) / length2
        p, q, r = p - along * x, q - along * y, r - along * z
        before, self._rate = self._rate, (p, q, r)
        squared = p * p + q * q + r * r
        if squared == 0.0:
            return field
        changed = (p - before[0]) ** 2 + (q - before[1]) ** 2 + (r - before[2]) ** 2
        weight = max(1.0 - changed / squared, 0.0)
        lag_s = self.time_constant - delay_s
        error = lag_s * ((1.0 - weight) * sqrt(squared) + 0.5 * weight * sqrt(changed))
        self.variance = 0.5 * error * error
        turn = weight * lag_s
        x, y, z = x + turn * p, y + turn * q, z + turn * r
        scale = sqrt(length2 / (x * x + y * y + z * z))
        return x * scale, y * scale, z * scale

    def _add(self, time_s: float, field: Vector) -> None:
        """Add a sample to its block, and remove blocks older than the span."""
        blocks = self._blocks
        if blocks and time_s - blocks[-1][5] < self._block_s:
            last = blocks[-1]
            last[0] += 1.0
            last[1] += time_s
            for axis in range(3):
                last[2 + axis] += field[axis]
        else:
            blocks.append([1.0, time_s, *field, time_s])
        span_s = SPAN_TIME_CONSTANTS * self.time_constant
        while len(blocks) > MIN_PARABOLA_BLOCKS and time_s - blocks[0][5] > span_s:
            blocks.popleft()

    def _derivative(self) -> Vector:
        """Return the derivative (nT/s) of the parabola at the last sample."""
        blocks, now = self._blocks, (self._last_us - self._begin_us) * 1e-6
        weights = _weights([block[1] / block[0] - now for block in blocks], [block[0] for block in blocks])
        rate = [0.0, 0.0, 0.0]
        for weight, block in zip(weights, blocks, strict=True):
            for axis in range(3):
                rate[axis] += weight * block[2 + axis] / block[0]
        return rate[0], rate[1], rate[2]


def _weights(times: list[float], counts: list[float]) -> list[float]:
    """Return the weight (1/s) of each block's mean in the derivative at time 0; `counts` are block sizes."""
    if len(times) < 2:
        return [0.0] * len(times)
    if len(times) == 2:
        slope = 1.0 / (times[1] - times[0])
        return [-slope, slope]
    s0 = s1 = s2 = s3 = s4 = 0.0
    for t, n in zip(times, counts, strict=True):
        s0, s1, s2, s3, s4 = s0 + n, s1 + n * t, s2 + n * t * t, s3 + n * t**3, s4 + n * t**4
    # the second row of the inverse of [[s0, s1, s2], [s1, s2, s3], [s2, s3, s4]]
    a, b, c = s2 * s3 - s1 * s4, s0 * s4 - s2 * s2, s1 * s2 - s0 * s3
    determinant = s1 * a + s2 * b + s3 * c
    if determinant == 0.0:
        return [0.0] * len(times)
    return [n * (a + b * t + c * t * t) / determinant for t, n in zip(times, counts, strict=True)]
