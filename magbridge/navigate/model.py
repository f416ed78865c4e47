"""The state that the filters estimate, its transition, and its relation to a block of samples.

The state holds the errors of dead reckoning and of the instruments, so its transition is linear whatever the
vehicle does, and one model serves every estimator, the smoother and the bound:

==  =========================================  =====================================================
0   north, m                                   of the true position from the dead-reckoned one
1   east, m
2   current north, m/s                         what carries the dead reckoning off; slow Gauss-Markov
3   current east, m/s
4   calibration bias, nT                       Gauss-Markov in time
5   map error, nT                              Gauss-Markov in the distance travelled
==  =========================================  =====================================================
"""

from __future__ import annotations

from math import exp, hypot, log, nan, sqrt
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from magbridge.calibration.model import Calibration
from magbridge.config import NotNegative, Positive
from magbridge.field.grid import AnomalyGrid, Local, T

__all__ = [
    "N_STATES",
    "Block",
    "Options",
    "any_level",
    "block_length",
    "curvature",
    "informed",
    "measurement_row",
    "prior",
    "resolution",
    "transition",
]

Array = NDArray[np.float64]

N_STATES = 6
LASTING = 3.0
"""Intervals: noise with a longer correlation time becomes a bias."""
LEG = 1_800.0
"""s, between turns or from dive to climb."""
FINE = 0.35
"""Share of the spread that one measurement allows: errors of successive ones are alike and add up."""


class Options(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How well things are known beforehand; all 1-sigma.

    Attributes
    ----------
    start_sigma : float
        m, of the first position, each axis.
    current_sigma, current_time : float
        m/s and s: the current, and its correlation time.
    drift : float
        m/sqrt(s), random walk of the dead reckoning.
    bias_sigma, bias_time : float
        nT and s: the error that the calibration leaves, and its correlation time.
    map_sigma, map_length : float
        nT and m: the map's error, and its correlation length. Independent errors of single nodes are the
        grid's own sigma.
    noise : float or None
        nT, the part of a sample's sigma that is white; of the rest, what goes beyond ``bias_sigma`` does not
        average out. None: all of it is white.
    noise_time : float
        s, correlation time of that noise; noise that lasts longer than a few intervals belongs to the bias.
    gate : float
        Largest innovation squared over its variance that is taken in.
    interval : float
        s, samples within are averaged to one update; sooner if the vehicle has moved 2 % of the map's
        correlation length.
    sigma_limit : float
        m, the largest 1-sigma of a valid position.
    doubt : float
        Odds at which another explanation of the field replaces the filter's.
    """

    start_sigma: Positive = 50.0
    current_sigma: NotNegative = 0.1
    current_time: Positive = 21_600.0
    drift: NotNegative = 0.2
    bias_sigma: NotNegative = 5.0
    bias_time: Positive = 21_600.0
    map_sigma: NotNegative = 2.0
    map_length: Positive = 1_000.0
    noise: NotNegative | None = None
    noise_time: NotNegative = 0.0
    gate: Positive = 16.0
    interval: NotNegative = 20.0
    sigma_limit: Positive = 500.0
    doubt: Positive = 2_000.0


class Block(NamedTuple):
    """Samples close enough together to be one measurement.

    Attributes
    ----------
    time_us : int
        µs, their mean time.
    latitude, longitude : float
        deg, dead-reckoned, their mean.
    anomaly : float
        nT, total field minus the main field at the dead-reckoned position.
    variance : float
        nT², of that mean.
    slope_north, slope_east : float
        nT/m, of the main field.
    depth : float
        m, their mean; NaN stands for the map's own height.
    """

    time_us: int
    latitude: float
    longitude: float
    anomaly: float
    variance: float
    slope_north: float
    slope_east: float
    depth: float = nan


def informed(options: Options, calibration: Calibration, sigma: float) -> Options:
    """Return options that include a calibration's own errors.

    Parameters
    ----------
    options : Options
        Their bias is that of all other sources: the map's level, the field's variation in time.
    calibration : Calibration
        Of the total field that will be taken in.
    sigma : float
        nT, 1-sigma that the calibration claims for a typical sample.

    Notes
    -----
    The white part is the noise of the calibration runs. If that noise was correlated for longer than a few
    updates, it does not average out: it becomes a bias with the same correlation time, and the white part
    is what drives it, ``σ √(1 - ρ²)`` with ρ the correlation from sample to sample. A calibration's other
    errors depend on attitude and masses, and last for a leg.
    """
    noise = calibration.noise
    white = noise.sensor
    rho = noise.autocorrelation
    noise_time = -noise.interval / log(rho) if 0.0 < rho < 1.0 else 0.0
    lasts = LEG
    if noise_time > LASTING * options.interval:
        white, lasts, noise_time = white * sqrt(1.0 - rho**2), noise_time, 0.0
    slow = sqrt(max(0.0, sigma**2 - white**2))
    return replace(
        options,
        noise=white,
        noise_time=noise_time,
        bias_sigma=hypot(options.bias_sigma, slow),
        bias_time=min(options.bias_time, lasts) if slow > options.bias_sigma else options.bias_time,
    )


def any_level(options: Options, grid: AnomalyGrid) -> Options:
    """Return options with which the field's level carries no information, and its changes as much as before.

    Notes
    -----
    The driving noise of a Gauss-Markov process is ``2σ²/τ`` (nT²/s). σ is raised to the map's RMS, and τ in
    proportion to σ², so that it stays the same.
    """
    o = options
    if o.bias_sigma >= grid.rms:
        return o
    lasts = o.bias_time * (grid.rms / max(o.bias_sigma, 1e-3 * grid.rms)) ** 2
    return replace(o, bias_sigma=grid.rms, bias_time=lasts)


def prior(options: Options, position_sigma: float | None = None) -> tuple[Array, Array]:
    """Return mean (6,) and covariance (6, 6) before anything was measured."""
    o = options
    sigma = o.start_sigma if position_sigma is None else position_sigma
    sigmas = [sigma, sigma, o.current_sigma, o.current_sigma, o.bias_sigma, o.map_sigma]
    return np.zeros(N_STATES), np.diag(np.square(sigmas))


def transition(options: Options, seconds: float, metres: float) -> tuple[Array, Array]:
    """Return F and Q (6, 6) over a time and a distance through the water.

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
        q[c, c] = gained
    for i, sigma, decay in (
        (4, o.bias_sigma, seconds / o.bias_time),
        (5, o.map_sigma, metres / o.map_length),
    ):
        f[i, i] = exp(-decay)
        q[i, i] = sigma**2 * (1.0 - f[i, i] ** 2)
    return f, q


def measurement_row(north: float, east: float) -> Array:
    """Return H (1, 6): the field's slopes at the position, and 1 for calibration bias and map error."""
    return np.array([[north, east, 0.0, 0.0, 1.0, 1.0]])


def curvature(local: Local[T], pnn: T, pne: T, pee: T) -> tuple[T, T]:
    """Return what a map's curvature adds to its mean (nT) and variance (nT²) under a position's spread.

    Parameters
    ----------
    local : Local
        The map at the mean of the position.
    pnn, pne, pee : float or (n,) array
        m², covariance of the position.

    Notes
    -----
    ``tr(C P)/2`` and ``tr((C P)²)/2``, with C the map's Hessian and P the covariance, to second order (the
    second-order filter of Bar-Shalom et al. 2001, sec. 10.3).
    """
    a, b = (
        local.north_north * pnn + local.north_east * pne,
        local.north_north * pne + local.north_east * pee,
    )
    c, d = local.north_east * pnn + local.east_east * pne, local.north_east * pne + local.east_east * pee
    return 0.5 * (a + d), 0.5 * (a * a + 2.0 * b * c + d * d)


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
        half the spread): those errors persist, and so do the curvature's.

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
    return float(min(0.25 * length, FINE * (2.0 * noise) ** 0.25 / curvature**0.5))
