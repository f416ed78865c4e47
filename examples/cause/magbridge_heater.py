"""A third-party cause for ``magbridge diagnose``: the field of a device that is switched on and off.

A cause is a class whose `candidates` returns hypotheses. Each hypothesis wraps an effect of the live
correction (here a `ChannelEffect`), so the bridge can correct a finding. The entry point names an instance.
"""

from __future__ import annotations

import numpy as np

from magbridge.calibration.effects import ChannelEffect
from magbridge.diagnose.causes import Cause
from magbridge.diagnose.columns import Candidate, of_effect
from magbridge.diagnose.problem import Problem

SIZE = 50.0
"""Prior standard deviation of the field, nT: two leads half a metre away that carry a few amperes."""


class HeaterField(Cause):
    """Hypothesis that a loop of leads adds ``b s(t)`` to the offset T (Biot and Savart); s is the switch."""

    name = "heater_field"
    meaning = "something that is switched on and off makes a field"
    needs = "a series that is on or off"
    disambiguation = "switch it by hand at one attitude"

    def candidates(self, problem: Problem) -> list[Candidate]:
        """Return a candidate for each channel with exactly two values: an offset proportional to it."""
        made = []
        for name, series in problem.survey.channels.items():
            values = series.values
            if np.unique(values).size != 2:
                continue  # the channel is not a switch

            def phi(rows: slice, values: np.ndarray = values) -> np.ndarray:
                return values[None, rows]

            width = SIZE / float(np.abs(values).max())
            effect = ChannelEffect(cause=self.name, channel=name)
            made.append(of_effect(problem, effect, width, "nT per 1", phi=phi, channel=name))
        return made


HEATER_FIELD = HeaterField()
