r"""Test whether the telemetry of the masses is late, by comparing each sample with later reports.

Late telemetry shows in the samples before a motion is reported: they fit the positions of a later report. A
sample of innovation v (variance S) has the innovation v' at the positions that are reported a time d later.
How late they are is known to a share w only, so the variance of v' is :math:`S' = S + w^2 (v' - v)^2`, and
the log-likelihood ratio of 'late by about d' over 'in time' is

.. math:: L_d \leftarrow \max\left(0, L_d + \tfrac12 \left(
          \frac{v^2}{S} - \frac{v'^2}{S'} - \log \frac{S'}{S} \right)\right)

(Page 1954, Biometrika 41:100). With masses at rest v' = v, and the ratio does not change. Late samples look
like outliers to the other tests, so this test uses them even if the sensor seems to be at fault.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from math import log, sqrt
from typing import Final, NamedTuple

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.learning.causes import Alarm
from magbridge.learning.doubt import LEARNING_ALARM_LOG_RATIO
from magbridge.learning.observation import Observation
from magbridge.records import Vector

__all__ = ["Hindsight", "Kept"]

LATE_US: Final = (8_000_000, 16_000_000, 32_000_000)
"""µs, d: shorter ones are those of telemetry that comes seldom."""
MAX_DELAY_ERROR: Final = 0.25
"""By how much of d a later report may be off."""
DELAY_UNCERTAINTY: Final = 0.4
"""w: the next d is the double."""
MAX_HINDSIGHT_SQUARE: Final = 36.0
"""v²/S at most: two samples are needed in any case, and the last before a motion is none of them."""
MAX_STORED_SAMPLES: Final = 41
"""Samples kept, at most one a second."""
MOVED: Final = 0.01
"""Of its scale, by which a parameter has moved."""


class Kept(NamedTuple):
    """A sample of masses at rest, with its innovation (nT) and that one's variance (nT²)."""

    time_us: int
    field: Vector
    reference: float
    phi: FloatArray
    positions: list[float]
    innovation: float
    variance: float


class Hindsight:
    """Keeps the samples of the last half minute."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget all evidence."""
        self._kept: deque[Kept] = deque(maxlen=MAX_STORED_SAMPLES)
        self._ratio = [0.0] * len(LATE_US)
        self._square = [0.0] * len(LATE_US)
        self._count = [0] * len(LATE_US)
        self._since_us = [0] * len(LATE_US)
        self._tested_us = [0] * len(LATE_US)

    def keep(self, sample: Kept) -> None:
        """Keep a sample."""
        if not self._kept or sample.time_us - self._kept[-1].time_us >= 1_000_000:
            self._kept.append(sample)
            self._count = [count + 1 for count in self._count]

    def test(
        self,
        time_us: int,
        phi: FloatArray,
        positions: list[float],
        observe: Callable[[Vector, FloatArray, float], Observation],
    ) -> Alarm | None:
        """Test the samples kept by the regressors (m,) and positions reported now.

        `observe` compares a field (nT), measured at some regressors, with a reference (nT).
        """
        for k in range(len(LATE_US)):
            one = self._reported_since(time_us, k)
            if one is None:
                continue
            self._tested_us[k] = one.time_us
            if np.abs(np.subtract(positions, one.positions)).max(initial=0.0) < MOVED:
                continue
            then, now = (observe(one.field, at, one.reference).e for at in (one.phi, phi))
            S = one.variance
            more = S + (DELAY_UNCERTAINTY * (now - then)) ** 2
            v = min(one.innovation**2 / S, MAX_HINDSIGHT_SQUARE)
            late = (one.innovation + now - then) ** 2 / more + log(more / S)
            if self._ratio[k] == 0.0:
                self._square[k], self._count[k], self._since_us[k] = 0.0, 1, one.time_us
            self._ratio[k] = max(0.0, self._ratio[k] + 0.5 * (v - late))
            self._square[k] += (now - then) ** 2 * (v > late)
            if self._ratio[k] > LEARNING_ALARM_LOG_RATIO:
                size = sqrt(self._square[k] / self._count[k])
                return Alarm(("clock_offset",), ("",), self._since_us[k] * 1e-6, size, self._ratio[k])
        return None

    def _reported_since(self, time_us: int, k: int) -> Kept | None:
        """Return the stored sample that the present report would match at the k-th d, or None."""
        late_us = LATE_US[k]
        one = min(self._kept, key=lambda one: abs(time_us - one.time_us - late_us), default=None)
        if one is None or abs(time_us - one.time_us - late_us) > MAX_DELAY_ERROR * late_us:
            return None
        return one if one.time_us > self._tested_us[k] else None
