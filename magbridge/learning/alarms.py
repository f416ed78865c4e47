r"""Test whether the model still explains the data, find the causes that fit, and keep the alarm's state.

:class:`ChangeDetector` tests the innovations of the baseline estimator for each cause, by
:mod:`magbridge.estimation.sequential`. A cause is learned by passing the result of its test to the estimator:
the amplitude :math:`\hat a = (I + M)^{-1} y`, of covariance :math:`(I + M)^{-1}`, moves the state by
:math:`-G \hat a`, where G contains the part that the filter has absorbed, :math:`\Xi`, and the cause's own
coefficients (Friedland 1969, IEEE Trans. Automatic Control 14:359). If several causes fit, each has a weight
proportional to :math:`e^L`.

:class:`LateTelemetryTest` tests whether the telemetry of the masses is late, by comparing each sample with
later reports. Late telemetry shows in the samples before a motion is reported: they fit the positions of a
later report. A sample of innovation v (variance S) has the innovation v' at the positions that are reported a
time d later. The delay is known only to a fraction w, so the variance of v' is
:math:`S' = S + w^2 (v' - v)^2`, and the log-likelihood ratio of 'late by about d' over 'in time' is

.. math:: L_d \leftarrow \max\left(0, L_d + \tfrac12 \left(
          \frac{v^2}{S} - \frac{v'^2}{S'} - \log \frac{S'}{S} \right)\right)

(Page 1954, Biometrika 41:100). With masses at rest v' = v, and the ratio does not change. Late samples look
like outliers to the other tests, so this test uses them even if the sensor seems to be at fault.

:class:`AlarmState` decides when to announce an alarm, when to learn its cause, and when it is over.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Sequence
from itertools import islice
from math import log, sqrt
from typing import Final, NamedTuple

import numpy as np

from magbridge.arrays import FloatArray, IndexArray
from magbridge.columns import TEMPERATURE
from magbridge.estimation.sequential import ALARM_LOG_RATIO, SequentialTest
from magbridge.learning.estimator import Estimator
from magbridge.learning.samples import LearnedTerms, LearningSample
from magbridge.records import NEVER, Quality

CAUSE_UNITS: Final = {
    "offset_step": 20.0,
    "offset_drift": 20.0,
    "temperature_offset": 2.0,
    "unmodelled_actuator": 20.0,
    "current_field": 20.0,
    "clock_offset": 2.0,
    "map_error": 50.0,
}
"""Prior 1-sigma of each cause's amplitude: nT, nT/h, nT/degC, nT per half range, nT/A, s, nT. Each cause has
a bit in MAG_LEARNING."""
FROM_ZERO: Final = ("offset_step", "current_field", "clock_offset", "map_error")
"""Causes whose effect is proportional to their regressor, not to its change since the onset."""
NO_COEFFICIENT: Final = frozenset(("clock_offset", "map_error"))
"""Causes that no coefficient can represent."""


def named(causes: Sequence[str]) -> str:
    """Return the names of the first two of `causes`, the likeliest, as words of a message."""
    return " or ".join(causes[:2]).replace("_", " ")


class AlarmCause(NamedTuple):
    """Cause to test: its name, the telemetry that it follows or "", and the states (3,) that represent it."""

    name: str
    channel: str
    states: IndexArray | None


class LearningAlarm(NamedTuple):
    """Alarm that the model no longer explains the data.

    `causes` are those that fit, the likeliest first, and `channels` the telemetry that each follows, or "".
    `since` is the onset of the likeliest cause (s since 1970 UTC), `size` the RMS of its effect on the total
    field (nT), and `strength` its log-likelihood ratio L.
    """

    causes: tuple[str, ...]
    channels: tuple[str, ...]
    since: float
    size: float
    strength: float
    mapless: bool = False
    """True for a map alarm: an unmapped crustal field explains the data. The corrected field is not affected,
    and the alarm lasts as long as the estimator bank raises it."""


MAX_CAUSE_LOG_RATIO: Final = log(20.0)
"""Largest difference of L from the best cause at which another cause still fits."""


class ChangeDetector:
    """Sequential test of an estimator's innovations for every cause."""

    def __init__(self, model: LearnedTerms, estimator: Estimator) -> None:
        self._offsets, self._states, self._origin = estimator.offsets, estimator.states, model.origin
        causes = [
            AlarmCause("offset_step", "", estimator.offsets),
            AlarmCause("offset_drift", "", estimator.slope),
            *(AlarmCause("unmodelled_actuator", name, model.slots(name)) for name in model.parameters),
            AlarmCause("temperature_offset", TEMPERATURE, model.slots(TEMPERATURE)),
            *(AlarmCause("current_field", name, model.slots(name)) for name in model.watched[1:]),
            AlarmCause("clock_offset", "", None),
            AlarmCause("map_error", "", None),
        ]
        self._causes = causes
        names = [cause.name for cause in causes]
        self._unit = np.array([CAUSE_UNITS[name] for name in names])
        self._no_vector = np.array([name in NO_COEFFICIENT for name in names])
        self._test = SequentialTest([name not in FROM_ZERO for name in names], self._states)
        self._now = 0.0

    def restart(self) -> None:
        """Discard all evidence, but keep the estimate of the noise."""
        self._test.restart()

    @property
    def strength(self) -> float:
        """Log-likelihood ratio L of the likeliest cause."""
        return float(self._test.log_ratio.max())

    def propagate(self, estimator: Estimator, F: FloatArray, seconds: float) -> None:
        """Propagate what the filter has absorbed of each cause; `F` is from :meth:`.Estimator.propagate`."""
        estimator.advance(self._test.absorbed, F, seconds)

    def test(
        self,
        estimator: Estimator,
        sample: LearningSample,
        by_offset: FloatArray,
        by_delay: float,
        by_level: float,
    ) -> LearningAlarm | None:
        """Test the estimator's prediction of a sample; return an alarm if a cause exceeds the threshold.

        `by_offset` (3,) is the derivative of the residual by the offset of each axis, `by_delay` the change
        of the residual with the telemetry's time, nT/s, `by_level` its derivative by the reference's level.
        """
        time = self._now = sample.time_us * 1e-6
        # one regressor for each cause, in their order; NaN where a channel's value is not known
        now = [1.0, time / 3600.0, *sample.positions, *sample.watched, by_delay, by_level]
        # each cause adds its regressor times the derivative by the offset of each axis; telemetry delay and
        # level act on the total field alone, not on an axis
        effects = np.outer(self._unit, by_offset)
        effects[self._no_vector] = 0.0
        effects[self._no_vector, 0] = self._unit[self._no_vector]
        largest = self._test.test(estimator.filter, time, np.nan_to_num(np.array(now)), effects)
        return self._alarm() if largest > ALARM_LOG_RATIO else None

    def updated(self, gain: FloatArray) -> None:
        """Account for the part of each cause that the estimator absorbed in its update with `gain` (n,)."""
        self._test.update(gain)

    def _alarm(self) -> LearningAlarm:
        """Return an alarm with the causes that fit."""
        test = self._test
        rows = test.competing(MAX_CAUSE_LOG_RATIO)[0]
        fitting = list(dict.fromkeys(self._causes[int(test.kind[row])][:2] for row in rows))
        return LearningAlarm(
            causes=tuple(dict.fromkeys(cause for cause, _ in fitting)),
            channels=tuple(channel for _, channel in fitting),
            since=float(test.onset[rows[0]]),
            size=test.rms(rows[0]),
            strength=self.strength,
        )

    def learned(self) -> tuple[FloatArray, FloatArray] | None:
        """Return the shift (n,) of the state that learns the fitting causes, and its covariance (n, n).

        Return None if no coefficient can represent the likeliest cause.
        """
        rows, weights = self._test.competing(MAX_CAUSE_LOG_RATIO)
        # the likeliest cause decides whether coefficients can be learned
        if self._states_of(rows[0]) is None:
            return None
        by, covariance = np.zeros(self._states), np.zeros((self._states, self._states))
        # moments of the mixture: mean and covariance about it
        for weight, row in zip(weights.tolist(), rows, strict=True):
            if self._states_of(row) is None:  # the cause moves no coefficient
                continue
            G, a = self._moves(row), self._test.amplitude[row]
            V = self._test.covariance(row) + np.outer(a, a)
            covariance += weight * G @ V @ G.T
            by -= weight * G @ a
        return by, np.asarray(covariance - np.outer(by, by))

    @property
    def misfit(self) -> float:
        """Mean normalised squared innovation that the likeliest cause leaves: 1 if it explains all."""
        return self._test.misfit(int(self._test.log_ratio.argmax()))

    def _states_of(self, row: int) -> IndexArray | None:
        return self._causes[int(self._test.kind[row])].states

    def _moves(self, row: int) -> FloatArray:
        """Return G (n, 3) of the module: the error of the state by a row's cause of unit amplitude."""
        kind, start = int(self._test.kind[row]), float(self._test.start[row])
        cause, unit = self._causes[kind], float(self._unit[kind])
        G = self._test.absorbed[:, row].copy()
        assert cause.states is not None
        # a drift has moved the offset since its onset, and continues with its slope
        if cause.name == "offset_drift":
            G[cause.states, range(3)] += unit / 3600.0
            G[self._offsets, range(3)] += unit * (self._now / 3600.0 - start)
            return np.asarray(G)
        # step or coefficient: the absorbed part (Xi), and the cause itself
        G[cause.states, range(3)] += unit
        if cause.name not in FROM_ZERO:
            # the regressor counts from the onset, the coefficient from its origin
            G[self._offsets, range(3)] -= unit * (start - self._origin(cause.channel))
        return np.asarray(G)


DELAYS_US: Final = (8_000_000, 16_000_000, 32_000_000)
"""Tested delays d, µs. Shorter delays are normal for telemetry that is sent seldom."""
MAX_DELAY_ERROR: Final = 0.25
"""Largest difference of a report's delay from d, as a fraction of d."""
DELAY_UNCERTAINTY: Final = 0.4
"""Fraction w of the module; it covers the gaps between the delays d, each twice the previous one."""
MAX_HINDSIGHT_SQUARE: Final = 36.0
"""Largest v²/S that a sample contributes, so that an alarm needs two samples."""
MAX_STORED_SAMPLES: Final = 41
"""Largest number of stored samples, at most one a second."""
MIN_MOTION: Final = 0.01
"""Smallest change of a scaled parameter that counts as a motion."""


class StoredSample(NamedTuple):
    """Sample with its masses at rest, its innovation (nT) and the innovation's variance (nT²)."""

    sample: LearningSample
    innovation: float
    variance: float


class DelayTest:
    """Page's test for telemetry that is late by about `delay_us` (µs)."""

    def __init__(self, delay_us: int) -> None:
        self._delay_us, self._tested_us = delay_us, NEVER
        self._ratio = self._square = 0.0
        self.count, self._since_us = 0, 0

    def reported_since(self, time_us: int, kept: Sequence[StoredSample]) -> StoredSample | None:
        """Return the stored sample about one delay older than `time_us`, or None if none is left to test."""
        delay_us, then_us = self._delay_us, time_us - self._delay_us
        after = bisect_left(kept, then_us, key=lambda one: one.sample.time_us)
        nearest = list(islice(kept, max(after - 1, 0), after + 1))
        stored = min(nearest, key=lambda one: abs(then_us - one.sample.time_us), default=None)
        if stored is None or abs(then_us - stored.sample.time_us) > MAX_DELAY_ERROR * delay_us:
            return None
        if stored.sample.time_us <= self._tested_us:
            return None
        self._tested_us = stored.sample.time_us
        return stored

    def add(self, stored: StoredSample, change: float) -> LearningAlarm | None:
        """Test a sample whose innovation grows by `change` (nT) at the positions reported now.

        Return an alarm if the log-likelihood ratio exceeds its threshold.
        """
        # compare v (positions reported then, variance S) with v' (positions reported now, variance S')
        v, S = stored.innovation, stored.variance
        S_late = S + (DELAY_UNCERTAINTY * change) ** 2
        square = min(v * v / S, MAX_HINDSIGHT_SQUARE)
        late = (v + change) ** 2 / S_late + log(S_late / S)
        # a ratio of 0 begins a new onset
        if self._ratio == 0.0:
            self._square, self.count, self._since_us = 0.0, 1, stored.sample.time_us
        self._ratio = max(0.0, self._ratio + 0.5 * (square - late))
        self._square += change**2 * (square > late)
        if self._ratio <= ALARM_LOG_RATIO:
            return None
        size = sqrt(self._square / self.count)
        return LearningAlarm(("clock_offset",), ("",), self._since_us * 1e-6, size, self._ratio)


class LateTelemetryTest:
    """Test for late telemetry, which compares stored samples of the last 40 s with later reports."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Discard all evidence."""
        self._kept: deque[StoredSample] = deque(maxlen=MAX_STORED_SAMPLES)
        self._tests = [DelayTest(delay_us) for delay_us in DELAYS_US]

    def keep(self, stored: StoredSample) -> None:
        """Store a sample, unless the last stored one is less than a second older."""
        if not self._kept or stored.sample.time_us - self._kept[-1].sample.time_us >= 1_000_000:
            self._kept.append(stored)
            for test in self._tests:
                test.count += 1

    def test(
        self,
        time_us: int,
        phi: FloatArray,
        positions: list[float],
        model: LearnedTerms,
        coefficients: FloatArray,
    ) -> LearningAlarm | None:
        """Test the stored samples with the regressors `phi` (m,) and the positions reported now.

        The `coefficients` (K,) of `model` predict the samples.
        """
        for test in self._tests:
            stored = test.reported_since(time_us, self._kept)
            if stored is None:
                continue
            sample = stored.sample
            if np.abs(np.subtract(positions, sample.positions)).max(initial=0.0) < MIN_MOTION:
                continue
            then, now = (
                model.observe(sample.field, at, coefficients, sample.reference).e for at in (sample.phi, phi)
            )
            if alarm := test.add(stored, now - then):
                return alarm
        return None


MIN_GROWTH: Final = 6.0
"""Least growth of an alarm's log-likelihood ratio before its cause is learned (6 = a factor of 400)."""
LOG_RATIO_PER_CAUSE: Final = 3.0
"""Additional growth required for each further cause that fits. More evidence often excludes causes, but to
separate causes after all were learned takes hours."""
MAX_WAIT_SAMPLES: Final = 128
"""Number of informative samples per fitting cause after which learning no longer waits for more evidence."""
MIN_UPDATE_GROWTH: Final = 2.0
"""Least growth of an alarm's log-likelihood ratio that updates the alarm."""
SILENT_SAMPLES: Final = 300
"""Number of informative samples without a new alarm after which an alarm is over."""


RELAPSE_FACTOR: Final = 4
"""Factor by which each relapse multiplies the evidence and the samples required."""
SIGNIFICANT_SQUARE: Final = 16.0
"""Squared normalised prediction error above which an error is significant."""


class AlarmState:
    """State of the current `alarm`, if there is one; `mapped` is True if the reference is a map.

    A relapse is an alarm that comes before the last learned cause has explained :data:`SILENT_SAMPLES`
    informative samples. An alarm after a relapse continues the first alarm, without another announcement. It
    ends when a learned calibration has explained as many samples.

    During an alarm, `flags` has the bit ``unexplained``, and `variance` is that of the unexplained residual,
    nT². `is_tried` is True if the alarm's cause was learned and no alarm has followed. `is_pending` is True
    until later samples confirm the learned calibration, which is not published before.
    """

    def __init__(self, *, mapped: bool = False) -> None:
        self._mapped = mapped
        self._peak = self._since = 0.0
        self.end()

    def end(self) -> None:
        """Close the alarm."""
        self.alarm: LearningAlarm | None = None
        self.flags, self.variance, self.relapses = 0, 0.0, 0
        self.is_tried = self.is_pending = False
        self._required = 0.0
        self._informative = self._silent = 0
        self._explained = SILENT_SAMPLES + 1

    @property
    def _slower(self) -> int:
        return int(RELAPSE_FACTOR**self.relapses)

    def update(self, alarm: LearningAlarm) -> str:
        """Update the state with an alarm of the change detector; return the notification, or ""."""
        before = self.alarm
        # an alarm after the cause was learned is a new alarm, or a relapse
        is_new = before is None or self.is_tried
        if before is not None and (alarm.mapless or before.mapless):
            if alarm.mapless and before.causes == alarm.causes:
                self.alarm, self._silent = alarm, 0
            return ""  # a map error explains every further alarm
        if before is not None and not is_new and alarm.strength < before.strength + MIN_UPDATE_GROWTH:
            return ""
        # a relapse: the last learned cause has not explained enough samples
        if is_new and self._explained <= SILENT_SAMPLES:
            self.relapses += 1
        self._since = self._since if self.relapses else alarm.since
        self.alarm, self._silent = alarm._replace(since=self._since), 0
        self.is_tried = self.is_pending = False
        self.flags = int(Quality.UNEXPLAINED)
        self._cover()
        if is_new:
            self._informative, self._required = 0, alarm.strength + self._slower * MIN_GROWTH
        if before is not None:
            return ""
        return f"unexplained{' still' * bool(self.relapses)}: {alarm.size:.0f} nT, {named(alarm.causes)}"

    def try_cause(self) -> None:
        """Record that the alarm's cause was learned, but is not published until it is confirmed."""
        self.is_tried = self.is_pending = True
        self._silent = self._explained = 0
        self._cover()

    def restart(self) -> None:
        """Require new evidence to learn the alarm's cause, because learning restarts."""
        if self.alarm is not None:
            self.alarm = self.alarm._replace(strength=0.0)
        self._required, self._informative = self._slower * MIN_GROWTH, 0

    def confirm(self) -> bool:
        """Record that the learned calibration is published; return True if the alarm is closed."""
        self.is_pending, self._silent = False, 0
        if self.relapses:
            self._cover()
            return False
        self.end()
        self._explained = 0
        return True

    def mark_mistaken(self) -> None:
        """Record that the learned calibration was rolled back."""
        if self.alarm is not None and not self.is_mapless:
            self.relapses, self.is_tried, self.is_pending = max(1, self.relapses), True, False
            self._explained = self._silent = 0

    def count(self, error: float, variance: float, *, informative: bool) -> None:
        """Count a sample, with the published calibration's error (nT) and its predicted variance (nT²).

        `informative` is True if the sample is informative about the coefficients.
        """
        # only informative samples count: the others cannot show an effect
        self._silent += informative
        self._informative += informative
        self._explained += informative
        # largest statistically significant error, forgotten over SILENT_SAMPLES informative samples
        seen = error * error - SIGNIFICANT_SQUARE * variance
        self._peak = max(self._peak * (1.0 - informative / SILENT_SAMPLES), seen)
        if self.relapses and seen > 0.0:
            self._silent = 0
        self._cover()

    def _cover(self) -> None:
        """Set the variance to the larger square: unpublished cause's effect or observed errors."""
        # sigma includes the cause's effect until it is published, then the observed errors
        learned = self.is_tried and not self.is_pending
        size = 0.0 if self.alarm is None or learned or self.is_mapless else self.alarm.size
        self.variance = max(size * size, self._peak if self.relapses or self.is_pending else 0.0)

    @property
    def is_mapless(self) -> bool:
        """True during a map alarm: an unmapped crustal field explains the data."""
        return self.alarm is not None and self.alarm.mapless

    @property
    def is_silent(self) -> bool:
        """True if the alarm has not been raised for :data:`SILENT_SAMPLES` informative samples."""
        return self.alarm is not None and self._silent > SILENT_SAMPLES

    @property
    def is_learnable(self) -> bool:
        """True if there is an alarm whose cause coefficients can represent."""
        return self.alarm is not None and not NO_COEFFICIENT.issuperset(self.alarm.causes)

    @property
    def is_certain(self) -> bool:
        """True if the evidence suffices to learn the alarm's cause."""
        if self.alarm is None or self.is_tried or not self.is_learnable:
            return False
        # each further candidate needs more growth, so that future attitudes separate the causes
        fit, slower = len(self.alarm.channels), self._slower
        sure = self.alarm.strength > self._required + slower * LOG_RATIO_PER_CAUSE * (fit - 1)
        if self._mapped and "map_error" in self.alarm.causes:
            sure = False  # map sheets may differ in level: only further attitudes show an offset
        return sure or self._informative > slower * MAX_WAIT_SAMPLES * fit
