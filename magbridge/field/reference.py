"""Reference field at every sample of a deployment: equation 4 of the paper, and its variation in time.

The field varies by tens of nT in a day and by hundreds in a storm, nearly equally over a hundred kilometres.
The column ``daily_variation`` of a log holds this variation: a base station's field minus its median.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot, sqrt
from typing import TYPE_CHECKING

import numpy as np

from magbridge.arrays import BoolArray, FloatArray
from magbridge.columns import CHANNELS, counts_from_boot
from magbridge.datasets import in_standard_units
from magbridge.diagnostics import Diagnostic
from magbridge.errors import DataError, FormatError, OutOfRange
from magbridge.field.continuation import continued
from magbridge.field.geodesy import wrap
from magbridge.field.grid import AnomalyGrid
from magbridge.field.igrf import coverage, igrf, magnitude

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "MAIN_FIELD_RANGE_NT", "UNRECORDED_SIGMA_NT", "about_mean", "earth_field", "main_field", "mean_sigma",
    "missing_anomaly", "other_units", "placed", "positions", "reference_field", "require_date",
    "separate_observatories", "sphere_radius", "station_gaps", "variation_level_sigma",
    "with_daily_variation", "with_true_heading",
]  # fmt: skip

MAIN_FIELD_RANGE_NT = 20_000.0, 70_000.0
"""Range of the total field, nT: 22,000 to 67,000 at the surface (IGRF), plus a crustal field of thousands."""
SPHERE_TOLERANCE = 0.3
"""Largest relative difference between the field and the radius of the sphere through the readings. Soft iron
and noise cause less; another unit causes a factor of 10 or more."""
HOLE, SHORT, FEWEST = 20.0, 60.0, 3
"""Shortest hole in the positions, in median intervals and at least in s; fewest positions for the test."""


def reference_field(
    deployment: xr.Dataset,
    grid: AnomalyGrid | None = None,
    site_bias: float = 0.0,
    *,
    main: FloatArray | None = None,
) -> FloatArray:
    """Return the true total field at every sample.

    Parameters
    ----------
    deployment : Dataset
        On ``time`` (s or datetime64); the column ``reference_field`` is used where it holds a number,
        elsewhere the field is computed from ``latitude longitude depth``.
    grid : AnomalyGrid, optional
        Map that is added to the main field; if its altitude is known, continued to the deployment's depth.
    site_bias : float, optional
        Error of the main-field model at the site, nT; added where the field is modelled.
    main : (n, 3) array, optional
        :func:`main_field` of the deployment, nT, if it has been computed already.

    Returns
    -------
    ndarray, (n,)
        Total field, nT; NaN where neither a reference nor a position is known.

    Raises
    ------
    FormatError
        No reference and no position in the whole deployment, or no date.
    OutOfRange
        A date or place that the IGRF or the grid does not cover.

    Notes
    -----
    ``H_e = |IGRF(φ, λ, depth, t)| + anomaly(φ, λ, depth) + site bias``. In eq. 4 of the paper the anomaly is
    the map's at its own altitude. The main field changes by about 0.02 nT/m of depth, and anomalies of
    shallow crustal sources by far more.
    """
    deployment = in_standard_units(deployment)
    size = deployment.sizes["time"]
    given = np.array(np.broadcast_to(deployment.get("reference_field", np.nan), size), float)
    unknown = np.isnan(given)
    if not unknown.any():
        return given
    if not all(name in deployment and deployment[name].notnull().any() for name in ("latitude", "longitude")):
        if not unknown.all():
            return given
        source = deployment.attrs.get("source", "deployment")
        raise FormatError(
            source,
            "expected latitude and longitude, or reference_field: the true field is unknown "
            "(calibrate --reference mean does without)",
        )
    require_date(deployment)
    longitude, latitude, depth = positions(deployment)
    reference = given.copy()
    reference[unknown] = site_bias + magnitude((main_field(deployment) if main is None else main)[unknown])
    if grid is not None:
        there = continued(grid, depth[unknown]).grid
        reference[unknown] += there.anomaly_at(longitude[unknown], latitude[unknown], depth[unknown])
    return reference


def about_mean(deployment: xr.Dataset) -> xr.Dataset:
    """Return a deployment with the mean length of its readings as the constant ``reference_field``, nT.

    This is for a log without date and place. The mean length is the radius of the sphere through the raw
    vectors. Hard iron does not change this radius, but a gain error common to all axes does.

    FormatError: the radius is not that of the Earth's field: too few attitudes, or another unit.
    """
    raw = np.column_stack([deployment[f"mag_{axis}"].to_numpy() for axis in "xyz"])
    radius = sphere_radius(raw[np.isfinite(raw).all(axis=1)])
    if not MAIN_FIELD_RANGE_NT[0] < radius < MAIN_FIELD_RANGE_NT[1]:
        source = deployment.attrs.get("source", "deployment")
        how = f"a sphere of {radius:.0f} nT through its readings: too few attitudes, or another unit"
        raise FormatError(source, f"expected a field of the Earth's size, not {how}")
    return deployment.assign(reference_field=("time", np.full(len(raw), radius), {"units": "nT"}))


def sphere_radius(points: FloatArray) -> float:
    """Return the radius of the best-fitting sphere through points (n, 3), by linear ``|m|² = 2 m·c + d``."""
    squared = np.einsum("ij,ij->i", points, points)
    (*centre, d), *_ = np.linalg.lstsq(np.column_stack([2 * points, np.ones(len(points))]), squared)
    return float(np.sqrt(max(d + np.dot(centre, centre), 1.0)))


def earth_field(
    deployment: xr.Dataset, grid: AnomalyGrid | None = None
) -> tuple[FloatArray, FloatArray | None, str]:
    """Return the reference to which a calibration is fitted: total field, vector, and the name of the source.

    The total field (n,), nT, is :func:`reference_field`. The vector (n, 3), nT, north-east-down, has this
    length and the IGRF's direction; it is None without positions or without a date.
    """
    if not {"latitude", "longitude"} <= set(deployment.variables) or counts_from_boot(deployment):
        return reference_field(deployment, grid), None, "reference_field"
    field = main_field(deployment)
    total = reference_field(deployment, grid, main=field)
    vector = field * (total / magnitude(field))[:, None]
    given = "reference_field" in deployment
    name = " + ".join(["reference_field" if given else "IGRF", *([grid.name] if grid is not None else [])])
    return total, vector, name


def other_units(channels: FloatArray, reference: float) -> str:
    """Return a message if raw channels (n, 3) cannot be in nT, given a field of `reference` nT; else "".

    Other units, such as gauss, differ by more than the factor of ten that iron may cause.
    """
    # A factor of ten covers any iron. Beyond it, only a sphere of the right radius proves nanoteslas.
    lengths = magnitude(channels)
    whole = np.isfinite(lengths)
    read = float(np.median(lengths[whole])) if whole.any() else reference
    if 0.1 * reference < read < 10.0 * reference:
        return ""
    # Hard iron may be many times the field; the sphere through the readings still has the field's radius.
    if read > reference and abs(sphere_radius(channels[whole]) / reference - 1.0) < SPHERE_TOLERANCE:
        return ""
    return (
        f"mag_x mag_y mag_z: the length of the vector is {read:.3g} (median), where the reference is "
        f"{reference:.0f} nT: expected nT"
    )


def main_field(deployment: xr.Dataset, *, is_partial: bool = False) -> FloatArray:
    """Return the IGRF at every sample, (n, 3) nT, north-east-down; NaN where no position or date is known.

    If `is_partial`, it is also NaN at times that the IGRF does not cover. OutOfRange: else, for such a time.
    """
    field = np.full((deployment.sizes["time"], 3), np.nan)
    if {"latitude", "longitude"} <= set(deployment.variables) and not counts_from_boot(deployment):
        longitude, latitude, depth = positions(deployment)
        known = np.isfinite(longitude) & np.isfinite(latitude)
        time = deployment["time"].to_numpy()
        if is_partial and known.any():
            start, end = coverage()
            known &= (time >= start) & (time <= end)
        if known.any():
            field[known] = igrf(longitude[known], latitude[known], depth[known], time[known])
    return field


def missing_anomaly(deployment: xr.Dataset) -> str:
    """Return why a corrected deployment has positions but no anomaly at some times; "" if it has one."""
    if counts_from_boot(deployment):
        return "its times count from the boot, so no anomaly is written; give --date YYYY-MM-DD"
    if not {"latitude", "longitude"} <= set(deployment.variables):
        return ""
    try:
        igrf(0.0, 0.0, 0.0, deployment["time"].to_numpy()[[0, -1]])
    except OutOfRange as error:
        return f"no anomaly and no declination are written for times outside the IGRF: {error}"
    return ""


def require_date(deployment: xr.Dataset) -> None:
    """Check that a deployment's times are dates, which the main field needs.

    Times since boot would read as 1970, when the field differed by up to 10 %.

    FormatError: the times count from the boot.
    """
    if counts_from_boot(deployment):
        raise FormatError(
            deployment.attrs.get("source", "deployment"),
            "its times count from the boot, so the Earth's field is not known: expected the day, by "
            "--date YYYY-MM-DD, or a column reference_field; calibrate also takes --reference mean",
        )


def positions(deployment: xr.Dataset) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return longitude, latitude (deg) and depth (m, 0 if unknown) at every sample, (n,) each.

    Rows without a position are interpolated linearly in time. Rows before the first and after the last known
    position get that position.
    """
    time = deployment["time"].to_numpy()
    longitude = _interpolated(time, deployment, "longitude", turn=360.0)
    depth = _interpolated(time, deployment, "depth") if "depth" in deployment else np.zeros(time.size)
    return wrap(longitude), _interpolated(time, deployment, "latitude"), np.nan_to_num(depth)


def placed(deployment: xr.Dataset) -> BoolArray:
    """Return True for samples (n,) whose position, logged or interpolated, is known.

    A position is unknown in a hole far longer than the usual interval, where a straight line may be wrong.
    If most samples lie in such holes, as between a glider's surfacings, all positions count as known.
    """
    time = deployment["time"].to_numpy().astype(float)
    known = np.isfinite(deployment["latitude"].to_numpy().astype(float))
    if known.sum() < FEWEST:
        return np.ones(len(time), bool)
    at = time[known]
    # A hole is far longer than the usual interval; near its ends the position is still known.
    longest = max(HOLE * float(np.median(np.diff(at))), SHORT)
    after = np.searchsorted(at, time)
    before = np.where(known, time, at[np.maximum(after - 1, 0)])
    next_one = np.where(known, time, at[np.minimum(after, len(at) - 1)])
    near = np.maximum(next_one - before, np.maximum(before - time, time - next_one)) <= longest
    return np.asarray(near if near.mean() > 0.5 else np.ones(len(time), bool))


def _interpolated(
    time: FloatArray, deployment: xr.Dataset, column: str, turn: float | None = None
) -> FloatArray:
    values = deployment[column].to_numpy().astype(float)
    known = np.isfinite(values)
    if not known.any():
        return np.full(time.size, np.nan)
    # Unwrap longitudes before the interpolation.
    path: FloatArray = values[known] if turn is None else np.unwrap(values[known], period=turn)
    if known.all():
        return path
    filled: FloatArray = np.interp(time, time[known], path)
    return filled


def with_true_heading(deployment: xr.Dataset, reference: str | None = None) -> xr.Dataset:
    """Return the deployment with ``heading`` (deg) measured from true north.

    `reference` is the north of the logged headings, "true" or "magnetic", or "inertial" for true headings by
    an instrument other than the magnetometer; default: the attribute ``heading_reference``. FormatError:
    magnetic headings without a date.

    Notes
    -----
    The true heading is the magnetic one plus the IGRF's declination ``D = atan2(B_east, B_north)``. Without
    a position it is NaN.
    """
    reference = reference or deployment.attrs.get("heading_reference")
    if reference != "magnetic" or "heading" not in deployment:
        return deployment.assign_attrs(heading_reference=reference) if reference else deployment
    require_date(deployment)
    # True heading = magnetic heading + declination, D = atan2(B_east, B_north).
    north, east, _ = main_field(deployment).T
    heading = (deployment["heading"].to_numpy() + np.degrees(np.arctan2(east, north))) % 360.0
    out = deployment.assign(heading=("time", heading, deployment["heading"].attrs))
    out.attrs["heading_reference"] = "true"
    return out


MAX_STATION_GAP = 3.0, 60.0
"""Longest time between two samples of a station, or beyond its ends, in intervals and at least in s."""
DAY_S, DAILY_RANGE_NT = 86_400.0, 45.0
"""Length of a day, s, and usual range of the quiet daily variation, nT: the geometric mean of 20 and 100."""
DAILY_SIGMA_NT, DISTURBANCE_SIGMA_NT = DAILY_RANGE_NT / 8.0**0.5, 20.0
"""Standard deviation of the quiet daily variation about its mean, nT, as that of a sine of its range, and of
disturbances over years, about that of the hourly index Dst."""
UNRECORDED_SIGMA_NT = hypot(DAILY_SIGMA_NT, DISTURBANCE_SIGMA_NT)
"""1-sigma of the field's variation in time without a base station, nT."""


def separate_observatories(logs: Sequence[xr.Dataset]) -> tuple[list[xr.Dataset], list[xr.Dataset]]:
    """Return the vehicle's logs, and the logs of observatories."""
    own = [log for log in logs if "observatory" not in log.attrs]
    return own, [log for log in logs if "observatory" in log.attrs]


def with_daily_variation(logs: Sequence[xr.Dataset], base: xr.Dataset) -> list[xr.Dataset]:
    """Return the vehicle's logs with the variation of a base station's field as ``daily_variation``, nT.

    `base` has ``total_field`` (nT), ``reference_field`` or a raw vector. The variation is about its median,
    and its attribute ``level_sigma`` is the 1-sigma of this level, nT. It is NaN where `base` has no sample
    near. FormatError: `base` has none of them. DataError: `base` covers no time of a log.
    """
    total = _total(base)
    known = np.isfinite(total)
    time = base["time"].to_numpy()[known]
    varied = total[known] - np.median(total[known]) if known.any() else total[known]
    described = {"units": "nT", "level_sigma": _level_sigma(time, varied)}
    found = []
    for log in logs:
        t = log["time"].to_numpy()
        covered = _covered(t, time)
        if not covered.any():
            source = base.attrs.get("source", "the base station's log")
            raise DataError(f"{source}: does not cover the time of {log.attrs.get('source', 'the log')}")
        variation = np.where(covered, np.interp(t, time, varied), np.nan)
        found.append(log.assign(daily_variation=("time", variation, described)))
    return found


def station_gaps(logs: Sequence[xr.Dataset], source: str) -> tuple[Diagnostic, ...]:
    """Return a warning if the base station `source` does not cover all of the logs' time, else ()."""
    spans: list[float] = []
    for log in logs:
        time, rows = log["time"].to_numpy(), np.flatnonzero(np.isnan(log["daily_variation"].to_numpy()))
        runs = [run for run in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if len(run)]
        spans += [float(time[min(run[-1] + 1, len(time) - 1)] - time[run[0]]) for run in runs]
    if not spans:
        return ()
    values = {"source": source, "seconds": sum(spans), "longest_s": max(spans)}
    return (Diagnostic("base_station_gap", values),)


def _covered(t: FloatArray, time: FloatArray) -> BoolArray:
    """Return True for times (n,) with samples of a station, at `time` (m,), near on both sides, s."""
    if len(time) < 2:
        return np.zeros(len(t), bool)
    most = max(MAX_STATION_GAP[0] * float(np.median(np.diff(time))), MAX_STATION_GAP[1])
    after = np.searchsorted(time, t).clip(1, len(time) - 1)
    inside = (time[after] - time[after - 1] <= most) | (t == time[after])
    return np.asarray(inside & (t >= time[0] - most) & (t <= time[-1] + most))


def _level_sigma(time: FloatArray, variation: FloatArray) -> float:
    """Return the 1-sigma, nT, of the median of a base station's variation (n,) as that of all days.

    A record shorter than a day lacks a part of the daily variation.
    """
    if not len(variation):
        return 0.0
    unseen = max(1.0 - (time[-1] - time[0]) / DAY_S, 0.0)
    return hypot(mean_sigma(variation), DAILY_SIGMA_NT * sqrt(unseen))


def mean_sigma(variation: FloatArray) -> float:
    """Return the 1-sigma of the mean of a `variation` (n,) in time, as that of all times.

    Notes
    -----
    Values of the autocorrelation ρ hold ``N = n / (1 + 2 Σ ρ)`` independent ones, the sum up to the first ρ
    that is not positive, and their mean has the variance ``s² / (N - 1)``.
    """
    size = len(variation)
    # N from the autocovariance, by the power spectrum of the padded record.
    power = np.abs(np.fft.rfft(variation - variation.mean(), 2 * size)) ** 2
    autocovariance = np.fft.irfft(power)[:size]
    positive = autocovariance[: int((autocovariance <= 0.0).argmax()) or size]
    independent = size * autocovariance[0] / (2.0 * positive.sum() - autocovariance[0] or 1.0)
    return float(variation.std() / sqrt(max(independent - 1.0, 1.0)))


def variation_level_sigma(log: xr.Dataset) -> float:
    """Return the 1-sigma of the level of a log's ``daily_variation``, nT; 0 without a base station."""
    return float(log["daily_variation"].attrs.get("level_sigma", 0.0)) if "daily_variation" in log else 0.0


def _total(base: xr.Dataset) -> FloatArray:
    """Return the total field (n,), nT, of a base station's log."""
    for name in ("total_field", "reference_field"):
        if name in base:
            return np.asarray(base[name].to_numpy(), float)
    if all(name in base for name in CHANNELS):
        return np.asarray(np.sqrt(sum(base[name].to_numpy() ** 2 for name in CHANNELS)))
    raise FormatError(
        base.attrs.get("source", "the base station's log"), "expected total_field, or mag_x mag_y mag_z"
    )
