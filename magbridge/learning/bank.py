r"""Estimators under different hypotheses, run in parallel: the best recent predictor is selected.

Without a hypothesis, a change is learned only once its test is significant. Until then, the estimator
attributes the change to the wrong coefficients, which is hard to undo: for example a change of temperature to
the turn-on offset, or a drift to a step. The baseline estimator assumes no change, and the change detector
tests it. Further estimators assume from the start that

- the offset follows the sensor's temperature;
- the offset drifts, at a rate that changes within hours;
- the map, if there is one, does not show the crustal field. A map error no larger than the crustal field
  hardly moves single samples, so no test of innovations shows it. If this estimator predicts significantly
  better, the bank raises a map alarm and selects this estimator until its lead is lost.

The selection is dynamic model selection (Raftery, Karny & Ettler 2010, Technometrics 52:52): with each
innovation v of variance S,

.. math:: \log w \leftarrow \alpha \log w - \tfrac12 (v^2 / S + \log S)
"""

from __future__ import annotations

from copy import deepcopy
from math import log
from typing import Final

from magbridge.arrays import FloatArray
from magbridge.columns import TEMPERATURE
from magbridge.estimation.sequential import ALARM_LOG_RATIO
from magbridge.learning.alarms import LearningAlarm
from magbridge.learning.estimator import Estimator, Nuisance
from magbridge.learning.judge import BEYOND_CHANCE
from magbridge.learning.model import LearnedTerms

__all__ = ["EstimatorBank"]

BANK_MEMORY_SAMPLES: Final = 2000.0
"""Samples over which predictions are weighted (exponential forgetting)."""
AHEAD: Final = 3.0
"""Lead in log w that changes the selected estimator. To leave the baseline estimator the lead has to reach
:data:`BEYOND_CHANCE`, because quantities that no test observes, as the level, depend on the hypothesis."""
MAX_BANK_SQUARE: Final = 25.0
"""Largest v²/S that one sample contributes: an outlier does not distinguish the estimators."""
CLOSE: Final = 10.0
"""Largest deficit in log w against an alarm's, which is the best of dozens of onsets and causes."""
PER_DEGREE: Final = 2.0
"""Prior 1-sigma of the offset's change with temperature, nT/degC an axis."""
DRIFT_SIGMA_NT_S: Final = 5.0 / 3600.0
"""Prior 1-sigma of the offset's drift, nT/s an axis."""
DRIFT_CORRELATION_TIME_S: Final = 2.0 * 3600.0
"""Correlation time of the drift rate, s."""


class EstimatorBank:
    """Estimators of the coefficients, one for each hypothesis.

    Parameters
    ----------
    model : LearnedTerms
    quiet : Estimator
        Baseline estimator, which assumes no change.
    mapless : Nuisance, optional
        Nuisance of the crustal field without the map, if the reference is a map.

    Attributes
    ----------
    all : list of Estimator
        All estimators; the baseline is the first.
    without_map : Estimator or None
        Estimator that does not use the map; the last of `all`.
    map_doubted : bool
        True if the bank has raised a map alarm and selects `without_map`.
    """

    def __init__(self, model: LearnedTerms, quiet: Estimator, mapless: Nuisance | None = None) -> None:
        self._model, self.all, self._mapless = model, [quiet], mapless
        self._weights, self._best, self._warm = [0.0], 0, 0
        self.without_map: Estimator | None = None
        self.map_doubted, self._since = False, 0.0

    @property
    def quiet(self) -> Estimator:
        """Baseline estimator, which assumes no change."""
        return self.all[0]

    @property
    def best(self) -> Estimator:
        """Selected estimator: the one with the highest recent predictive likelihood."""
        if self.map_doubted and self.without_map is not None:
            return self.without_map
        return self.all[self._best]

    def suppose(self) -> None:
        """Add the other hypotheses, each starting from the baseline's state."""
        slots = self._model.slots(TEMPERATURE)
        if TEMPERATURE in self._model.further and slots is not None:
            warm = deepcopy(self.quiet)
            warm.open(PER_DEGREE**2, slots)
            self._warm = len(self.all)
            self.all.append(warm)
        # a drift of unknown rate, which is forgotten within hours
        drifting = deepcopy(self.quiet)
        drifting.drift(DRIFT_SIGMA_NT_S, DRIFT_CORRELATION_TIME_S)
        self.all.append(drifting)
        if self._mapless is not None:
            self.without_map = deepcopy(self.quiet)
            self.without_map.leave_map(self._mapless)
            self.all.append(self.without_map)
        self._weights = [0.0] * len(self.all)

    def open(self, variance: float) -> None:
        """Increase the variance of the offsets of all estimators by `variance` (nT²) an axis."""
        for one in self.all:
            one.open(variance)

    def judge(self, time: float) -> LearningAlarm | None:
        """Score each estimator's prediction at a time (s); return the map alarm, if there is one."""
        # log w of the module, with a bounded innovation
        for k, one in enumerate(self.all):
            S = one.variance
            self._weights[k] *= 1.0 - 1.0 / BANK_MEMORY_SAMPLES
            self._weights[k] -= 0.5 * (min(one.residual * one.residual / S, MAX_BANK_SQUARE) + log(S))
        # the map has its own test below, since its estimator predicts another reference
        with_map = [k for k, one in enumerate(self.all) if one is not self.without_map]
        ahead = max(with_map, key=self._weights.__getitem__)
        if self._weights[ahead] > self._weights[self._best] + (AHEAD if self._best else BEYOND_CHANCE):
            self._best = ahead
        return None if self.without_map is None else self._doubt_map(time, self.without_map, ahead)

    def _doubt_map(self, time: float, mapless: Estimator, best_with: int) -> LearningAlarm | None:
        # lead in log w of the estimator without the map
        lead = self._weights[-1] - self._weights[best_with]
        if lead <= 0.0:
            self.map_doubted, self._since = False, time
        self.map_doubted = self.map_doubted or lead > ALARM_LOG_RATIO
        if not self.map_doubted:
            return None
        return LearningAlarm(("map_error",), ("",), self._since, abs(mapless.crust), lead, mapless=True)

    def take_over(self, strength: float) -> bool:
        """Replace the baseline by the estimator that follows the temperature; return True if it is replaced.

        The replacement needs significantly better predictions, and a log-likelihood not much lower than an
        alarm's, `strength`. An estimator that followed the temperature from the start knows it more exactly.
        """
        warm = self._warm
        if self._weights[warm] - self._weights[0] < max(BEYOND_CHANCE, strength - CLOSE):
            return False
        # the warm estimator goes on as well, so that it is compared with its copy
        self.all[0], self._weights[0], self._best = deepcopy(self.all[warm]), self._weights[warm], 0
        return True

    def explained(self, step: FloatArray, covariance: FloatArray, strength: float) -> None:
        """Move the baseline's state by `step` (n,), of additional covariance `covariance` (n, n).

        `step` and its log-likelihood ratio `strength` come from the alarm's cause; `strength` is added to the
        baseline's score.
        """
        # the evidence for the cause is what the baseline would have gained with it
        self.quiet.shift(step, covariance)
        self._weights[0] += strength
        if self._weights[0] > self._weights[self._best] + AHEAD:
            self._best = 0
