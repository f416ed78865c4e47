r"""Check whether the corrected total field depends on quantities that do not change the Earth's field.

The Earth's field does not depend on the vehicle's attitude, temperature or mass positions. An error of the
calibration does. With u the direction of the corrected field in sensor axes, an error changes the total field
by

- :math:`u^T a` (offset), :math:`\theta u^T a` (offset that follows the temperature), :math:`t\,u^T a`
(drift),
- :math:`u_x^2 a_x + u_y^2 a_y + u_x u_y a_{xy}` (gain),
- :math:`a\, \partial F / \partial p` (telemetry of a mass p).

A Kalman filter predicts the total field from a model of the crustal field along the track
(:mod:`magbridge.estimation.track_process`). :mod:`magbridge.estimation.sequential` tests the innovations for
each of these errors.

The null hypothesis contains everything that is expected: the calibration's coefficients have independent
errors of their stated covariance, which are states of the filter. The innovations are white only if the model
of the crustal field is right. So its roughness is adapted until successive innovations are uncorrelated
(Mehra 1970, IEEE Trans. Automatic Control 15:175), whatever the scale of the noise. Where the vehicle turns,
dives or climbs, the field's slope along the new path is unknown. During an alarm, sigma
includes the estimated error of the present sample, averaged over the errors and onsets that fit.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import acos, cos, exp, isfinite, nan
from typing import Final, NamedTuple

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.model import Noise
from magbridge.constants import MAIN_FIELD_SIGMA_NT
from magbridge.estimation.kalman import KalmanFilter
from magbridge.estimation.sequential import SequentialTest
from magbridge.estimation.track_process import TRACK_STATES, TrackProcess
from magbridge.health.checks import Messages
from magbridge.health.trend import TrendCheck
from magbridge.records import NEVER, Vector

MIN_INTERVAL_S: Final = 1.0
MAX_INTERVAL_S: Final = 4.0
INTERVAL_M: Final = 25.0
"""Interval between two tested samples: shortest and longest time (s), and preferred distance (m)."""
CONSTANT_SIGMA_NT: Final = 1000.0
MAX_GAP_S: Final = 1e5
"""Largest elapsed time between tested samples, s; after it, nothing is known of the field."""
OFFSET_NT: Final = 20.0
DRIFT_NT_PER_H: Final = 10.0
PER_DEGREE_NT: Final = 1.0
GAIN_NT: Final = 60.0
MASS_FRACTION: Final = 0.03
"""Prior 1-sigma of each error: of an axis's offset, drift and temperature effect, of the gain (nT in the
Earth's field), and of a mass's telemetry (fraction of the calibrated range)."""
RETENTION_SAMPLES: Final = 1000.0
"""Time constant, in tested samples, of the exponential forgetting of evidence."""
CONSISTENCY_ALARM_LOG_RATIO: Final = 15.0
"""Log-likelihood ratio L above which an alarm begins: by chance at most once in a million tested samples, if
the crustal field and the calibration's error are as modelled."""
NOISE_DOF: Final = 8.0
"""Degrees of freedom of the prior for the scale of the innovations' variance."""
MIN_ERROR_SIGMA: Final = 1.0
"""Smallest RMS effect of an error that raises an alarm, in sigmas of the total field."""
REPORTED_ERROR_SIGMA: Final = 3.0
REPORTED_LOG_RATIO: Final = 25.0
"""RMS effect, in sigmas, and L from which an alarm is reported in text; below either, only sigma widens."""
CLEAR_LOG_RATIO: Final = 4.0
"""Log-likelihood ratio L below which an alarm ends."""
COMPETING_LOG_RATIO: Final = 5.0
"""Largest difference from the maximum of L at which an error and onset still fit."""
MAX_PENDING: Final = 64
MAX_CONSISTENT_SIGMA: Final = 5.0
AGREEING: Final = 3
"""Innovations above MAX_CONSISTENT_SIGMA sigmas are ignored as outliers, until AGREEING come in a row."""
STRAIGHT_CHANGE: Final = 0.05
"""Change of each component of the unit vector up to which the attitude counts as unchanged."""
MIN_TURN_COSINE: Final = 0.985
"""Cosine of the change of the field's direction (10 deg) from which the path counts as turned."""
MIN_STRAIGHT_SAMPLES: Final = 8
"""Number of samples without a turn after which the crustal field's roughness counts as known."""
ROUGHNESS_GAIN: Final = 0.1
MAX_RESIDUAL_SIGMA: Final = 3.0
MIN_LOG_ROUGHNESS: Final = -2.0
MAX_LOG_ROUGHNESS: Final = 5.0
"""Gain from the product of successive residuals to the crustal field's log roughness, the largest residual
that counts, and the bounds of the log roughness: after a smooth stretch, the next one may be rougher."""
PAST_GAIN: Final = 0.2
"""Gain of the exponential average of past residuals."""
ERROR_KINDS: Final = ("offset", "offset with temperature", "offset drift", "gain", "telemetry of a mass")


class Sensitivity(NamedTuple):
    """Derivatives of a sample's corrected total field, nT.

    `mass_changes` is the change if each mass moves by :data:`MASS_FRACTION` of its range, `error_effects`
    (r,) the change by one standard deviation of each of the calibration's independent errors.
    """

    mass_changes: Sequence[float] = ()
    error_effects: FloatArray = np.zeros(0)


class TestedSample(NamedTuple):
    """Corrected sample that the consistency check tests.

    `time_us` is the time (µs), `unit` the direction of the corrected field. `anomaly` is the corrected total
    field minus the main field, or the total field itself if no main field is known (nT). `sigma` is the part
    of its 1-sigma that is not common to all samples (nT), `temperature` the sensor's (degC; NaN if unknown).
    `speed` is the speed across the crustal field (m/s), `course` the vehicle's (rad; NaN if unknown).
    """

    time_us: int
    unit: Vector
    anomaly: float
    sigma: float
    temperature: float
    speed: float
    course: float
    sensitivity: Sensitivity


class ConsistencyCheck:
    """Test of the total field for dependence on attitude, temperature, time and mass positions.

    `noise` is the calibration's noise model, `masses` the number of mass positions that the calibration uses.
    `is_wrong` is True during an alarm.
    """

    def __init__(self, noise: Noise, masses: int, messages: Messages) -> None:
        self._messages = messages
        self._process = TrackProcess(
            max(noise.sensor, 0.1), MAIN_FIELD_SIGMA_NT, CONSTANT_SIGMA_NT,
            autocorrelation=noise.autocorrelation, interval=noise.interval, white=noise.white,
        )  # fmt: skip
        self._masses = masses
        # temperature effect and drift act by their change since the onset, offset and gain in full
        since_onset = [False, True, True, False] + [False] * masses
        self._test = SequentialTest(since_onset, TRACK_STATES, RETENTION_SAMPLES, NOISE_DOF)
        self._log_roughness, self._straight_samples, self._past_residual = 0.0, 0, 0.0
        self._course = nan
        self.restart()

    def restart(self) -> None:
        """Discard all evidence and the filter's state, for example after a change of the calibration."""
        self._begin_filter(0)
        self._time_us, self._due_us, self._level = NEVER, NEVER, 0.0
        self._pending: deque[TestedSample] = deque(maxlen=MAX_PENDING)
        self._outliers = 0
        self._last_unit = self._path_unit = np.zeros(3)
        self._temperature = 0.0
        self._variance = 0.0
        self.is_wrong = False

    def _begin_filter(self, errors: int) -> None:
        """Begin a filter with a number of independent errors of the calibration, which have 1-sigma 1."""
        covariance = np.eye(TRACK_STATES + errors)
        covariance[:TRACK_STATES, :TRACK_STATES] = self._process.initial
        self._filter = KalmanFilter(np.zeros(len(covariance)), covariance)
        self._test.restart(len(covariance))

    def forget_crust(self) -> None:
        """Discard all evidence and the estimated roughness: the vehicle has become much faster."""
        self.restart()
        self._log_roughness, self._straight_samples = 0.0, 0

    @property
    def is_waiting(self) -> bool:
        """Return True if a sample waits for newer telemetry."""
        return bool(self._pending)

    def is_due(self, time_us: int, trend: TrendCheck) -> bool:
        """Return True if a new sample is due, at an interval that depends on the trend's crossing speed."""
        elapsed_us = time_us - self._due_us
        if 0 <= elapsed_us < 0.99e6 * MIN_INTERVAL_S:  # at any speed
            return False
        interval, speed = MAX_INTERVAL_S, trend.crossing_speed
        if speed > 0.0:
            interval = min(max(INTERVAL_M / speed, MIN_INTERVAL_S), MAX_INTERVAL_S)
        return not 0 <= elapsed_us < 0.99e6 * interval

    def add(self, sample: TestedSample) -> None:
        """Store a sample, which waits for its test until newer telemetry has come."""
        self._due_us = sample.time_us
        self._pending.append(sample)

    def drop(self, since_us: int) -> None:
        """Discard the waiting samples after `since_us` (µs), because a mass may have moved since then."""
        while self._pending and self._pending[-1].time_us > since_us:
            self._pending.pop()

    def confirm(self, reported_us: int) -> None:
        """Test the waiting samples that are not newer than the telemetry of the time `reported_us`, µs."""
        while self._pending and self._pending[0].time_us <= reported_us:
            self._test_sample(self._pending.popleft())

    def _test_sample(self, sample: TestedSample) -> None:
        """Predict the total field of a sample, test the innovation, and update the filter."""
        time_us, unit, total, sigma, temperature, speed, course, (mass_changes, errors) = sample
        seconds = 1e-6 * (time_us - self._time_us)
        # the first sample, a clock that goes back, and a calibration of other terms restart the check
        other_terms = len(self._filter.mean) != TRACK_STATES + len(errors)
        if self._time_us == NEVER or seconds < 0.0 or other_terms:
            self.restart()
            self._level, seconds = total, 0.0
            self._begin_filter(len(errors))
        seconds = min(seconds, MAX_GAP_S)
        self._time_us = time_us
        if isfinite(temperature):
            self._temperature = temperature
        turn, self._course = course - self._course, course
        stretch = exp(self._log_roughness / 3.0)
        metres = speed * stretch * seconds
        # time update of the crustal field, and of the part of each error that the filter has absorbed
        turn = self._turn(turn if isfinite(turn) else 0.0, np.array(unit))
        F, Q = self._process.transition(metres, seconds, turn, stretch)
        self._filter.predict(F, Q, slice(TRACK_STATES))
        absorbed = self._test.absorbed[:TRACK_STATES]
        absorbed[:] = np.dot(F, absorbed.reshape(len(F), -1)).reshape(absorbed.shape)
        # the calibration's own errors are states, so that the innovation is white while they are as stated
        row = np.concatenate([self._process.row(1.0), -errors])
        v = self._filter.innovate(total - self._level, row, self._process.white_variance)
        normalised = v / self._filter.sigma
        self._outliers = self._outliers + 1 if abs(normalised) > MAX_CONSISTENT_SIGMA else 0
        if 0 < self._outliers < AGREEING and not self.is_wrong:
            return
        # test the innovation before the filter absorbs it
        seconds_now = 1e-6 * time_us
        regressors = np.array([1.0, self._temperature, seconds_now / 3600.0] + [1.0] * (1 + self._masses))
        effects = self._effects(np.array(unit), np.array(mass_changes))
        largest = self._test.test(self._filter, seconds_now, regressors, effects)
        self._learn_roughness(normalised, np.array(unit))
        self._test.update(self._filter.update())
        self._decide(largest, sigma)

    def _turn(self, course_change: float, unit: FloatArray) -> float:
        """Return the angle between old and new direction of travel (rad), by the course and the attitude.

        A vehicle that dives or climbs moves along its axis, so that its attitude shows a change of the path
        that the course does not.
        """
        cosine = max(float(unit @ self._path_unit), 0.0) if self._path_unit.any() else 1.0
        if self._path_unit.any() and cosine > MIN_TURN_COSINE:
            return course_change
        self._path_unit = unit
        return acos(cosine * cos(course_change))

    def _learn_roughness(self, residual: float, unit: FloatArray) -> None:
        """Adapt the crustal field's roughness to a residual (sigmas), unless the vehicle turns."""
        # not in a turn, where an error of the calibration looks like roughness
        turned = float(np.abs(unit - self._last_unit).max())
        self._last_unit = unit
        residual = min(max(residual, -MAX_RESIDUAL_SIGMA), MAX_RESIDUAL_SIGMA)
        if turned < STRAIGHT_CHANGE and self._filter.covariance[3, 3] < 0.5 * CONSTANT_SIGMA_NT**2:
            self._straight_samples += 1
            # the innovations of the right model are white (Mehra 1970)
            self._log_roughness += ROUGHNESS_GAIN * residual * self._past_residual
            self._log_roughness = min(max(self._log_roughness, MIN_LOG_ROUGHNESS), MAX_LOG_ROUGHNESS)
        self._past_residual += PAST_GAIN * (residual - self._past_residual)

    def _effects(self, u: FloatArray, mass_changes: FloatArray) -> FloatArray:
        """Return the effect (kinds, 3) of each error's prior 1-sigma on the total field, nT."""
        effects = np.zeros((4 + self._masses, 3))
        # effects of the module, in the unit of each error
        effects[:3] = np.outer([OFFSET_NT, PER_DEGREE_NT, DRIFT_NT_PER_H], u)
        effects[3] = GAIN_NT * np.array([u[0] * u[0], u[1] * u[1], u[0] * u[1]])
        effects[4:, 0] = mass_changes
        return effects

    def _decide(self, largest: float, sigma: float) -> None:
        """Begin or end an alarm by the largest L, and set the variance to add while the alarm lasts."""
        test = self._test
        rows, weights = test.competing(COMPETING_LOG_RATIO)
        size = test.rms(rows[0])
        # no alarm for an error that sigma covers, or before the crustal field's roughness is known
        matters = size > MIN_ERROR_SIGMA * sigma and self._straight_samples >= MIN_STRAIGHT_SAMPLES
        if self.is_wrong:
            self.is_wrong = largest > CLEAR_LOG_RATIO
        else:
            self.is_wrong = matters and largest > CONSISTENCY_ALARM_LOG_RATIO
        self._variance = 0.0
        if not self.is_wrong:
            return
        # second moment of the error at the present attitude, over the errors and onsets that compete
        for row, weight in zip(rows, weights.tolist(), strict=True):
            f, a = test.signature[row], test.amplitude[row]
            error = float(f @ a)
            # an amplitude beyond its prior shows that the prior was too narrow, by this factor
            wider = max(1.0, float(a @ a) / len(a))
            self._variance += weight * (error * error + wider * float(f @ test.covariance(row) @ f))
        if size <= REPORTED_ERROR_SIGMA * sigma or largest < REPORTED_LOG_RATIO:
            return
        kind = ERROR_KINDS[min(int(test.kind[rows[0]]), len(ERROR_KINDS) - 1)]
        text = f"field depends on the attitude or a mass, {size:.0f} nT: {kind} wrong"
        self._messages.report("consistency", text)

    def variance(self) -> float:
        """Return the variance (nT²) that an alarm adds to the total field; 0 without an alarm."""
        return self._variance
