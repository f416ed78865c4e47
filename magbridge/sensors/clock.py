"""Estimate of the times of readings on the host's clock, from device times and times of arrival.

A byte arrives after it was sent: ``arrival = device time + offset + drift + delay``, ``delay >= 0``. Serial
converters and schedulers cause delays of up to many ms, but some readings have a short delay. So the relation
between the two clocks is a straight line below all points (device time, arrival - device time). Each block of
readings gives its lowest point, and a line is fitted to the lowest points of the last blocks. The shortest
delay, a constant, remains as an error of the times.

For an instrument without a clock but with a steady rate, the device time of reading n is ``n * period``. The
slope of the line is then the error of the nominal period. If the configured rate is wrong, the readings
arrive on a straight line with another period, which replaces the nominal period.

Without a clock, a late reading can have two causes: readings before it were lost, or it waited. A loss lasts:
all later readings are late by the same periods. Readings that waited arrive faster than the period. So a loss
is a belief, which the next readings can refute; it is then taken back.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from copy import copy
from itertools import islice
from math import inf, isnan, nan
from typing import Final, NamedTuple

from msgspec.structs import replace

from magbridge.records import MAX_DEVICE_TIME_S, Reading
from magbridge.sensors import Driver

__all__ = ["DeviceClock"]

FIRST_BLOCK_READINGS: Final = 8
"""Number of readings in the first blocks."""
LINE_POINTS: Final = 16
"""Number of lowest points to which the line is fitted."""
SPAN: Final = 4.0
"""Duration to which blocks grow, s, and time for which all points must be late before the line is restarted.
A busy computer may delay all points for a second."""
TOLERANCE: Final = 20_000.0
"""Difference from the line that an arrival may have, µs."""
INITIAL_DELAY_US: Final = 5_000.0
"""Mean delay before the first reading, µs."""
DELAY_OUTLIER: Final = 2.0
"""Multiple of the mean delay to which longer delays are reduced in the mean, because they are not typical."""
MIN_OUTLIER_US: Final = 1_000.0
"""Smallest delay that is reduced, µs."""
WANDER: Final = 0.05
"""Smallest sigma of the slope as a fraction of its prior sigma, because rates change with temperature."""
MARGIN: Final = 0.1
"""Largest error of the line, as a fraction of the period, where late readings differ from missing ones."""
BOUND: Final = 5.0
"""Largest magnitude of the slope, in prior sigmas."""


class Floor:
    """Estimate of the straight line below the points (x, y), with x in s and y in µs.

    `period_us`: time between the points, µs, if they are readings at a steady rate.
    `slope`, `slope_sigma`: slope of the line and its standard deviation, µs/s.
    `delay`: mean height of the points above the line, µs.
    `lowest`: lowest point (x, y) of the last complete block, or of the present one.

    Notes
    -----
    With the lowest points (x_k, y_k) of the blocks, their mean (X, Y), and b_0 the prior mean of the slope::

        b   = b_0 + sum (x_k - X) (y_k - Y - b_0 (x_k - X)) / S,   S = sum (x_k - X)^2 + (s / s_b)^2
        s_b = s / sqrt(S)                                          afterwards

    which is least squares with a Gaussian prior on the slope. The scatter s of the lowest points is the mean
    delay divided by the number of readings in a block, as for exponentially distributed delays.
    """

    def __init__(self, slope_sigma: float, period_us: float = inf) -> None:
        self._prior_sigma = slope_sigma
        self.slope = 0.0
        self.delay = min(INITIAL_DELAY_US, 0.25 * period_us)
        self.restart(0.0, 0.0)

    def restart(self, x: float, y: float) -> None:
        """Start a new line at the point (`x`, `y`), with the present slope as the prior mean of its slope."""
        self._prior = self.slope
        self.slope_sigma = self._prior_sigma
        self._points: list[tuple[float, float]] = []
        self._x, self._y = x, y
        self._drop = 0.0
        self._size = FIRST_BLOCK_READINGS
        self._count = 0
        self._began, self._least, self.lowest = x, inf, (x, y)
        self._late_from = inf

    def value_at(self, x: float) -> float:
        """Return the height of the line at `x`, µs."""
        return self._y + self.slope * (x - self._x) + self._drop

    @property
    def scatter(self) -> float:
        """Standard deviation of the lowest points of blocks, µs."""
        return self.delay / (self._size if self._points else max(self._count, 1)) + 1.0

    def tolerance(self, x: float) -> float:
        """Return the difference from the line (µs) that a point at `x` may have."""
        return TOLERANCE + 3.0 * self.slope_sigma * abs(x - self._x)

    def add(self, x: float, y: float, above: float, limit: float) -> float:
        """Add the point (`x`, `y`), `above` µs above the line; fit the line after each complete block.

        If the lowest points of all blocks were more than `limit` (µs) above the line for `SPAN`, return the
        height of the last one. Otherwise return 0. Blocks above `limit` do not enter the fit.
        """
        if not self._count:
            self._began, self._least = x, inf
        self.note(above)
        if above < self._least:
            self._least, self.lowest = max(above, 0.0), (x, y)
            self._drop += min(above, 0.0)
        self._count += 1
        if self._count < self._size:
            return 0.0
        self._count = 0
        if self._least > limit:
            self._late_from = min(self._late_from, self._began)
            return self._least if x - self._late_from >= SPAN else 0.0
        self._late_from = inf
        self._points = [*self._points, self.lowest]  # a copy of the line keeps its own list
        if len(self._points) == LINE_POINTS:
            self._thin(x - self._began)
        self._fit()
        return 0.0

    def note(self, above: float) -> None:
        """Add the height of a point above the line, µs, to the mean delay only."""
        outlier = max(DELAY_OUTLIER * self.delay, MIN_OUTLIER_US)
        self.delay += (max(0.0, min(above, outlier)) - self.delay) * 0.02

    def _thin(self, duration: float) -> None:
        """Join blocks in pairs if the last lasted less than `SPAN` (`duration`, s); else drop the oldest."""
        if duration >= SPAN:
            self._points = self._points[1:]
            return
        self._size *= 2
        pairs = zip(self._points[::2], self._points[1::2], strict=True)
        self._points = [min(pair, key=lambda point: point[1] - self.slope * point[0]) for pair in pairs]

    def _fit(self) -> None:
        points = self._points
        x = y = sxx = sxy = 0.0
        for x_k, y_k in points:  # not by sum(), whose rounding differs between Python versions and compilers
            x += x_k
            y += y_k
        x, y = x / len(points), y / len(points)
        for x_k, y_k in points:
            sxx += (x_k - x) ** 2
            sxy += (x_k - x) * (y_k - y)
        information = sxx + (self.scatter / self._prior_sigma) ** 2
        slope = self._prior + (sxy - self._prior * sxx) / information
        self.slope = max(-BOUND * self._prior_sigma, min(slope, BOUND * self._prior_sigma))
        self.slope_sigma = max(self.scatter / information**0.5, WANDER * self._prior_sigma)
        self._x, self._y, self._drop = x, y, 0.0


PERIOD_ERROR: Final = 0.03
"""Smallest relative error of a nominal period that replaces it."""
MEASURED_READINGS: Final = (16, 64, 256)
"""Numbers of the last readings from which the period is measured; more readings allow more jitter."""
MIN_MEASURED_US: Final = 500_000
"""Shortest time over which the period is measured, µs; readings that waited arrive within a shorter time."""
OUTLIERS: Final = 10
"""Reciprocal of the fraction of the highest residuals, and of the lowest, that do not count as scatter."""
MAX_SCATTER: Final = 0.3
"""Largest scatter of the times about a straight line, as a fraction of the period; a lost reading causes a
step of a whole period. Delays up to `TOLERANCE` are allowed in any case."""
MAX_RELATIVE_SCATTER: Final = 0.05
"""Largest scatter as a fraction of the difference between the measured and the nominal time."""


class MeasuredPeriod(NamedTuple):
    """Period of an instrument's readings, from the straight line of their times."""

    period_us: float
    """Measured period, µs."""
    time_us: float
    """Time of the last reading on the line through the earliest times, µs."""
    invented: int
    """Number of readings that were counted as missing because of the wrong period."""


class PeriodMeter:
    """Measurement of the period of readings that contradict their nominal period.

    Times (t) of the readings of a slower or faster instrument are a straight line over their number (n).
    Lost readings cause steps of whole periods, so that the times leave the line. So losses differ from a
    slower instrument, unless each second reading is lost.
    """

    def __init__(self) -> None:
        self._number = self._added = 0
        self._late_us = 0.0
        self._points: deque[tuple[int, float, float, int]] = deque(maxlen=MEASURED_READINGS[-1])

    def skip(self, readings: int) -> None:
        """Count `readings` without a known time."""
        self._number += readings

    def add(self, time_us: float, unseen: int, period_us: float) -> MeasuredPeriod | None:
        """Add the time of the last counted reading; return its period if it contradicts `period_us`.

        `unseen`: number of readings so far that count as missing by the nominal period.
        """
        if self._points:
            number, last_us, _, _ = self._points[-1]
            self._late_us = max(self._late_us + time_us - last_us - (self._number - number) * period_us, 0.0)
        self._points.append((self._number, time_us, self._late_us, unseen))
        self._added += 1
        for size in MEASURED_READINGS:
            if self._added % (size // 2) == 0 and len(self._points) >= size:
                measured = self._measure(size, period_us)
                if measured is not None:
                    self._late_us = 0.0
                    return measured
        return None

    def _measure(self, size: int, period_us: float) -> MeasuredPeriod | None:
        points = list(islice(self._points, len(self._points) - size, None))
        first, begin_us, late_us, unseen = points[0]
        last, end_us, _, all_unseen = points[-1]
        if end_us - begin_us < MIN_MEASURED_US or last == first:
            return None
        n = t = snn = snt = 0.0
        for number, time_us, _, _ in points:
            n += (number - first) / size
            t += (time_us - begin_us) / size
        for number, time_us, _, _ in points:
            snn += (number - first - n) ** 2
            snt += (number - first - n) * (time_us - begin_us - t)
        slope_us = snt / snn
        residuals = sorted(
            time_us - begin_us - slope_us * (number - first) for number, time_us, _, _ in points
        )
        scatter = residuals[-1 - size // OUTLIERS] - residuals[size // OUTLIERS]
        difference = (slope_us - period_us) * (last - first)
        allowed = MAX_RELATIVE_SCATTER * abs(difference)
        # after a pause of the line, readings that waited also arrive at short intervals
        waited = difference < 0.0 and late_us > allowed
        steady = scatter <= min(allowed, max(MAX_SCATTER * period_us, TOLERANCE))
        if waited or not steady or abs(slope_us - period_us) <= PERIOD_ERROR * period_us:
            return None
        line_us = begin_us + slope_us * (last - first) + residuals[0]
        return MeasuredPeriod(slope_us, line_us, all_unseen - unseen)


SIGMA_CLOCK: Final = 1e3
SIGMA_PERIOD: Final = 1e4
"""Prior standard deviations of a clock's rate and of a nominal period, µs/s (ppm)."""
RESTART: Final = 1e6
"""Difference from the host's time, µs, up to which a device time that went back counts as wrapped. Beyond it,
the instrument was restarted."""
HALF: Final = 0.6
"""Delay of a reading, as a fraction of the period, beyond which an earlier reading is missing."""
BASELINE: Final = 1 << 16
"""Number of readings after which the mean interval between readings is computed again."""
MIN_INTERVAL_READINGS: Final = 16
"""Smallest number of readings for a new mean interval to replace the previous one."""
KEEP_PHASE: Final = 3
"""Most missing readings in a row without a restart of the line; beyond, the instrument may have stopped."""


USUAL: Final = 5.0
"""Multiple of the mean delay up to which a delay is usual."""
CERTAIN_DELAYS: Final = 15.0
"""Multiple of the mean delay at which late readings are a loss: their smallest delay times their number. With
exponential delays, that many readings wait that long with a probability of e^-12."""
MIN_USUAL_US: Final = 6_000.0
"""Smallest delay that is not usual, µs; a busy computer may delay a reading for some ms."""
RUN: Final = 32
"""Most late readings from which a loss is believed; more would include the next loss."""
DOUBT: Final = 16
"""Number of beliefs that can be refuted, and number of periods for which each can be."""


class Belief(NamedTuple):
    """Loss of readings that later readings may refute, and the state before it."""

    beats: int
    """Number of readings that are believed to be lost."""
    arrival_us: int
    """Arrival of the reading after the loss, µs."""
    floor: Floor
    least: float
    """Smallest delay of the late readings without the loss, µs."""
    out_us: int
    """Time of the last reading before the late one, µs."""


class DeviceClock:
    """Estimator of the times of an instrument's readings on the host's clock.

    `time_modulo`: time at which the instrument's clock wraps to 0, s; 0 if it never wraps.
    `sequence_modulo`: value at which the instrument's count of readings wraps to 0; 0 if it never wraps.
    `period`: time between the readings of an instrument without a clock, s; 0 if not steady, so that each
        reading gets the time of its arrival. A measured period replaces one that the readings contradict.
    `invented`: number of readings that were reported as missing because the period was wrong, or because
        later ones waited.
    `stepped`: True if one of the two clocks was set before the last reading, so that the relation between
        the clocks is estimated again, or if a loss was taken back. The time may then be before the last one.
    """

    def __init__(self, *, time_modulo: float = 0.0, sequence_modulo: int = 0, period: float = 0.0) -> None:
        self._time_modulo = time_modulo
        self._sequence_modulo = sequence_modulo
        self._period = period
        self._meter = PeriodMeter()
        self._unseen = self.invented = 0
        self._floor = Floor(SIGMA_PERIOD, 1e6 * period) if period else Floor(SIGMA_CLOCK)
        self._sequence: int | None = None
        self._since_us = self._readings = 0
        self._interval_us = 0.0
        self._origin_us: int | None = None
        self._zero = self._turned = self._device_time = 0.0
        self._count = 0
        self._beliefs: deque[Belief] = deque(maxlen=DOUBT)
        self._late: list[float] = []
        self._least = inf
        self._arrival_us = self._received_us = self._out_us = 0
        self.stepped = False

    @classmethod
    def for_driver(cls, driver: Driver) -> DeviceClock:
        """Return a clock with the settings of a driver."""
        return cls(
            time_modulo=driver.time_modulo, sequence_modulo=driver.sequence_modulo, period=driver.period
        )

    @property
    def drift_ppm(self) -> float:
        """Rate of the host's clock minus the instrument's, µs/s."""
        return self._floor.slope

    @property
    def _limit_us(self) -> float:
        """Return how far a reading may be below the line, µs, at a steady rate."""
        return max(HALF * 1e6 * self._period, TOLERANCE)

    @property
    def rate(self) -> float:
        """Rate of the readings by their period, which was configured or measured, Hz; 0 if not steady."""
        return 1.0 / self._period if self._period else 0.0

    def stamp(self, readings: Sequence[Reading], arrival_us: int) -> list[Reading]:
        """Return the readings of one chunk, which arrived at `arrival_us` (µs), with their host times.

        The times increase, except after a step of a clock. With a steady rate, no time is later than the
        arrival, except for steps of 4 µs between readings of one time. Only the last reading updates the
        line, because the earlier readings waited for the last one. Readings that queued up during a stall of
        the host may come in several chunks; only the last chunk then ends with a reading without delay.
        """
        last = len(readings) - 1
        stamped = []
        for index, reading in enumerate(readings):
            waited = 0.0
            if index < last:
                waited = readings[last].device_time - reading.device_time
                if isnan(waited):
                    waited = (last - index) * self._period
                elif not 0.0 <= waited < 60.0:  # a restart or a wrap between the two readings
                    waited = 0.0
            stamped.append(self.update(reading, arrival_us, int(waited * 1e6) if index < last else None))
        return stamped

    def update(self, reading: Reading, arrival_us: int, waited_us: int | None = None) -> Reading:
        """Return a reading with its time on the host's clock.

        `arrival_us`: time of arrival on the host's clock, µs.
        `waited_us`: time for which the reading waited for a later one, µs. None: it did not wait, so that it
            updates the relation between the clocks.
        """
        limit_us, arrival_us, informative = arrival_us, arrival_us - (waited_us or 0), waited_us is None
        device_time, sequence, self._received_us = reading.device_time, reading.sequence, limit_us
        if not abs(device_time) < MAX_DEVICE_TIME_S:
            device_time = nan
        timed = not isnan(device_time)
        missing = self._missing(sequence, arrival_us)
        restarted = stepped = False
        since_us = 0.0
        if self._origin_us is None or timed == isnan(self._device_time):
            stepped = self._origin_us is not None
            self._begin(device_time, arrival_us)
            time_us = float(arrival_us)
        elif timed:
            if sequence is None and self._period:  # a nominal rate but no sequence number
                missing = self._missing_by_time(device_time)
            time_us, restarted, stepped = self._by_time(device_time, arrival_us, self._origin_us, informative)
        elif self._period:
            time_us, since_us, stepped, unseen = self._by_count(
                arrival_us, self._origin_us, missing, informative
            )
            missing += unseen
            time_us = min(time_us, limit_us)
        else:
            time_us = float(arrival_us)
        self._arrival_us, self._device_time = arrival_us, device_time
        out_us = int(time_us) & ~3
        # a restart of the line alone must not decrease the times: only a step of the host's clock leaves the
        # last time in the future
        if out_us <= self._out_us and not (stepped and self._out_us > limit_us + TOLERANCE):
            out_us = self._out_us + 4
        self._out_us, self.stepped = out_us, stepped
        missing = 0 if restarted else missing
        since = min(int(since_us), out_us)
        return replace(reading, time_us=out_us, missing=missing, restarted=restarted, since_us=since)

    def _missing(self, sequence: int | None, arrival_us: int) -> int:
        """Return the number of readings missing before the one with number `sequence`.

        The number may have wrapped several times since the last reading. So multiples of its modulo are added
        until the count fits the elapsed time divided by the mean interval of the readings. The result is
        correct if the error of this quotient is less than half the modulo.
        """
        last, self._sequence = self._sequence, sequence
        if sequence is None or last is None:
            self._since_us, self._readings = arrival_us, 0
            return 0
        hole, modulo = sequence - last - 1, self._sequence_modulo
        if hole == 0 and self._readings < BASELINE:
            self._readings += 1
            return 0
        if self._readings >= MIN_INTERVAL_READINGS or (self._readings and not self._interval_us):
            self._interval_us = (self._arrival_us - self._since_us) / self._readings
        if hole and modulo:
            hole %= modulo
            if self._interval_us > 0.0:
                expected = (arrival_us - self._arrival_us) / self._interval_us - 1.0
                hole += max(round((expected - hole) / modulo), -1) * modulo
            elif hole > modulo // 2:
                hole = 0
        self._since_us, self._readings = arrival_us, 0
        return max(hole, 0)

    def _missing_by_time(self, device_time: float) -> int:
        """Return the number of readings missing before the one with a device time, by the period."""
        self._meter.skip(1)
        measured = self._meter.add(1e6 * device_time, self._unseen, 1e6 * self._period)
        # a period that is longer by less than half causes no false losses
        if measured is not None and measured.period_us > 1.5e6 * self._period:
            self._period = measured.period_us * 1e-6
            self.invented += measured.invented
        missing = max(round((device_time - self._device_time) / self._period) - 1, 0)
        self._unseen += missing
        return missing

    def _begin(self, device_time: float, arrival_us: int) -> None:
        """Restart the estimate of the relation between the clocks from a reading."""
        self._origin_us = arrival_us
        self._zero, self._turned, self._count = device_time, 0.0, 0
        self._beliefs.clear()
        self._late, self._least = [], inf
        self._floor.restart(0.0, 0.0)

    def _by_time(
        self, device_time: float, arrival_us: int, origin_us: int, informative: bool
    ) -> tuple[float, bool, bool]:
        """Return the host time (µs) of a device time, and two flags: the clock restarted, a clock was set."""
        step = device_time - self._device_time
        if self._time_modulo:
            turns = round(((arrival_us - self._arrival_us) * 1e-6 - step) / self._time_modulo)
            step += turns * self._time_modulo
            self._turned += turns * self._time_modulo
        floor = self._floor
        x = device_time + self._turned - self._zero
        elapsed_us = 1e6 * x
        y = arrival_us - origin_us - elapsed_us
        above = y - floor.value_at(x)
        fell_back = device_time < 0.5 * self._device_time
        restarted = fell_back and (step < 0.0 or abs(above) > RESTART)
        tolerance = floor.tolerance(x)
        if restarted or step < 0.0 or above < -tolerance:
            self._begin(device_time, arrival_us)
            return float(arrival_us), restarted, not restarted
        late = floor.add(x, y, above, tolerance) if informative else 0.0
        if late:
            floor.restart(*floor.lowest)
        return origin_us + elapsed_us + floor.value_at(x), False, late > 0.0

    def _by_count(
        self, arrival_us: int, origin_us: int, missing: int, informative: bool
    ) -> tuple[float, float, bool, int]:
        """Return the host time (µs) by the count of readings, and its lower bound (µs) if it is uncertain.

        Also return True if the time stepped back, and the number of missing readings in addition to
        `missing`, the number by sequence numbers. The lower bound is 0 if the time is certain.
        """
        period_us = 1e6 * self._period
        self._count += 1 + missing
        self._meter.skip(1 + missing)
        if informative and (measured := self._meter.add(arrival_us, self._unseen, period_us)):
            self._period, self._floor = measured.period_us * 1e-6, Floor(SIGMA_PERIOD, measured.period_us)
            self._begin(nan, int(measured.time_us))
            self.invented += measured.invented
            return measured.time_us, 0.0, False, 0
        taken_back = self._take_back(arrival_us, origin_us)
        floor, x = self._floor, self._count * self._period
        y = arrival_us - origin_us - 1e6 * x
        value_us = floor.value_at(x)
        above, since_us, late = y - value_us, 0.0, 0.0
        # no reading is sent after its arrival, so a reading late by less than a period proves no loss; the
        # margin covers the scatter of the line and its error since the last reading, because each reading
        # below the line lowers the line
        slope_error = 3.0 * floor.slope_sigma * self._period * (1 + missing)
        margin = min(8.0 * floor.scatter + slope_error, MARGIN * period_us)
        beats = int((above + margin) // period_us)
        if beats > 0:
            if above > max(USUAL * floor.delay, MIN_USUAL_US):
                since_us = origin_us + 1e6 * x + value_us
            usual = above <= USUAL * floor.delay and floor.delay > HALF * period_us
            beats = self._lost(above, margin, informative)
            if usual and informative and not beats:  # the jitter is longer than the period
                late = floor.add(x, y, above, HALF * period_us + 20.0 * floor.scatter)
                beats = round(late / period_us)
        elif above >= -self._limit_us:
            if self._beliefs and above < -MARGIN * period_us:
                since_us = origin_us + 1e6 * x + value_us - self._beliefs[-1].beats * period_us
            if informative:
                self._waited()
                late = floor.add(x, y, above, HALF * period_us + 20.0 * floor.scatter)
            beats = round(late / period_us)
        if beats:
            self._count += beats
            x += beats * self._period
            y -= beats * period_us
            if not 0 < beats <= KEEP_PHASE:
                floor.restart(x, y)
        self._unseen += max(beats, 0)
        return origin_us + 1e6 * x + floor.value_at(x), since_us, taken_back or beats < 0, max(beats, 0)

    def _waited(self) -> None:
        """Count the delays of late readings as usual, because the reading after them is in time."""
        for above in self._late:
            self._floor.note(above)
        self._late, self._least = [], inf

    def _lost(self, above: float, margin: float, informative: bool) -> int:
        """Return the number of lost readings to believe in after a reading `above` (µs) the line.

        Readings that waited arrive faster than the period, each less late than the one before. So a reading
        counts only if it is not less late than all before it. If delays are longer than the period, the
        readings after a late one must wait for it, and their number proves less.
        """
        period_us, floor = 1e6 * self._period, self._floor
        if self._least == inf or len(self._late) == RUN:
            self._late, self._least = [above], above
        elif informative:
            self._late = [*self._late, above] if above > self._least - MARGIN * period_us else []
            self._least = min(self._least, above)
        usual = max(floor.delay, MIN_USUAL_US / USUAL) * max(1.0, 2.0 * floor.delay / period_us)
        if len(self._late) * self._least < CERTAIN_DELAYS * usual:
            return 0
        beats = int((self._least + margin) // period_us)
        self._beliefs.append(Belief(beats, self._received_us, copy(floor), self._least, self._out_us))
        self._late, self._least = [], inf
        return beats

    def _take_back(self, arrival_us: int, origin_us: int) -> bool:
        """Take back the losses that a reading refutes; return True if there were any.

        With the loss, the reading would have been sent after its arrival. Also the line is as before it.
        """
        count, period_us = self._count, 1e6 * self._period
        while self._beliefs:
            beats, believed_us, floor, least, out_us = self._beliefs[-1]
            x = self._count * self._period
            y = arrival_us - origin_us - 1e6 * x
            error = MARGIN * period_us + min(8.0 * floor.scatter, HALF * period_us)
            error += 3.0 * floor.slope_sigma * beats * self._period
            if y >= floor.value_at(x) - error and y >= self._floor.value_at(x) - self._limit_us:
                break
            if self._received_us - believed_us > DOUBT * period_us:
                self._beliefs.clear()
                break
            self._beliefs.pop()
            self._floor, self._late, self._least, self._out_us = floor, [], least, out_us
            self._count -= beats
            self._unseen -= beats
            self.invented += beats
        return self._count < count
