"""Prior uncertainties of start, current, calibration and map; and the map at the vehicle's depth."""

from __future__ import annotations

from math import hypot, isfinite, log, sqrt

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import ArrayLike

from magbridge.calibration.model import Calibration
from magbridge.config import NotNegative, Positive
from magbridge.errors import OutOfRange
from magbridge.field.continuation import continued
from magbridge.field.grid import AnomalyGrid

__all__ = ["NavigationOptions", "at_depth", "informed", "lasting_errors", "wider_level", "with_level"]

MAX_NOISE_INTERVALS = 3.0
"""Longest correlation time of noise, in update intervals; noise with a longer one counts as a bias."""
LEG_TIME_S = 1_800.0
"""Duration of a leg between turns, or from dive to climb, s."""


class NavigationOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Prior uncertainties (1-sigma) and limits of the navigator."""

    start_sigma: Positive = 50.0
    """1-sigma of the first position on each axis, m."""
    current_sigma: NotNegative = 0.1
    current_time: Positive = 21_600.0
    """`current_sigma`, `current_time`: 1-sigma of the current, m/s, and its correlation time, s."""
    drift: NotNegative = 0.2
    """Random walk of the dead reckoning, m/sqrt(s)."""
    motion_error: NotNegative = 0.02
    """Relative error of the speed, and error of the heading in rad. A turn adds this fraction of its change
    of velocity to the uncertainty of the current."""
    bias_sigma: NotNegative = 5.0
    bias_time: Positive = 21_600.0
    """`bias_sigma`, `bias_time`: 1-sigma of the calibration's residual error, nT; correlation time, s."""
    map_sigma: NotNegative = 2.0
    map_length: Positive = 1_000.0
    """`map_sigma`, `map_length`: 1-sigma of the map's error, nT, and its correlation length, m. Independent
    errors of single nodes are the grid's own sigma."""
    noise: NotNegative | None = None
    """White noise of a sample, nT. The rest of the sample's sigma beyond ``bias_sigma`` does not average out.
    None: all of the sigma is white noise."""
    noise_time: NotNegative = 0.0
    """Correlation time of ``noise``, s; noise that lasts longer than a few intervals belongs to the bias."""
    gate: Positive = 16.0
    """Largest squared innovation over its variance that the filter accepts."""
    interval: NotNegative = 20.0
    """Longest time over which samples are averaged to one update, s. Averaging ends earlier if the vehicle
    has moved 2 % of the map's correlation length."""
    sigma_limit: Positive = 500.0
    """Largest 1-sigma of a valid position, m; beyond it, a position that was known counts as lost."""
    alarm_odds: Positive = 2_000.0
    """Odds at which another explanation of the field replaces the filter's."""


def informed(options: NavigationOptions, calibration: Calibration, sigma: float) -> NavigationOptions:
    """Return options that include the calibration's errors; `sigma` (nT) is the 1-sigma of a typical sample.

    The bias of `options` covers all other sources: the map's level, the field's variation in time.

    Notes
    -----
    The white noise is that of the calibration runs. If their noise was correlated for longer than a few
    updates, it does not average out. It then counts as a bias with the same correlation time, and the white
    noise is its driving noise ``σ √(1 - ρ²)``, with ρ the correlation from sample to sample. Other errors of
    a calibration depend on attitude and masses, and last for a leg; the reference bias is constant.
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
    """Return options whose bias has a further uncertainty of `sigma`, nT, but the same driving noise."""
    return wider_level(options, hypot(options.bias_sigma, sigma)) if sigma else options


def wider_level(options: NavigationOptions, sigma: float) -> NavigationOptions:
    """Return options whose bias has a 1-sigma of at least `sigma`, nT, and the same driving noise.

    With the map's RMS, the field's absolute value carries no information, but its changes do.

    Notes
    -----
    The driving noise of a Gauss-Markov process, ``2σ²/τ`` (nT²/s), stays the same if τ rises with σ².
    """
    o = options
    if o.bias_sigma >= sigma:
        return o
    longer = (sigma / max(o.bias_sigma, 1e-3 * sigma)) ** 2
    return replace(o, bias_sigma=sigma, bias_time=o.bias_time * longer)


NEGLIGIBLE_FRACTION = 0.1
"""Largest negligible interpolation error over the map error: their sum is then less than 1 % larger."""


def at_depth(
    grid: AnomalyGrid, options: NavigationOptions, depth: ArrayLike
) -> tuple[AnomalyGrid, NavigationOptions]:
    """Return the map at the vehicle's depth, and options with the errors of continuation and interpolation.

    A map of unknown altitude is returned as it is. `depth` (n,), m, is the vehicle's; NaN is ignored, and
    without any depth the map is continued to the surface.

    Notes
    -----
    Independent errors of the map add their variances σᵢ² and the mean squares of their slopes, σᵢ²/Lᵢ². The
    correlation length L of the sum follows from 1/L² = Σ(σᵢ²/Lᵢ²) / Σσᵢ². The correlation length of the
    interpolation error is half the spacing of the nodes.
    """
    known = np.asarray(depth, float)
    known = known[np.isfinite(known)]
    # Errors of the continued map add to the map's own error as independent ones.
    there = continued(grid, known if known.size else 0.0)
    errors = [(there.sigma, there.length)] if there.sigma else []
    if grid.interpolation_sigma > NEGLIGIBLE_FRACTION * options.map_sigma:
        errors.append((grid.interpolation_sigma, 0.5 * grid.spacing))
    return lasting_errors(there.grid, _added(options, errors) if errors else options)


def lasting_errors(grid: AnomalyGrid, options: NavigationOptions) -> tuple[AnomalyGrid, NavigationOptions]:
    """Return map and options in which correlated errors of the map are in the filter's map error and bias.

    A sigma of the map with a ``sigma_length`` is correlated along the track. It belongs to the filter's
    state of map error, not to the noise of a measurement. The state is a typical error, from the median sigma
    and the options; the map's sigma at a node scales it. The sigma of the map's level adds to the bias.
    """
    options = with_level(options, grid.level_sigma)
    if grid.level_sigma:
        grid = grid.replaced(level_sigma=0.0)
    typical = float(np.median(grid.sigma[np.isfinite(grid.anomaly)]))
    if not (grid.sigma_length and typical):
        return grid, options
    known = _added(options, [(typical, grid.sigma_length)])
    sigma = np.hypot(grid.sigma, options.map_sigma)
    return grid.replaced(sigma=sigma, sigma_length=0.0, typical_error=known.map_sigma), known


def _added(options: NavigationOptions, errors: list[tuple[float, float]]) -> NavigationOptions:
    """Return options whose map error includes `errors`, pairs of a sigma, nT, and a correlation length, m.

    OutOfRange: a sigma that is not finite.
    """
    whole = [*errors, (options.map_sigma, options.map_length)]
    sigma = hypot(*(sigma for sigma, _ in whole))
    if not isfinite(sigma):
        raise OutOfRange("map's sigma", f"{sigma} nT", "only a map with a finite sigma can be used")
    # sigma^2 = sum s_i^2 and (sigma / L)^2 = sum (s_i / L_i)^2.
    steepness = hypot(*(sigma / length for sigma, length in whole))
    return replace(options, map_sigma=sigma, map_length=sigma / steepness)
