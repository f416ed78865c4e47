"""Puts the three channels and the telemetry on one time base, causally.

A multiplexed converter samples one channel after the other: all are brought to the time of the earliest
(:mod:`magbridge.one_time`). The anti-alias filter delays the field by ``filter_delay``; the sample's time is
corrected for that, and the telemetry is looked up at the corrected time.

While the process was held up, readings and telemetry waited. Inputs with a time of their own (the
instrument's clock, the autopilot's by TIMESYNC) keep it; inputs without one may be of any time of the stall.
A sample for which either is guessed is flagged ``late_join``, its parameters anywhere between their values
meanwhile.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import inf, isfinite, isnan, nan
from typing import Final

from magbridge.config import Align
from magbridge.one_time import OneTime
from magbridge.records import Quality, Reading, Vector
from magbridge.track import NEVER, Input, Track

__all__ = ["Aligner", "Sample", "nearest"]

STALE_FLAG: Final = int(Quality.STALE_TELEMETRY)
MOVING: Final = int(Quality.MOVING)
SATURATED_FLAG: Final = int(Quality.SATURATED)
OFFSET_SUSPECT: Final = int(Quality.OFFSET_SUSPECT)
GAP: Final = int(Quality.GAP)
LATE_JOIN: Final = int(Quality.LATE_JOIN)
WHOLE: Final = 1.5 * 2.0**52
"""Adding and then subtracting it rounds a number below 2^51."""


class Sample:
    """Three channels and the telemetry at one time.

    Attributes
    ----------
    reading : Reading
        As the instrument sent it.
    reading_us : int
        µs, our time at the reading's ``device_time``.
    time_us : int
        µs, common to all channels.
    field : tuple of 3 float
        nT, sensor axes, uncorrected.
    values : tuple of float
        The parameters at `time_us`, in the order of the calibration.
    age : float
        s, of the oldest telemetry used.
    quality : int
        :class:`~magbridge.records.Quality` bits.
    sigma : float
        nT, 1-sigma that the flags add in quadrature to the uncertainty of the corrected field.
    spans : tuple of (int, float, float)
        Parameters that are not known exactly: index in `values`, and the two ends of the interval in which
        the value lies.
    """

    __slots__ = ("age", "field", "quality", "reading", "reading_us", "sigma", "spans", "time_us", "values")

    def __init__(
        self,
        reading: Reading,
        reading_us: int,
        time_us: int,
        field: Vector,
        values: tuple[float, ...],
        age: float,
        quality: int,
        sigma: float,
        spans: tuple[tuple[int, float, float], ...],
    ) -> None:
        self.reading: Final = reading
        self.reading_us: Final = reading_us
        self.time_us: Final = time_us
        self.field: Final = field
        self.values: Final = values
        self.age: Final = age
        self.quality: Final = quality
        self.sigma: Final = sigma
        self.spans: Final = spans


class Aligner:
    """Joins readings and telemetry into samples.

    Parameters
    ----------
    inputs : sequence of Input
        The parameters that the calibration needs, in the calibration's order.
    settings : Align
    power_cycle : int or None
        The instrument's power-on counter at the time of its calibration; None where unknown.

    Attributes
    ----------
    tracks : tuple of Track
        Of the inputs.
    by_name : dict of str to Track
        Of the inputs, and of what else is watched.
    channels : OneTime
    late_since_us : int
        Start of the stall, µs, or 0: inputs may have waited at most since then.
    motion_since_us : int
        Time of the last report before the motion of the last sample, µs.
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
        """Follow a telemetry series that the calibration does not use yet; its gaps flag no sample."""
        if name not in self.by_name:
            self.by_name[name] = Track(Input(name, nan, nan, max_age))

    def follow(self, names: tuple[str, ...]) -> None:
        """Set the inputs to `names`, in the order of another calibration; each is an input or watched."""
        self.tracks = tuple([self.by_name[name] for name in names])

    def tune(self, settings: Align, ages: Mapping[str, float]) -> None:
        """Replace the settings, and the ages (s) after which the parameters named in `ages` are stale."""
        self.settings = settings
        for name, track in self.by_name.items():
            track.max_age = ages.get(name, track.max_age)

    def telemetry(self, name: str, time_us: int, value: float, *, guessed: bool = False) -> None:
        """Take a telemetry value; a name that the calibration does not need is ignored.

        Parameters
        ----------
        name : str
            Of the parameter.
        time_us : int
            µs, when it was true.
        value : float
            NaN where it is not known.
        guessed : bool
            `time_us` is its arrival, but it had waited.
        """
        track = self.by_name.get(name)
        if track is not None:
            since_us = self.late_since_us if guessed else 0
            track.update(time_us, value, self.settings.moving_rate, since_us)

    def reading(self, reading: Reading, time_us: int, *, restarted: bool = False, missing: int = 0) -> Sample:
        """Turn a reading into a sample.

        Parameters
        ----------
        reading : Reading
            As the driver returned it.
        time_us : int
            µs, host time of ``reading.device_time``.
        restarted : bool
            The instrument's clock restarted: it was powered on again.
        missing : int
            Number of readings lost just before this one.
        """
        settings = self.settings
        cycle, delay = reading.power_cycle, reading.channel_delay
        if cycle is not None:
            if self.power_cycle is None:
                self.power_cycle = cycle
            restarted = restarted or cycle != self.power_cycle
        self.offset_suspect = self.offset_suspect or restarted
        quality, measured = 0, reading.field
        field, first = self.channels.bring(measured, delay, time_us)
        variance = self.channels.variance
        if self._is_gap(time_us) or missing:
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

        sample_us = time_us + nearest(first * 1e6) - nearest(settings.filter_delay * 1e6)
        undated = self.late_since_us != 0 and isnan(reading.device_time)
        values, spans, age, more, growth = self._parameters(sample_us, undated)
        variance += growth
        sigma = variance**0.5 if variance else 0.0
        # the two low bits of a time belong to the log
        time_of_all_us = sample_us - sample_us % 4
        return Sample(reading, time_us, time_of_all_us, field, values, age, quality | more, sigma, spans)

    def _parameters(
        self, sample_us: int, undated: bool
    ) -> tuple[tuple[float, ...], tuple[tuple[int, float, float], ...], float, int, float]:
        """Return values, spans, age, flags and variance (nT²) of the parameters at `sample_us` (µs).

        An `undated` sample waited, and it is not known since when.
        """
        late_us, settings = self.late_since_us, self.settings
        settle_us = settings.settle_time * 1e6
        values: list[float] = []
        spans: list[tuple[int, float, float]] = []
        quality, variance, oldest = 0, 0.0, 0.0
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
                    quality |= MOVING  # or it stopped not long ago
                    self.motion_since_us = min(self.motion_since_us, track.reported_before_us)
            if sample_us < track.first_us or (late_us and (undated or sample_us > track.last_us)):
                quality |= LATE_JOIN
            if undated:
                spans.append((index, *track.extremes_since(late_us)))
            elif track.guess_us[0] <= sample_us <= track.guess_us[1]:
                quality |= LATE_JOIN
                spans.append((index, *track.guess))
        return tuple(values), tuple(spans), oldest, quality, variance

    def _is_gap(self, time_us: int) -> bool:
        """Return True if samples are missing before `time_us`.

        The time since the last reading is a gap when it exceeds ``gap_factor`` times both the mean period and
        the interval before it: an instrument that is set to sample less often is flagged once, not for ever.
        """
        if self._before_us == NEVER:
            return False
        step, before = time_us - self._before_us, self._step_us
        self._step_us = step
        if self._period_us and step > self.settings.gap_factor * max(self._period_us, before):
            return True
        self._period_us += (step - self._period_us) * (0.1 if self._period_us else 1.0)
        return False


def nearest(value: float) -> int:
    """Return the nearest integer, of two the even one: ``round`` without a call of Python."""
    return int(value + WHOLE - WHOLE) if abs(value) < 0.25 * WHOLE else round(value)
