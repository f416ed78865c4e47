"""From readings and telemetry to corrected samples: what the live bridge and ``magbridge correct`` share.

Alignment gives the channels and the parameters at the sample's time; the calibration turns them into the
corrected field. A parameter that is not known exactly (a mass in motion, telemetry that never came) widens
the sigma: the correction is evaluated at both ends of the interval in which the parameter lies.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import inf, isfinite, nan, sqrt
from typing import Any

from magbridge.align import Aligner, Sample
from magbridge.calibration.corrector import Corrector
from magbridge.calibration.model import RAISED, Calibration, identity
from magbridge.config import Align
from magbridge.field.nearby import HeldField
from magbridge.health import Attitude, Plausibility
from magbridge.health.direction import Direction
from magbridge.health.notices import Notices
from magbridge.health.turns import Turns
from magbridge.learning import Learner
from magbridge.learning.model import TEMPERATURE
from magbridge.parts import OptionalParts
from magbridge.records import BEYOND, Corrected, Reading, Vector
from magbridge.toml import convert
from magbridge.track import Input

__all__ = ["TEMPERATURE", "Correction"]

MAX_AGE = 30.0
"""s after which telemetry is stale, unless :meth:`magbridge.align.Aligner.tune` has said otherwise."""


class Correction:
    """Corrects reading after reading.

    Parameters
    ----------
    calibration : Calibration or None
        Without one every sample passes unchanged, flagged ``uncalibrated``.
    settings : Align, optional
        If not given, and :func:`~magbridge.rows.correct_rows` corrects a bridge's own log: that bridge's.
    learner : Learner, optional
        Learns from the samples; what it publishes is used from the next sample on.

    Attributes
    ----------
    notices : list of str
        What was found doubtful since the caller has last emptied it, each once.
    """

    def __init__(
        self, calibration: Calibration | None, settings: Align | None = None, learner: Learner | None = None
    ) -> None:
        self.learner, self.held_field = learner, HeldField()
        self._given = settings is not None
        calibration = calibration if calibration is not None else identity()
        ranges = {parameter.name: (parameter.low, parameter.high) for parameter in calibration.parameters}
        inputs = tuple(
            Input(name, *ranges.get(name, (nan, nan)), max_age=MAX_AGE) for name in calibration.channels
        )
        self.aligner = Aligner(inputs, settings or Align(), calibration.sensor.power_cycle)
        self.names = tuple(one.name for one in inputs)
        for name in learner.watched if learner is not None else ():
            self.aligner.watch(name, MAX_AGE)
        self._wants_temperature = TEMPERATURE in self.aligner.by_name
        self._corrector = Corrector(calibration)
        self._raised = Corrector(calibration.at_level()) if calibration.level else None
        # what has no calibration is not expected to be the Earth's field
        self._found = found = Notices()
        self.notices = found.lines
        self.parts = OptionalParts(found.lines.append)
        judged = calibration.method != "none"
        self.plausibility = self._plausibility(calibration) if judged else None
        self.turns, self.attitude = Turns(found), Attitude(found)
        self.direction = None if calibration.boresight is None else Direction(found)

    def as_declared(self, attrs: Mapping[str, Any]) -> None:
        """Align as the bridge did whose log declares its settings among its attributes.

        ConfigError: a number out of range.
        """
        declared = {key: float(value) for key, value in attrs.items() if isinstance(value, (int, float))}
        names = [key for key in Align.__struct_fields__ if f"align.{key}" in declared]
        if names and not self._given:
            settings = {key: declared[f"align.{key}"] for key in names}
            self.aligner.settings = convert(settings, Align, attrs.get("source", "the log"), "align.")
        ages = {name: declared.get(f"telemetry.{name}.max_age") for name in self.names}
        self.aligner.tune(self.aligner.settings, {name: age for name, age in ages.items() if age})

    def telemetry(self, name: str, value: float, time_us: int, *, guessed: bool = False) -> None:
        """Take a telemetry value; arguments as :meth:`magbridge.align.Aligner.telemetry`."""
        self.aligner.telemetry(name, time_us, value, guessed=guessed)

    def reading(
        self,
        reading: Reading,
        time_us: int,
        *,
        restarted: bool = False,
        missing: int = 0,
        main_field: float = nan,
        where: tuple[float, float] | None = None,
    ) -> tuple[Sample, Corrected]:
        """Align and correct one reading, and judge what comes out.

        Parameters
        ----------
        reading, time_us, restarted, missing
            As for :meth:`magbridge.align.Aligner.reading`.
        main_field : float
            nT, the main field's total where the sample was taken; NaN where that is not known.
        where : tuple of 2 float or None
            deg, latitude and longitude; None where not known.
        """
        if self.learner is not None and self.learner.calibration is not self._corrector.calibration:
            self._use(self.learner.calibration)
        if self._wants_temperature and isfinite(reading.temperature):  # not every reading need have one
            self.aligner.telemetry(TEMPERATURE, time_us, reading.temperature)
        sample = self.aligner.reading(reading, time_us, restarted=restarted, missing=missing)
        (F, sigma, x, y, z, sx, sy, sz), quality = self._corrector.numbers(
            sample.time_us, sample.field, sample.values, sample.quality
        )
        parts = self.parts
        judged, checked = parts.call(
            "plausibility check",
            (0.0, 0),
            self._check_field,
            sample,
            reading,
            (F, sigma),
            quality,
            main_field,
            where,
        )
        quality |= checked
        vector = (x, y, z)
        judged += parts.call(
            "attitude check", 0.0, self._check_attitude, sample, vector, F, sigma * sigma, judged, quality
        )
        turned = 0.0
        if self.direction is not None:
            turned, flags = parts.call("direction check", (0.0, 0), self._check_direction, sample, vector)
            quality |= flags
        if self.learner is not None:
            flags, variance = parts.call(
                "learning", (0, 0.0), self._learn, sample, quality, main_field, where, restarted
            )
            quality |= flags
            judged += variance
        if sample.sigma or sample.spans or judged or turned:
            more = judged + (self._more(sample) if sample.sigma or sample.spans else 0.0)
            sigma = sqrt(sigma * sigma + more)
            more += turned
            sx, sy, sz = sqrt(sx * sx + more), sqrt(sy * sy + more), sqrt(sz * sz + more)
        return sample, Corrected(F, sigma, (x, y, z), (sx, sy, sz), quality)

    def _check_field(
        self,
        sample: Sample,
        reading: Reading,
        total: tuple[float, float],
        quality: int,
        main_field: float,
        where: tuple[float, float] | None,
    ) -> tuple[float, int]:
        """Return the variance (nT^2) and the flags that the checks of the total field add."""
        if self.plausibility is None:
            return 0.0, 0
        if where is not None:
            self.plausibility.place(sample.time_us, *where)
        sigma = self.aligner.settings.reference_sigma
        variance = self.plausibility.check(sample.time_us, reading.field, *total, quality, main_field, sigma)
        return variance, self.plausibility.flags

    def _check_attitude(
        self, sample: Sample, vector: Vector, F: float, variance: float, judged: float, quality: int
    ) -> float:
        """Return the variance (nT^2) that the checks of the field against the attitude add."""
        if self.plausibility is None:
            return 0.0
        turns = self.turns.check(sample.time_us, *vector, F, variance + judged, quality)
        return turns + self.attitude.check(sample.time_us, *vector, F, variance, quality)

    def _check_direction(self, sample: Sample, vector: Vector) -> tuple[float, int]:
        """Return the variance (nT^2) of each component and the flags that the direction's check adds."""
        assert self.direction is not None
        variance = self.direction.check(sample.time_us, *vector)
        return variance, self.direction.flags

    def _learn(
        self,
        sample: Sample,
        quality: int,
        main_field: float,
        where: tuple[float, float] | None,
        restarted: bool,
    ) -> tuple[int, float]:
        """Update the learner with the sample; return its flags and its variance, nT^2."""
        assert self.learner is not None
        if restarted:
            self.learner.restarted()
        self.learner.sample(
            sample.time_us,
            sample.field,
            self._corrector.regressors,
            sample.values,
            quality,
            faulty=self.plausibility is not None and self.plausibility.fault,
            reference=main_field,
            where=where,
            age=sample.age,
            settled=self.aligner.channels.settled,
            watched=[self.aligner.by_name[name].at(sample.time_us)[0] for name in self.learner.watched],
        )
        return self.learner.flags, self.learner.variance

    def _use(self, calibration: Calibration) -> None:
        """Correct from now on with another calibration, of the same terms or with effects more or fewer."""
        self.aligner.follow(calibration.channels)
        values = [track.last for track in self.aligner.tracks]
        by = self._corrector.replace(calibration, values)
        if not calibration.level:
            self._raised = None
        elif self._raised is not None:
            self._raised.replace(calibration.at_level(), values)
        else:
            self._raised = Corrector(calibration.at_level())
        if self.plausibility is None:
            self.plausibility = self._plausibility(calibration)
        elif self.learner is not None:
            self.plausibility.explain(by, jumps=not self.learner.renewed)
            self.turns.explain(by)
            self.attitude.forget()

    def _plausibility(self, calibration: Calibration) -> Plausibility:
        return Plausibility(calibration.noise.sensor, self._found, calibration.reference.level_sigma)

    def level(self, sample: Sample, corrected: Corrected) -> float:
        """Return how much of a corrected sample's sigma all samples share, nT; NaN without a level."""
        if self._raised is None:
            return nan
        raised = self._raised.numbers(sample.time_us, sample.field, sample.values, sample.quality)[0][0]
        return abs(raised - corrected.total_field) / RAISED

    def _more(self, sample: Sample) -> float:
        """Return the variance to add: ``s^2 + sum ((F(hi) - F(lo)) / 2)^2``, s and spans the sample's."""
        more = sample.sigma * sample.sigma
        for change in self._corrector.changes(sample.field, sample.values, sample.spans):
            more += 0.25 * change * change
        if not more < BEYOND * BEYOND:  # also NaN, as where a parameter has neither value nor range
            more = inf
        return more
