"""Check whether the Earth has such a total field at the position, or anywhere.

The Earth's total field is the sum of the main field and the crustal field. The main field alone is off by 145
nT (1-sigma over the Earth, crustal field and disturbances included: the error model of Chulliat et al. 2020,
*The US/UK World Magnetic Model for 2020-2025*), or by ``align.reference_sigma``. A total field further off
than
:data:`MAX_LEVEL_SIGMA` is not the Earth's. Without a position, it is compared with the extremes on the Earth.

The reference bounds every error: while the field is more than :data:`FAR_SIGMA` off, sigma includes the
difference, until it is less than :data:`NEAR_SIGMA`.
"""

from __future__ import annotations

from math import isnan
from typing import Final

from magbridge.health.messages import Messages

__all__ = ["FAR_SIGMA", "MAX_LEVEL_SIGMA", "NEAR_SIGMA", "LevelCheck"]

MAX_LEVEL_SIGMA: Final = 5.0
FAR_SIGMA: Final = 3.0
NEAR_SIGMA: Final = 1.0
"""Sigmas of the total field about the main field."""
MIN_FIELD_NT: Final = 17_000.0
MAX_FIELD_NT: Final = 72_000.0
"""The main field's extremes on the Earth, 22,000 and 67,000 nT, with crustal fields."""
MIN_WRONG_SAMPLES: Final = 3
MIN_WRONG_US: Final = 8_000_000
"""Samples and time after which a wrong field is not a burst of bad readings."""
LEVEL_HOLD_US: Final = 3_600_000_000
"""Time for which a wrong field that is over is remembered."""


class LevelCheck:
    """Compare the total field with the main field.

    Attributes
    ----------
    is_wrong : bool
        Whether the last sample's total field is not the Earth's.
    until_us : int
        Time until which samples are flagged because it was wrong, µs.
    """

    def __init__(self, messages: Messages) -> None:
        self._messages = messages
        self.is_wrong = False
        self.until_us = 0
        self._is_far = False
        self._wrong_samples = self._since_us = self._far_samples = 0

    def check(
        self, time_us: int, total: float, sigma: float, reference: float, reference_sigma: float, steady: bool
    ) -> float:
        """Set :attr:`is_wrong`; return the variance (nT²) of a field that is far off.

        Only a sample of `steady` masses can end that.
        """
        if isnan(reference):
            self._record(time_us, total, reference, not MIN_FIELD_NT < total < MAX_FIELD_NT)
            return 0.0
        difference = total - reference
        # normalised square of the difference from the main field
        squared = difference * difference / (reference_sigma * reference_sigma + sigma * sigma)
        self._record(time_us, total, reference, squared > MAX_LEVEL_SIGMA * MAX_LEVEL_SIGMA)
        # two thresholds: begin at FAR_SIGMA, end at NEAR_SIGMA
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
