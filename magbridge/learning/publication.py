"""Publish the first calibration, or the learned one while it predicts better."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import msgspec
import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.file import calibration_id
from magbridge.calibration.model import Calibration, Noise
from magbridge.learning.estimator import Estimator
from magbridge.learning.judge import CANDIDATE, FIRST, PUBLISHED, Judge
from magbridge.learning.model import Model
from magbridge.learning.nuisance import Nuisance

__all__ = ["NO_METHOD", "Publication"]

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
    model : Model
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

    def __init__(self, model: Model, first: Calibration, nuisance: Nuisance) -> None:
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
        """Return the nine coefficients (9,), at `phi` (m,), of what was replaced since the last call."""
        replaced, self._replaced = self._replaced, {}
        return {which: phi @ weights for which, weights in replaced.items()}

    def propose(self, coefficients: FloatArray) -> None:
        """Set the candidate's coefficients (K,)."""
        self._replace(CANDIDATE, self._model.weights(coefficients))

    def _replace(self, which: int, weights: FloatArray) -> None:
        self._replaced.setdefault(which, self._weights[which])
        self._weights[which] = weights

    def made(self, estimator: Estimator, samples: int, noise: Noise) -> Calibration:
        """Return the calibration that an estimator has learned from so many samples, with its origin."""
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
            sigma = float(np.sqrt(estimator.mean @ toward))
            if sigma:  # no sample, no level
                level = tuple((toward[: first.coefficients.size] / sigma).tolist())
                reference = msgspec.structs.replace(reference, level_sigma=sigma)
        elif "learned" not in method:
            method += ", learned"
        inputs = first.inputs | {f"calibration {calibration_id(first):08x}": f"{samples} samples later"}
        made = self._model.calibration(coefficients, covariance)
        return replace(made, method=method, inputs=inputs, noise=noise, level=level, reference=reference)

    def stale(self, apart: float) -> bool:
        """Return True if `apart`, learned less published total field (nT), requires an update."""
        least, most = RENEW
        far = abs(apart) > MAX_PUBLISHED_DIFFERENCE * self.calibration.noise.sensor
        return self.learned and ((far and self.age >= least) or self.age >= most)

    def renew(self, calibration: Calibration) -> None:
        """Update the published calibration with the learned one, without a notification."""
        self.calibration = calibration
        self.coefficients = self._model.coefficients(calibration)[0]
        self._replace(PUBLISHED, self._model.weights(self.coefficients))
        self.age, self.renewed = 0, True

    def publish(self, calibration: Calibration, how: str) -> str:
        """Publish it for a reason of its own; return what to say of that."""
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

    def _change(self, how: str, before: int, after: int) -> str:
        self.renewed = False
        rms = np.sqrt(self.judge.mean_square)
        said = f"{how} {calibration_id(self.calibration):08x}"
        if before == FIRST and self.first.method == NO_METHOD:  # no errors to compare with
            return f"{said} from nothing"
        return f"{said}: {rms[before]:.1f} to {rms[after]:.1f} nT"
