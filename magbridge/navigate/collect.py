"""Samples to blocks: samples between which the map is linear become one measurement, their mean."""

from __future__ import annotations

from math import inf, sqrt
from typing import NamedTuple

from magbridge.field.earth import wrap
from magbridge.field.nearby import NearbyField
from magbridge.navigate.deadreckoning import DeadReckoning
from magbridge.navigate.model import Block
from magbridge.navigate.options import Options

__all__ = ["Collector"]

LEAST = 1e-3
"""nT: a smaller sigma is not believed."""


class Sums(NamedTuple):
    """Weighted sums over the block's samples so far; time and position relative to the first sample."""

    start_us: int
    latitude: float
    longitude: float
    travelled: float
    weight: float = 0.0
    time: float = 0.0
    d_latitude: float = 0.0
    d_longitude: float = 0.0
    anomaly: float = 0.0
    white: float = 0.0
    together: float = 0.0
    slow: float = 0.0
    slope_north: float = 0.0
    slope_east: float = 0.0
    depth: float = 0.0


class Collector:
    """Subtract the main field where dead reckoning puts the vehicle, and average until the block is full.

    Samples are weighted by their precision, so that one in ten taken with a mass in motion does no harm.

    Parameters
    ----------
    options : Options
    step : float
        m, that a block covers at most.

    Notes
    -----
    The mean of n samples over a time T, of noise σ with correlation time τ, has the variance
    ``σ² max(1/n, 2τ/(T + 2τ))``. The rest of a sample's variance does not average out; the part of it that is
    the filter's bias is subtracted, because the filter has a state for it.
    """

    def __init__(self, options: Options, step: float) -> None:
        self._interval_us, self._step, self._lasts = options.interval * 1e6, step, 2.0 * options.noise_time
        self._white = inf if options.noise is None else options.noise**2
        self._bias = options.bias_sigma**2
        self._main_field = NearbyField()
        self._sums: Sums | None = None
        self._seconds = 0.0  # from its first sample to its last

    def add(
        self, time_us: int, where: DeadReckoning, total_field: float, sigma: float, utc_offset_us: int = 0
    ) -> Block | None:
        """Take in a sample; return the block that it fills.

        Parameters
        ----------
        time_us, utc_offset_us : int
            µs of a clock that is never set, and what is to be added for UNIX time: the main field has a date.
        where : DeadReckoning
            At the place of the sample.
        total_field, sigma : float
            nT.
        """
        s = self._sums or Sums(time_us, where.latitude, where.longitude, where.travelled)
        main, slope_north, slope_east = self._main_field.at(
            where.latitude, where.longitude, where.depth, (time_us + utc_offset_us) * 1e-6
        )
        variance = max(sigma, LEAST) ** 2
        white, w = min(self._white, variance), 1.0 / variance
        self._sums = Sums(
            s.start_us,
            s.latitude,
            s.longitude,
            s.travelled,
            s.weight + w,
            s.time + w * (time_us - s.start_us),
            s.d_latitude + w * (where.latitude - s.latitude),
            s.d_longitude + w * wrap(where.longitude - s.longitude),
            s.anomaly + w * (total_field - main),
            s.white + w * w * white,
            s.together + w * sqrt(white),
            s.slow + w * sqrt(max(0.0, variance - white - self._bias)),
            s.slope_north + w * slope_north,
            s.slope_east + w * slope_east,
            s.depth + w * where.depth,
        )
        full = time_us - s.start_us >= self._interval_us or where.travelled - s.travelled >= self._step
        self._seconds = (time_us - s.start_us) * 1e-6
        return self.flush() if full else None

    def flush(self) -> Block | None:
        """Return the block of the samples collected so far; None if there are none."""
        s, self._sums = self._sums, None
        if s is None:
            return None
        w = s.weight
        lasting = self._lasts / (self._seconds + self._lasts) if self._lasts else 0.0
        white = max(s.white, lasting * s.together**2)
        return Block(
            s.start_us + round(s.time / w),
            s.latitude + s.d_latitude / w,
            wrap(s.longitude + s.d_longitude / w),
            s.anomaly / w,
            (white + s.slow**2) / w**2,
            s.slope_north / w,
            s.slope_east / w,
            s.depth / w,
        )
