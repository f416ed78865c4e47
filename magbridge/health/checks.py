r"""Check single readings for stuck channels, and for a total field that cannot be the Earth's.

A healthy channel repeats its reading with a probability p, and n times in a row with :math:`p^n`. The check
learns p for each channel, and for all three together. Noise and resolution give a lower bound of p: normal
noise of standard deviation :math:`\sigma` stays within a step q, if the field is in the middle of the step,
with the probability :math:`\mathrm{erf}(q / (2 \sqrt 2 \sigma))`, and within the steps of all three channels
with the third power. A single channel that repeats is evidence only while another channel moves by more than
two steps: the channels of a coarse sensor on a vehicle at rest may repeat for hours. Rounding gives the
readings of a moving vehicle a standard deviation of at least :math:`q / \sqrt{12}`.

A value at which a channel was stuck is a limit of the channel's range, if no reading was ever beyond it.

The Earth's total field is the sum of the main field and the crustal field. It differs from the main field by
138 nT (1-sigma over the Earth, with disturbances: the error model of the World Magnetic Model 2025, see
:mod:`magbridge.constants`), or by the configured ``align.reference_sigma``. A total field that differs by
more than :data:`MAX_LEVEL_SIGMA` is not the Earth's. If no position is known, the limits are the extremes on
the Earth. Sigma includes the difference once it exceeds :data:`FAR_SIGMA`, until it is below
:data:`NEAR_SIGMA`.
"""

from __future__ import annotations

from math import erf, inf, isnan, log, nan, sqrt
from typing import TYPE_CHECKING, Final

from magbridge.records import NEVER, Vector

if TYPE_CHECKING:
    from magbridge.health.scatter import Scatter  # which imports this module


class Messages:
    """Messages for the operator, each kind once; the caller empties `lines` after sending them."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self._kinds: set[str] = set()

    def report(self, kind: str, text: str) -> None:
        """Add a message, unless one of this kind was added before."""
        if kind not in self._kinds:
            self._kinds.add(kind)
            self.lines.append(text)


LEARNING_SAMPLES: Final = 256
"""Time constant, in samples, of the average fraction of repeated readings."""
MAX_PROBABILITY: Final = 1e-9
"""Probability of a run of repeated readings below which the channel counts as stuck."""
MIN_STUCK_FRACTION: Final = 1e-3
MIN_RUN: Final = 4
MIN_COMMON_RUN: Final = 3
MIN_MOTION_STEPS: Final = 2.5
"""Change of a reading, in steps, above which the vehicle moves: two steps, with room for rounding."""
AXIS_LETTERS: Final = "xyz"


class Repetition:
    """Statistics of a channel's repeated readings: length of the present run, and average fraction."""

    __slots__ = ("fraction", "run")

    def __init__(self) -> None:
        self.run = 0
        self.fraction = 0.1  # of repeated readings

    def change(self) -> None:
        """Record that the reading has changed."""
        self.run = 0
        self.fraction += (MIN_STUCK_FRACTION - self.fraction) / LEARNING_SAMPLES

    def repeat(self, probability: float, min_run: int) -> bool:
        """Record a repetition; return True if a run so long is too unlikely for a healthy channel.

        `probability` is a lower bound of the probability of one repetition.
        """
        self.run += 1
        if self.run >= min_run and self.run * log(max(self.fraction, probability)) < log(MAX_PROBABILITY):
            return True
        # exponential average of how often a healthy channel repeats
        self.fraction += (1.0 - self.fraction) / LEARNING_SAMPLES
        return False


class _Axis(Repetition):
    """Readings of one channel: the last, the range so far, and the limits of the range, nT."""

    __slots__ = ("high", "is_faulty", "last", "limits", "low")

    def __init__(self) -> None:
        super().__init__()
        self.last = nan
        self.low, self.high = inf, -inf
        self.limits = set[float]()
        self.is_faulty = False  # stuck, or at a limit at which it was stuck before

    def move(self, value: float) -> None:
        """Record a changed reading; a limit that it exceeds was not a limit."""
        self.change()
        if value > self.high:
            self.limits.discard(self.high)
            self.high = value
        if value < self.low:
            self.limits.discard(self.low)
            self.low = value
        self.last, self.is_faulty = value, value in self.limits

    def stick(self) -> None:
        """Record that the channel is stuck at the last reading."""
        self.is_faulty = True
        if self.last in (self.low, self.high):
            self.limits.add(self.last)


class RepetitionCheck:
    """Check of the three channels for stuck readings."""

    def __init__(self, messages: Messages) -> None:
        self._messages = messages
        self._axes = (_Axis(), _Axis(), _Axis())
        self._common = Repetition()
        self._step = inf  # smallest change of a reading, nT

    @property
    def is_repeating(self) -> bool:
        """Return True if the last reading repeats the previous one on all axes."""
        return self._common.run > 0

    def is_stuck(self, raw: Vector, scatter: Scatter) -> bool:
        """Return True if a channel is stuck, or reads a limit at which it was stuck before.

        `raw` is the reading, nT; `scatter` gives the measured white noise.
        """
        x_axis, y_axis, z_axis = self._axes
        x, y, z = raw
        changes = abs(x - x_axis.last), abs(y - y_axis.last), abs(z - z_axis.last)
        largest = max(changes)
        if largest == 0.0:
            stuck = self._repeat_all(scatter.white_sigma)
        else:
            stuck = False
            self._common.change()
            for change in changes:
                if 0.0 < change < self._step:
                    self._step = change
            is_moving = largest > MIN_MOTION_STEPS * self._step
            for number, axis in enumerate(self._axes):
                if raw[number] != axis.last:
                    axis.move(raw[number])
                elif is_moving and not axis.is_faulty:
                    self._repeat(number, axis, scatter.white_sigma)
        return stuck or x_axis.is_faulty or y_axis.is_faulty or z_axis.is_faulty

    def _probability(self, sigma: float) -> float:
        """Return the lower bound of the probability that one channel repeats, for noise of `sigma` nT."""
        return erf(self._step / (2.0 * sqrt(2.0) * max(sigma, 1e-9)))

    def _repeat_all(self, white_sigma: float) -> bool:
        """Record a reading that repeats on all axes; return True if the run of repetitions is a fault."""
        if not self._common.repeat(self._probability(white_sigma) ** 3, MIN_COMMON_RUN):
            return False
        self._messages.report("repeat", "all axes repeat one reading: sensor or driver at fault")
        return True

    def _repeat(self, number: int, axis: _Axis, white_sigma: float) -> None:
        """Record that an axis repeats its reading although the vehicle moves."""
        sigma = max(white_sigma, self._step / sqrt(12.0))  # with the noise of rounding
        if axis.repeat(self._probability(sigma), MIN_RUN):
            axis.stick()
            text = f"axis {AXIS_LETTERS[number]} stuck at {axis.last:.0f} nT, or clipped there"
            self._messages.report("axis", text)


MAX_LEVEL_SIGMA: Final = 5.0
FAR_SIGMA: Final = 3.0
NEAR_SIGMA: Final = 1.0
"""Thresholds of the difference between total field and main field, in sigmas: fault, begin and end of a wider
sigma."""
MIN_FIELD_NT: Final = 17_000.0
MAX_FIELD_NT: Final = 72_000.0
"""Limits of the Earth's total field, nT: the main field has 22,000 to 67,000 nT, plus crustal fields."""
MIN_WRONG_SAMPLES: Final = 3
MIN_WRONG_US: Final = 8_000_000
"""Number of samples, and time (µs), after which a wrong field is not just a burst of bad readings."""
LEVEL_HOLD_US: Final = 3_600_000_000
"""Time for which samples stay flagged after a wrong field has ended, µs."""


class LevelCheck:
    """Check of the total field against the main field.

    `is_wrong` is True if the last sample's total field cannot be the Earth's. After a longer fault, samples
    are flagged until the time `until_us`, µs.
    """

    def __init__(self, messages: Messages) -> None:
        self._messages = messages
        self.is_wrong = False
        self.until_us = NEVER
        self._is_far = False
        self._wrong_samples = self._since_us = self._far_samples = 0

    def check(
        self, time_us: int, total: float, sigma: float, reference: float, reference_sigma: float, steady: bool
    ) -> float:
        """Set :attr:`is_wrong`; return the squared difference (nT²) from the main field while it is large.

        Return 0 otherwise. Only a sample with masses at rest (`steady`) can end a large difference.
        """
        if isnan(reference):
            self._record(time_us, total, reference, not MIN_FIELD_NT < total < MAX_FIELD_NT)
            return 0.0
        difference = total - reference
        # normalised square of the difference from the main field
        squared = difference * difference / (reference_sigma * reference_sigma + sigma * sigma)
        self._record(time_us, total, reference, squared > MAX_LEVEL_SIGMA * MAX_LEVEL_SIGMA)
        # hysteresis: begin at FAR_SIGMA, end at NEAR_SIGMA
        if self._is_far and steady:
            self._is_far = squared > NEAR_SIGMA * NEAR_SIGMA
        self._is_far = self._is_far or squared > FAR_SIGMA * FAR_SIGMA
        if not self._is_far:
            self._far_samples = 0
            return 0.0
        self._far_samples += 1
        if self._far_samples == MIN_WRONG_SAMPLES:
            text = f"field of {total:.0f} nT, expected {reference:.0f}: sigma is widened"
            self._messages.report("far", text)
        return difference * difference

    def _record(self, time_us: int, total: float, reference: float, wrong: bool) -> None:
        self.is_wrong = wrong
        if not wrong:
            self._wrong_samples = 0
            return
        self._wrong_samples += 1
        if self._wrong_samples == 1:
            self._since_us = time_us
        if self._wrong_samples >= MIN_WRONG_SAMPLES and time_us - self._since_us >= MIN_WRONG_US:
            self.until_us = time_us + LEVEL_HOLD_US
            expected = f"{MIN_FIELD_NT:.0f} to {MAX_FIELD_NT:.0f}" if isnan(reference) else f"{reference:.0f}"
            self._messages.report(
                "level", f"field of {total:.0f} nT, expected {expected}: sensor or calibration"
            )
