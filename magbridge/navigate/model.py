"""The state that the filters estimate, its transition, and its relation to a block of samples.

The state holds the errors of dead reckoning and of the instruments, so its transition is linear whatever the
vehicle does, and one model serves every estimator, the smoother and the bound:

==  =========================================  =====================================================
0   north, m                                   of the true position from the dead-reckoned one
1   east, m
2   current north, m/s                         what carries the dead reckoning off; slow Gauss-Markov
3   current east, m/s
4   calibration bias, nT                       Gauss-Markov in time
5   map error, nT, where it is typical         Gauss-Markov in the distance travelled
==  =========================================  =====================================================
"""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, nan
from typing import NamedTuple

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.field.geodesy import wrap
from magbridge.field.grid import AnomalyGrid
from magbridge.navigate.deadreckoning import MotionNoise
from magbridge.navigate.options import Options

__all__ = [
    "NO_MOTION_NOISE", "N_STATES", "Block", "average", "block_length", "measurement_row", "prior",
    "resolution", "transition",
]  # fmt: skip

N_STATES = 6
NO_MOTION_NOISE = MotionNoise()
MAX_SPREAD_FRACTION = 0.35
"""Share of the spread that one measurement allows: errors of successive ones are correlated and add up."""


class Block(NamedTuple):
    """Samples close enough together to be one measurement."""

    time_us: int
    """Mean time of the samples, µs."""
    latitude: float
    longitude: float
    """`latitude`, `longitude`: deg, dead-reckoned, their mean."""
    anomaly: float
    """nT, total field minus the main field at the dead-reckoned position."""
    variance: float
    """nT², of that mean."""
    slope_north: float
    slope_east: float
    """`slope_north`, `slope_east`: nT/m, of the main field."""
    depth: float = nan
    """m, their mean; NaN stands for the map's own height."""


def average(blocks: Sequence[Block] | FloatArray) -> Block:
    """Return several blocks, or rows (n, 8) of their fields, as one: their mean, weighted by precision.

    Its variance is that of independent ones.
    """
    rows = np.array(blocks)
    start, _, longitude, *_ = rows[0].tolist()
    precision = 1.0 / rows[:, 4]
    rows[:, 0] -= start
    rows[:, 2] = wrap(rows[:, 2] - longitude)
    time, latitude, east, anomaly, _, *rest = (precision @ rows / precision.sum()).tolist()
    where = int(start) + round(time), latitude, wrap(longitude + east)
    return Block(*where, anomaly, 1.0 / float(precision.sum()), *rest)


def prior(options: Options, position_sigma: float | None = None) -> tuple[FloatArray, FloatArray]:
    """Return mean (6,) and covariance (6, 6) before anything was measured."""
    o = options
    sigma = o.start_sigma if position_sigma is None else position_sigma
    sigmas = [sigma, sigma, o.current_sigma, o.current_sigma, o.bias_sigma, o.map_sigma]
    return np.zeros(N_STATES), np.diag(np.square(sigmas))


def transition(
    options: Options, seconds: float, metres: float, motion: MotionNoise = NO_MOTION_NOISE
) -> tuple[FloatArray, FloatArray]:
    """Return F and Q (6, 6) over a time and a distance through the water.

    Parameters
    ----------
    options : Options
        Of the navigator.
    seconds, metres : float
        Time, and distance through the water.
    motion : MotionNoise, optional
        Uncertainty of the dead-reckoned motion in that time, in addition to ``options.drift``.

    Notes
    -----
    A Gauss-Markov state keeps ``a = exp(-Δ/τ)`` of itself and gains the variance ``σ²(1 - a²)``. The current
    is carried into the position to second order in Δ/τ.
    """
    o = options
    f, q = np.eye(N_STATES), np.zeros((N_STATES, N_STATES))
    kept = exp(-seconds / o.current_time)
    gained = o.current_sigma**2 * (1.0 - kept * kept)
    for p, c in ((0, 2), (1, 3)):
        f[p, c], f[c, c] = seconds * (1.0 + kept) / 2.0, kept
        q[p, p] = o.drift**2 * seconds + gained * seconds * seconds / 3.0
        q[p, c] = q[c, p] = gained * seconds / 2.0
        q[c, c] = gained + 0.5 * o.motion_error**2 * motion.turns
    q[:2, :2] += [[motion.nn, motion.ne], [motion.ne, motion.ee]]
    slow = (4, o.bias_sigma, seconds / o.bias_time), (5, o.map_sigma, metres / o.map_length)
    for i, sigma, decay in slow:
        f[i, i] = exp(-decay)
        q[i, i] = sigma**2 * (1.0 - f[i, i] ** 2)
    return f, q


def measurement_row(north: float, east: float, errors: float = 1.0) -> FloatArray:
    """Return H (1, 6): the field's slopes, 1 for the calibration's bias, and how many errors of the map."""
    return np.array([[north, east, 0.0, 0.0, 1.0, errors]])


def block_length(grid: AnomalyGrid) -> float:
    """Return the distance (m) over which a map is practically linear: 2 % of its correlation length."""
    return 0.02 * grid.correlation_length


def resolution(grid: AnomalyGrid, options: Options, variance: float) -> float:
    """Return the position spread, m, within which the map is linear to the noise of one measurement.

    Parameters
    ----------
    grid : AnomalyGrid
        Its scatter σ and its correlation length L.
    options : Options
        Bias and map error.
    variance : float
        nT², of a measurement. A sixteenth of what bias and map error gain until the next is added (as for
        half the spread): those errors persist, as the error by curvature does.

    Notes
    -----
    A spread s sees the curvature k as an error of variance ``(k s²)²/2``. With ``k = √3 σ/L²``, the rms
    second derivative of a map of scatter σ and covariance ``exp(-r²/2L²)``, that stays below the noise r
    while ``s² < √2 r/k``; and never more than a quarter of L, beyond which no Taylor series holds.
    """
    length = grid.correlation_length
    if not np.isfinite(length) or grid.rms == 0.0:
        return float("inf")
    _, Q = transition(options, options.interval, block_length(grid))
    noise = variance + (Q[4, 4] + Q[5, 5]) * 0.5**4
    curvature = 3.0**0.5 * grid.rms / length**2
    return float(min(0.25 * length, MAX_SPREAD_FRACTION * (2.0 * noise) ** 0.25 / curvature**0.5))
