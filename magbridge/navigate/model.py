"""The state that the filters estimate, its transition, and its relation to a block of samples.

The state holds the errors of dead reckoning and of the instruments, so its transition is linear whatever the
vehicle does, and one model serves every estimator, the smoother and the bound:

==  =========================================  =====================================================
0   north, m                                   of the true position from the dead-reckoned one
1   east, m
2   current north, m/s                         velocity error of dead reckoning; slow Gauss-Markov
3   current east, m/s
4   calibration bias, nT                       Gauss-Markov in time
5   map error, nT, at a typical node           Gauss-Markov in the distance travelled
==  =========================================  =====================================================

:class:`Collector` averages samples into a block while the map is linear between them. A block is full if the
next sample, at the same spacing, would lie beyond it. If the distance of samples exceeds the length of a
block, each sample is a block.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from math import exp, inf, nan
from typing import NamedTuple

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.field.geodesy import wrap
from magbridge.field.grid import AnomalyGrid
from magbridge.field.igrf import NearbyField
from magbridge.navigate.deadreckoning import DeadReckoning, MotionNoise
from magbridge.navigate.options import NavigationOptions

__all__ = [
    "NO_MOTION_NOISE", "N_STATES", "Block", "Collector", "average", "block_length", "changed_variance",
    "measurement_row", "prior", "resolution", "transition",
]  # fmt: skip

N_STATES = 6
NO_MOTION_NOISE = MotionNoise()
MAX_SPREAD_FRACTION = 0.35
"""Fraction of the spread that the noise of one measurement allows: errors of successive ones add up."""
LAYER_VARIANCE = 0.25
"""Variance of the change of wind per unit of the logarithm of the height, as a fraction of its own variance.
A climb from the ground to 100 m, 2.4 units, changes most of the wind."""
MIN_SIGMA_NT = 1e-3
"""Lower limit of a sample's sigma, nT."""


class Block(NamedTuple):
    """Mean of samples that are close enough together to be one measurement."""

    time_us: int
    """Mean time of the samples, µs."""
    latitude: float
    longitude: float
    """`latitude`, `longitude`: mean dead-reckoned position, deg."""
    anomaly: float
    """Total field minus the main field at the dead-reckoned position, nT."""
    variance: float
    """Variance of `anomaly`, nT²."""
    slope_north: float
    slope_east: float
    """`slope_north`, `slope_east`: slopes of the main field, nT/m."""
    depth: float = nan
    """Mean depth, m; NaN stands for the map's own height."""


def average(blocks: Sequence[Block] | FloatArray) -> Block:
    """Return the precision-weighted mean of several blocks, or of rows (n, 8) of their fields, as one block.

    Its variance is that of a mean of independent measurements.
    """
    rows = np.array(blocks)
    start, _, longitude, *_ = rows[0].tolist()
    # Time and longitude relative to the first row: no precision is lost, and no wrap at 180 degrees.
    precision = 1.0 / rows[:, 4]
    rows[:, 0] -= start
    rows[:, 2] = wrap(rows[:, 2] - longitude)
    time, latitude, east, anomaly, _, *rest = (precision @ rows / precision.sum()).tolist()
    where = int(start) + round(time), latitude, wrap(longitude + east)
    return Block(*where, anomaly, 1.0 / float(precision.sum()), *rest)


def prior(options: NavigationOptions, position_sigma: float | None = None) -> tuple[FloatArray, FloatArray]:
    """Return mean (6,) and covariance (6, 6) of the states before the first measurement.

    `position_sigma` is the 1-sigma of the position, m; default ``options.start_sigma``.
    """
    o = options
    sigma = o.start_sigma if position_sigma is None else position_sigma
    sigmas = [sigma, sigma, o.current_sigma, o.current_sigma, o.bias_sigma, o.map_sigma]
    return np.zeros(N_STATES), np.diag(np.square(sigmas))


def transition(
    options: NavigationOptions, seconds: float, metres: float, motion: MotionNoise = NO_MOTION_NOISE
) -> tuple[FloatArray, FloatArray]:
    """Return transition F and noise covariance Q, (6, 6), over a time (s) and a distance through water (m).

    `motion` is the uncertainty of the dead-reckoned motion in that time, in addition to ``options.drift``.

    Notes
    -----
    A Gauss-Markov state keeps ``a = exp(-Δ/τ)`` of itself and gains the variance ``σ²(1 - a²)``. The position
    integrates the current, to second order in Δ/τ.
    """
    o = options
    f, q = np.eye(N_STATES), np.zeros((N_STATES, N_STATES))
    # Gauss-Markov current over the time t: c' = a c + w, var w = s^2 (1 - a^2). Its integral is the drift
    # of the position; trapezoid for the mean, t^2/3 and t/2 for the covariances of an integrated random walk.
    kept = exp(-seconds / o.current_time)
    gained = o.current_sigma**2 * (1.0 - kept * kept)
    for p, c in ((0, 2), (1, 3)):
        f[p, c], f[c, c] = seconds * (1.0 + kept) / 2.0, kept
        q[p, p] = o.drift**2 * seconds + gained * seconds * seconds / 3.0
        q[p, c] = q[c, p] = gained * seconds / 2.0
        q[c, c] = gained + changed_variance(o, motion)
    # Position error of the motion between reports, then the two errors of the measurement.
    q[:2, :2] += [[motion.nn, motion.ne], [motion.ne, motion.ee]]
    slow = (4, o.bias_sigma, seconds / o.bias_time), (5, o.map_sigma, metres / o.map_length)
    for i, sigma, decay in slow:
        f[i, i] = exp(-decay)
        q[i, i] = sigma**2 * (1.0 - f[i, i] ** 2)
    return f, q


def changed_variance(options: NavigationOptions, motion: MotionNoise) -> float:
    """Return the variance of the current's change on each axis, (m/s)², by turns and changes of height."""
    o = options
    return 0.5 * o.motion_error**2 * motion.turns + LAYER_VARIANCE * o.current_sigma**2 * motion.layers


def measurement_row(north: float, east: float, errors: float = 1.0) -> FloatArray:
    """Return H (1, 6): the field's slopes (nT/m), 1 for the bias, and `errors` as the factor of map error."""
    return np.array([[north, east, 0.0, 0.0, 1.0, errors]])


def block_length(grid: AnomalyGrid) -> float:
    """Return the distance (m) over which a map is practically linear: 2 % of its correlation length."""
    return 0.02 * grid.correlation_length


def resolution(grid: AnomalyGrid, options: NavigationOptions, variance: float) -> float:
    """Return the position spread, m, within which the map is linear to the noise of one measurement.

    `variance` (nT²) is the noise of a measurement. The function adds 1/16 of the variance that bias and map
    error gain until the next measurement: those errors persist, as the curvature error does.

    Notes
    -----
    Within a spread s, a curvature k causes an error of variance ``(k s²)²/2``. A map of scatter σ and
    covariance ``exp(-r²/2L²)`` has the rms curvature ``k = √3 σ/L²``. The error stays below a noise of sigma
    n while ``s² < √2 n/k``. The spread is at most L/4, beyond which the Taylor series fails.
    """
    length = grid.correlation_length
    if not np.isfinite(length) or grid.rms == 0.0:
        return float("inf")
    _, Q = transition(options, options.interval, block_length(grid))
    # s^2 < sqrt(2 noise) / k: the curvature's error stays below the noise of one measurement.
    noise = variance + (Q[4, 4] + Q[5, 5]) * 0.5**4
    curvature = 3.0**0.5 * grid.rms / length**2
    return float(min(0.25 * length, MAX_SPREAD_FRACTION * (2.0 * noise) ** 0.25 / curvature**0.5))


class Collector:
    """Collector of samples into blocks: it subtracts the main field, and averages until a block is full.

    The main field is that at the dead-reckoned position. Weights are precisions, so that the few samples
    taken while a mass moves do no harm. A block covers at most `step` m.

    Notes
    -----
    The mean of n samples over a time T, of noise σ with correlation time τ, has the variance
    ``σ² max(1/n, 2τ/(T + 2τ))``. The rest of a sample's variance does not average out. The variance of the
    bias is subtracted from that rest, because the filter has a state for the bias.
    """

    def __init__(self, options: NavigationOptions, step: float) -> None:
        self._interval_us, self._step, self._lasts = options.interval * 1e6, step, 2.0 * options.noise_time
        self._white = inf if options.noise is None else options.noise**2
        self._bias = options.bias_sigma**2
        self._main_field = NearbyField()
        self._rows = array("d")  # each sample as the fields of a block: 20,000 are averaged in 1 ms
        self._start_us, self._begun = 0, 0.0  # time and m travelled at the first sample of the block
        self._last: tuple[float, float] | None = None  # time and m travelled at the previous sample

    def add(
        self, time_us: int, reckoning: DeadReckoning, total_field: float, sigma: float, utc_offset_us: int = 0
    ) -> Block | None:
        """Add a sample; return the block that this completes, or None.

        A sample too far from the block in time or distance completes it, and begins the next block.
        `utc_offset_us` is added to `time_us` for UNIX time: the main field depends on the date. `total_field`
        and its 1-sigma `sigma` are in nT.
        """
        # Anomaly = total field - main field at the dead-reckoned position and date.
        main, slope_north, slope_east = self._main_field.field_and_slopes(
            reckoning.latitude, reckoning.longitude, reckoning.depth, (time_us + utc_offset_us) * 1e-6
        )
        there = time_us, reckoning.travelled
        apart = self._rows and (
            time_us - self._start_us > self._interval_us or reckoning.travelled - self._begun > self._step
        )
        block = self.flush() if apart else None
        if not self._rows:
            self._start_us, self._begun = there
        # The very first sample is a block by itself, because the spacing of samples is not known yet.
        wait, step = (there[0] - self._last[0], there[1] - self._last[1]) if self._last else (inf, inf)
        self._last = there
        anomaly, variance = total_field - main, max(sigma, MIN_SIGMA_NT) ** 2
        place = reckoning.latitude, reckoning.longitude
        self._rows.extend((time_us, *place, anomaly, variance, slope_north, slope_east, reckoning.depth))
        # Full if the next sample, as far on as this one from its predecessor, would not fit.
        full = (
            time_us - self._start_us + wait > self._interval_us
            or reckoning.travelled - self._begun + step > self._step
        )
        return self.flush() if full and block is None else block

    def flush(self) -> Block | None:
        """Return the block of the samples collected so far; None if there are none."""
        if not self._rows:
            return None
        # Precision-weighted mean. Its variance has three parts: white noise, which averages out; noise with a
        # correlation time, by the number of independent samples; and what does not average out (`slow`).
        rows, self._rows = np.frombuffer(self._rows).reshape(-1, len(Block._fields)), array("d")
        variance = rows[:, Block._fields.index("variance")]
        w, white = 1.0 / variance, np.minimum(self._white, variance)
        seconds = (rows[-1, 0] - rows[0, 0]) * 1e-6
        lasting = self._lasts / (seconds + self._lasts) if self._lasts else 0.0
        noise = max(w * w @ white, lasting * (w @ np.sqrt(white)) ** 2)
        slow = w @ np.sqrt(np.maximum(variance - white - self._bias, 0.0))
        return average(rows)._replace(variance=float((noise + slow**2) / w.sum() ** 2))
