"""State of the learning since the first calibration: the estimators and the tests of their innovations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import msgspec
import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.model import Calibration
from magbridge.estimation.track_process import ReferenceSteps
from magbridge.learning.alarms import ChangeDetector, LateTelemetryTest, LearningAlarm, Signs, StoredSample
from magbridge.learning.bank import EstimatorBank
from magbridge.learning.estimator import Estimator, Nuisance
from magbridge.learning.judge import Coverage
from magbridge.learning.model import LearnedTerms
from magbridge.learning.samples import LearningSample, Observation, Way, observe
from magbridge.learning.start import BatchFit
from magbridge.records import Vector

__all__ = ["Knowledge"]

LINEAR: Final = 300.0
"""Offset uncertainty from which on the batch fit repeats the whole estimate, nT, 1-sigma of an axis."""
CREEP: Final = 3.0 / 86_400.0**0.5
"""nT per square root of a second: an offset walks by 3 nT a day."""
LEARNING_OUTLIER_SIGMA: Final = 5.0
AGREE: Final = 3
"""An innovation beyond so many sigmas says nothing, unless it is the third in a row."""


class Knowledge:
    """Estimators, change detector and batch fit of one learning period.

    Parameters
    ----------
    model : LearnedTerms
    first : Calibration
        Initial calibration; its offsets may have changed at this power-on.
    nuisance : Nuisance
        Nuisance of the reference.
    mapless : Nuisance or None
        Nuisance of the main field, if the reference is a map.
    turn_on : float
        1-sigma of the offsets' change at this power-on, nT.

    Attributes
    ----------
    bank : EstimatorBank
        Estimators.
    detector : ChangeDetector
        Change detector of the baseline estimator.
    coverage : Coverage
        Attitudes so far.
    start : BatchFit or None
        Batch fit, until a filter can continue without it.
    nuisance, noise
        Estimates so far.
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
        quiet = Estimator(coefficients, covariance, offsets, nuisance, CREEP)
        quiet.open(turn_on**2)
        self.bank, self.detector = EstimatorBank(model, quiet, mapless), ChangeDetector(model, quiet)
        self.late_telemetry, self._outliers = LateTelemetryTest(), 0
        self.coverage = Coverage(model.size)
        self._before: FloatArray | None = None
        self._reference_steps = ReferenceSteps()
        self.start: BatchFit | None = None
        if np.trace(covariance[np.ix_(offsets, offsets)]) > 3.0 * LINEAR**2:
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
        self.late_telemetry.keep(StoredSample(*sample[:5], innovation, self.bank.quiet.variance))

    def keep_faulty(self, sample: LearningSample) -> None:
        """Keep a sample that is not predicted."""
        quiet = self.bank.quiet
        now = self._observation_with(quiet)(sample.field, sample.phi, sample.reference)
        self.keep(sample, now.e - quiet.expected)

    def predict(self, sample: LearningSample, way: Way) -> tuple[Observation, Signs]:
        """Predict a sample with every estimator, on the way from the previous one.

        Returns
        -------
        Observation
            Residual and derivatives by the selected estimator.
        Signs
            Regressors of the causes to test.
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
        self.keep(sample, quiet.residual)
        now, clock = live[id(quiet)], 0.0
        if before is not None and 0.0 < seconds < 30.0:  # the residual if telemetry were a second late
            clock = (
                self._observation_with(quiet)(sample.field, before, sample.reference).e - now.e
            ) / seconds
        # the main field's model alone is smooth: without a map and without a step it has no error to test
        may_step = self._mapless is not None or self._reference_steps.total != 0.0
        offset, level = now.by_nine[6:], -1.0 / now.s if may_step else 0.0
        signs = Signs(sample.time_us * 1e-6, offset, tuple(sample.positions), sample.watched, clock, level)
        return best, signs

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
        far = abs(best.residual) > LEARNING_OUTLIER_SIGMA * best.sigma
        self._outliers = self._outliers + 1 if far else 0
        return far and self._outliers < AGREE and not learnable

    def learn(self, signs: Signs, *, frozen: bool) -> tuple[LearningAlarm | None, bool]:
        """Test the prediction, then learn from it; return the alarm, and True if the sample was used."""
        quiet = self.bank.quiet
        # test the innovation first: the update absorbs a part of every change
        alarm = self.detector.test(quiet, signs)
        for other in self.bank.all[1:]:
            other.update(learn=other.telling and not frozen)
        learn = quiet.telling and not frozen
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
