"""Whether the total field is one that the Earth has here, or anywhere.

The Earth's total field is the main field and the rock's; the main field alone is off by 145 nT (1-sigma over
the Earth, rock and disturbances included: the error model of Chulliat et al. 2020, *The US/UK World Magnetic
Model for 2020-2025*), or by ``align.reference_sigma``. More than :data:`LEVEL` sigmas are none of it. Without
a position, the total field is compared with the extremes on Earth. Rock is come upon little by little. Where
the field is more than :data:`FAR` sigmas off before it was ever within :data:`NEAR`, a gain may be wrong, and
sigma spans what it is off until it is.
"""

from __future__ import annotations

from math import isnan
from typing import Final

from magbridge.health.notices import Notices

__all__ = ["FAR", "LEVEL", "NEAR", "Level"]

LEVEL: Final = 5.0
FAR: Final = 3.0
NEAR: Final = 2.0
"""Sigmas of the level."""
LEAST: Final = 17_000.0
MOST: Final = 72_000.0
"""nT: the main field's extremes on Earth, 22,000 and 67,000 nT, with rock."""
WRONGS: Final = 3
WRONG_US: Final = 8_000_000
"""Samples, and µs, for which a wrong level is no burst of garbage."""
HOLD_US: Final = 3_600_000_000
"""µs for which one that is over is remembered."""


class Level:
    """The total field beside the main field.

    Attributes
    ----------
    wrong : bool
        The last sample's total field is none of the Earth's.
    until_us : int
        µs until which it is doubtful that it was wrong.
    """

    def __init__(self, notices: Notices) -> None:
        self._notices = notices
        self.wrong = False
        self.until_us = 0
        self._near = self._far = False  # the main field, once
        self._wrongs = self._since_us = 0

    def check(
        self, time_us: int, total: float, sigma: float, reference: float, reference_sigma: float, steady: bool
    ) -> float:
        """Set :attr:`wrong`; return the variance (nT²) of a field that was far off from the first on."""
        if isnan(reference):
            self._take(time_us, total, reference, not LEAST < total < MOST)
            return 0.0
        off = total - reference
        sigmas2 = off * off / (reference_sigma * reference_sigma + sigma * sigma)
        self._take(time_us, total, reference, sigmas2 > LEVEL * LEVEL)
        if self._near:
            return 0.0
        self._near = steady and sigmas2 <= NEAR * NEAR
        self._far = not self._near and (self._far or sigmas2 > FAR * FAR)
        if not self._far:
            return 0.0
        self._notices.report("far", f"field of {total:.0f} nT, expected {reference:.0f}: sigma is widened")
        return off * off

    def _take(self, time_us: int, total: float, reference: float, wrong: bool) -> None:
        self.wrong = wrong
        if not wrong:
            self._wrongs = 0
            return
        self._wrongs += 1
        if self._wrongs == 1:
            self._since_us = time_us
        if self._wrongs >= WRONGS and time_us - self._since_us >= WRONG_US:
            self.until_us = time_us + HOLD_US
            expected = f"{LEAST:.0f} to {MOST:.0f}" if isnan(reference) else f"{reference:.0f}"
            self._notices.report(
                "level", f"field of {total:.0f} nT, expected {expected}: sensor or calibration"
            )
