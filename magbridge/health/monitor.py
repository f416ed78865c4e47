"""Run on each corrected sample all checks that need no attitude from the autopilot."""

from __future__ import annotations

from collections.abc import Callable
from math import inf, isfinite, sqrt
from typing import Final

from magbridge.calibration.model import Noise
from magbridge.estimation.track_process import Course, ReferenceSteps
from magbridge.field.geodesy import separation
from magbridge.health.checks import MIN_FIELD_NT, LevelCheck, Messages, RepetitionCheck
from magbridge.health.consistency import ConsistencyCheck, Sensitivity, TestedSample
from magbridge.health.scatter import ACCELERATION, MIN_FASTER_M_S, Scatter
from magbridge.health.trend import TrendCheck
from magbridge.records import Quality, Vector

SUPPOSED_SPEED: Final = 30.0
"""Vehicle speed assumed until two positions give a speed, m/s."""
MAX_AGE_S: Final = 60.0
"""Longest time for which a jump or a sample of the consistency test waits for newer telemetry, s."""

IMPLAUSIBLE: Final = int(Quality.IMPLAUSIBLE)
STALE_TELEMETRY: Final = int(Quality.STALE_TELEMETRY)
UNSTEADY: Final = int(Quality.MOVING | Quality.STALE_TELEMETRY | Quality.SATURATED | Quality.LATE_JOIN)
"""Flags of a sample that the trend and consistency checks skip."""


class HealthMonitor:
    """Monitor that checks the corrected samples of one sensor, one after the other.

    Parameters
    ----------
    noise : Noise
        The calibration's noise model.
    messages : Messages, optional
        Collects the messages for the operator.
    level : float
        1-sigma of the total-field error that all samples have in common, nT.
    masses : int
        Number of mass positions that the calibration depends on.

    Attributes
    ----------
    flags : int
        :class:`~magbridge.records.Quality` bits of the last sample.
    is_fault : bool
        True if the last sample is an outlier, comes from a faulty sensor, or is not the Earth's field.
    is_changing : bool
        True if telemetry of the next sample has changed, which may explain a jump; the caller sets it.
    """

    def __init__(
        self, noise: Noise, messages: Messages | None = None, level: float = 0.0, masses: int = 0
    ) -> None:
        self._common = level * level
        self.flags = 0
        self.is_fault = self.is_changing = False
        messages = messages or Messages()
        self.messages = messages.lines
        self._axes, self._level = RepetitionCheck(messages), LevelCheck(messages)
        self._scatter = Scatter(noise, messages)
        self._trend = TrendCheck(self._scatter, messages)
        self._consistency = ConsistencyCheck(noise, masses, messages)
        self._position: tuple[float, float] | None = None
        self._course = Course()
        self._reference_steps = ReferenceSteps()
        self._unit: Vector = (0.0, 0.0, 0.0)

    def set_position(self, time_us: int, latitude: float, longitude: float) -> None:
        """Record the vehicle's position (deg), from which the checks derive the speed and the course."""
        if self._position is None:
            self._trend.set_speed(SUPPOSED_SPEED)
        elif (latitude, longitude) != self._position:
            self._course.move(*separation(*self._position, latitude, longitude))
        self._position = latitude, longitude
        speed = self._scatter.speed
        if self._scatter.set_position(time_us, latitude, longitude):
            self._trend.set_speed(self._scatter.speed)
            if self._scatter.speed > max(ACCELERATION * speed, MIN_FASTER_M_S):
                self._consistency.forget_crust()

    def begin_motion(self, since_us: int) -> None:
        """Undo checks of samples after `since_us` (µs), because a motion began that is reported only now."""
        self._trend.retract(since_us)
        self._consistency.drop(since_us)

    def check(
        self,
        time_us: int,
        raw: Vector,
        field: Vector,
        total_field: tuple[float, float],
        quality: int,
        main_field: tuple[float, float],
        temperature: float,
        age: float,
        sensitivity: Callable[[], Sensitivity],
    ) -> float:
        """Check a sample, set :attr:`flags`, and return the variance (nT²) that the checks add.

        `raw` and `field` are the reading and the corrected vector (nT), `total_field` is the corrected total
        field with its 1-sigma (nT), `quality` has the sample's flags so far. `main_field` is the main field
        (NaN if the position is unknown) with the 1-sigma of the Earth's field about it (nT). `temperature`
        is the sensor's (degC; NaN if unknown), `age` the age of the oldest telemetry (s). `sensitivity`
        returns the derivatives of the total field, see :class:`.consistency.Sensitivity`.
        """
        self.flags = 0
        self.is_fault = True
        total, sigma = total_field
        reference, reference_sigma = main_field
        level, trend = self._level, self._trend
        stuck = self._axes.is_stuck(raw, self._scatter)
        if not 0.0 < total < inf:
            if total == 0.0:
                level.check(time_us, total, sigma, reference, reference_sigma, steady=True)
                self.flags = IMPLAUSIBLE
            return 0.0
        steps = self._reference_steps
        if isfinite(reference) and not isfinite(steps.reference):
            self._consistency.restart()  # until now it tested the total field
        steps.follow(time_us, reference)
        # order: a wrong field must not enter the trend, and an outlier not the consistency test
        steady = not quality & UNSTEADY
        variance = level.check(time_us, total, sigma, reference, reference_sigma, steady)
        doubtful = stuck or level.is_wrong
        trend.is_outlier = False
        unit = field[0] / total, field[1] / total, field[2] / total
        own_sigma = sqrt(max(sigma * sigma - self._common, 0.0))
        if not steady:
            trend.has_moved = True
        elif not (self._axes.is_repeating and stuck):
            dx, dy, dz = unit[0] - self._unit[0], unit[1] - self._unit[1], unit[2] - self._unit[2]
            turned = sqrt(dx * dx + dy * dy + dz * dz)
            self._unit = unit
            if self.is_changing:
                trend.follow_telemetry(time_us, total)
            variance += trend.check(time_us, total, own_sigma, turned, learn=not doubtful)
        self.is_fault = doubtful or trend.is_outlier or time_us < level.until_us
        if trend.is_waiting:
            trend.confirm(time_us if quality & STALE_TELEMETRY else _reported_us(time_us, age))
        variance += trend.jump_variance(time_us)
        if self.is_fault or trend.is_away:
            self.flags = IMPLAUSIBLE
        consistency = self._consistency
        # the consistency check uses samples at rest that no other check flagged; one with a sigma as large
        # as the Earth's field, as of telemetry in a wrong unit, tells nothing and overflows
        usable = steady and not self.flags and sigma < MIN_FIELD_NT
        if usable and trend.is_established and consistency.is_due(time_us, trend):
            # while the position is unknown, the last known main field
            anomaly = total - steps.reference + steps.total if isfinite(steps.reference) else total
            course, speed = self._course.angle, trend.crossing_speed
            new = TestedSample(time_us, unit, anomaly, own_sigma, temperature, speed, course, sensitivity())
            consistency.add(new)
        if consistency.is_waiting:
            consistency.confirm(_reported_us(time_us, age))
        return variance + self._scatter.excess() + consistency.variance()

    def explain(self, difference: float, *, jumps: bool) -> None:
        """Adapt the checks to a new calibration, which changes the total field by `difference` (nT).

        `difference` is NaN if unknown. If `jumps`, the new calibration explains all past jumps.
        """
        if difference == difference:  # noqa: PLR0124 - NaN
            self._trend.explain(difference)
            self._scatter.explain(difference)
        self._consistency.restart()
        if jumps:
            self._trend.forget()


def _reported_us(time_us: int, age: float) -> int:
    """Return the time (µs) of the oldest telemetry, of age `age` (s) at `time_us` (µs)."""
    return time_us - round(1e6 * min(age, MAX_AGE_S))
