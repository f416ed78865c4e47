"""Resample the three channels and the telemetry to one common time, using past data only.

A multiplexed converter samples one channel after the other; the aligner interpolates all channels to the time
of the earliest (:mod:`magbridge.one_time`). The anti-alias filter delays the field by ``filter_delay``. The
aligner subtracts this delay from the sample's time, and evaluates the telemetry at the corrected time.

If the process stalls, readings and telemetry wait in buffers. An input with a time stamp (of the instrument,
or of the autopilot by TIMESYNC) keeps its time. Any other input may have been measured at any time during the
stall. A sample with an input of unknown time is flagged ``late_join``, and its sigma covers all values that
the parameters had during the stall. The flag also marks a reading that may have waited.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from math import inf, isfinite, isnan, nan
from typing import Final, NamedTuple

import msgspec

from magbridge.config import Align
from magbridge.one_time import OneTime
from magbridge.records import NEVER, Quality, Reading, Vector

__all__ = ["Aligner", "Input", "Sample", "Track"]


TRACK_LENGTH: Final = 1024
"""Number of telemetry values that are stored for each parameter: enough for 20 s at 50 Hz."""
MOTION_US: Final = 1_000_000
"""Time over which the change of a parameter decides whether it is moving, µs."""


class Input(NamedTuple):
    """Parameter that the calibration needs: name, calibrated range, and age (s) from which it is stale.

    `is_mass` is False for a parameter that is not the position of a mass, such as a current or temperature.
    """

    name: str
    low: float
    high: float
    max_age: float
    is_mass: bool = True


class Track:
    """Recent telemetry of one parameter.

    The parameter is moving if the last value differs from that of 1 s before by more than ``moving_rate``, a
    fraction of the calibrated range per second. The noise of the telemetry would look like motion over
    shorter times. Values at longer intervals are interpolated.

    From one value to the next, a moving parameter lies between the two. If the next value is late, its bounds
    grow by `rate`, the rate of the last value, up to the calibrated range.
    """

    __slots__ = (
        "before", "began_us", "first_us", "guess", "guess_us", "history", "input", "lacking", "last",
        "last_us", "max_age", "moved_us", "rate", "recent", "reported_before_us",
    )  # fmt: skip

    def __init__(self, quantity: Input) -> None:
        self.input, self.max_age = quantity, quantity.max_age
        self.history: deque[tuple[int, float]] = deque(maxlen=TRACK_LENGTH)
        self.last_us, self.last, self.before = NEVER, nan, nan  # the newest, and the value before it
        self.first_us = NEVER
        self.reported_before_us = NEVER  # time of the report before the last one
        # interval of times (µs) with values of unknown time, and interval of these values
        self.guess_us, self.guess = (NEVER, NEVER), (nan, nan)
        self.lacking = True
        self.recent: deque[tuple[int, float]] = deque()  # the last second, and the value before it
        self.began_us = self.moved_us = NEVER
        self.rate = 0.0  # magnitude, per second, if moving

    def update(self, time_us: int, value: float, moving_rate: float, since_us: int = 0) -> None:
        """Add a value measured at `time_us`, µs; ignore a value that is older than the last one.

        NaN means that the value is unknown from now on.

        If `since_us` is not 0, the value was measured at an unknown time between `since_us` and `time_us`.
        """
        self.lacking = not isfinite(value)
        if self.lacking:
            return
        if time_us < self.last_us:
            return
        if since_us:
            low, high = self.guess if self.guess_us[0] == since_us else (self.last, self.last)
            self.guess_us = since_us, time_us
            self.guess = (min(low, value), max(high, value)) if isfinite(low) else (value, value)
        if time_us == self.last_us:  # of several values at one time, keep the newest
            self.history.pop()
            self.recent.pop()
        else:
            self.before = self.last if self.history else value
        self.last_us, self.last = time_us, value
        newest = time_us, value
        self.history.append(newest)
        self.first_us = self.history[0][0]
        self.reported_before_us = self.history[-2][0] if len(self.history) > 1 else time_us
        recent, past_us = self.recent, time_us - MOTION_US
        recent.append(newest)
        while len(recent) > 1 and recent[1][0] <= past_us:
            recent.popleft()
        # value at past_us, interpolated; the first value if all are newer
        then_us, past = recent[0]
        if then_us < past_us:
            after_us, after = recent[1]
            past += (past_us - then_us) / (after_us - then_us) * (after - past)
        change, what = abs(value - past), self.input
        if change > moving_rate * (what.high - what.low):
            before_us = self.reported_before_us
            if self.moved_us < before_us:
                self.began_us = before_us  # the previous value was at rest
            self.moved_us = time_us
            # a motion that began within the second has made all of the change since then
            self.rate = change / min((time_us - self.began_us) * 1e-6, 1.0)

    def stale(self, time_us: int) -> bool:
        """Return True if the value is unknown, or older than ``max_age``, at `time_us`."""
        return self.lacking or time_us - self.last_us > self.max_age * 1e6

    def extremes_since(self, begin_us: int) -> tuple[float, float]:
        """Return smallest and largest value since `begin_us` (µs), including the value at that time."""
        low = high = self.last
        for then_us, value in reversed(self.history):
            low, high = min(low, value), max(high, value)
            if then_us <= begin_us:
                break
        return low, high

    def value_at(self, time_us: int) -> tuple[float, float, float, float]:
        """Return the value at `time_us` (µs), its age (s), and two values that bound it during a motion.

        Between two values the result is interpolated, and the age is 0. If the interval exceeds ``max_age``,
        the age is the time to the nearer value. After the last value, the last value is used.
        Before the first value, the first value is used, and the age is the time until it was measured.
        """
        after_us, after = self.last_us, self.last
        if after_us <= time_us:
            low, high = self._bounds(time_us) if self.moved_us == after_us else (self.before, after)
            return after, (time_us - after_us) * 1e-6, low, high
        for then_us, value in reversed(self.history):
            if then_us <= time_us:
                weight, step = (time_us - then_us) / (after_us - then_us), (after_us - then_us) * 1e-6
                age = min(weight, 1.0 - weight) * step if step > self.max_age else 0.0
                return value + weight * (after - value), age, value, after
            after_us, after = then_us, value
        return after, (after_us - time_us) * 1e-6, after, after

    def _bounds(self, time_us: int) -> tuple[float, float]:
        """Return two values that bound the moving parameter at `time_us` (µs), after the last value."""
        interval_us = self.last_us - self.reported_before_us
        late_us = time_us - self.last_us - interval_us  # since the next value was due
        if late_us <= 0:
            return self.before, self.last
        # half the width grows from half an interval's motion to that since the last value
        what, growth = self.input, self.rate * min(2 * late_us, late_us + interval_us // 2) * 1e-6
        # an interval of this width that lies in the calibrated range and about the last values if it can
        width = min(abs(self.last - self.before) + 2.0 * growth, what.high - what.low)
        low = min(max(min(self.before, self.last) - growth, what.low), what.high - width)
        return low, low + width


STALE_FLAG: Final = int(Quality.STALE_TELEMETRY)
MOVING: Final = int(Quality.MOVING)
SATURATED_FLAG: Final = int(Quality.SATURATED)
OFFSET_SUSPECT: Final = int(Quality.OFFSET_SUSPECT)
GAP: Final = int(Quality.GAP)
LATE_JOIN: Final = int(Quality.LATE_JOIN)


class Sample(msgspec.Struct, frozen=True, gc=False):
    """Three channels and the telemetry at one common time."""

    reading: Reading
    """Reading as the instrument sent it."""
    time_us: int
    """Common time of all channels, corrected for the filter's delay, µs."""
    field: Vector
    """Raw field in sensor axes at `time_us`, nT."""
    values: tuple[float, ...]
    """Values of the parameters at `time_us`, in the order of the calibration."""
    age: float
    """Age of the oldest telemetry value in the sample, s."""
    quality: int
    """:class:`~magbridge.records.Quality` bits."""
    sigma: float
    """1-sigma to add in quadrature to that of the corrected field because of flagged conditions, nT."""
    spans: tuple[tuple[int, float, float], ...]
    """Parameters with an uncertain value: index in `values`, and lower and upper bound of the value."""


class Aligner:
    """Join readings and telemetry into samples.

    `inputs` are the parameters of the calibration in its order. `tracks` holds their telemetry, and `by_name`
    also other telemetry that is watched. `power_cycle` is the instrument's power-on counter at its
    calibration (None if unknown). `late_since_us` is the start of a stall, µs (0 without a stall).
    `motion_since_us` (µs) is the time of the last report before a motion that affects the last sample.
    """

    def __init__(self, inputs: tuple[Input, ...], settings: Align, power_cycle: int | None = None) -> None:
        self.settings = settings
        self.tracks = tuple(Track(what) for what in inputs)
        self.by_name = {what.name: track for what, track in zip(inputs, self.tracks, strict=True)}
        self.power_cycle = power_cycle
        self.offset_suspect = False
        self.late_since_us = self.motion_since_us = 0
        self.channels = OneTime()
        self._before_us = NEVER
        self._period_us, self._step_us = 0.0, 0

    def watch(self, name: str, max_age: float) -> None:
        """Record a telemetry series that the calibration does not use yet; its gaps do not set flags."""
        if name not in self.by_name:
            self.by_name[name] = Track(Input(name, nan, nan, max_age))

    def follow(self, names: tuple[str, ...]) -> None:
        """Set the inputs to `names`, the order of another calibration; each must be an input or watched."""
        self.tracks = tuple([self.by_name[name] for name in names])

    def tune(self, settings: Align, ages: Mapping[str, float]) -> None:
        """Replace the settings, and for the parameters in `ages` the age (s) from which they are stale."""
        self.settings = settings
        for name, track in self.by_name.items():
            track.max_age = ages.get(name, track.max_age)

    def telemetry(self, name: str, time_us: int, value: float, *, guessed: bool = False) -> None:
        """Add a telemetry value measured at `time_us` (µs); NaN means unknown. Ignore names without a track.

        If `guessed`, `time_us` is the time of arrival after a stall.
        """
        track = self.by_name.get(name)
        if track is not None:
            since_us = self.late_since_us if guessed else 0
            track.update(time_us, value, self.settings.moving_rate, since_us)

    def reading(self, reading: Reading, time_us: int) -> Sample:
        """Return the sample of a reading; `time_us` (µs) is the host's time of ``reading.device_time``."""
        settings = self.settings
        cycle, delay, restarted = reading.power_cycle, reading.channel_delay, reading.restarted
        if cycle is not None:
            if self.power_cycle is None:
                self.power_cycle = cycle
            restarted = restarted or cycle != self.power_cycle
        self.offset_suspect = self.offset_suspect or restarted
        quality, measured = 0, reading.field
        field, first = self.channels.bring(measured, delay, time_us)
        variance = self.channels.variance
        if self._is_gap(time_us) or reading.missing:
            quality |= GAP
        x, y, z = measured
        if isfinite(x + y + z):
            self._before_us = time_us
        if self.offset_suspect:
            quality |= OFFSET_SUSPECT
            variance += settings.turn_on_sigma**2
        if reading.saturated:
            quality |= SATURATED_FLAG
            variance = inf

        sample_us = time_us + round(first * 1e6) - round(settings.filter_delay * 1e6)
        since_us = self.late_since_us if isnan(reading.device_time) else 0
        values, spans, age, more, growth = self._parameters(sample_us, since_us or reading.since_us)
        variance += growth
        sigma = variance**0.5 if variance else 0.0
        # the two low bits of a time belong to the log
        time_of_all_us = sample_us - sample_us % 4
        return Sample(reading, time_of_all_us, field, values, age, quality | more, sigma, spans)

    def _parameters(
        self, sample_us: int, since_us: int
    ) -> tuple[tuple[float, ...], tuple[tuple[int, float, float], ...], float, int, float]:
        """Return values, spans, age, flags and variance (nT²) of the parameters at `sample_us` (µs).

        `since_us`: earliest time at which the sample may have been measured, µs; 0 if its time is known.
        """
        late_us, settings = self.late_since_us, self.settings
        settle_us = settings.settle_time * 1e6
        values: list[float] = []
        spans: list[tuple[int, float, float]] = []
        quality, variance, oldest = LATE_JOIN if since_us else 0, 0.0, 0.0
        self.motion_since_us = sample_us
        for index, track in enumerate(self.tracks):
            if track.last_us == NEVER:
                what = track.input
                values.append(0.5 * (what.low + what.high))
                spans.append((index, what.low, what.high))
                quality |= STALE_FLAG
                oldest = inf
                continue
            value, age, low, high = track.value_at(sample_us)
            values.append(value)
            oldest = max(oldest, age)
            if track.lacking or age > track.max_age:
                quality |= STALE_FLAG
                variance += (settings.stale_growth * age) ** 2
            if track.moved_us == track.last_us or sample_us - track.moved_us <= settle_us:
                spans.append((index, low, high))
                if track.input.is_mass:
                    quality |= MOVING  # or stopped less than settle_time ago
                    self.motion_since_us = min(self.motion_since_us, track.reported_before_us)
            elif age and sample_us < track.last_us:  # between two values with a long interval
                spans.append((index, low, high))
            if sample_us < track.first_us or (late_us and sample_us > track.last_us):
                quality |= LATE_JOIN
            if since_us:
                spans.append((index, *track.extremes_since(since_us)))
            elif track.guess_us[0] <= sample_us <= track.guess_us[1]:
                quality |= LATE_JOIN
                spans.append((index, *track.guess))
        return tuple(values), tuple(spans), oldest, quality, variance

    def _is_gap(self, time_us: int) -> bool:
        """Return True if samples are missing before `time_us`.

        The time since the last reading is a gap if it exceeds ``gap_factor`` times both the mean period and
        the previous interval. So an instrument that changes to a lower rate is flagged only once.
        """
        if self._before_us == NEVER:
            return False
        step, before = time_us - self._before_us, self._step_us
        self._step_us = step
        if self._period_us and step > self.settings.gap_factor * max(self._period_us, before):
            return True
        self._period_us += (step - self._period_us) * (0.1 if self._period_us else 1.0)
        return False
