"""State of one learning period, and the calibrations that the bridge publishes."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import msgspec
import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.file import calibration_id
from magbridge.calibration.model import Calibration, Noise
from magbridge.estimation.track_process import ReferenceSteps
from magbridge.learning.alarms import (
    ChangeDetector,
    LateTelemetryTest,
    LearningAlarm,
    StoredSample,
)
from magbridge.learning.estimator import BatchFit, Estimator, EstimatorBank, Nuisance
from magbridge.learning.judge import CANDIDATE, FIRST, PUBLISHED, Coverage, Judge
from magbridge.learning.samples import LearnedTerms, LearningSample, Observation, Way

MAX_LINEAR_SIGMA_NT: Final = 300.0
"""Offset uncertainty above which learning begins with a batch fit, nT, 1-sigma of an axis."""
OFFSET_WALK: Final = 3.0 / 86_400.0**0.5
"""Random walk of an offset, nT per square root of a second: 3 nT in a day."""
LEARNING_OUTLIER_SIGMA: Final = 5.0
MIN_AGREEING_OUTLIERS: Final = 3
"""An innovation above LEARNING_OUTLIER_SIGMA sigmas is an outlier, unless it is the third in a row."""


class Knowledge:
    """Estimators, tests and batch fit of one learning period.

    The period begins with the calibration `first`, whose offsets may have changed at this power-on by
    `turn_on` (nT, 1-sigma). `nuisance` models the error of the reference; if the reference is a map,
    `mapless` models the error of the main field alone.
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
        offsets = model.offsets
        coefficients, covariance = model.coefficients(first)
        quiet = Estimator(coefficients, covariance, offsets, nuisance, OFFSET_WALK)
        quiet.open(turn_on**2)
        self.bank, self.detector = EstimatorBank(model, quiet, mapless), ChangeDetector(model, quiet)
        self.late_telemetry, self._outliers = LateTelemetryTest(), 0
        self.coverage = Coverage(model.size)
        self._before: FloatArray | None = None  # regressors of the previous sample
        self._present: FloatArray | None = None
        self._reference_steps = ReferenceSteps()
        self.start: BatchFit | None = None
        if np.trace(covariance[np.ix_(offsets, offsets)]) > 3.0 * MAX_LINEAR_SIGMA_NT**2:
            self.start = BatchFit(model, coefficients, covariance)
        else:
            self.bank.suppose()

    @property
    def believed(self) -> Nuisance:
        """Model of the reference's error in use: during a map alarm, the model without the map."""
        return self._mapless if self.bank.map_doubted and self._mapless else self.nuisance

    def look_back(self, time_us: int, phi: FloatArray, positions: list[float]) -> LearningAlarm | None:
        """Test whether the telemetry reported now fits earlier samples better than the earlier telemetry.

        Return an alarm if it does. `phi` (m,) are the regressors, `positions` the scaled mass positions.
        """
        if self.start is not None:
            return None
        coefficients = self.bank.quiet.coefficients
        return self.late_telemetry.test(time_us, phi, positions, self._model, coefficients)

    def keep(self, sample: LearningSample, innovation: float) -> None:
        """Store a sample and its innovation (nT) for the test of late telemetry."""
        self.late_telemetry.keep(StoredSample(sample, innovation, self.bank.quiet.filter.variance))

    def keep_faulty(self, sample: LearningSample) -> None:
        """Store a faulty sensor's sample for the test of late telemetry, without updating a filter."""
        quiet = self.bank.quiet
        now = self._model.observe(sample.field, sample.phi, quiet.coefficients, sample.reference)
        self.keep(sample, now.e - quiet.expected)

    def predict(self, sample: LearningSample, way: Way) -> Observation:
        """Predict a sample with every estimator, propagated over the `way` from the previous sample.

        Return the selected estimator's residual and derivatives.
        """
        self._before, self._present = self._present, sample.phi
        self._reference_steps.follow(sample.time_us, sample.reference)
        quiet = self.bank.quiet
        # time update of all estimators, and of what the tests have absorbed
        for other in self.bank.all[1:]:
            other.propagate(way)
        self.detector.propagate(quiet, quiet.propagate(way), way.seconds)
        # relinearise every estimator at its own coefficients
        self._quiet_observation = best = self._predict(quiet, sample)
        for other in self.bank.all[1:]:
            seen = self._predict(other, sample)
            best = seen if other is self.bank.best else best
        self.coverage.add(best.s * self._model.derivative(sample.phi, best.by_nine), best.direction)
        self.keep(sample, quiet.filter.innovation)
        return best

    def _predict(self, estimator: Estimator, sample: LearningSample) -> Observation:
        live = self._model.observe(sample.field, sample.phi, estimator.coefficients, sample.reference)
        estimator.predict(live.e, live.s, self._model.derivative(sample.phi, live.by_nine))
        estimator.follow(live.s)
        return live

    def outlying(self, *, learnable: bool) -> bool:
        """Return True for an outlier of the selected estimator that no `learnable` alarm explains."""
        if self.start is not None:
            return False
        best = self.bank.best
        far = abs(best.filter.innovation) > LEARNING_OUTLIER_SIGMA * best.filter.sigma
        self._outliers = self._outliers + 1 if far else 0
        return far and self._outliers < MIN_AGREEING_OUTLIERS and not learnable

    def learn(
        self, sample: LearningSample, seconds: float, *, frozen: bool
    ) -> tuple[LearningAlarm | None, bool]:
        """Test the prediction, then learn from it; return the alarm, and True if the sample was used.

        `seconds` is the time since the previous sample.
        """
        quiet, now, by_delay = self.bank.quiet, self._quiet_observation, 0.0
        # derivative of the residual by the telemetry's delay
        if self._before is not None and 0.0 < seconds < 30.0:
            late = self._model.observe(sample.field, self._before, quiet.coefficients, sample.reference)
            by_delay = (late.e - now.e) / seconds
        # without a map and without steps, the reference is smooth and has no error to test
        may_step = self._mapless is not None or self._reference_steps.total != 0.0
        by_level = -1.0 / now.s if may_step else 0.0
        # test the innovation first: the update absorbs a part of every change
        alarm = self.detector.test(quiet, sample, now.by_nine[6:], by_delay, by_level)
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
        # refit all samples from the prior, so that no linearisation at a poor start remains
        coefficients, nuisances, covariance, noise = self.start.fit(quiet.coefficients, self.nuisance)
        self.noise = msgspec.structs.replace(self.noise, sensor=noise)
        self.nuisance = Nuisance(self.noise, self.nuisance.spread, self.nuisance.constant)
        quiet.know(coefficients, nuisances, covariance, self.nuisance)
        return True

    def go_on(self) -> None:
        """End the batch fit and continue with the filters, if they can be linearised."""
        if self.start is not None and self.start.is_over:
            self.start = None
            self.bank.suppose()


NO_METHOD: Final = "none"
"""`method` of the prior of any vehicle, before there is a calibration."""
MAX_PUBLISHED_DIFFERENCE: Final = 0.3
"""Difference of learned and published total field that causes an update, as a fraction of the noise."""
MIN_UPDATE_SAMPLES: Final = 32
MAX_UPDATE_SAMPLES: Final = 256
"""Number of samples after which an update of the published calibration may follow, and must follow."""


class Publication:
    """The first (initial or accepted) calibration, the published calibration, and the judge between them.

    `coefficients` (K,) are those of the published `calibration`; `judge` compares it with the first one and
    with the candidate. `is_update` is True if the last publication was a routine update. `age` is the number
    of samples since the last publication.
    """

    def __init__(self, model: LearnedTerms, first: Calibration, nuisance: Nuisance) -> None:
        self._model, self.first, self.is_update = model, first, False
        self.forget(nuisance)

    def forget(self, nuisance: Nuisance) -> None:
        """Return to the first calibration, and discard all comparisons."""
        self.calibration, self.judge, self.age = self.first, Judge(nuisance), 0
        self.coefficients = self._model.coefficients(self.first)[0]
        self._weights = [self._model.weights(self.coefficients)] * 3
        self._replaced: dict[int, FloatArray] = {}

    @property
    def learned(self) -> bool:
        """Return True if the learned calibration is published."""
        return self.calibration is not self.first

    def nine(self, phi: FloatArray) -> list[FloatArray]:
        """Return the nine coefficients (9,) of first, published and candidate calibration at `phi` (m,)."""
        return [phi @ weights for weights in self._weights]

    def replaced(self, phi: FloatArray) -> dict[int, FloatArray]:
        """Return, once, the former nine coefficients (9,) at `phi` (m,) of each replaced calibration."""
        replaced, self._replaced = self._replaced, {}
        return {which: phi @ weights for which, weights in replaced.items()}

    def propose(self, coefficients: FloatArray) -> None:
        """Set the candidate's coefficients (K,)."""
        self._replace(CANDIDATE, self._model.weights(coefficients))

    def _replace(self, index: int, weights: FloatArray) -> None:
        self._replaced.setdefault(index, self._weights[index])
        self._weights[index] = weights

    def made(self, estimator: Estimator, samples: int, noise: Noise) -> Calibration:
        """Return the calibration that an estimator has learned from `samples` samples."""
        first, coefficients, method = self.first, estimator.coefficients, self.first.method
        covariance, level = estimator.covariance, first.level
        reference = first.reference
        if first.method == NO_METHOD:
            method = "learned"
            if self.learned:
                coefficients = estimator.at_level_of(self.coefficients)
                by = coefficients - estimator.coefficients
                covariance = covariance + np.outer(by, by)
            toward = covariance @ estimator.mean  # covariance of the coefficients with the mean field
            # level vector of the file: this covariance over the mean field's sigma
            sigma = float(np.sqrt(estimator.mean @ toward))
            if sigma:  # zero before the first sample
                level = tuple((toward[: first.coefficients.size] / sigma).tolist())
                reference = msgspec.structs.replace(reference, level_sigma=sigma)
        elif "learned" not in method:
            method += ", learned"
        inputs = first.inputs | {f"calibration {calibration_id(first):08x}": f"{samples} samples later"}
        made = self._model.calibration(coefficients, covariance)
        return replace(made, method=method, inputs=inputs, noise=noise, level=level, reference=reference)

    def stale(self, difference: float) -> bool:
        """Return True if `difference`, learned minus published total field (nT), requires an update."""
        far = abs(difference) > MAX_PUBLISHED_DIFFERENCE * self.calibration.noise.sensor
        return self.learned and ((far and self.age >= MIN_UPDATE_SAMPLES) or self.age >= MAX_UPDATE_SAMPLES)

    def renew(self, calibration: Calibration) -> None:
        """Update the published calibration with the learned one, without a notification."""
        self.calibration = calibration
        self.coefficients = self._model.coefficients(calibration)[0]
        self._replace(PUBLISHED, self._model.weights(self.coefficients))
        self.age, self.is_update = 0, True

    def publish(self, calibration: Calibration, how: str) -> str:
        """Publish a calibration for the reason `how`; return the message."""
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
        """Publish the first calibration again; return the message."""
        self.calibration, self.age = self.first, 0
        self.coefficients = self._model.coefficients(self.first)[0]
        self._replace(PUBLISHED, self._weights[FIRST])
        return self._change("rolled back: the first calibration predicts better", PUBLISHED, FIRST)

    def _change(self, how: str, previous: int, following: int) -> str:
        """Return the message of a change, with the RMS errors of two of the calibrations."""
        self.is_update = False
        rms = np.sqrt(self.judge.mean_square)
        text = f"{how} {calibration_id(self.calibration):08x}"
        if previous == FIRST and self.first.method == NO_METHOD:  # no errors to compare with
            return f"{text} from nothing"
        return f"{text}: {rms[previous]:.1f} to {rms[following]:.1f} nT"
