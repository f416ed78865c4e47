"""Correct readings with telemetry, for the live bridge and for ``magbridge correct``.

The aligner returns the channels and the parameters at the sample's time, and the calibration converts them to
the corrected field. An uncertain parameter (a mass in motion, missing telemetry) increases the sigma: the
correction is evaluated at the lower and upper bound of the parameter.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import inf, isfinite, nan, sqrt
from typing import TYPE_CHECKING, Any

from magbridge.align import Aligner, Input, Sample
from magbridge.calibration.correct import Corrector
from magbridge.calibration.model import LEVEL_STEP_SIGMA, Calibration, identity
from magbridge.columns import TEMPERATURE, usual
from magbridge.config import Align
from magbridge.datasets import expect
from magbridge.field.igrf import HeldField
from magbridge.filter_lag import LagCorrection
from magbridge.health import DirectionCheck, HealthMonitor, Messages
from magbridge.health.consistency import MASS_FRACTION, Sensitivity
from magbridge.parts import OptionalParts
from magbridge.records import MAX_MEASURED_NT, Corrected, Quality, Reading, Vector
from magbridge.toml import convert

if TYPE_CHECKING:
    from magbridge.learning import Learner  # imported by those who learn

__all__ = ["Correction"]

EXTRAPOLATED = int(Quality.EXTRAPOLATED)
MOVING = int(Quality.MOVING)
NOT_MASS_UNITS = frozenset({"A", "mA", "V", "W", "degC", "K", "bar", "dbar", "Pa", "kPa"})
"""Units of parameters that are not positions of masses: their changes do not set the flag ``moving``."""
MAX_AGE = 30.0
"""Default age from which telemetry is stale, s; :meth:`magbridge.align.Aligner.tune` replaces it."""


class Correction:
    """Corrector for a sequence of readings, with alignment, plausibility checks and online calibration.

    Parameters
    ----------
    calibration : Calibration or None
        Calibration to apply; without one, samples are unchanged and flagged ``uncalibrated``.
    settings : Align, optional
        Settings of the alignment. By default, :func:`~magbridge.rows.correct_rows` uses the settings that a
        bridge's own log declares.
    learner : Learner, optional
        Estimator that updates the calibration; a published calibration is used from the next sample on.

    Attributes
    ----------
    notices : list of str
        Messages about flagged samples since the caller last emptied the list, each once.
    corrector : Corrector
        Object that applies the calibration in use to a sample.
    is_contradicted : bool
        True if another sensor contradicts the last sample; the learner then does not use the next sample.
    is_suited : bool
        True once :func:`~magbridge.rows.correct_rows` has seen that the log suits the calibration.
    is_learning : bool
        False while the learner gets no samples, because the computer is overloaded.
    """

    def __init__(
        self, calibration: Calibration | None, settings: Align | None = None, learner: Learner | None = None
    ) -> None:
        self.learner, self.held_field = learner, HeldField()
        self._given = settings is not None
        calibration = calibration if calibration is not None else identity()
        expect("calibration", calibration, Calibration, "magbridge.load(path)")
        ranges = {parameter.name: (parameter.low, parameter.high) for parameter in calibration.parameters}
        units = {parameter.name: parameter.unit for parameter in calibration.parameters}
        inputs = tuple(
            Input(
                name, *ranges.get(name, (nan, nan)), MAX_AGE, usual(units.get(name, "")) not in NOT_MASS_UNITS
            )
            for name in calibration.channels
        )
        self._masses = [k for k, one in enumerate(inputs) if one.is_mass and isfinite(one.high - one.low)]
        self.aligner = Aligner(inputs, settings or Align(), calibration.sensor.power_cycle)
        self.names = tuple(one.name for one in inputs)
        for name in learner.watched if learner is not None else ():
            self.aligner.watch(name, MAX_AGE)
        self._wants_temperature = TEMPERATURE in self.aligner.by_name
        self.corrector = Corrector(calibration)
        self._raised = Corrector(calibration.at_level()) if calibration.level else None
        # without a calibration, the field need not resemble the Earth's
        self._messages = Messages()
        self.notices = self._messages.lines
        self.parts = OptionalParts(self.notices.append)
        self.health = self._health(calibration) if calibration.method != "none" else None
        self.direction = None if calibration.boresight is None else DirectionCheck(self._messages)
        self._was_moving = False
        self._conditions = {one.name: (one, nan) for one in calibration.unmodelled_conditions}
        self.is_suited = False
        self.is_contradicted, self.is_learning = False, True
        cutoff_hz = calibration.sensor.filter_cutoff
        self._filter_lag = LagCorrection(cutoff_hz) if cutoff_hz else None

    @property
    def calibration(self) -> Calibration:
        """Calibration that is in use."""
        return self.corrector.calibration

    def as_declared(self, attrs: Mapping[str, Any]) -> None:
        """Apply the alignment settings in the attributes of a bridge's log; ConfigError: out of range."""
        declared = {key: float(value) for key, value in attrs.items() if isinstance(value, (int, float))}
        names = [key for key in Align.__struct_fields__ if f"align.{key}" in declared]
        if names and not self._given:
            settings = {key: declared[f"align.{key}"] for key in names}
            self.aligner.settings = convert(settings, Align, attrs.get("source", "the log"), "align.")
        ages = {name: declared.get(f"telemetry.{name}.max_age") for name in self.names}
        self.aligner.tune(self.aligner.settings, {name: age for name, age in ages.items() if age})

    def telemetry(self, name: str, value: float, time_us: int, *, guessed: bool = False) -> None:
        """Add a telemetry value; see :meth:`magbridge.align.Aligner.telemetry` for the arguments."""
        self.aligner.telemetry(name, time_us, value, guessed=guessed)
        if name in self._conditions:
            self._hold(name, value)

    def reading(
        self,
        reading: Reading,
        time_us: int,
        *,
        main_field: float = nan,
        position: tuple[float, float] | None = None,
        depth: float = nan,
    ) -> tuple[Sample, Corrected]:
        """Align and correct one reading, and check the result; return the aligned and the corrected sample.

        `time_us` (µs) is the host's time of ``reading.device_time``. `main_field` is the total main field
        (nT) at the sample, `position` its latitude and longitude (deg), `depth` is in m; NaN or None if
        unknown.
        """
        if self.learner is not None and self.learner.calibration is not self.corrector.calibration:
            self._use(self.learner.calibration)
        if self._wants_temperature and isfinite(reading.temperature):  # a reading may lack it
            self.aligner.telemetry(TEMPERATURE, time_us, reading.temperature)
        sample = self.aligner.reading(reading, time_us)
        (F, sigma, x, y, z, sx, sy, sz), quality = self.corrector.numbers(
            sample.time_us, sample.field, sample.values, sample.quality
        )
        parts = self.parts
        vector, turned = (x, y, z), 0.0
        if self._filter_lag is not None:
            delay_s = self.aligner.settings.filter_delay
            vector = self._filter_lag.undo(sample.time_us, vector, delay_s)
            turned = self._filter_lag.variance
        judged = 0.0
        if self.health is not None:
            arguments = (self.health, sample, reading, (F, sigma), vector, quality, main_field, position)
            judged, flags = parts.call("plausibility check", (0.0, 0), self._check_field, *arguments)
            quality |= flags
        if self.direction is not None:
            more, flags = parts.call("direction check", (0.0, 0), self._check_direction, sample, vector)
            quality |= flags
            turned += more
        if self.learner is not None and self.is_learning:
            flags, variance = parts.call(
                "learning", (0, 0.0), self._learn, sample, quality, main_field, position
            )
            quality |= flags
            judged += variance
        beyond = 0.0
        if self._conditions:
            self._hold("depth", max(depth, 0.0))
            self._hold(TEMPERATURE, reading.temperature)
            beyond, flags = self._extrapolation(sigma)
            quality |= flags
        stated_sigma = sigma
        if sample.sigma or sample.spans or judged or turned or beyond:
            more = beyond + (self._more(sample) if sample.sigma or sample.spans else 0.0)
            stated_sigma = sqrt(sigma * sigma + more)
            more += judged
            sigma = sqrt(sigma * sigma + more)
            more += turned
            sx, sy, sz = sqrt(sx * sx + more), sqrt(sy * sy + more), sqrt(sz * sz + more)
        corrected = Corrected(F, sigma, vector, (sx, sy, sz), quality, main_field, stated_sigma)
        return sample, corrected

    def _check_field(
        self,
        health: HealthMonitor,
        sample: Sample,
        reading: Reading,
        total: tuple[float, float],
        vector: Vector,
        quality: int,
        main_field: float,
        position: tuple[float, float] | None,
    ) -> tuple[float, int]:
        """Check the corrected field; return the variance (nT^2) and the flags that the checks add."""
        if position is not None:
            health.set_position(sample.time_us, *position)
        is_moving = bool(sample.quality & MOVING)
        if is_moving and not self._was_moving:
            health.begin_motion(self.aligner.motion_since_us)
        self._was_moving, health.is_changing = is_moving, bool(sample.spans)
        reference = main_field, self.aligner.settings.reference_sigma
        variance = health.check(
            sample.time_us, reading.field, vector, total, quality, reference, reading.temperature, sample.age,
            lambda: self._sensitivity(sample),
        )  # fmt: skip
        return variance, health.flags

    def _sensitivity(self, sample: Sample) -> Sensitivity:
        """Return the derivatives of the last sample's total field by mass positions and coefficients."""
        spans = []
        for index in self._masses:
            one, value = self.aligner.tracks[index].input, sample.values[index]
            half = 0.5 * MASS_FRACTION * (one.high - one.low)
            spans.append((index, value - half, value + half))
        changes = self.corrector.changes(sample.field, sample.values, spans)
        return Sensitivity(changes, self.corrector.error_effects())

    def _hold(self, name: str, value: float) -> None:
        """Store the value of a condition if it is finite and the calibration does not model the condition."""
        if name in self._conditions and isfinite(value):
            self._conditions[name] = self._conditions[name][0], value

    def _extrapolation(self, sigma: float) -> tuple[float, int]:
        """Return the variance (nT^2) and the flag for a depth or temperature outside the range of the fit.

        An undetected effect over half the fitted range is assumed to be as large as the sample's `sigma`, nT,
        without the constant error of the reference. It grows in proportion to the distance from the range.
        """
        calibration = self.corrector.calibration
        own = max(sigma * sigma - calibration.reference.level_sigma**2, calibration.noise.sensor**2)
        variance = 0.0
        for condition, value in self._conditions.values():
            if excess := condition.excess(value):  # never inf * 0, which is NaN
                variance += own * excess * excess
        return (variance, EXTRAPOLATED) if variance > sigma * sigma else (variance, 0)

    def _check_direction(self, sample: Sample, vector: Vector) -> tuple[float, int]:
        """Check the direction; return the variance (nT^2) of each component and the flags that this adds."""
        assert self.direction is not None
        variance = self.direction.check(sample.time_us, *vector)
        return variance, self.direction.flags

    def _learn(
        self,
        sample: Sample,
        quality: int,
        main_field: float,
        position: tuple[float, float] | None,
    ) -> tuple[int, float]:
        """Update the learner with the sample; return the flags and the variance (nT^2) that it adds."""
        assert self.learner is not None
        if sample.reading.restarted:
            self.learner.restarted()
        self.learner.sample(
            sample.time_us,
            sample.field,
            self.corrector.regressors,
            sample.values,
            quality,
            faulty=self.is_contradicted or (self.health is not None and self.health.is_fault),
            reference=main_field,
            position=position,
            age=sample.age,
            settled=self.aligner.channels.settled,
            watched=[self.aligner.by_name[name].value_at(sample.time_us)[0] for name in self.learner.watched],
        )
        return self.learner.flags, self.learner.variance

    def _use(self, calibration: Calibration) -> None:
        """Replace the calibration by one of the same terms, possibly with other effects."""
        self.aligner.follow(calibration.channels)
        self._conditions = {}  # a learned calibration is valid under the present conditions
        values = [track.last for track in self.aligner.tracks]
        by = self.corrector.replace(calibration, values)
        if not calibration.level:
            self._raised = None
        elif self._raised is not None:
            self._raised.replace(calibration.at_level(), values)
        else:
            self._raised = Corrector(calibration.at_level())
        if self.health is None:
            self.health = self._health(calibration)
        elif self.learner is not None:
            self.health.explain(by, jumps=not self.learner.renewed)

    def _health(self, calibration: Calibration) -> HealthMonitor:
        level = calibration.reference.level_sigma
        return HealthMonitor(calibration.noise, self._messages, level, len(self._masses))

    def level(self, sample: Sample, corrected: Corrected) -> float:
        """Return the part of the total field's sigma that all samples share, nT; NaN if not modelled."""
        if self._raised is None:
            return nan
        raised = self._raised.numbers(sample.time_us, sample.field, sample.values, sample.quality)[0][0]
        return abs(raised - corrected.total_field) / LEVEL_STEP_SIGMA

    def _more(self, sample: Sample) -> float:
        """Return the variance of alignment, ``s^2 + sum ((F(hi) - F(lo)) / 2)^2``, nT^2.

        s is the `sigma` of the sample, lo and hi are the bounds of its uncertain parameters.
        """
        more = sample.sigma * sample.sigma
        for change in self.corrector.changes(sample.field, sample.values, sample.spans):
            more += 0.25 * change * change
        # more is NaN if a parameter has neither value nor range
        return more if more < MAX_MEASURED_NT * MAX_MEASURED_NT else inf
