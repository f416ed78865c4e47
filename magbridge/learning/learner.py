"""Estimate a calibration on board the bridge, sample by sample."""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot, isnan
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.file import calibration_id
from magbridge.calibration.model import Calibration
from magbridge.constants import MAIN_FIELD_SIGMA_NT
from magbridge.learning.alarms import NO_COEFFICIENT, AlarmState, LearningAlarm, named
from magbridge.learning.estimator import BEYOND_CHANCE, Nuisance
from magbridge.learning.judge import FIRST
from magbridge.learning.knowledge import NO_METHOD, Knowledge, Publication
from magbridge.learning.samples import Intake, LearnedTerms, LearningSample, Observation, Way, observe
from magbridge.records import Quality, Vector

if TYPE_CHECKING:
    from magbridge.field.grid import AnomalyGrid  # which imports scipy


class Notice(NamedTuple):
    """Notification: text, time (s since 1970 UTC), and `grave`, which is True for a warning."""

    text: str
    time: float
    grave: bool = False

    @property
    def date(self) -> str:
        """Date and time, UTC."""
        return f"{np.datetime64(round(self.time), 's')}Z"


class LearnerState(NamedTuple):
    """Contents of a MAG_LEARNING message.

    `learned_samples` is the number of samples learned from. `rms` are the RMS errors of the first, the
    published and the learned calibration (nT); `better` is the log-likelihood ratio of the learned over the
    first. `causes`, onset `since_us` (µs since 1970 UTC) and `size` (nT) describe the alarm, if there is one.
    """

    learned_samples: int
    rms: tuple[float, float, float]
    better: float
    causes: tuple[str, ...]
    since_us: int
    size: float


MIN_CAUSE_LOG_RATIO: Final = 9.0
"""Log-likelihood ratio below which the learner closes an alarm and does not learn its cause."""
MAX_MISFIT: Final = 2.0
"""Largest mean normalised squared innovation that a cause may leave if it explains the samples. A larger
value shows that the true cause is another, such as a current without telemetry."""
MOVING: Final = int(Quality.MOVING)
UNFIT: Final = MOVING | int(Quality.STALE_TELEMETRY | Quality.SATURATED | Quality.LATE_JOIN)
"""Flags that exclude a sample from learning."""


class Learner:
    """On-board estimator of a calibration's coefficients, fed with the samples that the bridge corrects.

    Parameters
    ----------
    calibration : Calibration
        Initial calibration.
    grid : AnomalyGrid, optional
        Anomaly map to add to the main field; samples outside the map are not used.
    spread : float
        1-sigma of the Earth's field about its reference, nT. Without a map, it is also the 1-sigma of the
        reference's constant error; a map has none.
    turn_on : float
        1-sigma of the offsets' change at every power-on, nT.
    max_rate : float
        Highest rate of samples to learn from, Hz.
    currents : tuple of str
        Names of the telemetry channels that are electric currents, in ampere.

    Attributes
    ----------
    watched : tuple of str
        Names of the telemetry that :meth:`sample` needs: the temperature, and the currents.
    samples : int
        Number of samples that coefficients were learned from.
    notices : list of Notice
        Notifications since the caller last emptied the list.
    enabled, frozen : bool
        If not enabled, samples are ignored. If frozen, calibrations are compared and alarms raised, but no
        coefficient changes.

    Raises
    ------
    CalibrationError
        The calibration has no constant offset.
    """

    def __init__(
        self,
        calibration: Calibration,
        *,
        grid: AnomalyGrid | None = None,
        spread: float = MAIN_FIELD_SIGMA_NT,
        turn_on: float = 20.0,
        max_rate: float = 1.0,
        currents: tuple[str, ...] = (),
    ) -> None:
        self._model = LearnedTerms(calibration, currents)
        self.watched = self._model.watched
        self._unfit = UNFIT if calibration.method == NO_METHOD else UNFIT | int(Quality.UNCALIBRATED)
        self._grid, self._max_rate, self._turn_on = grid, max_rate, turn_on
        self.enabled, self.frozen = True, False
        self.notices: list[Notice] = []
        self._now_us = 0
        nuisance = Nuisance(calibration.noise, spread, 0.0 if grid is not None else spread)
        self._publication = Publication(self._model, calibration, nuisance)
        self._standing = AlarmState(mapped=grid is not None)
        self._begin(nuisance)

    @property
    def first(self) -> Calibration:
        """Initial calibration, or the last calibration that the operator accepted."""
        return self._publication.first

    @property
    def calibration(self) -> Calibration:
        """Published calibration, with which the bridge corrects."""
        return self._publication.calibration

    @property
    def renewed(self) -> bool:
        """Return True if the last change of the published calibration was a routine update."""
        return self._publication.is_update

    @property
    def flags(self) -> int:
        """Quality flags of the last sample: ``unexplained``, or 0."""
        return self._standing.flags

    @property
    def variance(self) -> float:
        """Variance to add to the total field's while an alarm lasts, nT²."""
        return self._standing.variance

    @property
    def state(self) -> LearnerState:
        """Present state of learning, for MAG_LEARNING."""
        judge, alarm = self._publication.judge, self._standing.alarm
        first, published, learned = np.sqrt(judge.mean_square).tolist()
        causes = alarm.causes if alarm else ()
        since, size = (round(alarm.since * 1e6), alarm.size) if alarm else (0, 0.0)
        return LearnerState(self.samples, (first, published, learned), judge.better, causes, since, size)

    def learned(self) -> Calibration:
        """Return the calibration as learned so far, with its covariance and origin."""
        knowledge = self._knowledge
        return self._publication.made(knowledge.bank.best, self.samples, knowledge.noise)

    def accept(self) -> None:
        """Make the learned calibration the first one, which no rollback undoes, and close the alarm."""
        if self.samples:
            self._publish("accepted: learned calibration")
            self._publication.accept()
        self._settle("acknowledged")

    def forget(self) -> None:
        """Return to the initial calibration and restart learning from it."""
        self._settle("forgotten")
        self._publication.forget(self._knowledge.nuisance)
        self._begin(self._knowledge.nuisance)
        self._notify("learning: all forgotten")

    def _begin(self, nuisance: Nuisance) -> None:
        """Reset learning, so that it starts with the first calibration."""
        self._unlearned = 0.0  # size of a change that ended without a cause and may last, nT
        self._restart(nuisance)
        self._intake = Intake(self._max_rate)
        self.samples = 0
        self._unconfirmed = False  # a cause was learned, and no calibration was published since
        self._expected = False  # the cause that was learned explains the samples
        self._refuted = False  # another alarm came before later samples confirmed the cause

    def _restart(self, nuisance: Nuisance) -> None:
        """Restart learning with the published calibration, whose offsets may have changed since."""
        published = self.calibration
        # without the map, the reference is off by the crustal field and its level
        mapless = (
            Nuisance(published.noise, MAIN_FIELD_SIGMA_NT, MAIN_FIELD_SIGMA_NT)
            if self._grid is not None
            else None
        )
        self._knowledge = Knowledge(
            self._model, published, nuisance, mapless, hypot(self._turn_on, self._unlearned)
        )

    def _notify(self, text: str, grave: bool = False) -> None:
        """Add a notification, which is a warning if it is `grave`."""
        self.notices.append(Notice(text, self._now_us * 1e-6, grave))

    def restarted(self) -> None:
        """Handle a power cycle of the sensor, which may have changed the offsets."""
        self._intake.drop()
        self._knowledge.bank.open(self._turn_on**2)

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
        position: tuple[float, float] | None,
        watched: Sequence[float],
        age: float = 0.0,
        settled: Vector | None = None,
    ) -> None:
        """Add a corrected sample, taken at `time_us` (µs since 1970 UTC).

        The sample waits until newer telemetry arrives. If a mass had begun to move, it is discarded.

        `field` is the raw field (nT, sensor axes). `regressors` and `values` are the regressors and channel
        values of the calibration at that time. `faulty` is True if the sensor is at fault, or the field
        cannot be the Earth's. `reference` is the main field H_e (nT; NaN without a `position`, which is
        latitude and longitude in deg). `watched` are the values of the telemetry :attr:`watched` (NaN if
        unknown). `age` is the age of the parameters' oldest telemetry (s). `settled` is the field of the
        previous sample, if this sample makes it more exact.
        """
        # axes sampled in turn: the next reading makes the waiting sample more exact
        self._intake.settle(settled)
        if not self.enabled:
            return
        self._now_us, unfit = time_us, quality & self._unfit
        fit = not (unfit or faulty)
        if unfit & ~MOVING or isnan(reference) or position is None:
            self._nothing(time_us)
            return
        if not self._intake.due(time_us, fit=fit):
            return
        if self._grid is not None:
            reference += self._grid.look_up(position[1], position[0]).anomaly
        phi, positions = self._model.regressors(regressors, watched), self._model.scaled(values)
        if isnan(reference) or not np.isfinite(phi).all():
            self._nothing(time_us)
            return
        # late telemetry shows only now, in stored samples
        self._raise_alarm(self._knowledge.look_back(time_us, phi, positions))
        if unfit:
            self._intake.drop()
        # newer telemetry has come without a motion: the waiting samples are at rest
        for before in self._intake.confirmed(time_us, age):
            self._take(before)
        if not fit:
            self._nothing(time_us)
        if unfit:
            return
        new = LearningSample(time_us, field, reference, phi, positions, position, tuple(watched), faulty)
        self._intake.wait(new)

    def _nothing(self, time_us: int) -> None:
        """Record an unusable sample; send a notification after an hour without a usable one."""
        if self._intake.short(time_us):
            self._notify("learning: an hour without a sample to learn from", True)

    def _take(self, sample: LearningSample) -> None:
        """Predict a sample, compare the calibrations, learn from it, and decide what to publish."""
        knowledge = self._knowledge
        if sample.faulty:
            knowledge.keep_faulty(sample)
            return
        way = self._intake.moved(sample)
        now, best = knowledge.predict(sample, way), knowledge.bank.best
        if knowledge.outlying(learnable=self._standing.is_learnable):
            self._standing.count(best.filter.innovation, best.filter.variance, informative=False)
            return
        published = self._judge(sample, way)
        difference = published.e - now.e
        if knowledge.start is None:
            # compare and test before learning: a prediction must not use its own sample
            self._compare(sample.time_us * 1e-6, difference)
            alarm, learned = knowledge.learn(sample, way.seconds, frozen=self.frozen)
            self._raise_alarm(alarm)
            self._count(learned=learned)
        elif not self.frozen:
            self._learn_start(sample, way)
        # until the first fit, nothing is published or judged
        if knowledge.start is None or knowledge.start.fitted:
            self._decide(difference * now.s)

    def _raise_alarm(self, alarm: LearningAlarm | None) -> None:
        """Update the alarm's state with an alarm, if there is one, and send the notification that results."""
        if alarm is None:
            return
        pending = self._standing.is_pending
        if news := self._standing.update(alarm):
            self._notify(news, True)
        self._refuted = self._refuted or (pending and not self._standing.is_pending)

    def _publish(self, how: str) -> None:
        """Publish the learned calibration; `how` is the reason in the notification."""
        self._notify(self._publication.publish(self.learned(), how))
        self._unconfirmed, self._unlearned = False, 0.0

    def _settle(self, how: str) -> None:
        """Close the alarm, if there is one; `how` is the reason in the notification."""
        if self._standing.alarm is None:
            return
        self._standing.end()
        # the evidence so far belongs to the closed alarm
        self._knowledge.detector.restart()
        self._knowledge.late_telemetry.restart()
        self._notify(f"explained again: {how}")

    def _close_unexplained(self) -> None:
        """Close an alarm that no coefficient explained, and restart the judge, whose data it affected."""
        assert self._standing.alarm is not None
        self._unlearned = self._standing.alarm.size
        self._publication.judge.restart()
        self._settle("gone")

    def _judge(self, sample: LearningSample, way: Way) -> Observation:
        """Predict a sample by every calibration; return the observation by the published calibration."""
        publication, judge = self._publication, self._publication.judge

        def observed(nine: FloatArray) -> Observation:
            return observe(sample.field, nine, self._model.field, sample.reference)

        direction = observed(publication.nine(sample.phi)[FIRST]).direction
        if judge.is_due(way.metres, way.seconds, direction) and self._knowledge.start is None:
            publication.propose(self._knowledge.bank.best.coefficients)
        seen = [observed(nine) for nine in publication.nine(sample.phi)]
        # a replaced calibration keeps the level of its crustal field
        for which, nine in publication.replaced(sample.phi).items():
            judge.replace(which, seen[which].e - observed(nine).e, seen[which].s)
        first, published, candidate = seen
        # the judge's filters use the same transition as the estimators
        F = self._knowledge.believed.transition(*way)[0]
        judge.judge(F, (first.e, published.e, candidate.e), first.s)
        return published

    def _compare(self, time: float, difference: float) -> None:
        """Select the best estimator; `difference` is the published residual minus the best one's, nT."""
        bank, publication = self._knowledge.bank, self._publication
        best, was_doubted = bank.best, bank.map_doubted
        seen = (
            (best.filter.innovation + difference, best.filter.variance)
            if publication.learned
            else publication.judge.last
        )
        self._standing.count(*seen, informative=bank.quiet.is_informative)
        bank.judge(time)
        if bank.map_doubted and bank.without_map is not None:
            size = abs(bank.without_map.crust)
            alarm = LearningAlarm(("map_error",), ("",), bank.map_since, size, bank.map_lead, mapless=True)
            self._raise_alarm(alarm)
        if bank.map_doubted != was_doubted:
            publication.judge.restart(self._knowledge.believed)

    def _learn_start(self, sample: LearningSample, way: Way) -> None:
        """Learn from a sample while the batch fit runs, before a filter can be linearised."""
        if not self._knowledge.begin(sample, way):
            self._count(learned=True)
            return
        self._publication.propose(self._knowledge.bank.quiet.coefficients)
        self._publication.judge.restart(self._knowledge.nuisance)
        if self._publication.learned:
            self._publication.renew(self.learned())
            self._publication.is_update = False  # the previous fit may have caused the jump
        self._knowledge.go_on()

    def _count(self, *, learned: bool) -> None:
        """Count a sample; `learned` is True if coefficients were learned from the sample."""
        self.samples += learned
        self._publication.age += 1

    def _decide(self, difference: float) -> None:
        """Publish or roll back; `difference` is the difference of learned and published total field, nT."""
        publication = self._publication
        if not self.frozen and (self._refuted or self._end()):
            self._standing.restart()
            self._restart_judged()
            return
        worse, relapsed = publication.judge.roll_back, self._standing.relapses > 0
        # discard the worse calibration first, then publish the better one
        if worse and not publication.learned and self._standing.alarm is None:
            publication.judge.discard()  # the learned calibration may improve yet
        elif worse or (relapsed and publication.judge.improves < -BEYOND_CHANCE):
            self._standing.mark_mistaken()
            if worse and publication.learned:
                self._notify(publication.roll_back())
            self._restart_judged()
            return
        if self.frozen or not self._trusted():
            return
        # the first publication needs the judge; later updates follow the estimator
        pending = self._standing.is_pending
        if pending or not publication.learned:
            if self._holds():
                self._publish_learned()
        elif publication.stale(difference):
            publication.renew(self.learned())

    def _restart_judged(self) -> None:
        """Restart learning and the judge from the published calibration."""
        self._publication.judge.restart()
        self._unconfirmed = self._refuted = False
        self._restart(self._knowledge.nuisance)

    def _holds(self) -> bool:
        """Return True if the learned calibration is better, and its change significant at all attitudes."""
        publication, best = self._publication, self._knowledge.bank.best
        if self._knowledge.start is not None and not publication.learned:  # no calibration is published
            return publication.judge.better > BEYOND_CHANCE
        # better in the last blocks, and significant at all attitudes so far
        change = best.coefficients - publication.coefficients
        expected = self._standing.is_pending and self._expected
        return publication.judge.adopt(expected=expected) and self._knowledge.coverage.is_significant(
            change, best.covariance
        )

    def _publish_learned(self) -> None:
        """Publish the learned calibration; close the alarm that it explains."""
        if not self._standing.is_pending:
            for estimator in self._knowledge.bank.all:
                estimator.keep_level(self._publication.coefficients)
            self._publish("learned")
            return
        self._publication.publish(self.learned(), "learned")
        self._unconfirmed, self._unlearned = False, 0.0
        how = self._explained
        if self._standing.confirm():
            self._notify(f"explained again: {how}")

    def _trusted(self) -> bool:
        """Return True without an alarm, or if the best estimator's hypothesis explains the alarm."""
        standing, bank = self._standing, self._knowledge.bank
        if standing.alarm is None or standing.is_mapless or standing.is_tried:
            return True
        return standing.is_learnable and not standing.relapses and bank.best is not bank.quiet

    def _end(self) -> bool:
        """Close an alarm that has been silent for long, or learn its cause if the evidence suffices.

        Return True if learning has to restart, because no later samples confirmed the learned calibration.
        """
        standing, publication = self._standing, self._publication
        judge = publication.judge
        if standing.is_pending and (judge.improves > 0.0 or not judge.is_complete):
            return False
        if not standing.is_silent:
            if standing.is_certain:
                self._take_up()
            return False
        # unconfirmed learning restarts from the published calibration
        restart = self._unconfirmed or (standing.relapses > 0 and not standing.is_tried)
        if not standing.is_tried:
            self._close_unexplained()
        elif publication.learned and not standing.is_pending:
            self._settle(self._explained)
        else:
            name = "learned" if publication.learned else "first"
            which = calibration_id(publication.calibration)
            self._settle(f"the {name} calibration holds, {which:08x}")
        return restart

    @property
    def _explained(self) -> str:
        """Learned causes of the alarm, with the calibration's id, for a notification."""
        assert self._standing.alarm is not None
        causes = named([one for one in self._standing.alarm.causes if one not in NO_COEFFICIENT])
        return f"{causes}, learned {calibration_id(self._publication.calibration):08x}"

    def _take_up(self) -> None:
        """Learn the alarm's cause on trial, if coefficients can represent the cause."""
        bank, alarm = self._knowledge.bank, self._standing.alarm
        strength = self._knowledge.detector.strength
        if strength < MIN_CAUSE_LOG_RATIO:
            self._close_unexplained()
            return
        assert alarm is not None
        # a cause that explains the samples needs less confirmation than a change without an alarm
        self._expected = self._knowledge.detector.misfit < MAX_MISFIT
        if "temperature_offset" not in alarm.causes or not bank.take_over(strength):
            moved = self._knowledge.detector.learned()
            if moved is None:
                return
            bank.explained(*moved, strength)
        self._knowledge.detector.restart()
        self._publication.judge.discard()
        self._standing.try_cause()
        self._unconfirmed = True
