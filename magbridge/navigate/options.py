"""Options: how well start, current, calibration and map are known before anything is measured."""

from __future__ import annotations

from math import hypot, log, sqrt

import msgspec
from msgspec.structs import replace

from magbridge.calibration.model import Calibration
from magbridge.config import NotNegative, Positive
from magbridge.field.grid import AnomalyGrid

__all__ = ["NavigationOptions", "any_level", "informed", "with_level"]

MAX_NOISE_INTERVALS = 3.0
"""Longest correlation time of noise, in intervals; noise with a longer one becomes a bias."""
LEG_TIME_S = 1_800.0
"""Duration of a leg between turns, or from dive to climb, s."""


class NavigationOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How well things are known beforehand; all 1-sigma."""

    start_sigma: Positive = 50.0
    """Sigma of the first position on each axis, m."""
    current_sigma: NotNegative = 0.1
    current_time: Positive = 21_600.0
    """`current_sigma`, `current_time`: m/s and s: the current, and its correlation time."""
    drift: NotNegative = 0.2
    """m/sqrt(s), random walk of the dead reckoning."""
    motion_error: NotNegative = 0.02
    """Relative error of speed, and of heading in rad: what a turn adds to the uncertainty of the current, as
    a fraction of the change of velocity."""
    bias_sigma: NotNegative = 5.0
    bias_time: Positive = 21_600.0
    """`bias_sigma`, `bias_time`: nT and s: the error that the calibration leaves, and its correlation time.
    """
    map_sigma: NotNegative = 2.0
    map_length: Positive = 1_000.0
    """`map_sigma`, `map_length`: nT and m: the map's error, and its correlation length. Independent errors of
    single nodes are the grid's own sigma."""
    noise: NotNegative | None = None
    """White part of a sample's sigma, nT; of the rest, what goes beyond ``bias_sigma`` does not
    average out. None: all of it is white."""
    noise_time: NotNegative = 0.0
    """Correlation time of that noise, s; noise that lasts longer than a few intervals belongs to the bias."""
    gate: Positive = 16.0
    """Largest innovation squared over its variance that is accepted."""
    interval: NotNegative = 20.0
    """Time over which samples are averaged to one update, s; less if the vehicle has moved 2 % of the map's
    correlation length."""
    sigma_limit: Positive = 500.0
    """Largest 1-sigma of a valid position, m."""
    alarm_odds: Positive = 2_000.0
    """Odds at which another explanation of the field replaces the filter's."""


def informed(options: NavigationOptions, calibration: Calibration, sigma: float) -> NavigationOptions:
    """Return options that include a calibration's own errors.

    Parameters
    ----------
    options : NavigationOptions
        Their bias is that of all other sources: the map's level, the field's variation in time.
    calibration : Calibration
        Of the total field that will be used.
    sigma : float
        nT, 1-sigma that the calibration claims for a typical sample.

    Notes
    -----
    The white part is the noise of the calibration runs. If that noise was correlated for longer than a few
    updates, it does not average out: it becomes a bias with the same correlation time, and the white part
    is what drives it, ``σ √(1 - ρ²)`` with ρ the correlation from sample to sample. A calibration's other
    errors depend on attitude and masses, and last for a leg; its level is that of all samples.
    """
    # AR(1) noise with the correlation rho from sample to sample: correlation time -dt / log(rho).
    noise = calibration.noise
    white = noise.sensor
    rho = noise.autocorrelation
    noise_time = -noise.interval / log(rho) if 0.0 < rho < 1.0 else 0.0
    lasts = LEG_TIME_S
    # Correlated for longer than a few updates: it is a bias; only its driving noise averages out.
    if noise_time > MAX_NOISE_INTERVALS * options.interval:
        white *= sqrt(noise.white + (1.0 - noise.white) * (1.0 - rho**2))
        lasts, noise_time = noise_time, 0.0
    # The rest of sigma^2, beyond level and white noise, lasts for a leg.
    level = calibration.reference.level_sigma
    slow = sqrt(max(0.0, sigma**2 - level**2 - white**2))
    known = replace(
        options,
        noise=white,
        noise_time=noise_time,
        bias_sigma=hypot(options.bias_sigma, slow),
        bias_time=min(options.bias_time, lasts) if slow > options.bias_sigma else options.bias_time,
    )
    return with_level(known, level)


def with_level(options: NavigationOptions, sigma: float) -> NavigationOptions:
    """Return options with a level that is uncertain by a further `sigma`, nT, and changes as before."""
    return _wider_level(options, hypot(options.bias_sigma, sigma)) if sigma else options


def any_level(options: NavigationOptions, grid: AnomalyGrid) -> NavigationOptions:
    """Return options with which the field's level carries no information, its changes as much as before."""
    return _wider_level(options, grid.rms)


def _wider_level(options: NavigationOptions, sigma: float) -> NavigationOptions:
    """Return options with a level of at least `sigma`, nT, whose changes are as large as before.

    Notes
    -----
    The driving noise of a Gauss-Markov process is ``2σ²/τ`` (nT²/s). σ is raised, and τ in proportion to σ²,
    so that it stays the same.
    """
    o = options
    if o.bias_sigma >= sigma:
        return o
    return replace(
        o, bias_sigma=sigma, bias_time=o.bias_time * (sigma / max(o.bias_sigma, 1e-3 * sigma)) ** 2
    )
