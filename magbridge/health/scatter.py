r"""Estimate the noise of the total field at several lags, beyond variations that the crustal field can cause.

A jump or a ramp hardly changes the median of the second differences
:math:`F(t) - 2 F(t - T) + F(t - 2T)`. At a lag T of one sample, it measures white noise. A disturbance of
the period P adds :math:`4 \sin^2(\pi T / P)` times its amplitude: 0.4 times at T = P/10, 3 times at
T = P/3. The crustal field limits T: a wave of length L, passed at the speed v, adds
:math:`(2 \pi v T / L)^2` times its amplitude. The factor is 2 % if v T is :data:`TRAVEL_M` and L is 500 m.
The estimate subtracts this part. (The Allan variance, too, measures the noise at each interval: Allan 1966,
*Statistics of atomic frequency standards*, Proc. IEEE 54:221.)

The calibration's noise model (a white fraction w, the rest an AR(1) process of autocorrelation
:math:`\rho(T)`) has second differences of variance

.. math:: V(T) = \sigma^2 \left( 6 w + (1 - w)(6 - 8 \rho(T) + 2 \rho(2T)) \right)

The largest ratio of the measured variance to V(T) is the factor by which the variance of the whole noise,
including its slow part, has grown. The samples' variance grows accordingly.
"""

from __future__ import annotations

from math import nan, sqrt
from typing import Final

from magbridge.calibration.model import Noise
from magbridge.field.geodesy import separation
from magbridge.health.checks import Messages
from magbridge.records import NEVER

MIN_NOISE_NT: Final = 0.1
"""Lower bound of the sensor noise, nT, 1-sigma: no fluxgate has less."""
MEDIAN_FACTOR: Final = 1.02
"""Factor of one step by which a sample moves the estimated median of the second differences."""
RUN_SAMPLES: Final = 6
MAX_STEPS: Final = 12
"""Number of consecutive samples on one side of the median before a sample moves it by several steps, and the
largest number of steps. Twentyfold noise is then learned in half the samples, without more false alarms."""
RARE_RATIO: Final = 4.0
"""Ratio to the median above which a difference counts as three samples: one in 140 of white noise."""
START_STEPS: Final = 60
"""Smallest number of steps by which the n-th sample moves the median, times n, for a fast start."""
MIN_COUNT: Final = 5
UNCERTAINTY: Final = 4.0
"""Number of second differences from which their median is used. After n of them, the tolerance for its error
is the factor 1 + UNCERTAINTY / n."""
MEDIAN_TO_SIGMA: Final = 1.0 / 0.6745
"""Ratio of 1-sigma to the median absolute value of a normal variable."""
SECOND_DIFFERENCE: Final = 6.0
"""Ratio of the variance of white noise's second differences to the variance of the noise."""
INNOVATION: Final = 4.0 / 3.0
"""Ratio of the innovation variance of a level filter with gain 1/2 to the variance of its white noise."""
FLOOR: Final = 1.125
"""Smallest variance of an innovation, as a multiple of the noise model's."""
MAX_QUIET_RATIO: Final = 2.5
"""Ratio of the measured noise to the calibration's above which sigma is widened; half this ratio ends it."""
REPORTED_RATIO: Final = 5.0
"""Ratio above which the operator receives a message."""
SCATTER_LAGS: Final = (1, 2, 4, 8)
STORED: Final = 2 * SCATTER_LAGS[-1] + 1
"""Lags, in eighths of the longest lag, and number of samples stored for them."""
TRAVEL_M: Final = 12.0
"""Largest distance that the vehicle may cover within a lag, m."""
CRUST_NT: Final = 2.2
"""Median second difference of a crustal field of 145 nT and 500 m wavelength over TRAVEL_M, nT."""
MAX_LAG_US: Final = 32_000_000
"""Longest lag, µs: it limits the effect of the field's variations with time on a vehicle at rest."""
FIRST_INTERVAL_US: Final = 8_000_000
SPEED_INTERVAL_US: Final = 60_000_000
"""Shortest times over which the first and each later speed is measured, µs."""
SPEED_CHECK_US: Final = 500_000
ACCELERATION: Final = 2.0
MIN_FASTER_M: Final = 20.0
MIN_FASTER_M_S: Final = 2.0
"""Interval (µs) of checks for a higher speed, such as at take-off, and the conditions to adopt it at
once: growth by this factor, over this distance (m) and above this speed (m/s)."""


class MedianDifference:
    """Running median of the absolute second differences at one lag, nT."""

    __slots__ = ("count", "is_rising", "median", "run")

    def __init__(self) -> None:
        self.median = 0.0
        self.count = 0
        self.run, self.is_rising = 0, False  # consecutive samples on one side of the median

    def update(self, difference: float) -> None:
        """Update the median with the absolute value of a second difference, nT."""
        # stochastic approximation of the median: equal steps up and down in its logarithm
        rising = difference > self.median
        weight = 3 if difference > RARE_RATIO * self.median else 1
        self.run = self.run + weight if rising == self.is_rising else 0
        self.is_rising = rising
        steps = max(min(max(self.run - RUN_SAMPLES, 1), MAX_STEPS), START_STEPS // (self.count + 1))
        self.median *= MEDIAN_FACTOR**steps if rising else MEDIAN_FACTOR**-steps
        self.count += 1

    @property
    def variance(self) -> float:
        """Variance of the second differences, nT²."""
        sigma = MEDIAN_TO_SIGMA * self.median
        return sigma * sigma


class Scatter:
    """Estimator of the total field's noise, and of its excess over the calibration's noise model.

    `variance` is the variance of an innovation from one sample to the next (nT²), at least that of the noise
    model. `speed` is the vehicle's speed (m/s; NaN while unknown).
    """

    def __init__(self, noise: Noise, messages: Messages) -> None:
        self._messages, self._noise = messages, noise
        self._is_known = noise.sensor > 0.0
        self._sigma2 = max(noise.sensor, MIN_NOISE_NT) ** 2
        self.floor = FLOOR * INNOVATION * self._sigma2
        self.variance = self.floor
        self.speed = nan
        self._next = MedianDifference()  # from sample to sample
        self._last = self._last_but_one = nan
        self._last_us = self._step_us = 0
        self._lagged = tuple(MedianDifference() for _ in SCATTER_LAGS)
        self._fields, self._times = [nan] * STORED, [0] * STORED
        self._place = 0
        self._ratio = 0.0  # of the lagged differences' variance to the model's
        self._is_noisy = False
        self._max_lag_us = 0  # none while the speed is not known
        self._latitude = self._longitude = nan
        self._position_us = self._checked_us = NEVER
        self._faster = 0  # positions in a row that show a higher speed

    def begin(self, variance: float) -> None:
        """Initialise the estimates from the variance of an innovation, nT²."""
        self.variance = variance
        median = (variance / INNOVATION * SECOND_DIFFERENCE) ** 0.5 / MEDIAN_TO_SIGMA
        for differences in (self._next, *self._lagged):
            differences.median = median

    @property
    def white_sigma(self) -> float:
        """Measured 1-sigma of the white noise, nT."""
        return sqrt(self._next.variance / SECOND_DIFFERENCE)

    def _expected(self, lag_us: int) -> float:
        """Return the variance V(T) of second differences by the noise model at the lag `lag_us`, nT²."""
        noise = self._noise
        white = noise.white if noise.autocorrelation > 0.0 and noise.interval > 0.0 else 1.0
        slow = 0.0
        if white < 1.0:
            # slow part of V(T): an AR(1) process
            rho = noise.autocorrelation ** (1e-6 * lag_us / noise.interval)
            slow = 6.0 - 8.0 * rho + 2.0 * rho * rho
        # V(T) of the module
        variance = self._sigma2 * (SECOND_DIFFERENCE * white + (1.0 - white) * slow)
        return float(max(variance, SECOND_DIFFERENCE * MIN_NOISE_NT**2))

    def set_position(self, time_us: int, latitude: float, longitude: float) -> bool:
        """Record the position (deg); return True if it gave a new speed, which limits the lags."""
        if 0 <= time_us - self._checked_us < SPEED_CHECK_US:
            return False
        self._checked_us = time_us
        if latitude == self._latitude and longitude == self._longitude:
            return False
        north, east = separation(self._latitude, self._longitude, latitude, longitude)
        step_us = time_us - self._position_us
        distance = (north * north + east * east) ** 0.5
        # a clock that goes back gives no speed
        speed = distance / (1e-6 * step_us) if step_us > 0 else nan
        faster = max(ACCELERATION * self.speed, MIN_FASTER_M_S)  # NaN while no speed is known
        is_faster = speed > faster and distance > MIN_FASTER_M
        interval_us = SPEED_INTERVAL_US if self.speed == self.speed else FIRST_INTERVAL_US
        if 0 <= step_us < interval_us and not is_faster:
            return False
        self._latitude, self._longitude, self._position_us = latitude, longitude, time_us
        if speed != speed:  # noqa: PLR0124 - faster than a call
            return False
        # two positions confirm a higher speed; a single one may be a jump of the position
        self._faster = self._faster + 1 if is_faster else 0
        if self._faster == 1:
            return False
        if is_faster:
            # the lags of the lower speed would measure the crustal field
            self._lagged = tuple(MedianDifference() for _ in SCATTER_LAGS)
            self.begin(self.variance)
        self.speed = speed
        self._max_lag_us = round(1e6 * min(TRAVEL_M / max(speed, 1e-3), 1e-6 * MAX_LAG_US))
        return True

    def follow(self, time_us: int, total: float) -> None:
        """Update the noise estimates with a sample's total field, nT."""
        difference = abs(total - 2.0 * self._last + self._last_but_one)
        self._last_but_one, self._last = self._last, total
        if difference == difference:  # noqa: PLR0124 - faster than a call
            self._next.update(difference)
            step_us = time_us - self._last_us
            if step_us != self._step_us and step_us > 0:
                self._step_us = step_us
                self.floor = FLOOR * INNOVATION / SECOND_DIFFERENCE * self._expected(step_us)
            self.variance = max(INNOVATION / SECOND_DIFFERENCE * self._next.variance, self.floor)
        if self._max_lag_us and not 0 <= time_us - self._times[self._place] < self._max_lag_us * 3 // 32:
            self._store(time_us, total)
        self._last_us = time_us

    def _store(self, time_us: int, total: float) -> None:
        """Store a sample, and update the medians with the second differences that end at it."""
        # ring buffer with eight samples in the longest lag
        self._place = place = (self._place + 1) % STORED
        self._fields[place], self._times[place] = total, time_us
        self._ratio = 0.0
        for lag, differences in zip(SCATTER_LAGS, self._lagged, strict=True):
            middle, first = (place - lag) % STORED, (place - 2 * lag) % STORED
            late_us = time_us - self._times[middle]
            early_us = self._times[middle] - self._times[first]
            # only lags that the speed allows, and differences of equal intervals
            if late_us > self._max_lag_us:
                continue
            if abs(late_us - early_us) * 8 <= late_us:
                difference = abs(total - 2.0 * self._fields[middle] + self._fields[first])
                if difference == difference:  # noqa: PLR0124 - faster than a call
                    differences.update(difference)
            # excess over what a crustal field makes at this lag, relative to the noise model
            if differences.count >= MIN_COUNT:
                certain = 1.0 + UNCERTAINTY / differences.count
                crust = (MEDIAN_TO_SIGMA * CRUST_NT * (lag / SCATTER_LAGS[-1]) ** 2) ** 2
                excess = differences.variance / certain**2 - crust
                self._ratio = max(self._ratio, excess / self._expected(late_us))

    def explain(self, difference: float) -> None:
        """Shift the stored total fields by `difference` (nT), the effect of a new calibration."""
        self._last += difference
        self._last_but_one += difference
        self._fields = [field + difference for field in self._fields]

    def excess(self) -> float:
        """Return the variance (nT²) to add for noise above the calibration's, or 0 if there is none."""
        if not self._is_known or self._next.count < MIN_COUNT:
            return 0.0
        # the factor by which the whole noise has grown, with a hysteresis of two
        squared = max(self.variance / self.floor, self._ratio)
        ratio = squared**0.5
        certain = 1.0 + UNCERTAINTY / self._next.count
        self._is_noisy = ratio > MAX_QUIET_RATIO * (0.5 if self._is_noisy else certain)
        if not self._is_noisy:
            return 0.0
        variance = max(INNOVATION * squared * self._sigma2, self.variance)
        if ratio > REPORTED_RATIO * certain:
            self._messages.report("noise", f"noise of {variance**0.5:.0f} nT: sigma is widened")
        return variance
