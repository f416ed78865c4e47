"""Samples to blocks: what is measured within a step of the map is one measurement, of its mean."""

from __future__ import annotations

from typing import NamedTuple

from magbridge.field.earth import wrap
from magbridge.field.nearby import NearbyField
from magbridge.navigate.deadreckoning import DeadReckoning
from magbridge.navigate.model import Block

__all__ = ["Collector"]


class Sums(NamedTuple):
    """What the samples of the block so far add up to, relative to the first of them."""

    start_us: int
    latitude: float
    longitude: float
    travelled: float
    n: int = 0
    time: int = 0
    d_latitude: float = 0.0
    d_longitude: float = 0.0
    anomaly: float = 0.0
    variance: float = 0.0
    slope_north: float = 0.0
    slope_east: float = 0.0


class Collector:
    """Subtract the main field where dead reckoning puts the vehicle, and average until the block is full.

    Parameters
    ----------
    interval : float
        s, that a block lasts at most.
    step : float
        m, that it covers at most.
    noise : float or None
        nT, the part of a sample's sigma that averages out; None: all of it.
    """

    def __init__(self, interval: float, step: float, noise: float | None) -> None:
        self._interval_us, self._step, self._noise = interval * 1e6, step, noise
        self._main_field = NearbyField()
        self._sums: Sums | None = None

    def add(self, time_us: int, where: DeadReckoning, total_field: float, sigma: float) -> Block | None:
        """Take in a sample; return the block that it fills."""
        s = self._sums or Sums(time_us, where.latitude, where.longitude, where.travelled)
        main, slope_north, slope_east = self._main_field.at(
            where.latitude, where.longitude, where.depth, time_us * 1e-6
        )
        self._sums = Sums(
            s.start_us,
            s.latitude,
            s.longitude,
            s.travelled,
            s.n + 1,
            s.time + time_us - s.start_us,
            s.d_latitude + where.latitude - s.latitude,
            s.d_longitude + wrap(where.longitude - s.longitude),
            s.anomaly + total_field - main,
            s.variance + sigma * sigma,
            s.slope_north + slope_north,
            s.slope_east + slope_east,
        )
        full = time_us - s.start_us >= self._interval_us or where.travelled - s.travelled >= self._step
        return self.flush() if full else None

    def flush(self) -> Block | None:
        """Return the block of the samples that wait for more to join them; None if none wait."""
        s, self._sums = self._sums, None
        if s is None:
            return None
        variance = s.variance / s.n
        white = variance if self._noise is None else min(self._noise**2, variance)
        return Block(
            s.start_us + s.time // s.n,
            s.latitude + s.d_latitude / s.n,
            wrap(s.longitude + s.d_longitude / s.n),
            s.anomaly / s.n,
            white / s.n + (variance - white),
            s.slope_north / s.n,
            s.slope_east / s.n,
        )
