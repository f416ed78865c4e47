"""Estimate and test sample by sample, decide what to publish and when to roll back, and close alarms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import msgspec
import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.file import calibration_id
from magbridge.calibration.model import Calibration, Noise
from magbridge.estimation.track_process import ReferenceSteps
from magbridge.learning.alarms import (
    NO_COEFFICIENT,
    AlarmState,
    CauseRegressors,
    ChangeDetector,
    LateTelemetryTest,
    LearningAlarm,
    StoredSample,
    named,
)
from magbridge.learning.estimator import BEYOND_CHANCE, BatchFit, Estimator, EstimatorBank, Nuisance
from magbridge.learning.judge import CANDIDATE, FIRST, PUBLISHED, Coverage, Judge
from magbridge.learning.samples import LearnedTerms, LearningSample, Observation, Way, observe
from magbridge.records import Vector

__all__ = ["NO_METHOD", "Decision", "Knowledge", "Publication"]

MAX_LINEAR_SIGMA_NT: Final = 300.0
"""Offset uncertainty from which on the batch fit repeats the whole estimate, nT, 1-sigma of an axis."""
OFFSET_WALK: Final = 3.0 / 86_400.0**0.5
"""nT per square root of a second: an offset walks by 3 nT a day."""
LEARNING_OUTLIER_SIGMA: Final = 5.0
MIN_AGREEING_OUTLIERS: Final = 3
"""An innovation beyond so many sigmas says nothing, unless it is the third in a row."""


class Knowledge:
    """Estimators, tests and batch fit of one learning period.

    It begins with a calibration, whose offsets may have changed at this power-on by `turn_on` (nT, 1-sigma),
    and with the nuisance of the reference, and of the main field alone if the reference is a map.
    """

    def __init__(
        self,
        model: LearnedTerms,
        first: Calibration,
        nuisance: Nuisance,
        mapless: Nuisance | None,
        turn_on: float,
    ) -> None:
        self._model, self._mapless, self.nuisance, self.noise = model, mapless, nuisance, first.noise
        self._field, offsets = first.reference.field, model.offsets
        coefficients, covariance = model.coefficients(first)
        quiet = Estimator(coefficients, covariance, offsets, nuisance, OFFSET_WALK)
        quiet.open(turn_on**2)
        self.bank, self.detector = EstimatorBank(model, quiet, mapless), ChangeDetector(model, quiet)
        self.late_telemetry, self._outliers = LateTelemetryTest(), 0
        self.coverage = Coverage(model.size)
        self._before: FloatArray | None = None
        self._reference_steps = ReferenceSteps()
        self.start: BatchFit | None = None
        if np.trace(covariance[np.ix_(offsets, offsets)]) > 3.0 * MAX_LINEAR_SIGMA_NT**2:
            self.start = BatchFit(model, coefficients, covariance, self._field)
        else:
            self.bank.suppose()

    @property
    def believed(self) -> Nuisance:
        """Nuisance in use: the one without the map during a map alarm."""
        return self._mapless if self.bank.map_doubted and self._mapless else self.nuisance

    def observe(self, field: Vector, nine: FloatArray, reference: float) -> Observation:
        """Return the observation of a field (nT) with nine coefficients (9,)."""
        return observe(field, nine, self._field, reference)

    def _observation_with(self, estimator: Estimator) -> Callable[[Vector, FloatArray, float], Observation]:
        """Return the observation of a field at regressors (m,) with an estimator's coefficients."""
        return lambda field, phi, reference: self.observe(
            field, phi @ self._model.weights(estimator.coefficients), reference
        )

    def look_back(self, time_us: int, phi: FloatArray, positions: list[float]) -> LearningAlarm | None:
        """Test whether the regressors (m,) reported now fit earlier samples better than those of then."""
        if self.start is not None:
            return None
        return self.late_telemetry.test(time_us, phi, positions, self._observation_with(self.bank.quiet))

    def keep(self, sample: LearningSample, innovation: float) -> None:
        """Keep a sample that is wrong by an innovation (nT), to look back at."""
        self.late_telemetry.keep(StoredSample(sample, innovation, self.bank.quiet.filter.variance))

    def keep_faulty(self, sample: LearningSample) -> None:
        """Keep a sample that is not predicted."""
        quiet = self.bank.quiet
        now = self._observation_with(quiet)(sample.field, sample.phi, sample.reference)
        self.keep(sample, now.e - quiet.expected)

    def predict(self, sample: LearningSample, way: Way) -> tuple[Observation, CauseRegressors]:
        """Predict a sample with every estimator, on the way from the previous one.

        Return the selected estimator's residual and derivatives, and the regressors of the causes to test.
        """
        before, self._before = self._before, sample.phi
        self._reference_steps.follow(sample.time_us, sample.reference)
        quiet = self.bank.quiet
        # time update of all estimators, and of what the tests have absorbed
        for other in self.bank.all[1:]:
            other.propagate(way)
        seconds = way.seconds
        self.detector.propagate(quiet, quiet.propagate(way), seconds)
        # relinearise every estimator at its own coefficients
        live = {id(one): self._predict(one, sample) for one in self.bank.all}
        best = live[id(self.bank.best)]
        self.coverage.add(best.s * self._model.derivative(sample.phi, best.by_nine), best.direction)
        self.keep(sample, quiet.filter.innovation)
        now, clock = live[id(quiet)], 0.0
        if before is not None and 0.0 < seconds < 30.0:  # the residual if telemetry were a second late
            clock = (
                self._observation_with(quiet)(sample.field, before, sample.reference).e - now.e
            ) / seconds
        # the main field's model alone is smooth: without a map and without a step it has no error to test
        may_step = self._mapless is not None or self._reference_steps.total != 0.0
        offset, level = now.by_nine[6:], -1.0 / now.s if may_step else 0.0
        regressors = CauseRegressors(
            sample.time_us * 1e-6, offset, tuple(sample.positions), sample.watched, clock, level
        )
        return best, regressors

    def _predict(self, estimator: Estimator, sample: LearningSample) -> Observation:
        live = self._observation_with(estimator)(sample.field, sample.phi, sample.reference)
        estimator.predict(live.e, live.s, self._model.derivative(sample.phi, live.by_nine))
        estimator.follow(live.s)
        return live

    def outlying(self, *, learnable: bool) -> bool:
        """Return True for an outlier that no estimator predicts and no `learnable` alarm explains."""
        if self.start is not None:
            return False
        best = self.bank.best
        far = abs(best.filter.innovation) > LEARNING_OUTLIER_SIGMA * best.filter.sigma
        self._outliers = self._outliers + 1 if far else 0
        return far and self._outliers < MIN_AGREEING_OUTLIERS and not learnable

    def learn(self, regressors: CauseRegressors, *, frozen: bool) -> tuple[LearningAlarm | None, bool]:
        """Test the prediction, then learn from it; return the alarm, and True if the sample was used."""
        quiet = self.bank.quiet
        # test the innovation first: the update absorbs a part of every change
        alarm = self.detector.test(quiet, regressors)
        for other in self.bank.all[1:]:
            other.update(learn=other.is_informative and not frozen)
        learn = quiet.is_informative and not frozen
        self.detector.updated(quiet.update(learn=learn))
        return alarm, learn

    def begin(self, sample: LearningSample, way: Way) -> bool:
        """Add a sample to the batch fit; return True if the fit of all samples was repeated."""
        assert self.start is not None
        quiet = self.bank.quiet
        if not self.start.add(sample.field, sample.phi, sample.reference, way):
            quiet.update(learn=True)
            return False
        # all samples so far, from the prior: no linearisation of a poor start stays
        fitted = self.start.fit(quiet.coefficients, self.nuisance)
        self.noise = msgspec.structs.replace(self.noise, sensor=fitted.noise)
        self.nuisance = Nuisance(self.noise, self.nuisance.spread, self.nuisance.constant)
        quiet.know(fitted.coefficients, fitted.nuisances, fitted.covariance, self.nuisance)
        return True

    def go_on(self) -> None:
        """End the batch fit and continue with the filters, if they can be linearised."""
        if self.start is not None and self.start.is_over:
            self.start = None
            self.bank.suppose()


NO_METHOD: Final = "none"
"""The method of a calibration that is none."""
MAX_PUBLISHED_DIFFERENCE: Final = 0.3
"""Difference of learned and published total field that causes an update, as a fraction of the noise."""
MIN_UPDATE_SAMPLES: Final = 32
MAX_UPDATE_SAMPLES: Final = 256
"""Samples after which it may be updated, and is in any case."""


class Publication:
    """Hold the first (initial or accepted) calibration and the published one, and judge between them.

    Attributes
    ----------
    first, calibration : Calibration
        First and published calibration.
    coefficients : (K,) array
        Coefficients of the published calibration.
    judge : Judge
        Compares both, and the candidate.
    is_update : bool
        True if the last change of the published calibration was a routine update.
    age : int
        Samples used since that change.
    """

    def __init__(self, model: LearnedTerms, first: Calibration, nuisance: Nuisance) -> None:
        self._model, self.first, self.is_update = model, first, False
        self.forget(nuisance)

    def forget(self, nuisance: Nuisance) -> None:
        """Go back to the first, as if nothing had been judged."""
        self.calibration, self.judge, self.age = self.first, Judge(nuisance), 0
        self.coefficients = self._model.coefficients(self.first)[0]
        self._weights = [self._model.weights(self.coefficients)] * 3
        self._replaced: dict[int, FloatArray] = {}

    @property
    def learned(self) -> bool:
        """Return True if the learned calibration is published."""
        return self.calibration is not self.first

    def nine(self, phi: FloatArray) -> list[FloatArray]:
        """Return the nine coefficients (9,) at `phi` (m,): first, published one and candidate."""
        return [phi @ weights for weights in self._weights]

    def replaced(self, phi: FloatArray) -> dict[int, FloatArray]:
        """Return the nine coefficients (9,), at `phi` (m,), of the calibrations that were replaced."""
        replaced, self._replaced = self._replaced, {}
        return {which: phi @ weights for which, weights in replaced.items()}

    def propose(self, coefficients: FloatArray) -> None:
        """Set the candidate's coefficients (K,)."""
        self._replace(CANDIDATE, self._model.weights(coefficients))

    def _replace(self, index: int, weights: FloatArray) -> None:
        self._replaced.setdefault(index, self._weights[index])
        self._weights[index] = weights

    def made(self, estimator: Estimator, samples: int, noise: Noise) -> Calibration:
        """Return the calibration that an estimator has learned, with its origin."""
        first, coefficients, method = self.first, estimator.coefficients, self.first.method
        covariance, level = estimator.covariance, first.level
        reference = first.reference
        if first.method == NO_METHOD:
            method = "learned"
            if self.learned:
                coefficients = estimator.at_level_of(self.coefficients)
                by = coefficients - estimator.coefficients
                covariance = covariance + np.outer(by, by)
            toward = covariance @ estimator.mean  # how coefficients go with the level, which has this sigma
            # level vector of the file: covariance with the mean field, over its sigma
            sigma = float(np.sqrt(estimator.mean @ toward))
            if sigma:  # no sample, no level
                level = tuple((toward[: first.coefficients.size] / sigma).tolist())
                reference = msgspec.structs.replace(reference, level_sigma=sigma)
        elif "learned" not in method:
            method += ", learned"
        inputs = first.inputs | {f"calibration {calibration_id(first):08x}": f"{samples} samples later"}
        made = self._model.calibration(coefficients, covariance)
        return replace(made, method=method, inputs=inputs, noise=noise, level=level, reference=reference)

    def stale(self, difference: float) -> bool:
        """Return True if `difference`, learned less published total field (nT), requires an update."""
        far = abs(difference) > MAX_PUBLISHED_DIFFERENCE * self.calibration.noise.sensor
        return self.learned and ((far and self.age >= MIN_UPDATE_SAMPLES) or self.age >= MAX_UPDATE_SAMPLES)

    def renew(self, calibration: Calibration) -> None:
        """Update the published calibration with the learned one, without a notification."""
        self.calibration = calibration
        self.coefficients = self._model.coefficients(calibration)[0]
        self._replace(PUBLISHED, self._model.weights(self.coefficients))
        self.age, self.is_update = 0, True

    def publish(self, calibration: Calibration, how: str) -> str:
        """Publish it for another reason; return the message."""
        before = PUBLISHED if self.learned else FIRST
        self.renew(calibration)
        return self._change(how, before, CANDIDATE)

    def accept(self) -> None:
        """Make the published calibration the first one, so that no rollback undoes it."""
        self.first = self.calibration
        self._weights[FIRST] = self._weights[PUBLISHED]
        self.judge.mean_square[FIRST] = self.judge.mean_square[PUBLISHED]
        self.judge.restart()

    def roll_back(self) -> str:
        """Publish the first again; return what to say of that."""
        self.calibration, self.age = self.first, 0
        self.coefficients = self._model.coefficients(self.first)[0]
        self._replace(PUBLISHED, self._weights[FIRST])
        return self._change("rolled back: the first calibration predicts better", PUBLISHED, FIRST)

    def _change(self, how: str, previous: int, following: int) -> str:
        self.is_update = False
        rms = np.sqrt(self.judge.mean_square)
        said = f"{how} {calibration_id(self.calibration):08x}"
        if previous == FIRST and self.first.method == NO_METHOD:  # no errors to compare with
            return f"{said} from nothing"
        return f"{said}: {rms[previous]:.1f} to {rms[following]:.1f} nT"


MIN_CAUSE_LOG_RATIO: Final = 9.0
"""Log-likelihood ratio below which an alarm is closed instead of its cause learned."""
MAX_MISFIT: Final = 2.0
"""Mean normalised square of the innovations that a cause leaves, up to which it explains them. A cause that
leaves more is not the true one, as where a current has no telemetry."""


class Decision:
    """Evaluate every sample and decide what to publish.

    `notify` is called with the text of a notification, and True if its severity is WARNING.

    Attributes
    ----------
    samples : int
        Number of samples that coefficients were learned from.
    """

    def __init__(
        self, publication: Publication, standing: AlarmState, notify: Callable[[str, bool], None]
    ) -> None:
        self._publication, self._standing, self._notify = publication, standing, notify
        self.samples = 0
        self._unconfirmed = False  # a cause was learned, and nothing was published since
        self._expected = False  # the cause that was learned explains the samples
        self._refuted = False  # another alarm came before later samples confirmed it

    def learned(self, knowledge: Knowledge) -> Calibration:
        """Return the calibration as learned so far, with its covariance and where it comes from."""
        return self._publication.made(knowledge.bank.best, self.samples, knowledge.noise)

    def raise_alarm(self, alarm: LearningAlarm | None) -> None:
        """Update the alarm's state with an alarm, if there is one, and send the notification that results."""
        if alarm is None:
            return
        pending = self._standing.is_pending
        if news := self._standing.update(alarm):
            self._notify(news, True)
        self._refuted = self._refuted or (pending and not self._standing.is_pending)

    def publish(self, knowledge: Knowledge, how: str) -> None:
        """Publish the learned calibration; `how` is the reason in the notification."""
        self._notify(self._publication.publish(self.learned(knowledge), how), False)
        self._unconfirmed = False

    def settle(self, knowledge: Knowledge, how: str) -> None:
        """Close the alarm, if there is one; `how` is the reason in the notification."""
        if self._standing.alarm is None:
            return
        self._standing.end()
        # the evidence so far belongs to the alarm that is over
        knowledge.detector.restart()
        knowledge.late_telemetry.restart()
        self._notify(f"explained again: {how}", False)

    def close_unexplained(self, knowledge: Knowledge) -> None:
        """Close an alarm that no coefficient explained, and restart the judge, which its cause affected."""
        self._publication.judge.restart()
        self.settle(knowledge, "gone")

    def take(self, knowledge: Knowledge, sample: LearningSample, way: Way, *, frozen: bool) -> bool:
        """Predict a sample, compare the calibrations, learn from it, and decide what to publish.

        `way` leads from the previous sample to this one. Return True if learning has to
        restart from the first calibration.
        """
        now, regressors = knowledge.predict(sample, way)
        best = knowledge.bank.best
        if knowledge.outlying(learnable=self._standing.is_learnable):
            self._standing.count(best.filter.innovation, best.filter.variance, informative=False)
            return False
        published = self._judge(knowledge, sample, way)
        difference = published.e - now.e
        if knowledge.start is None:
            # compare and test before learning: a prediction must not know its own sample
            self._compare(knowledge, regressors.time, difference)
            alarm, learned = knowledge.learn(regressors, frozen=frozen)
            self.raise_alarm(alarm)
            self._count(learned=learned)
        elif not frozen:
            self._begin(knowledge, sample, way)
        if knowledge.start is not None and not knowledge.start.fitted:
            return False  # neither published nor judged
        return self._decide(knowledge, difference * now.s, frozen=frozen)

    def _judge(self, knowledge: Knowledge, sample: LearningSample, way: Way) -> Observation:
        """Predict a sample by every calibration; return the published one's observation."""
        publication, judge = self._publication, self._publication.judge

        def observe(nine: FloatArray) -> Observation:
            return knowledge.observe(sample.field, nine, sample.reference)

        direction = observe(publication.nine(sample.phi)[FIRST]).direction
        if judge.is_due(way.metres, way.seconds, direction) and knowledge.start is None:
            publication.propose(knowledge.bank.best.coefficients)
        seen = [observe(nine) for nine in publication.nine(sample.phi)]
        # a calibration that was replaced goes on with the level of its crustal field
        for which, nine in publication.replaced(sample.phi).items():
            judge.replace(which, seen[which].e - observe(nine).e, seen[which].s)
        first, published, candidate = seen
        # the judge's filters move on over the same way as the estimators
        F = knowledge.believed.transition(*way)[0]
        judge.judge(F, (first.e, published.e, candidate.e), first.s)
        return published

    def _compare(self, knowledge: Knowledge, time: float, difference: float) -> None:
        """Select the best estimator; `difference` (nT): published residual less the best's."""
        bank, publication = knowledge.bank, self._publication
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
            map_alarm = LearningAlarm(
                ("map_error",), ("",), bank.map_since, size, bank.map_lead, mapless=True
            )
            self.raise_alarm(map_alarm)
        if bank.map_doubted != was_doubted:
            publication.judge.restart(knowledge.believed)

    def _begin(self, knowledge: Knowledge, sample: LearningSample, way: Way) -> None:
        """Learn from a sample while the batch fit runs, before a filter can be linearised."""
        if not knowledge.begin(sample, way):
            self._count(learned=True)
            return
        self._publication.propose(knowledge.bank.quiet.coefficients)
        self._publication.judge.restart(knowledge.nuisance)
        if self._publication.learned:
            self._publication.renew(self.learned(knowledge))
            self._publication.is_update = False  # the previous fit may have caused the jump
        knowledge.go_on()

    def _count(self, *, learned: bool) -> None:
        self.samples += learned
        self._publication.age += 1

    def _decide(self, knowledge: Knowledge, difference: float, *, frozen: bool) -> bool:
        """Publish or roll back; `difference` is the difference of learned and published total field, nT."""
        publication = self._publication
        if not frozen and (self._refuted or self._end(knowledge)):
            publication.judge.restart()
            self._standing.restart()
            self._unconfirmed = self._refuted = False
            return True
        worse, relapsed = publication.judge.roll_back, self._standing.relapses > 0
        # discard the worse calibration first, then publish the better one
        if worse and not publication.learned and self._standing.alarm is None:
            publication.judge.discard()  # the learned calibration may improve yet
        elif worse or (relapsed and publication.judge.improves < -BEYOND_CHANCE):
            self._standing.mark_mistaken()
            if worse and publication.learned:
                self._notify(publication.roll_back(), False)
            publication.judge.restart()
            self._unconfirmed = self._refuted = False
            return True
        if frozen or not self._trusted(knowledge):
            return False
        # the first publication needs the judge; later ones follow the estimator
        pending = self._standing.is_pending
        if pending or not publication.learned:
            if self._holds(knowledge):
                self._publish_learned(knowledge)
        elif publication.stale(difference):
            publication.renew(self.learned(knowledge))
        return False

    def _holds(self, knowledge: Knowledge) -> bool:
        """Return True if the learned calibration is better, and its change significant everywhere."""
        publication, best = self._publication, knowledge.bank.best
        if knowledge.start is not None and not publication.learned:  # no calibration is published
            return publication.judge.better > BEYOND_CHANCE
        # better in the last blocks, and known at all attitudes so far
        change = best.coefficients - publication.coefficients
        expected = self._standing.is_pending and self._expected
        return publication.judge.adopt(expected=expected) and knowledge.coverage.is_significant(
            change, best.covariance
        )

    def _publish_learned(self, knowledge: Knowledge) -> None:
        """Publish the learned calibration; close the alarm that it explains."""
        if not self._standing.is_pending:
            for one in knowledge.bank.all:
                one.keep_level(self._publication.coefficients)
            self.publish(knowledge, "learned")
            return
        self._publication.publish(self.learned(knowledge), "learned")
        self._unconfirmed = False
        how = self._explained
        if self._standing.confirm():
            self._notify(f"explained again: {how}", False)

    def _trusted(self, knowledge: Knowledge) -> bool:
        """Return True without an alarm, or if the best estimator's hypothesis explains the alarm."""
        standing, bank = self._standing, knowledge.bank
        if standing.alarm is None or standing.is_mapless or standing.is_tried:
            return True
        return standing.is_learnable and not standing.relapses and bank.best is not bank.quiet

    def _end(self, knowledge: Knowledge) -> bool:
        """Close an alarm that has been silent for long, or learn the cause of one that is certain enough.

        Return True if learning has to restart, because no later samples confirmed the learned calibration.
        """
        standing, publication = self._standing, self._publication
        judge = publication.judge
        if standing.is_pending and (judge.improves > 0.0 or not judge.is_complete):
            return False
        if not standing.is_silent:
            if standing.is_certain:
                self._take_up(knowledge)
            return False
        # learning that nothing has confirmed restarts from the published calibration
        restart = self._unconfirmed or (standing.relapses > 0 and not standing.is_tried)
        if not standing.is_tried:
            self.close_unexplained(knowledge)
        elif publication.learned and not standing.is_pending:
            self.settle(knowledge, self._explained)
        else:
            name = "learned" if publication.learned else "first"
            which = calibration_id(publication.calibration)
            self.settle(knowledge, f"the {name} calibration holds, {which:08x}")
        return restart

    @property
    def _explained(self) -> str:
        assert self._standing.alarm is not None
        causes = named([one for one in self._standing.alarm.causes if one not in NO_COEFFICIENT])
        return f"{causes}, learned {calibration_id(self._publication.calibration):08x}"

    def _take_up(self, knowledge: Knowledge) -> None:
        """Learn the cause of the alarm, if coefficients can represent it, on trial."""
        bank, alarm = knowledge.bank, self._standing.alarm
        strength = knowledge.detector.strength
        if strength < MIN_CAUSE_LOG_RATIO:
            self.close_unexplained(knowledge)
            return
        assert alarm is not None
        # a cause that explains the samples needs less confirmation than a change without an alarm
        self._expected = knowledge.detector.misfit < MAX_MISFIT
        if "temperature_offset" not in alarm.causes or not bank.take_over(strength):
            moved = knowledge.detector.learned()
            if moved is None:
                return
            bank.explained(*moved, strength)
        knowledge.detector.restart()
        self._publication.judge.discard()
        self._standing.try_cause()
        self._unconfirmed = True
