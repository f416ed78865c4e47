r"""Check whether channels repeat their reading: stuck, clipped, or all of them not read again.

A healthy channel repeats its reading with a probability p, and n times in a row with :math:`p^n`. It is
learned for each channel alone, and for all three together. For all three, p is at least what the noise gives:
normal noise of standard deviation :math:`\sigma`, in steps of q, repeats a channel's reading with the
probability
:math:`q / (2 \sqrt\pi \sigma)`.
"""

from __future__ import annotations

from math import inf, log, nan, pi, sqrt
from typing import Final

from magbridge.health.messages import Messages
from magbridge.records import Vector

__all__ = ["RepetitionCheck"]

LEARNING_SAMPLES: Final = 256
"""Samples over which the fraction of repeated readings is learned."""
MAX_PROBABILITY: Final = 1e-9
"""Probability of a run of repeated readings that a healthy channel does not show."""
MIN_STUCK_FRACTION: Final = 1e-3
MIN_RUN: Final = 4
MIN_COMMON_RUN: Final = 3
AXIS_LETTERS: Final = "xyz"


class Repetition:
    """Repetitions of one reading: how many in a row, and how often they occur."""

    __slots__ = ("fraction", "last", "limit", "run")

    def __init__(self) -> None:
        self.last = self.limit = nan
        self.run = 0
        self.fraction = 0.1  # of repeated readings

    def change(self) -> None:
        """Record that the reading has changed."""
        self.run = 0
        self.fraction += (MIN_STUCK_FRACTION - self.fraction) / LEARNING_SAMPLES

    def repeat(self, probability: float, min_run: int) -> bool:
        """Record a repetition; return True if a healthy channel does not repeat its reading so often."""
        self.run += 1
        if self.run >= min_run and self.run * log(max(self.fraction, probability)) < log(MAX_PROBABILITY):
            return True
        # exponential average of how often a healthy channel repeats
        self.fraction += (1.0 - self.fraction) / LEARNING_SAMPLES
        return False


class RepetitionCheck:
    """Check three channels."""

    def __init__(self, messages: Messages) -> None:
        self._messages = messages
        self._axes = (Repetition(), Repetition(), Repetition())
        self._common = Repetition()
        self._has_limit = False
        self._step = inf  # smallest change of a reading, nT

    @property
    def is_repeating(self) -> bool:
        """Return True if the last reading repeats the previous one on all axes."""
        return self._common.run > 0

    def is_stuck(self, raw: Vector, white_sigma: float) -> bool:
        """Return True if channels repeat their reading, or read a limit at which they were once stuck.

        Parameters
        ----------
        raw : tuple of 3 float
            Reading, nT.
        white_sigma : float
            1-sigma of the white noise, nT.
        """
        same = [value == axis.last for value, axis in zip(raw, self._axes, strict=True)]
        if all(same):
            return self._repeat_all(white_sigma)
        self._common.change()
        stuck = False
        for number, (axis, value) in enumerate(zip(self._axes, raw, strict=True)):
            if same[number]:
                stuck = self._repeat(number, axis, value) or stuck
                continue
            change = abs(value - axis.last)
            self._step = min(self._step, change)
            axis.last = value
            axis.change()
            stuck = stuck or (self._has_limit and abs(value) == axis.limit)
        return stuck

    def _repeat_all(self, white_sigma: float) -> bool:
        # probability that one channel repeats: step of the readings over sigma, as in the module
        axis_probability = min(self._step / (2.0 * sqrt(pi) * max(white_sigma, 1e-9)), 1.0)
        if not self._common.repeat(axis_probability**3, MIN_COMMON_RUN):
            return False
        self._messages.report("repeat", "all axes repeat one reading: sensor or driver at fault")
        return True

    def _repeat(self, number: int, axis: Repetition, value: float) -> bool:
        # a value at which the axis was stuck before is a limit: no probability is needed
        if abs(value) == axis.limit:
            axis.run += 1
        elif not axis.repeat(0.0, MIN_RUN):
            return False
        axis.limit, self._has_limit = abs(value), True
        self._messages.report(
            "axis", f"axis {AXIS_LETTERS[number]} stuck at {value:.0f} nT, or clipped there"
        )
        return True
