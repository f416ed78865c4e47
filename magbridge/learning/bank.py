r"""Estimators that suppose different changes, side by side: the one that predicts best lately is believed.

A change that nobody supposed is learned only once it is beyond chance, and what was mistaken for it until
then is hard to undo: a warming passes for the offset of this power-on, a drift for a step. So beside the
estimator that supposes nothing, and that doubt tests, others suppose from the start that

- the offset follows the sensor's temperature;
- the offset drifts, at a rate that changes within hours.

Which to believe is dynamic model selection (Raftery, Karny & Ettler 2010, Technometrics 52:52): with each
innovation v of variance S,

.. math:: \log w \leftarrow \alpha \log w - \tfrac12 (v^2 / S + \log S)
"""

from __future__ import annotations

from copy import deepcopy
from math import log
from typing import Final

from magbridge.arrays import FloatArray
from magbridge.learning.estimator import Estimator
from magbridge.learning.judge import BEYOND_CHANCE
from magbridge.learning.model import TEMPERATURE, Model

__all__ = ["Bank"]

MEMORY: Final = 2000.0
"""Samples over which predictions count."""
AHEAD: Final = 3.0
"""By which log w has to be ahead to change whom to believe."""
MOST: Final = 25.0
"""v²/S of one sample at most: an outlier says nothing of which is better."""
CLOSE: Final = 10.0
"""How far its log w may be behind a doubt's, which is the best of dozens of onsets and causes."""
PER_DEGREE: Final = 2.0
"""nT/degC, 1-sigma, by which an axis's offset may follow the temperature."""
RATE: Final = 5.0 / 3600.0
"""nT/s, 1-sigma, by which it may drift."""
CHANGES: Final = 2.0 * 3600.0
"""s over which that rate is forgotten."""


class Bank:
    """What is learned, by each supposition.

    Parameters
    ----------
    model : Model
    quiet : Estimator
        The one that supposes nothing.

    Attributes
    ----------
    all : list of Estimator
        That one first.
    """

    def __init__(self, model: Model, quiet: Estimator) -> None:
        self._model, self.all = model, [quiet]
        self._weights, self._best = [0.0], 0

    @property
    def quiet(self) -> Estimator:
        """The one that supposes nothing."""
        return self.all[0]

    @property
    def best(self) -> Estimator:
        """The one to believe."""
        return self.all[self._best]

    def suppose(self) -> None:
        """Let the others begin at what the quiet one knows."""
        slots = self._model.slots(TEMPERATURE)
        if TEMPERATURE in self._model.further and slots is not None:
            warm = deepcopy(self.quiet)
            warm.open(PER_DEGREE**2, slots)
            self.all.append(warm)
        drifting = deepcopy(self.quiet)
        drifting.drift(RATE, CHANGES)
        self.all.append(drifting)
        self._weights = [0.0] * len(self.all)

    def open(self, variance: float) -> None:
        """Let the offsets be unknown by a further `variance` (nT²) an axis."""
        for one in self.all:
            one.open(variance)

    def judge(self) -> None:
        """Take note of what each has predicted."""
        for k, one in enumerate(self.all):
            S = one.variance
            self._weights[k] *= 1.0 - 1.0 / MEMORY
            self._weights[k] -= 0.5 * (min(one.residual * one.residual / S, MOST) + log(S))
        ahead = max(range(len(self.all)), key=self._weights.__getitem__)
        if self._weights[ahead] > self._weights[self._best] + AHEAD:
            self._best = ahead

    def take_over(self, strength: float) -> bool:
        """Let the quiet one go on from the one that follows the temperature; return whether it does.

        It does where that one has predicted better beyond chance, and hardly worse than what a doubt has
        found, with a log-likelihood ratio `strength`. For what was supposed from the start is known better.
        """
        lead = max((w - self._weights[0] for w in self._weights[1:-1]), default=0.0)
        if lead < max(BEYOND_CHANCE, strength - CLOSE):
            return False
        self.all[0], self._weights[0], self._best = deepcopy(self.all[1]), self._weights[1], 0
        return True

    def explained(self, by: FloatArray, covariance: FloatArray, strength: float) -> None:
        """Move the quiet one by `by` (n,), known to a further `covariance` (n, n), as a doubt has found.

        Its log-likelihood ratio `strength` speaks for the quiet one from now on.
        """
        self.quiet.shift(by, covariance)
        self._weights[0] += strength
        if self._weights[0] > self._weights[self._best] + AHEAD:
            self._best = 0
