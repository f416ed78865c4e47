"""Decide when to publish the learned calibration, when to roll it back, and when to close an alarm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import msgspec
import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.file import calibration_id
from magbridge.calibration.model import Calibration, Noise
from magbridge.learning.alarms import NO_COEFFICIENT, AlarmState, LearningAlarm, named
from magbridge.learning.estimator import Estimator, Nuisance
from magbridge.learning.judge import BEYOND_CHANCE, CANDIDATE, FIRST, PUBLISHED, Judge
from magbridge.learning.knowledge import Knowledge
from magbridge.learning.model import LearnedTerms
from magbridge.learning.samples import LearningSample, Observation, Way

__all__ = ["NO_METHOD", "Decision", "Publication"]

NO_METHOD: Final = "none"
"""The method of a calibration that is none."""
MAX_PUBLISHED_DIFFERENCE: Final = 0.3
"""Difference of learned and published total field that causes an update, as a fraction of the noise."""
RENEW: Final = 32, 256
"""Samples after which it may be, and is in any case."""


class Publication:
    """Holds the first calibration and the published one, and judges between them.

    Parameters
    ----------
    model : LearnedTerms
    first : Calibration
        Initial calibration.
    nuisance : Nuisance

    Attributes
    ----------
    first : Calibration
        Initial or accepted calibration.
    calibration : Calibration
        Published calibration.
    coefficients : (K,) array
        Coefficients of the published calibration.
    judge : Judge
    renewed : bool
        True if the last change of the published calibration was a routine update.
    age : int
        Samples used since that change.
    """

    def __init__(self, model: LearnedTerms, first: Calibration, nuisance: Nuisance) -> None:
        self._model, self.first, self.renewed = model, first, False
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
        least, most = RENEW
        far = abs(difference) > MAX_PUBLISHED_DIFFERENCE * self.calibration.noise.sensor
        return self.learned and ((far and self.age >= least) or self.age >= most)

    def renew(self, calibration: Calibration) -> None:
        """Update the published calibration with the learned one, without a notification."""
        self.calibration = calibration
        self.coefficients = self._model.coefficients(calibration)[0]
        self._replace(PUBLISHED, self._model.weights(self.coefficients))
        self.age, self.renewed = 0, True

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
        self.renewed = False
        rms = np.sqrt(self.judge.mean_square)
        said = f"{how} {calibration_id(self.calibration):08x}"
        if previous == FIRST and self.first.method == NO_METHOD:  # no errors to compare with
            return f"{said} from nothing"
        return f"{said}: {rms[previous]:.1f} to {rms[following]:.1f} nT"


GONE: Final = 9.0
"""Log-likelihood ratio below which an alarm's cause is closed as gone instead of learned."""


MAX_MISFIT: Final = 2.0
"""Mean normalised square of the innovations that a cause leaves, up to which it explains them. A cause that
leaves more is not the true one, as where a current has no telemetry."""


class Decision:
    """Evaluates every sample and decides what to publish.

    Parameters
    ----------
    publication : Publication
    standing : AlarmState
        State of the alarm.
    notify : callable
        Called with the text of a notification, and True if its severity is WARNING.

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
        """Pass an alarm, if there is one, to the alarm's state, and send the notification that results."""
        if alarm is None:
            return
        pending = self._standing.pending
        if news := self._standing.raised(alarm):
            self._notify(news, True)
        self._refuted = self._refuted or (pending and not self._standing.pending)

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

    def gone(self, knowledge: Knowledge) -> None:
        """Close an alarm that no coefficient explained, and restart the judge, which its cause affected."""
        self._publication.judge.restart()
        self.settle(knowledge, "gone")

    def take(self, knowledge: Knowledge, sample: LearningSample, way: Way, *, frozen: bool) -> bool:
        """Predict a sample, compare the calibrations, learn from it, and decide what to publish.

        `way` leads from the previous sample to this one. Return True if learning has to
        restart from the first calibration.
        """
        now, signs = knowledge.predict(sample, way)
        best = knowledge.bank.best
        if knowledge.outlying(learnable=self._standing.learnable):
            self._standing.count(best.residual, best.variance, telling=False)
            return False
        published = self._judge(knowledge, sample, way)
        difference = published.e - now.e
        if knowledge.start is None:
            # compare and test before learning: a prediction must not know its own sample
            self._compare(knowledge, signs.time, difference)
            alarm, learned = knowledge.learn(signs, frozen=frozen)
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
        best, doubted = bank.best, bank.map_doubted
        seen = (best.residual + difference, best.variance) if publication.learned else publication.judge.last
        self._standing.count(*seen, telling=bank.quiet.telling)
        self.raise_alarm(bank.judge(time))
        if bank.map_doubted != doubted:
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
            self._publication.renewed = False  # the previous fit may have caused the jump
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
        # first undo what is worse, then publish what is better
        if worse and not publication.learned and self._standing.alarm is None:
            publication.judge.discard()  # the learned calibration may improve yet
        elif worse or (relapsed and publication.judge.improves < -BEYOND_CHANCE):
            self._standing.mistaken()
            if worse and publication.learned:
                self._notify(publication.roll_back(), False)
            publication.judge.restart()
            self._unconfirmed = self._refuted = False
            return True
        if frozen or not self._trusted(knowledge):
            return False
        # the first publication needs the judge; later ones follow the estimator
        pending = self._standing.pending
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
        expected = self._standing.pending and self._expected
        return publication.judge.adopt(expected=expected) and knowledge.coverage.is_significant(
            change, best.covariance
        )

    def _publish_learned(self, knowledge: Knowledge) -> None:
        """Publish the learned calibration; close the alarm that it explains."""
        if not self._standing.pending:
            for one in knowledge.bank.all:
                one.keep_level(self._publication.coefficients)
            self.publish(knowledge, "learned")
            return
        self._publication.publish(self.learned(knowledge), "learned")
        self._unconfirmed = False
        how = self._explained
        if self._standing.confirmed():
            self._notify(f"explained again: {how}", False)

    def _trusted(self, knowledge: Knowledge) -> bool:
        """Return True without an alarm, or if the best estimator's hypothesis explains the alarm."""
        standing, bank = self._standing, knowledge.bank
        if standing.alarm is None or standing.mapless or standing.tried:
            return True
        return standing.learnable and not standing.relapses and bank.best is not bank.quiet

    def _end(self, knowledge: Knowledge) -> bool:
        """Close an alarm that has been silent for long, or learn the cause of one that is certain enough.

        Return True if learning has to restart, because no later samples confirmed the learned calibration.
        """
        standing, publication = self._standing, self._publication
        judge = publication.judge
        if standing.pending and (judge.improves > 0.0 or not judge.is_complete):
            return False
        if not standing.gone:
            if standing.ripe:
                self._take_up(knowledge)
            return False
        # learning that nothing has confirmed restarts from the published calibration
        restart = self._unconfirmed or (standing.relapses > 0 and not standing.tried)
        if not standing.tried:
            self.gone(knowledge)
        elif publication.learned and not standing.pending:
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
        if strength < GONE:
            self.gone(knowledge)
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
        self._standing.take_up()
        self._unconfirmed = True
