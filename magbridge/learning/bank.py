r"""Estimators that suppose different changes, side by side: the one that predicts best lately is believed.

A change that nobody supposed is learned only once it is beyond chance, and what was mistaken for it until
then is hard to undo: a warming passes for the offset of this power-on, a drift for a step. So beside the
estimator that supposes nothing, and that doubt tests, others suppose from the start that

- the offset follows the sensor's temperature;
- the offset drifts, at a rate that changes within hours;
- the map, where there is one, shows nothing of the rock. An error no larger than rock moves single samples
  by next to nothing, so no test of innovations shows it; but once this one predicts better beyond chance, the
  map is doubted, and this one believed until it does not predict better any more.

Which to believe is dynamic model selection (Raftery, Karny & Ettler 2010, Technometrics 52:52): with each
innovation v of variance S,

.. math:: \log w \leftarrow \alpha \log w - \tfrac12 (v^2 / S + \log S)
"""

from __future__ import annotations

from copy import deepcopy
from math import log
from typing import Final

from magbridge.arrays import FloatArray
from magbridge.learning.causes import Alarm
from magbridge.learning.doubt import LEAST
from magbridge.learning.estimator import Estimator
from magbridge.learning.judge import BEYOND_CHANCE
from magbridge.learning.model import TEMPERATURE, Model
from magbridge.learning.nuisance import Nuisance

__all__ = ["Bank"]

MEMORY: Final = 2000.0
"""Samples over which predictions count."""
AHEAD: Final = 3.0
"""By which log w has to be ahead to change whom to believe. To leave the quiet one, :data:`BEYOND_CHANCE`:
what no change is seen of, as the level, is at the mercy of what is supposed."""
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
    mapless : Nuisance, optional
        Rock without the map, where there is one.

    Attributes
    ----------
    all : list of Estimator
        That one first.
    without_map : Estimator or None
        The last of them.
    map_doubted : bool
        Whether that one is to be believed.
    """

    def __init__(self, model: Model, quiet: Estimator, mapless: Nuisance | None = None) -> None:
        self._model, self.all, self._mapless = model, [quiet], mapless
        self._weights, self._best, self._warm = [0.0], 0, 0
        self.without_map: Estimator | None = None
        self.map_doubted, self._since = False, 0.0

    @property
    def quiet(self) -> Estimator:
        """The one that supposes nothing."""
        return self.all[0]

    @property
    def best(self) -> Estimator:
        """The one to believe."""
        if self.map_doubted and self.without_map is not None:
            return self.without_map
        return self.all[self._best]

    def suppose(self) -> None:
        """Let the others begin at what the quiet one knows."""
        slots = self._model.slots(TEMPERATURE)
        if TEMPERATURE in self._model.further and slots is not None:
            warm = deepcopy(self.quiet)
            warm.open(PER_DEGREE**2, slots)
            self._warm = len(self.all)
            self.all.append(warm)
        drifting = deepcopy(self.quiet)
        drifting.drift(RATE, CHANGES)
        self.all.append(drifting)
        if self._mapless is not None:
            self.without_map = deepcopy(self.quiet)
            self.without_map.leave_map(self._mapless)
            self.all.append(self.without_map)
        self._weights = [0.0] * len(self.all)

    def open(self, variance: float) -> None:
        """Let the offsets be unknown by a further `variance` (nT²) an axis."""
        for one in self.all:
            one.open(variance)

    def judge(self, time: float) -> Alarm | None:
        """Take note of what each has predicted at a time (s); return a doubt in the map, if there is one."""
        for k, one in enumerate(self.all):
            S = one.variance
            self._weights[k] *= 1.0 - 1.0 / MEMORY
            self._weights[k] -= 0.5 * (min(one.residual * one.residual / S, MOST) + log(S))
        with_map = [k for k, one in enumerate(self.all) if one is not self.without_map]
        ahead = max(with_map, key=self._weights.__getitem__)
        if self._weights[ahead] > self._weights[self._best] + (AHEAD if self._best else BEYOND_CHANCE):
            self._best = ahead
        return None if self.without_map is None else self._doubt_map(time, self.without_map, ahead)

    def _doubt_map(self, time: float, without: Estimator, best_with: int) -> Alarm | None:
        lead = self._weights[-1] - self._weights[best_with]
        if lead <= 0.0:
            self.map_doubted, self._since = False, time
        self.map_doubted = self.map_doubted or lead > LEAST
        if not self.map_doubted:
            return None
        return Alarm(("map_error",), ("",), self._since, abs(without.rock), lead, mapless=True)

    def take_over(self, strength: float) -> bool:
        """Let the quiet one go on from the one that follows the temperature; return whether it does.

        It does where that one has predicted better beyond chance, and hardly worse than what a doubt has
        found, with a log-likelihood ratio `strength`. For what was supposed from the start is known better.
        """
        warm = self._warm
        if self._weights[warm] - self._weights[0] < max(BEYOND_CHANCE, strength - CLOSE):
            return False
        self.all[0], self._weights[0], self._best = deepcopy(self.all[warm]), self._weights[warm], 0
        return True

    def explained(self, by: FloatArray, covariance: FloatArray, strength: float) -> None:
        """Move the quiet one by `by` (n,), known to a further `covariance` (n, n), as a doubt has found.

        Its log-likelihood ratio `strength` speaks for the quiet one from now on.
        """
        self.quiet.shift(by, covariance)
        self._weights[0] += strength
        if self._weights[0] > self._weights[self._best] + AHEAD:
            self._best = 0
