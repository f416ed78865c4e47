"""Learn a calibration on board the bridge, sample by sample."""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from magbridge.calibration.model import Calibration
from magbridge.learning.alarms import AlarmState
from magbridge.learning.decision import NO_METHOD, Decision, Knowledge, Publication
from magbridge.learning.estimator import Nuisance
from magbridge.learning.samples import Intake, LearnedTerms, LearningSample
from magbridge.records import Quality, Vector

if TYPE_CHECKING:
    from magbridge.field.grid import AnomalyGrid  # it brings scipy

__all__ = ["Learner", "LearnerState", "Notice"]


class Notice(NamedTuple):
    """A change to announce, and when (s); `grave` where someone should look."""

    text: str
    time: float
    grave: bool = False

    @property
    def date(self) -> str:
        """The time, UTC."""
        return f"{np.datetime64(round(self.time), 's')}Z"


class LearnerState(NamedTuple):
    """What MAG_LEARNING says: see there."""

    learned_samples: int
    rms: tuple[float, float, float]
    better: float
    causes: tuple[str, ...]
    since_us: int
    size: float


MOVING: Final = int(Quality.MOVING)
UNFIT: Final = MOVING | int(Quality.STALE_TELEMETRY | Quality.SATURATED | Quality.LATE_JOIN)
"""Samples that nothing is learned from."""
MAIN_FIELD_SIGMA_NT: Final = 145.0
"""1-sigma of the field about the main field alone, nT."""


class Learner:
    """Learns a calibration's coefficients while the bridge corrects with it.

    Parameters
    ----------
    calibration : Calibration
        Initial calibration.
    grid : AnomalyGrid, optional
        Anomaly map to add to the main field; outside of it no sample is used.
    spread : float
        1-sigma of the Earth's field about its reference, nT. A map has a known level; the level of the main
        field is uncertain by `spread`.
    turn_on : float
        1-sigma of the offsets' change at every power-on, nT.
    max_rate : float
        Highest rate of samples to learn from, Hz.
    currents : tuple of str
        Names of telemetry in ampere.

    Attributes
    ----------
    watched : tuple of str
        Telemetry that :meth:`sample` wants: the temperature, and the currents.
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
        spread: float = 145.0,
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
        """The calibration that it began with, or that was accepted."""
        return self._publication.first

    @property
    def calibration(self) -> Calibration:
        """Calibration to publish."""
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
        """Variance to add to that of the total field while the data are not explained, nT²."""
        return self._standing.variance

    @property
    def samples(self) -> int:
        """That coefficients were learned from."""
        return self._decision.samples

    @property
    def state(self) -> LearnerState:
        """How learning stands."""
        judge, alarm = self._publication.judge, self._standing.alarm
        first, published, learned = np.sqrt(judge.mean_square).tolist()
        causes = alarm.causes if alarm else ()
        since, size = (round(alarm.since * 1e6), alarm.size) if alarm else (0, 0.0)
        return LearnerState(self.samples, (first, published, learned), judge.better, causes, since, size)

    def learned(self) -> Calibration:
        """Return the calibration as learned so far, with its covariance and where it comes from."""
        return self._decision.learned(self._knowledge)

    def accept(self) -> None:
        """Make the learned calibration the first one, which no rollback undoes, and close the alarm."""
        if self.samples:
            self._decision.publish(self._knowledge, "accepted: learned calibration")
            self._publication.accept()
        self._decision.settle(self._knowledge, "acknowledged")

    def forget(self) -> None:
        """Return to the initial calibration and restart learning from it."""
        self._decision.settle(self._knowledge, "forgotten")
        self._publication.forget(self._knowledge.nuisance)
        self._begin(self._knowledge.nuisance)
        self._notify("learning: all forgotten")

    def _begin(self, nuisance: Nuisance) -> None:
        self._restart(nuisance)
        self._decision = Decision(self._publication, self._standing, self._notify)
        self._intake = Intake(self._max_rate)

    def _restart(self, nuisance: Nuisance) -> None:
        """Begin to learn from the published calibration; offsets may have changed at this power-on."""
        published = self.calibration
        # without the map, the reference is off by the crustal field and its level
        mapless = (
            Nuisance(published.noise, MAIN_FIELD_SIGMA_NT, MAIN_FIELD_SIGMA_NT)
            if self._grid is not None
            else None
        )
        self._knowledge = Knowledge(self._model, published, nuisance, mapless, self._turn_on)

    def _notify(self, text: str, grave: bool = False) -> None:
        self.notices.append(Notice(text, self._now_us * 1e-6, grave))

    def restarted(self) -> None:
        """Allow for a power cycle of the sensor: its offsets may have changed."""
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
        """Add a corrected sample of a time (µs since 1970 UTC).

        The sample waits until newer telemetry arrives. If a mass had begun to move, it is discarded.

        `field` is the raw field, nT, sensor axes; `regressors` and `values` are the calibration's at that
        time, the latter of its channels. `faulty` is True if the sensor is at fault, or the field cannot be
        the Earth's. `reference` is H_e, nT, NaN without a position (latitude and longitude, deg). `watched`
        are the values of the telemetry named by :attr:`watched`, NaN if unknown; `age` is that of the
        parameters' oldest telemetry, s. `settled` is the field of the previous sample, if this sample makes
        it more exact.
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
        # late telemetry shows only now, in samples that have waited or are kept
        self._decision.raise_alarm(self._knowledge.look_back(time_us, phi, positions))
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
        """Send a notification after every hour without a usable sample."""
        if self._intake.short(time_us):
            self._notify("learning: an hour without a sample to learn from", True)

    def _take(self, sample: LearningSample) -> None:
        """Learn from a sample, or keep it to look back at."""
        knowledge = self._knowledge
        if sample.faulty:
            knowledge.keep_faulty(sample)
        elif self._decision.take(knowledge, sample, self._intake.moved(sample), frozen=self.frozen):
            self._restart(knowledge.nuisance)
