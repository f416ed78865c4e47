"""How much the total field scatters, at several lags, about what rock can do.

Neither a jump nor a ramp changes for long the median of second differences ``F(t) - 2 F(t-T) + F(t-2T)``.
From sample to sample they see white noise. A hum of the period P they see as ``4 sin^2(pi T / P)``: with a
lag T of a tenth of P little, with one of a third all. How long T may be, is the rock's to say: of a wave of
length L passed at the speed v they see ``(2 pi v T / L)^2``, 2 % where ``v T`` is :data:`TRAVEL` and L 500 m,
which is taken off. The largest of the medians is what the field scatters by (as an Allan variance shows at
each interval what is noise there: Allan 1966, *Statistics of atomic frequency standards*, Proc. IEEE 54:221).
"""

from __future__ import annotations

from math import nan
from typing import Final

from magbridge.field.geodesy import separation
from magbridge.health.notices import Notices

__all__ = ["QUIETEST", "Scatter"]

QUIETEST: Final = 0.1
"""nT: no fluxgate's noise is lower."""
STEP: Final = 1.02
"""Factor by which a sample moves the median of the second differences."""
PATIENCE: Final = 6
FASTEST: Final = 12
"""Samples in a row that lie on one side of the median before its steps grow, and by how many times at most:
twenty times the noise is learned in half the samples, and white noise passes for more no oftener."""
RARE: Final = 4.0
"""Times the median that counts as three samples: of white noise one in 140 is as large."""
SWIFT: Final = 60
"""The n-th step is at least SWIFT/n such factors: at the start the noise is learned in a few samples."""
ENOUGH: Final = 5
UNSURE: Final = 4.0
"""Second differences from which on their median says something of the noise; after n it may be 1 + UNSURE/n
times as far off as later."""
INNOVATION: Final = 4.0 / 3.0 / (6.0 * 0.6745**2)
"""Variance of an innovation over the square of that median. White noise of variance v gives innovations from
a level with gain 1/2 the variance 4/3 v, second differences 6 v, and the median of a normal variable's
absolute value is 0.6745 sigma."""
NOISY: Final = 2.5
"""How many times the scatter of innovations that the calibration's noise gives is added to sigma, until it is
half of that."""
LOUD: Final = 5.0
"""How many times is reported."""
LAGS: Final = (1, 2, 4, 8)
KEPT: Final = 2 * LAGS[-1] + 1
"""Lags, in intervals of which the longest has eight, or six where no samples come then; samples for them."""
TRAVEL: Final = 12.0
"""m by which a vehicle goes on within the longest lag, at most."""
ROCK: Final = 2.2
"""nT, the median of second differences that rock of 145 nT and 500 m makes then."""
LONGEST_US: Final = 32_000_000
"""µs of the longest lag, at most: also a vehicle that stands still is passed by the field's variations."""
PACE_US: Final = 60_000_000
"""µs over which the speed is measured, at least."""


class Bends:
    """The median of second differences at one lag."""

    __slots__ = ("count", "median", "rising", "run")

    def __init__(self) -> None:
        self.median = 0.0
        self.count = 0
        self.run, self.rising = 0, False  # on one side of the median

    def take(self, bend: float) -> None:
        """Take a second difference's absolute value, nT."""
        rising = bend > self.median
        self.run = self.run + (3 if bend > RARE * self.median else 1) if rising == self.rising else 0
        self.rising = rising
        step = STEP ** max(min(max(self.run - PATIENCE, 1), FASTEST), SWIFT // (self.count + 1))
        self.median *= step if rising else 1.0 / step
        self.count += 1


class Scatter:
    """Scatter of the innovations of a total field.

    Parameters
    ----------
    noise : float
        nT, 1-sigma of a channel's noise by the calibration.

    Attributes
    ----------
    variance : float
        nT², of an innovation from one sample to the next; never less than the calibration's noise gives.
    """

    def __init__(self, noise: float, notices: Notices) -> None:
        self._notices = notices
        self._known = noise > 0.0
        self.floor = 1.5 * max(noise, QUIETEST) ** 2
        self.variance = self.floor
        self._next = Bends()  # from sample to sample
        self._last = self._last_but_one = nan
        self._lagged = tuple(Bends() for _ in LAGS)
        self._fields, self._times = [nan] * KEPT, [0] * KEPT
        self._at = 0
        self._largest = 0.0  # variance of the others, less the rock's
        self._noisy = False
        self._longest_us = 0  # lag; none while the speed is not known
        self._latitude = self._longitude = nan
        self._place_us = 0

    def begin(self, variance: float) -> None:
        """Take the variance (nT²) that an innovation may have at first."""
        self.variance = variance
        self._next.median = (variance / INNOVATION) ** 0.5
        for bends in self._lagged:
            bends.median = self._next.median

    def place(self, time_us: int, latitude: float, longitude: float) -> None:
        """Take where the vehicle is, deg: how fast it goes says how long a lag may be."""
        apart_us = time_us - self._place_us
        if 0 <= apart_us < PACE_US or (latitude == self._latitude and longitude == self._longitude):
            return
        north, east = separation(self._latitude, self._longitude, latitude, longitude)
        speed = (north * north + east * east) ** 0.5 / (1e-6 * apart_us)
        if speed == speed:  # noqa: PLR0124 - NaN
            self._longest_us = round(1e6 * min(TRAVEL / max(speed, 1e-3), 1e-6 * LONGEST_US))
        self._latitude, self._longitude, self._place_us = latitude, longitude, time_us

    def follow(self, time_us: int, total: float) -> None:
        """Take a sample."""
        bend = abs(total - 2.0 * self._last + self._last_but_one)
        self._last_but_one, self._last = self._last, total
        if bend == bend:  # noqa: PLR0124 - NaN
            self._next.take(bend)
            self.variance = max(INNOVATION * self._next.median * self._next.median, self.floor)
        if self._longest_us and not 0 <= time_us - self._times[self._at] < self._longest_us * 3 // 32:
            self._keep(time_us, total)

    def _keep(self, time_us: int, total: float) -> None:
        """Keep a sample, and take the second differences from it back."""
        self._at = at = (self._at + 1) % KEPT
        self._fields[at], self._times[at] = total, time_us
        self._largest = 0.0
        for lag, bends in zip(LAGS, self._lagged, strict=True):
            middle, first = (at - lag) % KEPT, (at - 2 * lag) % KEPT
            late_us = time_us - self._times[middle]
            early_us = self._times[middle] - self._times[first]
            if late_us <= self._longest_us and abs(late_us - early_us) * 8 <= late_us:
                bend = abs(total - 2.0 * self._fields[middle] + self._fields[first])
                if bend == bend:  # noqa: PLR0124 - NaN
                    bends.take(bend)
            if bends.count >= ENOUGH:
                median, rock = bends.median / (1.0 + UNSURE / bends.count), ROCK * (lag / LAGS[-1]) ** 2
                self._largest = max(self._largest, INNOVATION * (median * median - rock * rock))

    def explain(self, by: float) -> None:
        """Take note that another calibration moves the total field `by` nT."""
        self._last += by
        self._last_but_one += by
        self._fields = [field + by for field in self._fields]

    def excess(self) -> float:
        """Return the variance (nT²) that more noise than the calibration's adds."""
        if not self._known or self._next.count < ENOUGH:
            return 0.0
        variance = max(self.variance, self._largest)
        ratio = (variance / self.floor) ** 0.5
        sure = 1.0 + UNSURE / self._next.count
        self._noisy = ratio > NOISY * (0.5 if self._noisy else sure)
        if ratio > LOUD * sure:
            self._notices.report("noise", f"noise of {variance**0.5:.0f} nT: sigma is widened")
        return variance if self._noisy else 0.0
