"""Compensate a scalar magnetometer by the direction of a vector sensor and by telemetry.

Notes
-----
A scalar magnetometer on a vehicle reads the Earth's field F and what the vehicle adds along it (Tolles &
Lawson 1950; Leliak 1961, doi:10.1109/TANE3.1961.4201799)::

    s - F = u.p + (F / F_0) u^T I u + u^T E du/dt + sum_k z_k (u.c_k) + a dF/dt + level

u is the unit vector of the field in the vector sensor's axes, p the permanent field (nT), I the induced
(nT, symmetric), E that of the eddy currents (nT s), z_k a telemetry channel about its centre in units of
its swing, c_k its field (nT a swing), and the level is one constant for each power cycle. If the scalar is
late, s is the reading of that much later, and a (s, negative if the scalar is late) is what remains of the
lag; with known coefficients its column is the rate of the whole right side. All coefficients are Gaussian
with the prior widths that the fit chose.

The width of a channel's prior is for one swing *over everything known, the log to be corrected included*:
:func:`magbridge.calibration.fitting.scalar_fit.adapt_to_log`.
"""

from __future__ import annotations

from enum import IntFlag
from typing import NamedTuple

import msgspec
import numpy as np

from magbridge.arrays import BoolArray, FloatArray
from magbridge.constants import MAIN_FIELD_SIGMA_NT
from magbridge.errors import CalibrationError
from magbridge.estimation.residual import PAIRS, robust_scale, symmetric

__all__ = [
    "CYCLE_LEVEL_SIGMA_NT", "DISAGREEMENT_SIGMA", "IMPOSSIBLE_FRACTION", "PLATFORM_TERMS", "RANGE_MARGIN",
    "CorrectedScalar", "ScalarChannel", "ScalarNoise", "ScalarQuality",
    "ScalarSensor", "ScalarSeries", "SensorDisagreement", "compare_sensors", "correct_scalar",
    "moved_earlier", "scalar_design", "term_columns", "unknown_direction_variance",
]  # fmt: skip

PLATFORM_TERMS = 19
"""Permanent (3), induced (6), eddy (9) and lag (1) columns, before the channels' three each."""
PLATFORM_COLUMNS = {
    "permanent": slice(0, 3), "induced": slice(3, 9), "eddy": slice(9, 18), "lag": slice(18, 19)
}  # fmt: skip
CYCLE_LEVEL_SIGMA_NT = 30.0
"""1-sigma of the level of a power cycle, nT."""
SAME_POWER_CYCLE_S = 12 * 3600.0
"""Time within which a log without a power cycle's number is taken to be of the fitted cycle, s."""
MAX_MOVE_INTERVALS = 3.0
"""Intervals between two readings, across which a moved reading is not interpolated."""
RANGE_MARGIN = 0.02
"""Fraction of a channel's range by which telemetry may exceed it without a flag."""
JUMP_SIGMA = 8.0
"""Change from one sample to the next, in robust standard deviations of the changes, that is a jump."""
DISAGREEMENT_SIGMA = 4.0
"""Difference of two sensors, in its standard deviations, from which on it is flagged."""
IMPOSSIBLE_FRACTION = 0.2
"""Distance from the reference, as a fraction of it, that neither crust nor vehicle explains."""
MIN_AGREEING_SAMPLES = 10
"""Samples at which two sensors agree, from which on these show the crustal field."""
BLAME_RATIO = 2.0
"""Ratio of two sensors' standardised distances from the reference, beyond which the farther one is blamed."""


class ScalarQuality(IntFlag):
    """Flags of a compensated sample, column ``scalar_quality``."""

    EXTRAPOLATED = 1
    """A telemetry channel is outside the range of the fit."""
    DISAGREES = 2
    """The vector's direction is doubtful, or the scalar differs from vector or main field."""
    JUMP = 4
    """The reading jumped while the vector sensor's did not."""
    MISSING = 8
    """A channel, the direction or the reading is unknown: without a value, 0, or repeated."""


class ScalarChannel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A telemetry channel of the compensation."""

    name: str
    """Column of the log."""
    centre: float
    """Median of the channel in the fitted logs, in its unit."""
    quantiles: tuple[float, float]
    """2 % and 98 % quantile of the channel in the fitted logs, in its unit."""
    low: float
    """Smallest value in the fitted logs, in its unit."""
    high: float
    """Largest value in the fitted logs, in its unit."""
    unit: str = ""

    @property
    def scale(self) -> float:
        """The channel's swing in the fitted logs, in its unit; 1 for a channel that did not change."""
        swing = self.quantiles[1] - self.quantiles[0]
        return swing if swing > 0.0 else 1.0


class ScalarNoise(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Noise of the compensated scalar: white, and a sum of Ornstein-Uhlenbeck processes (flicker)."""

    white: float
    """1-sigma of the white part of one sample, nT."""
    interval: float
    """Interval of the samples to which `white` refers, s."""
    time_constants: tuple[float, ...] = ()
    """Correlation times of the Ornstein-Uhlenbeck processes, s."""
    process_sigma: tuple[float, ...] = ()
    """1-sigma of each process, nT."""


class ScalarSensor(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A calibrated scalar magnetometer: one entry of ``sensors`` in ``cal.json``."""

    kind: str
    """``scalar``."""
    column: str
    """Column of the log that holds the scalar's reading, nT."""
    directions_from: str
    """Vector sensor whose corrected field gives the directions u."""
    reference_field: float
    """Field F_0 that scales the induced terms, nT."""
    channels: tuple[ScalarChannel, ...]
    coefficients: tuple[float, ...]
    """Permanent (nT), induced xx yy zz xy xz yz (nT), eddy (nT s, row by row), lag (s), three for each
    channel (nT a swing), then one level for each power cycle (nT)."""
    covariance: tuple[tuple[float, ...], ...]
    """Covariance of the coefficients for the prior's widths `prior_sigma`."""
    prior_sigma: tuple[float, ...]
    """1-sigma of each coefficient's prior."""
    noise: ScalarNoise
    power_cycles: tuple[int | None, ...] = (None,)
    """Number of the power cycle of each level."""
    fitted_from: float = 0.0
    """s since 1970 UTC, first sample of the fit."""
    fitted_until: float = 0.0
    """s since 1970 UTC, last sample of the fit."""
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Forward, starboard and down from the positions' origin to the scalar sensor, m."""
    slow_variance: float = 0.0
    """nT^2, variance of the slow noise: the sigma of the corrected field counts it."""
    lag: float = 0.0
    """s, by which the reading is behind the vector: it is moved before the terms are subtracted."""
    width_covariance: tuple[tuple[float, ...], ...] = ()
    """Covariance of the coefficients that the uncertainty of the prior's widths adds to `covariance`."""

    @property
    def total_covariance(self) -> FloatArray:
        """Covariance (m, m) of the coefficients, with that of uncertain widths."""
        covariance = np.array(self.covariance)
        return covariance + np.array(self.width_covariance) if self.width_covariance else covariance

    def without_shift(self) -> ScalarSensor:
        """Return the sensor with its lag as the coefficient of the reading's rate, for live use."""
        k = PLATFORM_TERMS - 1
        coefficients = *self.coefficients[:k], self.coefficients[k] - self.lag, *self.coefficients[k + 1 :]
        return msgspec.structs.replace(self, lag=0.0, coefficients=coefficients)


class ScalarSeries(NamedTuple):
    """Samples of a scalar magnetometer and a vector sensor."""

    time: FloatArray
    """(n,), s since 1970 UTC, ascending."""
    scalar: FloatArray
    """(n,), nT, as read; NaN where missing."""
    vector: FloatArray
    """(n, 3), nT, field of the vector sensor, corrected where it is calibrated."""
    reference: FloatArray
    """(n,), nT, reference field (main field, map); NaN where unknown."""
    channels: FloatArray
    """(n, k), telemetry, in the channels' order."""
    power_cycle: FloatArray
    """(n,), number of the power cycle; NaN where unknown."""


class CorrectedScalar(NamedTuple):
    """A compensated scalar magnetometer, n samples."""

    field: FloatArray
    """(n,), nT."""
    sigma: FloatArray
    """(n,), nT, standard deviation of `field`."""
    level_sigma: FloatArray
    """(n,), nT, the part of `sigma` that all samples of a power cycle share."""
    extrapolated: BoolArray
    """(n,), a channel is outside the range of the fit."""
    missing: BoolArray
    """(n,), a channel or the direction is unknown."""


def moved_earlier(reading: FloatArray, time: FloatArray, lag: float) -> FloatArray:
    """Return the reading (n,), nT, of `lag` (s) later; NaN where that is in a gap or outside the log.

    A cubic through the readings on both sides, whose slopes are central differences.
    """
    known = np.isfinite(reading)
    moments, first = np.unique(time[known], return_index=True)
    if lag == 0.0 or len(moments) < 2:
        return reading
    values, widths = reading[known][first], np.diff(moments)
    slopes = np.gradient(values, moments)
    step = float(np.median(widths))
    k = np.clip(np.searchsorted(moments, time + lag, "right") - 1, 0, len(widths) - 1)
    h = widths[k]
    x = (time + lag - moments[k]) / h
    moved = values[k] * (1.0 + 2.0 * x) * (1.0 - x) ** 2 + values[k + 1] * (3.0 - 2.0 * x) * x**2
    moved += h * x * (1.0 - x) * (slopes[k] * (1.0 - x) - slopes[k + 1] * x)
    # In a gap and outside the log a straight line from the near side, for at most one interval.
    open_end = (x < 0.0) | (x > 1.0) | (h > MAX_MOVE_INTERVALS * step)
    after, before = x * h, (1.0 - x) * h
    is_first = np.abs(after) < np.abs(before)
    line = np.where(is_first, values[k] + slopes[k] * after, values[k + 1] - slopes[k + 1] * before)
    moved = np.where(open_end, line, moved)
    far = open_end & (np.minimum(np.abs(after), np.abs(before)) > step)
    return np.where(far | ~known, np.nan, moved)


def scalar_design(
    series: ScalarSeries,
    channels: tuple[ScalarChannel, ...],
    reference_field: float,
    coefficients: FloatArray | None = None,
) -> FloatArray:
    """Return the columns (n, 19 + 3k) of the model, without levels; `reference_field` is F_0, nT.

    With `coefficients` of the terms the lag's column is the rate of the reference and of the vehicle's field.
    """
    length = np.sqrt(np.einsum("ni,ni->n", series.vector, series.vector))
    u = series.vector / length[:, None]
    turn = _rate(u, series.time)  # du/dt, 1/s
    ratio = length / reference_field
    columns = [*u.T]
    columns += [(2.0 - (i == j)) * u[:, i] * u[:, j] * ratio for i, j in PAIRS]
    columns += [u[:, i] * turn[:, j] for i in range(3) for j in range(3)]
    smooth = series.reference if np.isfinite(series.reference).any() else series.scalar
    known = np.isfinite(smooth)
    rate = _rate(smooth, series.time)
    columns.append(np.interp(series.time, series.time[known], rate[known]) if known.any() else rate)
    for channel, values in zip(channels, series.channels.T, strict=True):
        z = (values - channel.centre) / channel.scale
        columns += [z * u[:, i] for i in range(3)]
    design = np.stack(columns, axis=1)
    if coefficients is not None and np.isfinite(series.reference).any():  # the reading's rate has both
        k = PLATFORM_TERMS - 1
        others = np.delete(design, k, axis=1) @ np.delete(coefficients[: design.shape[1]], k)
        design[:, k] += np.nan_to_num(_rate(others, series.time))
    return design


def _rate(values: FloatArray, time: FloatArray) -> FloatArray:
    """Return the derivative by time, (n,) or (n, 3), over the known rows; NaN in the others."""
    known = np.isfinite(values).reshape(len(values), -1).all(axis=1)
    moments, first, same = np.unique(time[known], return_index=True, return_inverse=True)
    rate = np.where(np.isfinite(values), 0.0, np.nan)
    if len(moments) > 1:
        rate[known] = np.gradient(values[known][first], moments, axis=0)[same]
    return rate


def term_columns(channels: tuple[ScalarChannel, ...]) -> dict[str, slice]:
    """Return the columns of :func:`scalar_design` that each term has: the platform's, then the channels'."""
    columns = dict(PLATFORM_COLUMNS)
    for index, channel in enumerate(channels):
        columns[channel.name] = slice(PLATFORM_TERMS + 3 * index, PLATFORM_TERMS + 3 * index + 3)
    return columns


def correct_scalar(sensor: ScalarSensor, series: ScalarSeries) -> CorrectedScalar:
    """Compensate a scalar magnetometer; the reference of `series` may be NaN throughout.

    The field (n,) is NaN where a channel, the direction or the reading is unknown; its sigma there is
    infinite. CalibrationError: another number of channels than the sensor's.
    """
    known = sensor.channels
    if series.channels.shape[1] != len(known):
        names = ", ".join(channel.name for channel in known)
        raise CalibrationError(f"expected {len(known)} channels ({names}), got {series.channels.shape[1]}")
    mean, covariance = np.array(sensor.coefficients), sensor.total_covariance
    series = series._replace(scalar=moved_earlier(series.scalar, series.time, sensor.lag))
    design = scalar_design(series, known, sensor.reference_field, mean)
    size = design.shape[1]
    level, level_sigma, cross = _level(sensor, series, mean, covariance)
    with np.errstate(invalid="ignore"):
        field = series.scalar - design @ mean[:size] - level
        platform = np.einsum("ni,ij,nj->n", design, covariance[:size, :size], design)
        joint = 2.0 * np.einsum("ni,ni->n", design, cross)
        variance = np.maximum(platform + joint + level_sigma**2, 0.0)
        common = _common_variance(design, covariance[:size, :size], cross, level_sigma)
        common = np.fmin(common, variance)
        variance += sensor.noise.white**2 + sensor.slow_variance
        low = np.array([channel.low for channel in known])
        high = np.array([channel.high for channel in known])
        margin = RANGE_MARGIN * (high - low)
        outside = ((series.channels < low - margin) | (series.channels > high + margin)).any(axis=1)
    missing = ~np.isfinite(field)
    sigma = np.where(missing, np.inf, np.sqrt(variance))
    return CorrectedScalar(field, sigma, np.sqrt(common), np.asarray(outside & ~missing), missing)


def _common_variance(
    design: FloatArray, covariance: FloatArray, cross: FloatArray, level_sigma: FloatArray
) -> FloatArray:
    """Return the variance (n,), nT^2, that all samples of a power cycle share.

    Notes
    -----
    The errors of two samples with the rows a, b (terms and level) have the covariance ``a^T C b``. Its mean
    over all pairs of a power cycle is ``m^T C m``, with m the mean row. The level alone is not it: its error
    is correlated with that of the terms. `cross` (n, m) and `level_sigma` (n,) are those of :func:`_level`.
    """
    variance = np.full(len(design), np.nan)
    for level in np.unique(np.column_stack([level_sigma, cross]), axis=0):
        rows = (level_sigma == level[0]) & (cross == level[1:]).all(axis=1)
        known = design[rows & np.isfinite(design).all(axis=1)]
        if len(known):
            mean = known.mean(axis=0)
            common = mean @ covariance @ mean + 2.0 * mean @ level[1:] + level[0] ** 2
            variance[rows] = max(float(common), 0.0)
    return variance


def unknown_direction_variance(sensor: ScalarSensor, channels: FloatArray) -> FloatArray:
    """Return the variance (n,), nT^2, of a compensation whose direction may be any; `channels` (n, k).

    Notes
    -----
    The terms are u.p, u^T I u and z_k (u.c_k). The squares of p, of I without the part that is the same in
    all directions, and of z_k c_k are added: an upper bound of each term's square.
    """
    mean = np.array(sensor.coefficients)
    induced = symmetric(mean[None, PLATFORM_COLUMNS["induced"]])[0]
    induced -= np.trace(induced) / 3.0 * np.eye(3)
    constant = float((mean[PLATFORM_COLUMNS["permanent"]] ** 2).sum() + (induced**2).sum())
    variance = np.full(len(channels), constant)
    for k, one in enumerate(sensor.channels):
        field = mean[PLATFORM_TERMS + 3 * k : PLATFORM_TERMS + 3 * k + 3]
        variance += np.nan_to_num((channels[:, k] - one.centre) / one.scale) ** 2 * (field @ field)
    return variance


def _level(
    sensor: ScalarSensor, series: ScalarSeries, mean: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the level of every sample (n,), its sigma (n,), and its covariance with the terms (n, m)."""
    n, size = len(series.time), len(mean) - len(sensor.power_cycles)
    level, sigma, cross = np.zeros(n), np.full(n, CYCLE_LEVEL_SIGMA_NT), np.zeros((n, size))
    near = (series.time > sensor.fitted_from - SAME_POWER_CYCLE_S) & (
        series.time < sensor.fitted_until + SAME_POWER_CYCLE_S
    )
    for index, cycle in enumerate(sensor.power_cycles, size):
        unnumbered = np.isnan(series.power_cycle) & near
        rows = unnumbered if cycle is None else series.power_cycle == cycle
        level[rows], sigma[rows] = mean[index], np.sqrt(covariance[index, index])
        cross[rows] = covariance[index, :size]
    return level, sigma, cross


class SensorDisagreement(NamedTuple):
    """Variances and flags that the comparison of a scalar and a vector sensor adds, n samples."""

    scalar_variance: FloatArray
    """(n,), nT^2, to add to the scalar's variance."""
    vector_variance: FloatArray
    """(n,), nT^2, to add to the variance of the vector sensor's total field."""
    disagrees: BoolArray
    """(n,), the difference is beyond its standard deviation."""
    jump: BoolArray
    """(n,), the scalar jumped and the vector sensor did not."""


def compare_sensors(
    scalar: FloatArray,
    scalar_sigma: FloatArray,
    total: FloatArray,
    total_sigma: FloatArray,
    reference: FloatArray,
) -> SensorDisagreement:
    """Compare a compensated scalar sensor with the length of a corrected vector.

    All are (n,), nT: both sensors' total field with its 1-sigma, and the reference; NaN where unknown.

    Notes
    -----
    With ``w`` the difference, ``max(0, w^2 - s1^2 - s2^2)`` is its variance that neither sigma explains. It
    is added to the sensor that is the farther from the expected field, in standard deviations that include
    the expectation's own; to both where that does not distinguish them. The expected field is the reference
    plus what both sensors read of the crust before and after, where they agree: a disturbance that cancels a
    crustal anomaly is thus not taken for the truth. A scalar that is farther from the reference than
    :data:`IMPOSSIBLE_FRACTION` of it disagrees, and the distance is an error.
    """
    with np.errstate(invalid="ignore"):
        difference = scalar - total
        expected = scalar_sigma**2 + total_sigma**2
        excess = np.nan_to_num(np.maximum(difference**2 - expected, 0.0), posinf=0.0)
        disagrees = difference**2 > DISAGREEMENT_SIGMA**2 * expected
        field, sigma = _expected_field(0.5 * (scalar + total), reference, disagrees)
        off_scalar = np.abs(scalar - field) / np.hypot(scalar_sigma, sigma)
        off_total = np.abs(total - field) / np.hypot(total_sigma, sigma)
        # Neither sensor is blamed alone where the expected field is unknown: both comparisons are False.
        blame_vector = off_total > BLAME_RATIO * off_scalar
        blame_scalar = off_scalar > BLAME_RATIO * off_total
        far = np.abs(scalar - reference) > IMPOSSIBLE_FRACTION * reference
    scalar_excess = np.where(far, (scalar - reference) ** 2, np.where(blame_vector, 0.0, excess))
    vector_excess = np.where(blame_scalar, 0.0, excess)
    jump = _jumps(scalar) & ~_jumps(total)
    return SensorDisagreement(scalar_excess, vector_excess, np.asarray(disagrees | far), jump)


def _expected_field(
    mean: FloatArray, reference: FloatArray, disagrees: BoolArray
) -> tuple[FloatArray, float]:
    """Return the field that both sensors should read (n,), nT, and its 1-sigma, from their `mean` (n,)."""
    # where they agree, mean - reference is the crustal field; without a reference, interpolate the mean
    rows = np.flatnonzero(np.isfinite(mean) & ~disagrees)
    base = reference if np.isfinite(reference).any() else np.zeros(len(mean))
    rows = rows[np.isfinite(base[rows])]
    if len(rows) < MIN_AGREEING_SAMPLES:
        return reference, MAIN_FIELD_SIGMA_NT
    crust = (mean - base)[rows]
    sigma = min(robust_scale(crust - np.median(crust)), MAIN_FIELD_SIGMA_NT)
    return base + np.interp(np.arange(len(mean)), rows, crust), sigma


def _jumps(values: FloatArray) -> BoolArray:
    """Return where values (n,), nT, change by far more than they usually do from one sample to the next."""
    change = np.abs(np.diff(values, prepend=values[:1]))
    known = change[np.isfinite(change)]
    usual = robust_scale(known) if len(known) else 0.0
    return np.asarray(np.nan_to_num(change) > JUMP_SIGMA * max(usual, 1e-3))
