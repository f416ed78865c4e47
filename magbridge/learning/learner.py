"""A bridge's learning: what it takes from each sample.

What is published of it is :mod:`.publication`'s, how a doubt stands :mod:`.standing`'s.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from math import isnan
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec
import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.file import calibration_id
from magbridge.calibration.model import Calibration
from magbridge.field.geodesy import separation
from magbridge.learning.bank import Bank
from magbridge.learning.doubt import Alarm, Doubt, Signs
from magbridge.learning.estimator import Estimator
from magbridge.learning.hindsight import Hindsight, Kept
from magbridge.learning.judge import FIRST, LEARNED
from magbridge.learning.model import Model
from magbridge.learning.nuisance import Nuisance
from magbridge.learning.observation import Observation, observe
from magbridge.learning.publication import NONE, Publication
from magbridge.learning.report import Notice, State
from magbridge.learning.standing import Standing
from magbridge.learning.start import Start
from magbridge.records import Quality, Vector

if TYPE_CHECKING:
    from magbridge.field.grid import AnomalyGrid  # it brings scipy

__all__ = ["Learner"]

MOVING: Final = int(Quality.MOVING)
UNFIT: Final = MOVING | int(Quality.STALE_TELEMETRY | Quality.SATURATED | Quality.LATE_JOIN)
"""Samples that nothing is learned from."""
MAPLESS: Final = 145.0
"""nT, 1-sigma of the field about the main field alone."""
LINEAR: Final = 300.0
"""nT, 1-sigma of an axis's offset: from here on it is fitted anew as a whole."""
CREEP: Final = 3.0 / 86_400.0**0.5
"""nT per square root of a second: an offset walks by 3 nT a day."""
GONE: Final = 9.0
"""Log-likelihood ratio below which it is not learned any more, but gone."""
OUTLIER: Final = 5.0
AGREE: Final = 3
"""An innovation beyond so many sigmas says nothing, unless it is the third in a row."""
MOST_HELD: Final = 64
"""Samples that wait for newer telemetry, at most: the first are then left out."""
SHORT_US: Final = 3_600_000_000
"""µs without a sample to learn from after which that is told."""


class Taken(NamedTuple):
    """A sample that may be learned from, unless it is `faulty`."""

    time_us: int
    field: Vector
    reference: float
    phi: FloatArray
    positions: list[float]
    where: tuple[float, float]
    watched: tuple[float, ...]
    faulty: bool


class Learner:
    """Learns a calibration's coefficients while the bridge corrects with it.

    Parameters
    ----------
    calibration : Calibration
        The one to begin with.
    grid : AnomalyGrid, optional
        What the field differs by from the main field, outside of which nothing is learned.
    spread : float
        nT, 1-sigma of the Earth's field about its reference.
    turn_on : float
        nT, 1-sigma, by which offsets change at every power-on.
    max_rate : float
        Hz: samples to learn from, at most.
    currents : tuple of str
        Names of telemetry in ampere.

    Attributes
    ----------
    watched : tuple of str
        Telemetry that :meth:`sample` wants: the temperature, and the currents.
    notices : list of Notice
        What has changed since the caller last emptied it.
    samples : int
        That coefficients were learned from.
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
        grid: AnomalyGrid | None = None,
        spread: float = 145.0,
        turn_on: float = 20.0,
        max_rate: float = 1.0,
        currents: tuple[str, ...] = (),
    ) -> None:
        self._model = Model(calibration, currents)
        self.watched = self._model.watched
        self._turn_on = turn_on
        self._unfit = UNFIT if calibration.method == NONE else UNFIT | int(Quality.UNCALIBRATED)
        self._grid, self._spread = grid, spread
        self._nuisance = Nuisance(calibration.noise, spread)
        self._period_us = round(1e6 / max_rate)
        self.enabled, self.frozen = True, False
        self.notices: list[Notice] = []
        self._now_us = 0
        self._publication = Publication(self._model, calibration, self._nuisance)
        self._standing = Standing(mapped=grid is not None)
        self._begin()

    @property
    def first(self) -> Calibration:
        """The calibration that it began with, or that was accepted."""
        return self._publication.first

    @property
    def calibration(self) -> Calibration:
        """The one to publish."""
        return self._publication.calibration

    @property
    def renewed(self) -> bool:
        """Whether that has changed last by what was learned since, for no reason of its own."""
        return self._publication.renewed

    @property
    def flags(self) -> int:
        """Of the last sample: ``unexplained``, or 0."""
        return self._standing.flags

    @property
    def variance(self) -> float:
        """nT², to add to that of the total field while the data are not explained."""
        return self._standing.variance

    @property
    def state(self) -> State:
        """How learning stands."""
        publication, alarm = self._publication, self._standing.alarm
        judge, published = publication.judge, publication.learned
        rms = np.sqrt(judge.mean_square).tolist()
        causes = alarm.causes if alarm else ()
        since, size = (round(alarm.since * 1e6), alarm.size) if alarm else (0, 0.0)
        better = -judge.worse if published else judge.better
        return State(self.samples, (rms[FIRST], rms[published], rms[LEARNED]), better, causes, since, size)

    def learned(self) -> Calibration:
        """Return the calibration as learned so far, with its covariance and where it comes from."""
        return self._publication.made(self._bank.best, self.samples, self._noise)

    def accept(self) -> None:
        """Let what is learned be the calibration that nothing rolls back, and the doubt be known."""
        if self.samples:
            self._publish("accepted: what was learned")
            self._publication.accept()
        self._settle("acknowledged")

    def forget(self) -> None:
        """Go back to the calibration that it began with, and learn anew from there."""
        self._settle("forgotten")
        self._publication.forget(self._nuisance)
        self._begin()
        self._notify("learning: all forgotten")

    def _begin(self) -> None:
        self._restart()
        self.samples = 0
        self._last_us = self._looked_us = self._taken_us = self._reported_us = 0
        self._held: deque[Taken] = deque(maxlen=MOST_HELD)
        self._where: tuple[float, float] | None = None
        self._before: FloatArray | None = None

    def _restart(self) -> None:
        """Begin to learn from the first calibration, whose offsets may have changed at this power-on."""
        first, offsets = self.first, self._model.offsets
        coefficients, covariance = self._model.coefficients(first)
        quiet = Estimator(coefficients, covariance, offsets, self._nuisance, CREEP)
        quiet.open(self._turn_on**2)
        self._mapless = Nuisance(first.noise, MAPLESS) if self._grid is not None else None
        self._bank, self._doubt = Bank(self._model, quiet, self._mapless), Doubt(self._model, quiet)
        self._hindsight = Hindsight()
        self._outliers, self._noise = 0, first.noise
        self._start: Start | None = None
        if np.trace(covariance[np.ix_(offsets, offsets)]) > 3.0 * LINEAR**2:
            self._start = Start(self._model, coefficients, covariance, first.reference.field)
        else:
            self._bank.suppose()

    def _notify(self, text: str, *, grave: bool = False) -> None:
        self.notices.append(Notice(text, self._now_us * 1e-6, grave))

    def restarted(self) -> None:
        """Take note that the sensor was powered anew: its offsets may have changed."""
        self._held.clear()
        self._bank.open(self._turn_on**2)

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
        watched: Sequence[float],
        age: float = 0.0,
    ) -> None:
        """Take a sample that was corrected.

        It is judged once newer telemetry has come: had a mass begun to move meanwhile, it is left out.

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
        watched : sequence of float
            As :attr:`watched`; NaN where unknown.
        age : float
            s, of the parameters' oldest telemetry.
        """
        if not self.enabled:
            return
        self._now_us, unfit = time_us, quality & self._unfit
        if unfit & ~MOVING or isnan(reference) or where is None:
            self._nothing(time_us)
            return
        fit = not (unfit or faulty)
        if 0 <= time_us - (self._taken_us if fit else self._looked_us) < 0.99 * self._period_us:
            return
        if self._grid is not None:
            reference += self._grid.look_up(where[1], where[0]).anomaly
        phi, positions = self._model.regressors(regressors, watched), self._model.scaled(values)
        if isnan(reference) or not np.isfinite(phi).all():
            self._nothing(time_us)
            return
        self._look_back(time_us, phi, positions)
        if unfit:
            self._held.clear()
        while self._held and self._held[0].time_us < time_us - age * 1e6:
            self._take(self._held.popleft())
        if not fit:
            self._nothing(time_us)
        if unfit:
            return
        self._taken_us = time_us if fit else self._taken_us
        one = Taken(time_us, field, reference, phi, positions, where, tuple(watched), faulty)
        if positions:
            self._held.append(one)
        else:
            self._take(one)

    def _take(self, sample: Taken) -> None:
        """Predict a sample, judge by it, and learn from it."""
        time_us, field, reference, phi, positions, where, watched, faulty = sample
        quiet = self._bank.quiet
        if faulty:
            missed = self._by(quiet)(field, phi, reference).e - quiet.expected
            self._hindsight.keep(Kept(time_us, field, reference, phi, positions, missed, quiet.variance))
            return
        metres, seconds = self._moved(time_us, where)
        before, self._before = self._before, phi
        bank = self._bank
        best, doubted = bank.best, bank.map_doubted
        for other in bank.all[1:]:
            other.propagate(metres, seconds)
        self._doubt.propagate(quiet, quiet.propagate(metres, seconds), seconds)
        live = {id(one): self._predict(one, field, phi, reference) for one in bank.all}
        self._hindsight.keep(Kept(time_us, field, reference, phi, positions, quiet.residual, quiet.variance))
        observed, clock = live[id(quiet)], 0.0
        if before is not None and 0.0 < seconds < 30.0:  # what it would be, were telemetry a second late
            clock = (self._by(quiet)(field, before, reference).e - observed.e) / seconds
        signs = Signs(
            time_us * 1e-6, observed.by_nine[6:], tuple(positions), watched, clock, -1.0 / observed.s
        )
        if self._start is None and self._outlying(best):
            self._standing.count(best.residual, best.variance, telling=False)
            return
        by_first, by_published = self._publication.nine(phi)
        first = self._observe(field, by_first, reference)
        nuisance = self._mapless if doubted and self._mapless else self._nuisance
        self._publication.judge.judge(
            *nuisance.over(metres, seconds), first.e, first.s, best.residual, best.variance
        )
        apart = self._observe(field, by_published, reference).e - live[id(best)].e
        if self._start is not None:
            if not self.frozen:
                self._fit(self._start, due=self._start.add(field, phi, reference, metres, seconds))
        else:
            self._compare(time_us * 1e-6, apart)
            self._learn(signs)
        self._decide(apart * live[id(best)].s)

    def _outlying(self, best: Estimator) -> bool:
        """Whether the sample is an outlier that no other agrees with so far, and no doubt explains."""
        far = abs(best.residual) > OUTLIER * best.sigma
        self._outliers = self._outliers + 1 if far else 0
        return far and self._outliers < AGREE and not self._standing.learnable

    def _compare(self, time: float, apart: float) -> None:
        """Follow which estimator predicts best, and how well what is published does, `apart` (nT) from it."""
        bank, publication = self._bank, self._publication
        best, doubted = bank.best, bank.map_doubted
        seen = (best.residual + apart, best.variance) if publication.learned else publication.judge.last
        self._standing.count(*seen, telling=bank.quiet.telling)
        self._raise(bank.judge(time))
        if bank.map_doubted != doubted:
            publication.judge.restart(self._mapless if bank.map_doubted else self._nuisance)

    def _predict(self, one: Estimator, field: Vector, phi: FloatArray, reference: float) -> Observation:
        """Let an estimator predict a sample; return what it is by its coefficients."""
        live = self._by(one)(field, phi, reference)
        one.predict(live.e, live.s, self._model.derivative(phi, live.by_nine))
        one.follow(live.s)
        return live

    def _look_back(self, time_us: int, phi: FloatArray, positions: list[float]) -> None:
        """Test whether what telemetry reports now fits earlier samples better than what it did then."""
        self._looked_us = time_us
        if self._start is None:
            self._raise(self._hindsight.test(time_us, phi, positions, self._by(self._bank.quiet)))

    def _by(self, one: Estimator) -> Callable[[Vector, FloatArray, float], Observation]:
        """Return what a field, at some regressors (m,), is by an estimator's coefficients."""
        return lambda field, phi, reference: self._observe(
            field, phi @ self._model.weights(one.coefficients), reference
        )

    def _raise(self, alarm: Alarm | None) -> None:
        if alarm is not None and (news := self._standing.raised(alarm)):
            self._notify(news, grave=True)

    def _nothing(self, time_us: int) -> None:
        """Say once an hour or more passes without a sample to learn from."""
        if not self._last_us:
            self._last_us = time_us
        if time_us - self._last_us > SHORT_US and self._reported_us != self._last_us:
            self._reported_us = self._last_us
            self._notify("learning: an hour without a sample to learn from", grave=True)

    def _moved(self, time_us: int, where: tuple[float, float]) -> tuple[float, float]:
        """Return m and s since the last sample that was taken."""
        before, last_us = self._where or where, self._last_us or time_us
        self._where, self._last_us = where, time_us
        north, east = separation(*before, *where)
        return (north * north + east * east) ** 0.5, max(time_us - last_us, 0) * 1e-6

    def _observe(self, field: Vector, nine: FloatArray, reference: float) -> Observation:
        return observe(field, nine, self.first.reference.field, reference)

    def _learn(self, signs: Signs) -> None:
        """Doubt what was predicted, and learn from it."""
        quiet = self._bank.quiet
        self._raise(self._doubt.test(quiet, signs))
        for other in self._bank.all[1:]:
            other.update(learn=other.telling and not self.frozen)
        learn = quiet.telling and not self.frozen
        self._doubt.updated(quiet.update(learn=learn))
        self.samples += learn
        self._publication.age += 1

    def _fit(self, start: Start, *, due: bool) -> None:
        """Learn from a sample while next to nothing is known; fit all so far where that is due."""
        estimator = self._bank.quiet
        if not due:
            estimator.update(learn=True)
            self.samples += 1
            self._publication.age += 1
            return
        fitted = start.fit(estimator.coefficients, self._nuisance)
        self._noise = msgspec.structs.replace(self._noise, sensor=fitted.noise)
        self._nuisance = Nuisance(self._noise, self._spread)
        estimator.know(fitted.coefficients, fitted.nuisances, fitted.covariance, self._nuisance)
        self._publication.judge.restart(self._nuisance)
        if self._publication.learned:
            self._publication.renew(self.learned())
        if start.over:
            self._start = None
            self._bank.suppose()

    def _settle(self, how: str) -> None:
        """End the doubt."""
        if self._standing.alarm is None:
            return
        self._standing.end()
        self._doubt.restart()
        self._hindsight.restart()
        self._notify(f"explained again: {how}")

    def _gone(self) -> None:
        """End a doubt that no coefficient took up; what was judged meanwhile was judged by its cause."""
        self._publication.judge.restart()
        self._settle("gone")

    def _decide(self, apart: float) -> None:
        """Publish what predicts better, go back to what does, and end a doubt whose cause is known or gone.

        Parameters
        ----------
        apart : float
            nT, of the published total field from what is learned.
        """
        publication, standing = self._publication, self._standing
        if standing.gone and not self.frozen:
            if standing.tried:
                now = calibration_id(self.calibration)
                self._settle(
                    f"{'learned' if publication.learned else 'the first calibration holds,'} {now:08x}"
                )
            else:
                self._gone()
        elif standing.ripe and not self.frozen:
            self._take_up()
        if publication.judge.roll_back:
            if publication.learned:
                self._notify(publication.roll_back())
            publication.judge.restart()
            self._restart()
            standing.mistaken()
        elif self.frozen or not self._trusted:
            return
        elif not publication.learned and publication.judge.adopt:
            for one in self._bank.all:
                one.keep_level(publication.coefficients)
            self._publish("learned")
        elif publication.stale(apart):
            publication.renew(self.learned())

    @property
    def _trusted(self) -> bool:
        """Whether nothing is doubted, but perhaps what the best estimator has supposed from the start."""
        standing, bank = self._standing, self._bank
        if standing.alarm is None or standing.mapless:
            return True
        return standing.learnable and not standing.relapses and bank.best is not bank.quiet

    def _take_up(self) -> None:
        """Learn what is behind the doubt, if coefficients can take it up."""
        strength = float(self._doubt.statistic.max())
        if strength < GONE:
            self._gone()
            return
        assert self._standing.alarm is not None
        if "temperature_offset" not in self._standing.alarm.causes or not self._bank.take_over(strength):
            moved = self._doubt.learned()
            if moved is None:
                return
            self._bank.explained(*moved, strength)
        self._publication.publish(self.learned(), "learned")
        self._doubt.restart()
        if self._standing.learned():
            self._notify(f"explained again: learned {calibration_id(self.calibration):08x}")

    def _publish(self, how: str) -> None:
        self._notify(self._publication.publish(self.learned(), how))
