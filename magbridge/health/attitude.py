"""What of the total field follows the attitude: an axis' gain or offset is wrong, or a mass.

Rock knows nothing of the attitude, and bends slowly; a vehicle rolls, pitches and yaws all the time. Of the
direction u of the corrected field in body axes, wrong offsets o and gains g change the total field F by
``u o + F (g_x u_x^2 + g_y u_y^2)``, to first order and up to a constant (the gain of all axes is none of it,
:mod:`magbridge.health.level`). The five numbers theta are found by least squares from the changes
within half a minute, ``F - F_a = (r - r_a) theta + e``: a ridge regression, whose prior is what a sensor may
be off by (Hoerl & Kennard 1970, Technometrics 12:55), with Huber's weights (1964, Ann. Math. Stat. 35:73),
which forgets by half in twenty minutes. Changes that overlap count as one, and the variance of e is learned,
rock included. ``theta' A theta`` is chi-squared where nothing follows the attitude. Beyond :data:`ALARM`
sigma spans ``r theta`` and its own doubt.
"""

from __future__ import annotations

from collections import deque
from math import exp
from typing import Any, Final

import numpy as np

from magbridge.health.judge import DOUBTFUL
from magbridge.health.notices import Notices

__all__ = ["Attitude"]

EVERY_US: Final = 1_000_000
"""µs from one look to the next."""
LAG_US: Final = 15_000_000
LONGEST_US: Final = 32_500_000
"""µs over which a change is taken."""
FORGET: Final = 1800.0
"""s."""
PRIOR: Final = np.diag(1.0 / np.array([100.0, 100.0, 20.0, 1000.0, 1000.0]) ** 2)
"""1/nT²: offsets of 100 nT, gains of 2 % in the Earth's field; 1-sigma. That of z is nearly a constant."""
START: Final = 100.0
LEARNED: Final = 1
MEMORY: Final = 128
"""nT² that the variance of e is at first, as if so many looks had told; and over how many it is learned."""
CLIP: Final = 16.0
"""Times the usual that a square counts as, at most."""
HUBER: Final = 3.0
ALARM: Final = 12.0
CALM: Final = 6.0


class Attitude:
    """Regresses the total field on the attitude.

    Parameters
    ----------
    notices : Notices, optional
        Takes what is found.
    """

    def __init__(self, notices: Notices | None = None) -> None:
        self._notices = notices or Notices()
        self.notices = self._notices.lines
        self._variance, self._looks = START, LEARNED
        self._next_us = 0
        self._wrong = False
        self.forget()

    def forget(self) -> None:
        """Begin anew, as where the calibration is another."""
        self._kept: deque[tuple[int, Any, float]] = deque()
        self._information, self._toward = np.zeros((5, 5)), np.zeros(5)
        self._theta, self._covariance = np.zeros(5), np.linalg.inv(PRIOR)
        self._wrong = False

    def check(
        self, time_us: int, x: float, y: float, z: float, total: float, variance: float, quality: int
    ) -> float:
        """Look at a sample now and then; return the variance (nT²) to add to its field's.

        Parameters
        ----------
        time_us : int
            µs.
        x, y, z, total : float
            nT, the corrected vector and total field.
        variance : float
            nT², of the total field by the calibration.
        quality : int
            Flags so far.
        """
        look = not quality & DOUBTFUL and not 0 <= self._next_us - time_us <= EVERY_US
        if not (look or self._wrong) or not total > 0.0:
            return 0.0
        x, y, z = x / total, y / total, z / total
        r = np.array([x, y, z, x * x, y * y])
        if look:
            self._next_us = time_us + EVERY_US
            self._look(time_us, r, total, variance)
        return float((r @ self._theta) ** 2 + r @ self._covariance @ r) if self._wrong else 0.0

    def _look(self, time_us: int, r: Any, total: float, variance: float) -> None:
        kept = self._kept
        while kept and not 0 < time_us - kept[0][0] <= LONGEST_US:
            kept.popleft()
        if kept and time_us - kept[0][0] >= LAG_US:
            since_us, before, field = kept[0]
            every_us = time_us - kept[-1][0]
            share = every_us / (time_us - since_us)
            self._learn(r - before, total - field, variance, share, exp(-1e-6 * every_us / FORGET))
        kept.append((time_us, r, total))

    def _learn(self, moved: Any, change: float, variance: float, share: float, keep: float) -> None:
        """Take a change of r and of the field, nT, of which `share` is new; `keep` what came before."""
        e = change - float(moved @ self._theta)
        self._looks = min(self._looks + 1, MEMORY)
        self._variance += (min(e * e, CLIP * self._variance) - self._variance) / self._looks
        spread = max(self._variance, variance)
        weight = share / spread * min(1.0, HUBER * spread**0.5 / max(abs(e), 1e-9))
        self._information = keep * self._information + weight * np.outer(moved, moved)
        self._toward = keep * self._toward + weight * change * moved
        self._covariance = np.linalg.inv(self._information + PRIOR)
        self._theta = self._covariance @ self._toward
        self._wrong = float(self._theta @ self._toward) > (CALM if self._wrong else ALARM)
        if self._wrong:
            self._notices.report("attitude", "field follows the attitude: gain, offset or a mass wrong")
