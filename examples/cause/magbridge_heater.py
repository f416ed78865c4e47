"""A third-party cause for ``magbridge diagnose``: something that is switched on and off has a field.

A cause is one class, whose `candidates` are hypotheses. Each is an effect that the live correction knows too
(here a `ChannelEffect`), so the finding can be corrected live. The entry point names an instance.
"""

from __future__ import annotations

import numpy as np

from magbridge.calibration.effects import ChannelEffect
from magbridge.diagnose.causes import Cause
from magbridge.diagnose.columns import Candidate, of_effect
from magbridge.diagnose.problem import Problem

SIZE = 50.0
"""nT, a plausible size (1-sigma): a pair of leads half a metre away that carries some amperes."""


class HeaterField(Cause):
    """Put forward a loop of leads: ``T += b s(t)`` (Biot and Savart), s the switch, on or off."""

    name = "heater_field"
    meaning = "something that is switched on and off makes a field"
    needs = "a series that is on or off"
    disambiguation = "switch it by hand at one attitude"

    def candidates(self, problem: Problem) -> list[Candidate]:
        """Return an offset that follows each channel of two values."""
        made = []
        for name, series in problem.survey.channels.items():
            values = series.values
            if np.unique(values).size != 2:
                continue  # no switch

            def phi(rows: slice, values: np.ndarray = values) -> np.ndarray:
                return values[None, rows]

            width = SIZE / float(np.abs(values).max())
            effect = ChannelEffect(cause=self.name, channel=name)
            made.append(of_effect(problem, effect, width, "nT per 1", phi=phi, channel=name))
        return made


HEATER_FIELD = HeaterField()
