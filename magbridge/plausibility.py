"""Whether a corrected sample can be the Earth's field, judged by those before it and by the main field.

Every check is cheap, knows only the time of events, and needs nothing but the samples:

level
    The Earth's total field is the main field and the rock's; the main field alone is off by 145 nT (1-sigma
    over the Earth, rock and disturbances included: the error model of Chulliat et al. 2020, *The US/UK World
    Magnetic Model for 2020-2025*), or by ``align.reference_sigma``. More than :data:`LEVEL` sigmas are none
    of it. Without a position, the total field is compared with the extremes on Earth. Rock is come upon
    little by little. Where the field is more than :data:`FAR` sigmas off before it was ever within
    :data:`NEAR`, a gain may be wrong, and sigma spans what it is off until it is.
axis
    A channel that repeats its number while the others change is stuck, or stands at a limit. How often it may
    is learned: a coarse instrument repeats itself, `n` times in a row with the probability ``p^n``.
jump
    The total field does not change with the attitude, and changes slowly with the place. The innovation
    ``e = F - L`` from a level L that follows it has the variance ``S = s^2 + (5/7 slope dt)^2 + sigma^2 +
    sigma_L^2``: s and the slope are learned, and the sigmas are those of the correction, only where
    a mass may have moved. Where ``e^2 > GATE^2 S``, a Kalman filter's gate (Bar-Shalom et al. 2001,
    *Estimation with Applications to Tracking and Navigation*, section 5.4), the sample is an outlier.
    Outliers that agree with each other are another level, which nothing explains: what follows is
    doubtful by the sum of such jumps, until it is nothing, and is remembered for some time.
noise
    Where s is far above the calibration's, it is added to sigma.
"""

from __future__ import annotations

from math import inf, isnan, log, nan
from typing import Final

from magbridge.records import Quality, Vector

__all__ = ["Plausibility"]

LEVEL: Final = 5.0
FAR: Final = 3.0
NEAR: Final = 2.0
"""Sigmas of the level."""
LEAST: Final = 17_000.0
MOST: Final = 72_000.0
"""nT: the main field's extremes on Earth, 22,000 and 67,000 nT, with rock."""
GATE: Final = 7.0
"""Sigmas of an innovation; 5.5 would be one false alarm a month, were the noise Gaussian."""
ROCK: Final = (5.0 / GATE) ** 2
"""Of the slope's share in S: over a pause or a motion it is five sigmas of a slope that are acceptable."""
SLOPE: Final = 0.7
LEAST_SLOPE: Final = 0.05
"""nT/s, 1-sigma, by which the field changes as a vehicle passes rock: at first, and at least."""
SLOPE_US: Final = 20_000_000
"""µs over which it is measured."""
AGREE: Final = 3
"""Outliers that agree with each other are a new level."""
MEMORY: Final = 64
"""Slopes over which the usual one is learned."""
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
CLIP: Final = 16.0
"""Squares beyond this many times the usual (of slopes) or the gate (of outliers) count as this much."""
NOISY: Final = 2.5
"""How many times the scatter of innovations that the calibration's noise gives is added to sigma, until it is
half of that."""
LOUD: Final = 5.0
"""How many times is reported."""
REPEATS: Final = 256
"""Samples over which the share of repeated numbers is learned."""
RARELY: Final = 1e-9
"""Probability of a run of repeated numbers that a healthy axis does not show."""
UNREST: Final = 0.3
BURST: Final = 8
BURST_UNREST: Final = 0.8
"""Share of an outlier's square that is added to the variance of the next sample, and so on: a spike passes.
One that comes within so many samples of another is rather noise, whose next sample is as bad."""
WRONG_US: Final = 8_000_000
"""µs for which a wrong level is no burst of garbage."""
LASTING_US: Final = 120_000_000
"""µs after which a jump is no passing thing."""
HOLD_US: Final = 60_000_000
LONG_US: Final = 3_600_000_000
LONGEST_US: Final = 86_400_000_000
"""µs for which a fault that is over is remembered: first, where the level was wrong or a mass's move did not
explain what was seen, and at most. Each time it comes again it is remembered four times longer, but no more
than an hour where no mass has moved; and a jump that came back, as long as it lasted."""
IMPLAUSIBLE: Final = int(Quality.IMPLAUSIBLE)
UNSTEADY: Final = int(Quality.MOVING | Quality.STALE_TELEMETRY | Quality.SATURATED | Quality.LATE_JOIN)
AXES: Final = "xyz"


class Axis:
    """One channel as the instrument sends it: whether it repeats itself."""

    __slots__ = ("last", "rail", "run", "share")

    def __init__(self) -> None:
        self.last = self.rail = nan
        self.run = 0
        self.share = 0.1  # of repeated numbers


class Plausibility:
    """Judges sample after sample.

    Parameters
    ----------
    noise : float
        nT, 1-sigma of a channel's noise by the calibration.

    Attributes
    ----------
    flags : int
        Of the last sample: :class:`~magbridge.records.Quality` bits.
    fault : bool
        The last sample is an outlier, of a sensor at fault, or not of the Earth: no level, old or new.
    notices : list of str
        What was found since the caller has last emptied it, each once.
    """

    def __init__(self, noise: float) -> None:
        self.flags = 0
        self.fault = False
        self.notices: list[str] = []
        self._reported: set[str] = set()
        self._axes = (Axis(), Axis(), Axis())
        self._stood = False  # whether an axis has a rail
        self._known = noise > 0.0
        self._floor = 1.5 * max(noise, QUIETEST) ** 2
        self._variance = 0.0  # of innovations, nT^2
        self._near = self._far = False  # the main field, once
        self._level = nan
        self._level_variance = 0.0
        self._unsteady = False  # since the last sample that was judged, so a mass may have moved
        self._before = nan  # the level before a sample that only the time or a mass's move made acceptable
        self._level_us = 0
        self._slope = SLOPE * SLOPE
        self._mark, self._mark_us = nan, 0
        self._unrest = self._median = 0.0
        self._decay, self._quiet = UNREST, BURST
        self._last = self._last_but_one = nan
        self._moved_us = 0
        self._candidate, self._agreed = nan, 0
        self._bends = self._accepted = 0
        self._noisy = False
        self._run, self._rising = 0, False  # of second differences on one side of their median
        self._moved = self._largest = 0.0
        self._jumps = self._wrong = 0
        self._until_us = self._wrong_until_us = self._wrong_us = 0

    def check(
        self,
        time_us: int,
        raw: Vector,
        total: float,
        sigma: float,
        quality: int,
        reference: float,
        reference_sigma: float,
    ) -> float:
        """Judge a sample: set :attr:`flags`, return the variance (nT²) to add to the field's.

        Parameters
        ----------
        time_us : int
            µs.
        raw : tuple of 3 float
            nT, the channels as the instrument sent them.
        total, sigma : float
            nT, the corrected total field and its 1-sigma.
        quality : int
            Flags so far.
        reference, reference_sigma : float
            nT, main field (NaN where the position is not known) and 1-sigma of the Earth's field about it.
        """
        self.flags = 0
        stuck = self._stuck(raw)
        self.fault = True
        if not 0.0 <= total < inf:
            return 0.0
        off = 0.0 if isnan(reference) else total - reference
        sigmas2 = off * off / (reference_sigma * reference_sigma + sigma * sigma)
        wrong = self._is_wrong(time_us, total, reference, sigmas2)
        more = self._span(total, reference, sigmas2, steady=not quality & UNSTEADY)
        if quality & UNSTEADY:
            self._unsteady = True
        else:
            more += self._jump(time_us, total, sigma, learn=not (stuck or wrong))
        if stuck or wrong or time_us < self._wrong_until_us:
            self.flags = IMPLAUSIBLE
        self.fault = self.flags != 0
        return more + self._doubt(time_us)

    def explain(self, by: float, *, jumps: bool) -> None:
        """Take note that another calibration moves the total field `by` nT, and may explain past jumps."""
        if by == by:  # noqa: PLR0124 - compiled, quicker than a call
            self._level += by
            self._candidate += by
            self._last += by
            self._last_but_one += by
        if not jumps:
            return
        self._mark = nan
        self._moved = self._largest = 0.0
        self._jumps = self._until_us = 0

    def _stuck(self, raw: Vector) -> bool:
        """Say whether an axis repeats its number while another changes, or stands where it once stuck."""
        first, second, third = self._axes
        x, y, z = raw
        same_x, same_y, same_z = x == first.last, y == second.last, z == third.last
        if not (same_x or same_y or same_z or self._stood):
            first.last, second.last, third.last = x, y, z
            first.run = second.run = third.run = 0
            first.share += (1e-3 - first.share) / REPEATS
            second.share += (1e-3 - second.share) / REPEATS
            third.share += (1e-3 - third.share) / REPEATS
            return False
        if same_x and same_y and same_z:
            return False
        stuck = self._repeats(0, first, x, same_x)
        stuck = self._repeats(1, second, y, same_y) or stuck
        return self._repeats(2, third, z, same_z) or stuck

    def _repeats(self, number: int, axis: Axis, value: float, same: bool) -> bool:
        if not same:
            axis.last, axis.run = value, 0
            axis.share += (1e-3 - axis.share) / REPEATS
            return abs(value) == axis.rail
        axis.run += 1
        if axis.run < 4 and abs(value) != axis.rail:
            axis.share += (1.0 - axis.share) / REPEATS
            return False
        if abs(value) != axis.rail and axis.run * log(axis.share) > log(RARELY):
            axis.share += (1.0 - axis.share) / REPEATS
            return False
        axis.rail, self._stood = abs(value), True
        self._notify("axis", f"axis {AXES[number]} stuck at {value:.0f} nT, or clipped there")
        return True

    def _span(self, total: float, reference: float, sigmas2: float, *, steady: bool) -> float:
        """Return the variance (nT²) of a field that is far off the main field from the first sample on."""
        if isnan(reference) or self._near:
            return 0.0
        self._near = steady and sigmas2 <= NEAR * NEAR
        self._far = not self._near and (self._far or sigmas2 > FAR * FAR)
        if not self._far:
            return 0.0
        off = total - reference
        self._notify("far", f"field of {total:.0f} nT, expected {reference:.0f}: sigma is widened")
        return off * off

    def _is_wrong(self, time_us: int, total: float, reference: float, sigmas2: float) -> bool:
        """Say whether the total field is none that the Earth has here, or anywhere."""
        wrong = not LEAST < total < MOST if isnan(reference) else sigmas2 > LEVEL * LEVEL
        if not wrong:
            self._wrong = 0
            return False
        self._wrong += 1
        if self._wrong == 1:
            self._wrong_us = time_us
        if self._wrong >= AGREE and time_us - self._wrong_us >= WRONG_US:
            self._wrong_until_us = time_us + LONG_US
            expected = f"{LEAST:.0f} to {MOST:.0f}" if isnan(reference) else f"{reference:.0f}"
            self._notify("level", f"field of {total:.0f} nT, expected {expected}: sensor or calibration")
        return True

    def _jump(self, time_us: int, total: float, sigma: float, *, learn: bool) -> float:
        """Follow the level; return the variance (nT²) to add to that of a sample which is an outlier."""
        variance = max(self._variance, self._floor)
        if isnan(self._level):
            if learn:
                self._begin(time_us, total, sigma)
                self._variance = 9.0 * max(sigma * sigma, self._floor)
                self._median = (self._variance / INNOVATION) ** 0.5
            return 0.0
        seconds = 1e-6 * (time_us - self._level_us)
        moved = self._unsteady
        spread = variance + ROCK * self._slope * seconds * seconds
        if moved:
            spread += sigma * sigma + self._level_variance
        e = total - self._level
        self._learn_noise(total)
        if e * e > GATE * GATE * spread and self._accepted < AGREE:
            if moved and learn:
                self._move(time_us, e, moved)
            self._begin(time_us, total, sigma)  # which of the first is the outlier is not known
            self._accepted = 0
            return 0.0
        if e * e <= GATE * GATE * spread:
            self._accepted += 1
            self._agreed = 0
            self._before = self._level if e * e > GATE * GATE * variance else nan
            known = (
                self._slope < 0.5 * SLOPE * SLOPE
            )  # then after a pause or a motion the sample knows better
            gain = 1.0 - 0.5 * (variance / spread if known else 1.0)
            self._begin(time_us, self._level + gain * e, sigma)
            if time_us - self._mark_us >= SLOPE_US:
                self._learn_slope(time_us)
            self._unrest = self._unrest * self._decay if self._unrest > variance else 0.0
            self._quiet += 1
            return self._unrest
        self._unrest = min(e * e, CLIP * GATE * GATE * spread)
        self._decay = BURST_UNREST if self._quiet < BURST else UNREST
        self._quiet = 0
        self.flags = IMPLAUSIBLE
        if not learn:
            return e * e
        off = total - self._candidate
        if self._agreed and off * off <= GATE * GATE * spread:
            self._agreed += 1
            self._candidate += 0.5 * off
        else:
            self._candidate, self._agreed = total, 1
        if self._agreed == AGREE:
            back = self._candidate - self._before
            if not back * back <= GATE * GATE * spread:  # else the last that was accepted was the outlier
                self._move(time_us, self._candidate - self._level, moved)
            self._begin(time_us, self._candidate, sigma)
            self._agreed = 0
        return e * e

    def _begin(self, time_us: int, level: float, sigma: float) -> None:
        self._level, self._level_us, self._unsteady = level, time_us, False
        self._level_variance = sigma * sigma

    def _learn_noise(self, total: float) -> None:
        """Follow the median of second differences, which neither a jump nor a ramp changes for long."""
        bend = abs(total - 2.0 * self._last + self._last_but_one)
        self._last_but_one, self._last = self._last, total
        if bend == bend:  # noqa: PLR0124 - compiled, quicker than a call
            rising = bend > self._median
            self._run = self._run + (3 if bend > RARE * self._median else 1) if rising == self._rising else 0
            self._rising = rising
            step = STEP ** max(min(max(self._run - PATIENCE, 1), FASTEST), SWIFT // (self._bends + 1))
            self._median *= step if rising else 1.0 / step
            self._variance = INNOVATION * self._median * self._median
            self._bends += 1

    def _learn_slope(self, time_us: int) -> None:
        """Follow the mean square of the rate at which the level changes."""
        seconds = 1e-6 * (time_us - self._mark_us)
        rate = (self._level - self._mark) / seconds
        if rate == rate and seconds < 10e-6 * SLOPE_US:  # noqa: PLR0124 - compiled, quicker than a call
            self._slope += (min(rate * rate, CLIP * self._slope) - self._slope) / MEMORY
            self._slope = max(self._slope, LEAST_SLOPE * LEAST_SLOPE)
        self._mark, self._mark_us = self._level, time_us

    def _move(self, time_us: int, by: float, moved: bool) -> None:
        """Take note that the level has moved `by` nT, which nothing explains."""
        if self._moved * self._moved <= GATE * GATE * max(self._variance, self._floor):
            self._moved_us = time_us  # from here on it is another level
        elif time_us - self._moved_us > LASTING_US:
            away_us = time_us - self._moved_us
            self._until_us = max(self._until_us, time_us + min(away_us, LONG_US))
        self._moved += by
        self._mark = nan
        self._largest = max(self._largest, abs(self._moved), abs(by))
        hold, most = (LONG_US, LONGEST_US) if moved else (HOLD_US, LONG_US)
        self._until_us = max(self._until_us, time_us + min(hold << min(2 * self._jumps, 20), most))
        self._jumps += 1
        if moved:
            self._notify(
                "move", f"field jumps by {by:+.0f} nT as a mass moves: calibration or telemetry wrong"
            )
        else:
            self._notify("jump", f"field jumps by {by:+.0f} nT, which no telemetry explains")

    def _doubt(self, time_us: int) -> float:
        """Return the variance (nT²) that past jumps, and more noise than the calibration's, add."""
        more = 0.0
        variance = max(self._variance, self._floor)
        if self._jumps:
            if self._moved * self._moved > GATE * GATE * variance:
                self.flags |= IMPLAUSIBLE
                more = self._largest * self._largest
            elif time_us < self._until_us:
                more = self._largest * self._largest
            else:
                self._moved = self._largest = 0.0
        if self._known and self._bends >= ENOUGH:
            ratio = (variance / self._floor) ** 0.5
            self._noisy = ratio > NOISY * (0.5 if self._noisy else 1.0 + UNSURE / self._bends)
            if self._noisy:
                more += variance
            if ratio > LOUD * (1.0 + UNSURE / self._bends):
                self._notify("noise", f"noise of {variance**0.5:.0f} nT: sigma is widened")
        return more

    def _notify(self, key: str, text: str) -> None:
        if key not in self._reported:
            self._reported.add(key)
            self.notices.append(text)
