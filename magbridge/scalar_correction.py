"""Compensate the readings of a scalar magnetometer live, with the vector sensor's samples of the same time.

The compensation (:mod:`magbridge.calibration.scalar`) needs the direction of the field and its rate of change
at the time of the reading, and how fast the reading itself changes. So a reading waits for the next one, and
for a vector sample that is not older than that. The vector is interpolated to the readings' times; all
derivatives are then central differences, as offline.
"""

from __future__ import annotations

from collections import deque
from math import inf, isfinite, nan, sqrt
from typing import NamedTuple

import numpy as np

from magbridge.align import Aligner, Input, Sample
from magbridge.arrays import FloatArray
from magbridge.calibration.model import Noise
from magbridge.calibration.scalar import CYCLE_LEVEL_SIGMA_NT, ScalarSensor, ScalarSeries, correct_scalar
from magbridge.config import Align
from magbridge.health import HealthMonitor, Messages
from magbridge.health.consistency import Sensitivity
from magbridge.parts import OptionalParts
from magbridge.records import Corrected, Quality, Reading, Vector

__all__ = ["ScalarCorrection"]

MAX_TELEMETRY_AGE_S = 30.0
"""s after which telemetry is stale, unless the configuration sets another age."""
MAX_WAIT_US = 3_000_000
"""µs that a reading waits for the next one and for the vector; then it is published without a field."""
STORED_VECTORS = 4096
"""Vector samples that are kept: three seconds at 1,000 Hz."""
NO_VECTOR = (nan, nan, nan)


class PendingReading(NamedTuple):
    """A reading that waits for its compensation."""

    sample: Sample
    main_field: float
    """Main field's total, nT; NaN where unknown."""
    where: tuple[float, float] | None
    """Position of the vehicle: latitude and longitude, deg; None where unknown."""


class ScalarCorrection:
    """Correct reading after reading of a scalar magnetometer.

    Without the compensation `sensor` a reading is published as it is; `sigma` is then its 1-sigma, nT, and
    without both, samples are flagged ``uncalibrated``. `settings` hold the filter delay of this sensor.
    `notices` collects the messages about flagged samples, each once, until the caller empties it.
    """

    def __init__(self, sensor: ScalarSensor | None, settings: Align, sigma: float | None = None) -> None:
        self._sensor = sensor.without_shift() if sensor is not None else None
        channels = sensor.channels if sensor is not None else ()
        age = MAX_TELEMETRY_AGE_S
        inputs = tuple(Input(one.name, one.low, one.high, age, is_mass=False) for one in channels)
        self.aligner = Aligner(inputs, settings)
        self._messages = Messages()
        self.notices = self._messages.lines
        self.parts = OptionalParts(self.notices.append)
        self._sigma = CYCLE_LEVEL_SIGMA_NT if sigma is None else sigma
        self._flags = int(Quality.UNCALIBRATED) if sensor is None and sigma is None else 0
        white = sensor.noise.white if sensor is not None else 0.0
        self._health = None if self._flags else HealthMonitor(Noise(white), self._messages)
        self._vectors: deque[tuple[int, Vector]] = deque(maxlen=STORED_VECTORS)
        self._pending: deque[PendingReading] = deque()
        self._before: Sample | None = None

    def tune(self, settings: Align, ages: dict[str, float]) -> None:
        """Replace the settings of the alignment; the filter delay stays that of this sensor."""
        self.aligner.tune(settings, ages)

    def telemetry(self, name: str, value: float, time_us: int, *, guessed: bool = False) -> None:
        """Process a telemetry value; arguments as :meth:`magbridge.align.Aligner.telemetry`."""
        self.aligner.telemetry(name, time_us, value, guessed=guessed)

    def vector(self, time_us: int, field: Vector) -> None:
        """Record the corrected vector (nT) of the vector sensor's sample at `time_us` (µs)."""
        if self._sensor is not None and isfinite(field[0] + field[1] + field[2]):
            if self._vectors and time_us <= self._vectors[-1][0]:
                self._vectors.clear()  # a clock was set back
            self._vectors.append((time_us, field))

    def reading(
        self,
        reading: Reading,
        time_us: int,
        main_field: float = nan,
        position: tuple[float, float] | None = None,
    ) -> None:
        """Record one reading; parameters as for :meth:`magbridge.correction.Correction.reading`."""
        sample = self.aligner.reading(reading, time_us)
        self._pending.append(PendingReading(sample, main_field, position))

    def samples(self, now_us: int) -> list[tuple[Sample, Corrected]]:
        """Return the samples that are complete at `now_us` (µs)."""
        pending = self._pending
        if self._sensor is None:
            ready = list(pending)
            pending.clear()
            results = [(one.sample.field[0], self._sigma) for one in ready]
            flags = [0] * len(ready)
        else:
            count = self._complete(now_us)
            ready = [pending.popleft() for _ in range(count)]
            results, flags = self._compensate([one.sample for one in ready])
        together = zip(ready, results, flags, strict=True)
        return [self._checked(one, total, sigma, flag) for one, (total, sigma), flag in together]

    def _complete(self, now_us: int) -> int:
        """Return the number of pending readings, from the first, that need not wait longer."""
        vector_us = self._vectors[-1][0] if self._vectors else 0
        count = 0
        for k, one in enumerate(self._pending):
            has_next = k + 1 < len(self._pending) and self._pending[k + 1].sample.time_us <= vector_us
            if not has_next and now_us - one.sample.time_us < MAX_WAIT_US:
                break
            count = k + 1
        return count

    def _compensate(self, samples: list[Sample]) -> tuple[list[tuple[float, float]], list[int]]:
        """Return total field and sigma (nT), and the flags, of readings in a row."""
        if not samples:
            return [], []
        sensor = self._sensor
        assert sensor is not None
        after = [self._pending[0].sample] if self._pending else []
        before = [self._before] if self._before is not None else []
        self._before = samples[-1]
        while len(self._vectors) > 2 and self._vectors[1][0] < samples[0].time_us - MAX_WAIT_US:
            self._vectors.popleft()
        row = [*before, *samples, *after]
        stale = int(Quality.STALE_TELEMETRY)
        if len(row) < 2:
            return [(nan, inf)] * len(samples), [stale] * len(samples)
        cycles = [one.reading.power_cycle for one in row]
        series = ScalarSeries(
            np.array([one.time_us for one in row]) * 1e-6,
            np.array([one.field[0] for one in row]),
            self._vectors_at([one.time_us for one in row]),
            np.full(len(row), nan),
            np.array([one.values for one in row]).reshape(len(row), len(sensor.channels)),
            np.array([nan if cycle is None else cycle for cycle in cycles], float),
        )
        found = correct_scalar(sensor, series)
        part = slice(len(before), len(before) + len(samples))
        flags = np.where(found.extrapolated, int(Quality.EXTRAPOLATED), 0) | np.where(found.missing, stale, 0)
        both = zip(found.field[part].tolist(), found.sigma[part].tolist(), strict=True)
        return list(both), flags[part].tolist()

    def _vectors_at(self, times_us: list[int]) -> FloatArray:
        """Return the vector (n, 3), nT, at times in µs; NaN where it is not known."""
        if len(self._vectors) < 2:
            return np.full((len(times_us), 3), nan)
        times = np.array([time_us for time_us, _ in self._vectors], float)
        field = np.array([vector for _, vector in self._vectors])
        wanted = np.array(times_us, float)
        columns = [np.interp(wanted, times, axis, left=nan, right=nan) for axis in field.T]
        far = np.abs(times[np.clip(np.searchsorted(times, wanted), 0, len(times) - 1)] - wanted) > MAX_WAIT_US
        return np.where(far[:, None], nan, np.stack(columns, axis=1))

    def _checked(
        self, pending: PendingReading, total: float, sigma: float, flags: int
    ) -> tuple[Sample, Corrected]:
        """Return a sample with the flags and the variance that alignment and plausibility checks add."""
        sample = pending.sample
        quality = sample.quality | flags | self._flags
        variance = sigma * sigma + sample.sigma * sample.sigma
        stated_sigma = sqrt(variance)
        if self._health is not None and isfinite(total):
            arguments = (self._health, pending, (total, sigma), quality)
            added, more = self.parts.call("plausibility check", (0.0, 0), self._check, *arguments)
            variance, quality = variance + added, quality | more
        main_field, sigma = pending.main_field, sqrt(variance)
        return sample, Corrected(total, sigma, NO_VECTOR, NO_VECTOR, quality, main_field, stated_sigma)

    def _check(
        self, health: HealthMonitor, pending: PendingReading, total: tuple[float, float], quality: int
    ) -> tuple[float, int]:
        """Return the variance (nT²) and the flags of the plausibility checks."""
        sample, F = pending.sample, pending.sample.field[0]
        health.is_changing = bool(sample.spans)
        if pending.where is not None:
            health.set_position(sample.time_us, *pending.where)
        reference = pending.main_field, self.aligner.settings.reference_sigma
        # one channel in place of three: its direction never changes, and it repeats only as a whole
        variance = health.check(
            sample.time_us, (F, F, F), (total[0], 0.0, 0.0), total, quality, reference,
            sample.reading.temperature, sample.age, Sensitivity,
        )  # fmt: skip
        return variance, health.flags
