"""Samples to blocks: samples between which the map is linear become one measurement, their mean.

A block is full when one more sample, as far on as the last, would lie beyond it: where every step is longer
than a block, every sample is one, and samples farther from each other than the map's detail are never
averaged.
"""

from __future__ import annotations

from array import array
from math import inf

import numpy as np

from magbridge.field.nearby import NearbyField
from magbridge.navigate.deadreckoning import DeadReckoning
from magbridge.navigate.model import Block, average
from magbridge.navigate.options import Options

__all__ = ["Collector"]

MIN_SIGMA_NT = 1e-3
"""nT: a smaller sigma is not believed."""


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
        self._rows = array("d")  # of numbers, a block of one sample each: 20,000 of them are averaged in 1 ms
        self._start_us, self._begun = 0, 0.0  # the first of them: when, and m travelled until then
        self._last: tuple[float, float] | None = None  # the sample before: when, and m travelled until then

    def add(
        self, time_us: int, where: DeadReckoning, total_field: float, sigma: float, utc_offset_us: int = 0
    ) -> Block | None:
        """Add a sample; return the block that it fills, or the one that it is too far away to join.

        Parameters
        ----------
        time_us, utc_offset_us : int
            Monotonic time and its offset to UNIX time, µs: the main field depends on the date.
        where : DeadReckoning
            Dead reckoning at the sample's place.
        total_field, sigma : float
            Total field and its 1-sigma, nT.
        """
        main, slope_north, slope_east = self._main_field.at(
            where.latitude, where.longitude, where.depth, (time_us + utc_offset_us) * 1e-6
        )
        there = time_us, where.travelled
        apart = self._rows and (
            time_us - self._start_us > self._interval_us or where.travelled - self._begun > self._step
        )
        block = self.flush() if apart else None
        if not self._rows:
            self._start_us, self._begun = there
        # the first sample of all is a block by itself: how long a step is, is not known yet
        wait, step = (there[0] - self._last[0], there[1] - self._last[1]) if self._last else (inf, inf)
        self._last = there
        anomaly, variance = total_field - main, max(sigma, MIN_SIGMA_NT) ** 2
        place = where.latitude, where.longitude
        self._rows.extend((time_us, *place, anomaly, variance, slope_north, slope_east, where.depth))
        full = (
            time_us - self._start_us + wait > self._interval_us
            or where.travelled - self._begun + step > self._step
        )
        return self.flush() if full and block is None else block

    def flush(self) -> Block | None:
        """Return the block of the samples collected so far; None if there are none."""
        if not self._rows:
            return None
        rows, self._rows = np.frombuffer(self._rows).reshape(-1, len(Block._fields)), array("d")
        variance = rows[:, Block._fields.index("variance")]
        w, white = 1.0 / variance, np.minimum(self._white, variance)
        seconds = (rows[-1, 0] - rows[0, 0]) * 1e-6
        lasting = self._lasts / (seconds + self._lasts) if self._lasts else 0.0
        noise = max(w * w @ white, lasting * (w @ np.sqrt(white)) ** 2)
        slow = w @ np.sqrt(np.maximum(variance - white - self._bias, 0.0))
        return average(rows)._replace(variance=float((noise + slow**2) / w.sum() ** 2))
