"""Check one corrected sample after the other, by all checks that need no attitude from the autopilot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import inf, isfinite, sqrt
from typing import Final

from magbridge.calibration.model import Noise
from magbridge.estimation.track_process import Course, ReferenceSteps
from magbridge.field.geodesy import separation
from magbridge.health.checks import LevelCheck, Messages, RepetitionCheck
from magbridge.health.consistency import ConsistencyCheck, TestedSample
from magbridge.health.scatter import ACCELERATION, MIN_FASTER_M_S, Scatter
from magbridge.health.trend import TrendCheck
from magbridge.records import Quality, Vector

SUPPOSED_SPEED: Final = 30.0
"""Speed until it is known, m/s."""
MAX_AGE_S: Final = 60.0
"""Age of telemetry after which a sample is tested without waiting for newer telemetry."""

IMPLAUSIBLE: Final = int(Quality.IMPLAUSIBLE)
UNSTEADY: Final = int(Quality.MOVING | Quality.STALE_TELEMETRY | Quality.SATURATED | Quality.LATE_JOIN)
"""Flags of a sample by which no trend is followed."""


class HealthMonitor:
    """Check sample after sample.

    Parameters
    ----------
    noise : Noise
        The calibration's noise model.
    messages : Messages, optional
        Receives the messages.
    level : float
        Part of every sample's sigma that is common to all samples, nT.
    masses : int
        Number of positions that the calibration depends on.

    Attributes
    ----------
    flags : int
        :class:`~magbridge.records.Quality` bits of the last sample.
    is_fault : bool
        Whether the last sample is an outlier, comes from a faulty sensor, or is not the Earth's field.
    """

    def __init__(
        self, noise: Noise, messages: Messages | None = None, level: float = 0.0, masses: int = 0
    ) -> None:
        self._common = level * level
        self.flags = 0
        self.is_fault = False
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
        """Record the vehicle's position, deg; the speed separates noise from crustal field."""
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
        """Record that telemetry reports a motion, which may have begun after `since_us`."""
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
        mass_changes: Callable[[], Sequence[float]],
    ) -> float:
        """Check a sample: set :attr:`flags`, return the variance (nT²) to add to the field's.

        `raw` and `field` are the reading and the corrected vector, `total_field` the corrected total field
        and its 1-sigma, nT; `quality` has the flags so far. `main_field` is NaN where the position is not
        known, with the 1-sigma of the Earth's field about it, nT. `temperature` is that of the sensor (degC;
        NaN where it is not known), `age` that of the oldest telemetry (s). `mass_changes` returns by how much
        the total field changes where each mass moves, see :class:`.consistency.TestedSample`.
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
        self._reference_steps.follow(time_us, reference)
        # the order matters: a wrong field must not become a trend, nor an outlier evidence
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
            variance += trend.check(time_us, total, own_sigma, turned, learn=not doubtful)
        self.is_fault = doubtful or trend.is_outlier or time_us < level.until_us
        variance += trend.jump_variance(time_us)
        if self.is_fault or trend.is_away:
            self.flags = IMPLAUSIBLE
        consistency = self._consistency
        # consistency: samples at rest that no other check has flagged
        if steady and not self.flags and trend.is_established and consistency.is_due(time_us, trend):
            anomaly = total - reference + self._reference_steps.total if isfinite(reference) else total
            changes, course, speed = tuple(mass_changes()), self._course.angle, trend.crossing_speed
            new = TestedSample(time_us, unit, anomaly, own_sigma, temperature, changes, speed, course)
            consistency.add(new)
        if consistency.is_waiting:
            consistency.confirm(time_us - round(1e6 * min(age, MAX_AGE_S)))
        return variance + self._scatter.excess() + consistency.variance()

    def explain(self, difference: float, *, jumps: bool) -> None:
        """Record that another calibration changes the total field by `difference`, nT."""
        if difference == difference:  # noqa: PLR0124 - NaN
            self._trend.explain(difference)
            self._scatter.explain(difference)
        self._consistency.restart()
        if jumps:
            self._trend.forget()
