"""Decide when to publish the learned calibration, when to roll it back, and when to close an alarm."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from magbridge.arrays import FloatArray
from magbridge.calibration.file import calibration_id
from magbridge.calibration.model import Calibration
from magbridge.learning.causes import NO_COEFFICIENT, Alarm, named
from magbridge.learning.intake import Sample
from magbridge.learning.judge import BEYOND_CHANCE, FIRST
from magbridge.learning.knowledge import Knowledge
from magbridge.learning.observation import Observation
from magbridge.learning.publication import Publication
from magbridge.learning.standing import Standing

__all__ = ["Decision"]

GONE: Final = 9.0
"""Log-likelihood ratio below which an alarm's cause is closed as gone instead of learned."""


class Decision:
    """Evaluates every sample and decides what to publish.

    Parameters
    ----------
    publication : Publication
    standing : Standing
        State of the alarm.
    notify : callable
        Called with the text of a notification, and True if its severity is WARNING.

    Attributes
    ----------
    samples : int
        Number of samples that coefficients were learned from.
    """

    def __init__(
        self, publication: Publication, standing: Standing, notify: Callable[[str, bool], None]
    ) -> None:
        self._publication, self._standing, self._notify = publication, standing, notify
        self.samples = 0
        self._unconfirmed = False  # a cause was learned, and nothing was published since
        self._refuted = False  # another alarm came before later samples confirmed it

    def learned(self, knowledge: Knowledge) -> Calibration:
        """Return the calibration as learned so far, with its covariance and where it comes from."""
        return self._publication.made(knowledge.bank.best, self.samples, knowledge.noise)

    def doubt(self, alarm: Alarm | None) -> None:
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
        knowledge.doubt.restart()
        knowledge.hindsight.restart()
        self._notify(f"explained again: {how}", False)

    def gone(self, knowledge: Knowledge) -> None:
        """Close an alarm that no coefficient explained, and restart the judge, which its cause affected."""
        self._publication.judge.restart()
        self.settle(knowledge, "gone")

    def take(self, knowledge: Knowledge, sample: Sample, way: tuple[float, float], *, frozen: bool) -> bool:
        """Predict a sample, compare the calibrations, learn from it, and decide what to publish.

        `way` is the distance (m) and time (s) since the previous sample. Return True if learning has to
        restart from the first calibration.
        """
        now, signs = knowledge.predict(sample, *way)
        best = knowledge.bank.best
        if knowledge.outlying(learnable=self._standing.learnable):
            self._standing.count(best.residual, best.variance, telling=False)
            return False
        published = self._judge(knowledge, sample, way)
        apart = published.e - now.e
        if knowledge.start is None:
            self._compare(knowledge, signs.time, apart)
            alarm, learned = knowledge.learn(signs, frozen=frozen)
            self.doubt(alarm)
            self._count(learned=learned)
        elif not frozen:
            self._begin(knowledge, sample, way)
        if knowledge.start is not None and not knowledge.start.fitted:
            return False  # neither published nor judged
        return self._decide(knowledge, apart * now.s, frozen=frozen)

    def _judge(self, knowledge: Knowledge, sample: Sample, way: tuple[float, float]) -> Observation:
        """Let the calibrations predict a sample; return the published one's observation."""
        publication, judge = self._publication, self._publication.judge

        def observe(nine: FloatArray) -> Observation:
            return knowledge.observe(sample.field, nine, sample.reference)

        direction = observe(publication.nine(sample.phi)[FIRST]).direction
        if judge.is_due(*way, direction) and knowledge.start is None:
            publication.propose(knowledge.bank.best.coefficients)
        seen = [observe(nine) for nine in publication.nine(sample.phi)]
        for which, nine in publication.replaced(sample.phi).items():
            judge.replace(which, seen[which].e - observe(nine).e, seen[which].s)
        first, published, candidate = seen
        F = knowledge.believed.transition(*way)[0]
        judge.judge(F, (first.e, published.e, candidate.e), first.s)
        return published

    def _compare(self, knowledge: Knowledge, time: float, apart: float) -> None:
        """Select the best estimator; `apart` (nT) is the published calibration's residual less the best's."""
        bank, publication = knowledge.bank, self._publication
        best, doubted = bank.best, bank.map_doubted
        seen = (best.residual + apart, best.variance) if publication.learned else publication.judge.last
        self._standing.count(*seen, telling=bank.quiet.telling)
        self.doubt(bank.judge(time))
        if bank.map_doubted != doubted:
            publication.judge.restart(knowledge.believed)

    def _begin(self, knowledge: Knowledge, sample: Sample, way: tuple[float, float]) -> None:
        """Learn from a sample while the batch fit runs, before a filter can be linearised."""
        if not knowledge.begin(sample, *way):
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

    def _decide(self, knowledge: Knowledge, apart: float, *, frozen: bool) -> bool:
        """Publish or roll back; `apart` is the difference of learned and published total field, nT."""
        publication = self._publication
        if not frozen and (self._refuted or self._end(knowledge)):
            publication.judge.restart()
            self._standing.restart()
            self._unconfirmed = self._refuted = False
            return True
        worse, relapsed = publication.judge.roll_back, self._standing.relapses > 0
        if worse and not publication.learned and self._standing.alarm is None:
            publication.judge.discard()  # what is learned may get better yet
        elif worse or (relapsed and publication.judge.improves < -BEYOND_CHANCE):
            self._standing.mistaken()
            if worse and publication.learned:
                self._notify(publication.roll_back(), False)
            publication.judge.restart()
            self._unconfirmed = self._refuted = False
            return True
        if frozen or not self._trusted(knowledge):
            return False
        pending = self._standing.pending
        if pending or not publication.learned:
            if self._holds(knowledge):
                self._publish_learned(knowledge)
        elif publication.stale(apart):
            publication.renew(self.learned(knowledge))
        return False

    def _holds(self, knowledge: Knowledge) -> bool:
        """Return True if what is learned predicts better, and differs from what is published everywhere."""
        publication, best = self._publication, knowledge.bank.best
        if knowledge.start is not None and not publication.learned:  # no calibration is published
            return publication.judge.better > BEYOND_CHANCE
        change = best.coefficients - publication.coefficients
        return publication.judge.adopt and knowledge.coverage.is_significant(change, best.covariance)

    def _publish_learned(self, knowledge: Knowledge) -> None:
        """Publish what is learned; close the alarm that it explains."""
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

        Return True if learning has to restart, because no later samples confirmed what was learned.
        """
        standing, publication = self._standing, self._publication
        if standing.pending and publication.judge.improves > 0.0:
            return False
        if not standing.gone:
            if standing.ripe:
                self._take_up(knowledge)
            return False
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
        strength = float(knowledge.doubt.statistic.max())
        if strength < GONE:
            self.gone(knowledge)
            return
        assert alarm is not None
        if "temperature_offset" not in alarm.causes or not bank.take_over(strength):
            moved = knowledge.doubt.learned()
            if moved is None:
                return
            bank.explained(*moved, strength)
        knowledge.doubt.restart()
        self._publication.judge.discard()
        self._standing.take_up()
        self._unconfirmed = True
