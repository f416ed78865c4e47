"""What becomes of what is learned: it is published, taken back, or ends a doubt."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from magbridge.calibration.file import calibration_id
from magbridge.calibration.model import Calibration
from magbridge.learning.causes import NO_COEFFICIENT, Alarm, named
from magbridge.learning.intake import Sample
from magbridge.learning.knowledge import Knowledge
from magbridge.learning.publication import Publication
from magbridge.learning.standing import Standing

__all__ = ["Decision"]

GONE: Final = 9.0
"""Log-likelihood ratio below which it is not learned any more, but gone."""


class Decision:
    """Judges and decides with every sample.

    Parameters
    ----------
    publication : Publication
    standing : Standing
        The doubt's.
    notify : callable
        Called with what to say of a change, and whether someone should look.

    Attributes
    ----------
    samples : int
        That coefficients were learned from.
    """

    def __init__(
        self, publication: Publication, standing: Standing, notify: Callable[[str, bool], None]
    ) -> None:
        self._publication, self._standing, self._notify = publication, standing, notify
        self.samples = 0

    def learned(self, knowledge: Knowledge) -> Calibration:
        """Return the calibration as learned so far, with its covariance and where it comes from."""
        return self._publication.made(knowledge.bank.best, self.samples, knowledge.noise)

    def doubt(self, alarm: Alarm | None) -> None:
        """Take note of a doubt that a test has raised, if it has."""
        if alarm is not None and (news := self._standing.raised(alarm)):
            self._notify(news, True)

    def publish(self, knowledge: Knowledge, how: str) -> None:
        """Publish what is learned, and say `how` that came."""
        self._notify(self._publication.publish(self.learned(knowledge), how), False)

    def settle(self, knowledge: Knowledge, how: str) -> None:
        """End the doubt, if there is one, and say `how`."""
        if self._standing.alarm is None:
            return
        self._standing.end()
        knowledge.doubt.restart()
        knowledge.hindsight.restart()
        self._notify(f"explained again: {how}", False)

    def gone(self, knowledge: Knowledge) -> None:
        """End a doubt that no coefficient took up; what was judged meanwhile was judged by its cause."""
        self._publication.judge.restart()
        self.settle(knowledge, "gone")

    def take(self, knowledge: Knowledge, sample: Sample, way: tuple[float, float], *, frozen: bool) -> bool:
        """Predict a sample, judge by it, learn from it, and decide what becomes of that.

        It is `way` (m and s) after the one before; return whether to learn anew from the first calibration.
        """
        publication = self._publication
        now, signs = knowledge.predict(sample, *way)
        best = knowledge.bank.best
        if knowledge.outlying(learnable=self._standing.learnable):
            self._standing.count(best.residual, best.variance, telling=False)
            return False
        first, published = (
            knowledge.observe(sample.field, nine, sample.reference) for nine in publication.nine(sample.phi)
        )
        rock = knowledge.believed.transition(*way)
        publication.judge.judge(*rock, first.e, first.s, best.residual, best.variance)
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

    def _compare(self, knowledge: Knowledge, time: float, apart: float) -> None:
        """Follow which estimator predicts best, and how well what is published does, `apart` (nT) from it."""
        bank, publication = knowledge.bank, self._publication
        best, doubted = bank.best, bank.map_doubted
        seen = (best.residual + apart, best.variance) if publication.learned else publication.judge.last
        self._standing.count(*seen, telling=bank.quiet.telling)
        self.doubt(bank.judge(time))
        if bank.map_doubted != doubted:
            publication.judge.restart(knowledge.believed)

    def _begin(self, knowledge: Knowledge, sample: Sample, way: tuple[float, float]) -> None:
        """Learn from a sample while next to nothing is known."""
        if not knowledge.begin(sample, *way):
            self._count(learned=True)
            return
        self._publication.judge.restart(knowledge.nuisance)
        if self._publication.learned:
            self._publication.renew(self.learned(knowledge))
            self._publication.renewed = False  # what jumped may have been the fit before
        knowledge.go_on()

    def _count(self, *, learned: bool) -> None:
        self.samples += learned
        self._publication.age += 1

    def _decide(self, knowledge: Knowledge, apart: float, *, frozen: bool) -> bool:
        """Publish what predicts better, `apart` (nT) from what is published, or go back to what does."""
        publication = self._publication
        if not frozen:
            self._end(knowledge)
        if publication.judge.roll_back:
            if publication.learned:
                self._notify(publication.roll_back(), False)
            publication.judge.restart()
            self._standing.mistaken()
            return True
        if frozen or not self._trusted(knowledge):
            return False
        if not publication.learned and publication.judge.adopt:
            for one in knowledge.bank.all:
                one.keep_level(publication.coefficients)
            self.publish(knowledge, "learned")
        elif publication.stale(apart):
            publication.renew(self.learned(knowledge))
        return False

    def _trusted(self, knowledge: Knowledge) -> bool:
        """Whether nothing is doubted, but perhaps what the best estimator has supposed from the start."""
        standing, bank = self._standing, knowledge.bank
        if standing.alarm is None or standing.mapless:
            return True
        return standing.learnable and not standing.relapses and bank.best is not bank.quiet

    def _end(self, knowledge: Knowledge) -> None:
        """End a doubt that has been quiet for long, or learn what is behind one that is sure enough."""
        standing, publication = self._standing, self._publication
        if not standing.gone:
            if standing.ripe:
                self._take_up(knowledge)
        elif not standing.tried:
            self.gone(knowledge)
        elif publication.learned:
            self.settle(knowledge, self._explained)
        else:
            self.settle(knowledge, f"the first calibration holds, {calibration_id(publication.first):08x}")

    @property
    def _explained(self) -> str:
        assert self._standing.alarm is not None
        causes = named([one for one in self._standing.alarm.causes if one not in NO_COEFFICIENT])
        return f"{causes}, learned {calibration_id(self._publication.calibration):08x}"

    def _take_up(self, knowledge: Knowledge) -> None:
        """Learn what is behind the doubt, if coefficients can take it up."""
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
        self._publication.publish(self.learned(knowledge), "learned")
        how = self._explained
        knowledge.doubt.restart()
        if self._standing.learned():
            self._notify(f"explained again: {how}", False)
