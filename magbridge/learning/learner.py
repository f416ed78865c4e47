"""A bridge's learning: what it takes from each sample, what it publishes, and when it says that it doubts."""

from __future__ import annotations

from dataclasses import replace
from math import isnan, nan
from typing import Final

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.compilation import coefficient_tensor
from magbridge.calibration.file import calibration_id
from magbridge.calibration.model import Calibration
from magbridge.field.geodesy import separation
from magbridge.learning.doubt import Alarm, Doubt, Signs
from magbridge.learning.estimator import Estimator, constant_offsets
from magbridge.learning.judge import CANDIDATE, FIXED, PUBLISHED, Judge
from magbridge.learning.nuisance import STATES, Nuisance
from magbridge.learning.observation import Observation, observe
from magbridge.learning.report import Notice, State
from magbridge.records import Quality, Vector

__all__ = ["Learner"]

UNFIT: Final = int(
    Quality.STALE_TELEMETRY | Quality.MOVING | Quality.SATURATED | Quality.LATE_JOIN | Quality.UNCALIBRATED
)
"""Samples that nothing is learned from."""
CREEP: Final = 3.0 / 86_400.0**0.5
"""nT per square root of a second: an offset walks by 3 nT a day."""
FASTER: Final = 10.0
"""Times faster while the data are not explained, and for some time after."""
CREEPING: Final = frozenset({"offset_drift", "temperature_offset"})
"""Causes that go on after their first part was learned."""
LEARNABLE: Final = CREEPING | {"offset_step", "unmodelled_actuator"}
"""Causes that the calibration's coefficients can take up, if only in part."""
MORE: Final = 2.0
"""By which an alarm's log-likelihood ratio has to grow to be news."""
QUIET: Final = 300
"""Telling samples without an alarm after which its cause is gone."""
STEADY: Final = 2000
"""Telling samples without one after which offsets creep no faster than usual."""
OUTLIER: Final = 5.0
AGREE: Final = 3
"""An innovation beyond so many sigmas is not learned from, unless it is the third in a row."""
SHORT_US: Final = 3_600_000_000
"""µs without a sample to learn from after which that is told."""


class Learner:
    """Learns a calibration's coefficients while the bridge corrects with it.

    Parameters
    ----------
    calibration : Calibration
        The one to begin with.
    spread : float
        nT, 1-sigma of the Earth's field about its reference.
    turn_on : float
        nT, 1-sigma, by which offsets change at every power-on.
    max_rate : float
        Hz: samples to learn from, at most.
    currents : tuple of str
        Names of telemetry in ampere, for :meth:`telemetry`.

    Attributes
    ----------
    calibration : Calibration
        The one to publish.
    flags : int
        Of the last sample: ``unexplained``, or 0.
    variance : float
        nT², to add to that of the total field while the data are not explained.
    notices : list of Notice
        What has changed since the caller last emptied it.
    currents : tuple of str
        As given.
    enabled, frozen : bool
        Not enabled, nothing happens; frozen, it judges and doubts, but learns nothing.

    Raises
    ------
    CalibrationError
        The calibration has no constant offset.
    """

    def __init__(
        self,
        calibration: Calibration,
        *,
        spread: float = 145.0,
        turn_on: float = 20.0,
        max_rate: float = 1.0,
        currents: tuple[str, ...] = (),
    ) -> None:
        self.first = self.calibration = calibration
        self._tensor = coefficient_tensor(calibration)[0]
        self._flat = self._tensor.reshape(len(self._tensor), -1)
        self._offsets = constant_offsets(self._tensor)
        self._turn_on = turn_on
        self._nuisance = Nuisance(calibration.noise, spread)
        self._kappa = 0.0
        self._period_us = round(1e6 / max_rate)
        self._scaling = [(one.centre, one.scale) for one in calibration.parameters]
        self.currents = currents
        self._currents = dict.fromkeys(currents, nan)
        self.enabled, self.frozen = True, False
        self.flags, self.variance = 0, 0.0
        self.notices: list[Notice] = []
        self.samples = 0
        self._alarm: Alarm | None = None
        self._forget()

    @property
    def state(self) -> State:
        """How learning stands."""
        rms = np.sqrt(self._judge.mean_square).tolist()
        alarm = self._alarm
        causes = alarm.causes if alarm else ()
        since, size = (round(alarm.since * 1e6), alarm.size) if alarm else (0, 0.0)
        return State(self.samples, (rms[0], rms[1], rms[2]), self._judge.better, causes, since, size)

    def learned(self) -> Calibration:
        """Return the calibration as learned so far, with its covariance and where it comes from."""
        origin = f"{calibration_id(self.calibration):08x}"
        method = self.first.method if "learned" in self.first.method else f"{self.first.method}, learned"
        return replace(
            self.first,
            coefficients=self._estimator.coefficients,
            covariance=self._estimator.covariance,
            method=method,
            inputs=self.calibration.inputs | {f"calibration {origin}": f"{self.samples} samples later"},
        )

    def accept(self) -> None:
        """Let what is learned be the calibration that nothing rolls back, and the doubt be known."""
        if self.samples:
            self._challenge()
            self._publish(CANDIDATE, "accepted: what was learned")
            self.first = self.calibration
            self._weights[FIXED] = self._weights[PUBLISHED]
            self._judge.settle()
        self._settle("acknowledged")

    def forget(self) -> None:
        """Go back to the calibration that it began with, and learn anew from there."""
        self._settle("forgotten")
        self._forget()
        self.calibration = self.first
        self._notify("learning: all forgotten")

    def _forget(self) -> None:
        self._judge = Judge(self._nuisance)
        self._restart(self.first)
        self._weights = [self._weights_of(self.first.coefficients)] * 3
        self._candidate = self.first
        self.samples = 0
        self._last_us = self._told_us = 0
        self._where: tuple[float, float] | None = None

    def _restart(self, calibration: Calibration) -> None:
        """Begin to learn from a calibration, whose offsets may have changed at this power-on."""
        self._estimator = Estimator(
            calibration.coefficients, calibration.covariance, self._offsets, self._nuisance, CREEP
        )
        self._estimator.open(self._turn_on**2)
        positions = tuple(one.name for one in calibration.parameters)
        states = len(calibration.coefficients) + STATES
        self._doubt = Doubt(positions, tuple(self._currents), states)
        self._outliers = self._quiet = 0

    def _notify(self, text: str, *, grave: bool = False) -> None:
        self.notices.append(Notice(text, self._now_us * 1e-6, grave))

    def _weights_of(self, coefficients: FloatArray) -> FloatArray:
        """(m, 9) what each regressor adds to the nine coefficients, nT."""
        return np.asarray((coefficients @ self._flat).reshape(self._tensor.shape[1:]))

    def telemetry(self, name: str, value: float) -> None:
        """Take a value of telemetry that the calibration does not need."""
        if name in self._currents:
            self._currents[name] = value

    def restarted(self) -> None:
        """Take note that the sensor was powered anew: its offsets may have changed."""
        self._estimator.open(self._turn_on**2)

    def sample(
        self,
        time_us: int,
        field: Vector,
        regressors: list[float],
        values: tuple[float, ...],
        quality: int,
        *,
        faulty: bool,
        reference: float,
        where: tuple[float, float] | None,
        temperature: float = nan,
    ) -> None:
        """Take a sample that was corrected.

        Parameters
        ----------
        time_us : int
            µs.
        field : tuple of 3 float
            nT, raw, sensor axes, all of one time.
        regressors : list of float
            The calibration's, at that time.
        values : tuple of float
            The calibration's channels.
        quality : int
            Flags.
        faulty : bool
            The sensor is at fault, or the field is none of the Earth's.
        reference : float
            nT, H_e; NaN where the position is not known.
        where : tuple of 2 float or None
            deg, latitude and longitude.
        temperature : float
            degC, at the sensor.
        """
        if not self.enabled:
            return
        self._now_us = time_us
        if quality & UNFIT or faulty or isnan(reference) or where is None:
            self._nothing(time_us)
            return
        if 0 <= time_us - self._last_us < 0.99 * self._period_us:
            return
        phi = np.array(regressors)
        if not np.isfinite(phi).all():
            return
        metres, seconds = self._moved(time_us, where)
        live, e, offset = self._observe(field, phi, reference)
        signs = Signs(
            time_us * 1e-6,
            offset,
            temperature,
            tuple((v - c) / s for v, (c, s) in zip(values, self._scaling, strict=False)),
            tuple(self._currents.values()),
            self._clock(field, phi, reference, live.e, seconds),
            -1.0 / live.s,
        )
        F = self._estimator.propagate(metres, seconds)
        self._doubt.propagate(F)
        self._judge.judge(*self._nuisance.over(metres, seconds), e, live.s)
        self._learn(live, phi, signs)
        self._decide()
        self._aged(seconds)

    def _aged(self, seconds: float) -> None:
        """Let what is published age, while offsets creep faster than its sigma knows."""
        if self._alarm is None and self._estimator.creep > CREEP:
            self.variance += (self._estimator.creep**2 - CREEP**2) * seconds

    def _nothing(self, time_us: int) -> None:
        """Say once an hour or more passes without a sample to learn from."""
        if not self._last_us:
            self._last_us = time_us
        if time_us - self._last_us > SHORT_US and self._told_us != self._last_us:
            self._told_us = self._last_us
            self._notify("learning: an hour without a sample to learn from", grave=True)

    def _moved(self, time_us: int, where: tuple[float, float]) -> tuple[float, float]:
        """Return m and s since the last sample that was taken."""
        before, last_us = self._where or where, self._last_us or time_us
        self._where, self._last_us = where, time_us
        north, east = separation(*before, *where)
        return (north * north + east * east) ** 0.5, max(time_us - last_us, 0) * 1e-6

    def _observe(
        self, field: Vector, phi: FloatArray, reference: float
    ) -> tuple[Observation, FloatArray, FloatArray]:
        """Return what is learned's observation, all residuals that are judged, and de by the offset."""
        F_0 = self.first.reference.field
        live_weights = self._weights_of(self._estimator.coefficients)
        e = np.empty(3)
        for which in (FIXED, PUBLISHED, CANDIDATE):
            nine = phi @ self._weights[which]
            e[which] = observe(field, nine, F_0, reference, self._kappa).e
        live = observe(field, phi @ live_weights, F_0, reference, self._kappa)
        return live, e, live.by_nine[6:]

    def _clock(self, field: Vector, phi: FloatArray, reference: float, e: float, seconds: float) -> float:
        """Return by how much the residual changes if telemetry is a second late, nT/s."""
        before, self._phi = getattr(self, "_phi", phi), phi
        if not 0.0 < seconds < 30.0:
            return 0.0
        weights = self._weights_of(self._estimator.coefficients)
        late = observe(field, before @ weights, self.first.reference.field, reference, self._kappa)
        return (late.e - e) / seconds

    def _learn(self, live: Observation, phi: FloatArray, signs: Signs) -> None:
        """Predict the sample, doubt, and learn from it."""
        estimator = self._estimator
        by_coefficients = self._flat @ np.outer(phi, live.by_nine).ravel()
        estimator.predict(live.e, live.s, by_coefficients)
        far = abs(estimator.residual) > OUTLIER * estimator.sigma
        self._outliers = self._outliers + 1 if far else 0
        alarm = self._doubt.test(estimator, signs)
        if alarm is not None and self._raise(alarm):
            estimator.open(alarm.amplitude**2)
            estimator.predict(live.e, live.s, by_coefficients)
        if far and self._outliers < AGREE and alarm is None:
            return
        learn = estimator.telling and not self.frozen
        self._doubt.updated(estimator.update(learn=learn))
        self.samples += learn
        self._quiet += learn

    def _raise(self, alarm: Alarm) -> bool:
        """Begin to doubt, or know better what is doubted; return whether there is anything new."""
        standing = self._alarm
        if standing is not None and alarm.strength < standing.strength + MORE:
            return False
        self._quiet = 0
        self._alarm = alarm
        self._estimator.creep = FASTER * CREEP
        self.flags, self.variance = int(Quality.UNEXPLAINED), alarm.size**2
        if standing is None:
            self._judge.hurry()
            names = " or ".join(alarm.causes[:2]).replace("_", " ")
            self._notify(f"unexplained: {alarm.size:.0f} nT, {names}", grave=True)
        elif standing.causes != alarm.causes and len(alarm.causes) == 1:
            self._notify(f"unexplained: it is {alarm.causes[0].replace('_', ' ')}", grave=True)
        return True

    def _settle(self, how: str) -> None:
        """End the doubt."""
        if self._alarm is None:
            return
        if not set(self._alarm.causes) & CREEPING:
            self._estimator.creep = CREEP
        self._alarm = None
        self.flags, self.variance = 0, 0.0
        self._doubt.restart()
        self._notify(f"explained again: {how}")

    def _decide(self) -> None:
        """Publish what predicts better, go back to what does, and end a doubt whose cause is gone."""
        judge = self._judge
        if judge.roll_back and self.calibration is not self.first:
            self._publish(FIXED, "rolled back: the first calibration predicts better")
            self._restart(self.first)
        elif judge.adopt and not self.frozen and not self._beyond_learning():
            self._publish(CANDIDATE, "learned")
            self._settle("learned")
        elif judge.stale and not self.frozen:
            self._challenge()
        if self._quiet > STEADY and self._estimator.creep > CREEP:
            self._estimator.creep = CREEP
            self.variance = 0.0 if self._alarm is None else self.variance
        if self._alarm is not None and self._quiet > QUIET and judge.better < 1.0:
            self._settle("gone")

    def _beyond_learning(self) -> bool:
        """Whether what is doubted is nothing that coefficients can learn: they would follow it badly."""
        return self._alarm is not None and not set(self._alarm.causes) & LEARNABLE

    def _challenge(self) -> None:
        """Let what is learned so far be the candidate."""
        self._candidate = self.learned()
        self._weights[CANDIDATE] = self._weights_of(self._candidate.coefficients)
        self._judge.challenge(self._estimator.beside, soon=self._estimator.creep > CREEP)

    def _publish(self, which: int, how: str) -> None:
        before, after = (float(value) ** 0.5 for value in self._judge.mean_square[[PUBLISHED, which]])
        self.calibration = self._candidate if which == CANDIDATE else self.first
        self._weights[PUBLISHED] = self._weights[which]
        self._judge.publish(which)
        if self._alarm is None:
            self.variance = 0.0
        name = calibration_id(self.calibration)
        self._notify(f"{how} {name:08x}: {before:.1f} to {after:.1f} nT")
