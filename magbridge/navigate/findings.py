"""Findings about an estimated track, and its errors against positions that the estimate did not use."""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot, sqrt
from typing import NamedTuple

import numpy as np
import xarray as xr

from magbridge.arrays import RealArray
from magbridge.field.geodesy import metres_per_degree, separation
from magbridge.field.grid import AnomalyGrid
from magbridge.field.igrf import total_field
from magbridge.navigate.options import NavigationOptions
from magbridge.navigate.record import Jump, NavigationState

__all__ = ["REFERENCES", "errors", "findings_of", "reference_track", "with_errors"]

REFERENCES = (
    ("truth_latitude", "truth_longitude"),
    ("gps_latitude", "gps_longitude"),
    ("latitude", "longitude"),
)
"""Pairs of columns that may hold a position, the best first."""


def reference_track(deployment: xr.Dataset, used: frozenset[str]) -> xr.Dataset | None:
    """Return the best positions of a log that the estimate has not used, with the total field; else None.

    `used` has the names of the columns that the estimate used.
    """
    for pair in REFERENCES:
        if pair[0] not in used and all(name in deployment for name in pair):
            others = [name for name in ("total_field_sigma", "depth") if name in deployment]
            wanted = [*pair, "total_field", *others]
            known = deployment[wanted].rename(dict(zip(pair, ("latitude", "longitude"), strict=True)))
            known = known.dropna("time", subset=["latitude", "longitude"])
            if known.sizes["time"]:
                return known.assign_attrs(reference_track=pair[0].removesuffix("latitude") or "log")
    return None


def with_errors(result: xr.Dataset, truth: xr.Dataset | None) -> xr.Dataset:
    """Return `result` with its errors against the reference track, m; NaN without one near in time."""
    if truth is None:
        return result
    time = result["time"].to_numpy()
    known = truth["time"].to_numpy()
    spacing = max(60.0, 2.0 * float(np.median(np.diff(known)))) if known.size > 1 else 60.0
    # Interpolate the reference track; a row without a reference position near in time has no error.
    nearest = np.abs(known[np.clip(np.searchsorted(known, time), 0, known.size - 1)] - time)
    before = np.abs(known[np.clip(np.searchsorted(known, time) - 1, 0, known.size - 1)] - time)
    near = np.minimum(nearest, before) <= spacing
    latitude = np.interp(time, known, truth["latitude"].to_numpy())
    longitude = np.interp(time, known, np.unwrap(truth["longitude"].to_numpy(), period=360.0))
    added = {}
    for prefix in ("", "smoothed_"):
        there = (result[f"{prefix}{name}"].to_numpy() for name in ("latitude", "longitude"))
        north, east = separation(latitude, longitude, *there)
        added[f"{prefix}error_north"] = np.where(near, north, np.nan)
        added[f"{prefix}error_east"] = np.where(near, east, np.nan)
    named = {
        name: ("time", values, {"units": "m", "long_name": name.replace("_", " ")})
        for name, values in added.items()
    }
    return result.assign(named).assign_attrs(reference_track=truth.attrs["reference_track"])


def errors(result: xr.Dataset) -> tuple[xr.DataArray, xr.DataArray]:
    """Return the position errors (n,), m, of the estimate and of dead reckoning alone; NaN where unknown."""
    if "error_north" not in result:
        nobody = result["north"] * np.nan
        return nobody, nobody
    north, east = result["error_north"], result["error_east"]
    return (north**2 + east**2) ** 0.5, ((north - result["north"]) ** 2 + (east - result["east"]) ** 2) ** 0.5


MIN_MAP_POSITIONS = 40
"""Smallest number of known positions with which the map's place is tested."""
SEARCH = 1_500.0
"""Largest displacement of the map that the search tries on each axis, m."""
LATTICE = 31
"""Number of shifts that the search tries on each axis."""
MIN_RELIEF_SIGMA = 3.0
"""Smallest RMS of an informative map, in sigmas of bias and map error."""
DOUBLE = 2.0
"""Largest scatter of field minus map with the right map, in sigmas of bias and map error."""
MAX_SHIFTED_SCATTER_FRACTION = 0.6
"""Largest scatter of field minus shifted map, over that without shift, with which a shift is reported."""
MAX_BIAS_SIGMA = 4.0
"""Largest bias that the calibration can explain, in sigmas of the bias."""
LISTED = 3
"""Number of jumps that are reported one by one: the map of another place causes dozens."""
MAX_MEDIAN_SIGMA_RATIO = 3.0
"""Largest sigma of a sample that is compared with the map, over the median sigma."""
EXPLAINED = 0.5
"""Smallest fraction of the field's variance along the track that the right map explains."""


def findings_of(
    result: xr.Dataset,
    grid: AnomalyGrid,
    options: NavigationOptions,
    jumps: Sequence[Jump],
    reference_track: xr.Dataset | None,
) -> list[str]:
    """Return findings about a navigated track, one sentence each.

    `result` holds the records made with `grid` and `options`, `jumps` the restarts in order, and
    `reference_track` ``latitude longitude total_field`` at known positions.
    """
    hours = (result["time"].to_numpy() - float(result["time"][0])) / 3600.0
    state = result["state"].to_numpy().astype(int)
    off = np.isnan(result["map_anomaly"].to_numpy())
    findings = []
    if off.any():
        findings.append(
            f"off the map for {100.0 * off.mean():.0f} % of the track, first after {hours[off][0]:.1f} h:"
            " dead reckoning only"
        )
    silent = (state == NavigationState.DEAD_RECKONING) & ~off
    if silent.mean() > 0.5:
        known = hypot(options.bias_sigma, options.map_sigma)
        variance = result["covariance_nn"] + result["covariance_ee"]
        typical = float(np.sqrt(np.median(variance.to_numpy()[silent])))
        findings.append(
            f"the field carries no information for {100.0 * silent.mean():.0f} % of the track: "
            + (
                f"the map is flat there ({grid.rms:.1f} nT RMS, where calibration and map are known only to "
                f"{known:.1f} nT)"
                if grid.rms < MIN_RELIEF_SIGMA * known
                else f"dead reckoning is as good as this map can be ({typical:.0f} m)"
            )
        )
    findings += _jumps(jumps, float(result["time"][0]))
    if (lost := (state == NavigationState.LOST)).any():
        findings.append(
            f"lost for {100.0 * lost.mean():.2g} % of the track, first after {hours[lost][0]:.1f} h"
        )
    findings += _level(result, options)
    if reference_track is not None:
        findings += _positions(grid, reference_track, options)
    if state[-1] == NavigationState.SEARCHING and not off[-1]:
        findings.append("several positions still explain the field at the end of the log")
    return findings


def _jumps(jumps: Sequence[Jump], start: float) -> list[str]:
    hours = [(jump.time_us * 1e-6 - start) / 3600.0 for jump in jumps]
    sentences = []
    for hour, jump in zip(hours, jumps[:LISTED], strict=False):
        far = hypot(jump.north, jump.east)
        moved = f"moved {far:.0f} m ({_compass(jump.north, jump.east)})" if far >= 0.5 else "restarted there"
        sentence = f"after {hour:.1f} h {jump.cause}: {moved}"
        if far > 3.0 * jump.allowed:
            sentence += (
                f", {far / jump.allowed:.0f} times what dead reckoning allows:"
                " the start or the map is in the wrong place (datum?)"
            )
        sentences.append(sentence)
    if (others := len(jumps) - LISTED) > 0:
        times = "once more" if others == 1 else f"another {others} times, the last time"
        sentences.append(f"moved {times} after {hours[-1]:.1f} h")
    return sentences


def _level(result: xr.Dataset, options: NavigationOptions) -> list[str]:
    """Return a sentence on the bias at the end of the track, if it exceeds what a calibration leaves."""
    tracked = result.where(result["state"] == NavigationState.TRACKING, drop=True)
    if not tracked.sizes["time"]:
        return []
    last = tracked.isel(time=slice(-max(1, tracked.sizes["time"] // 4), None))
    bias, sigma = float(last["bias"].mean()), float(last["bias_sigma"].mean())
    if abs(bias) < MAX_BIAS_SIGMA * max(options.bias_sigma, sigma):
        return []
    sentence = (
        f"the measured level differs from the map's by {bias:+.0f} nT, where the calibration allows"
        f" {options.bias_sigma:.1f} nT: the map's main field may be of another epoch, or at another altitude"
    )
    return [sentence]


class _Shift(NamedTuple):
    """Best-fitting shift of a map, m north and east, and the scatter (nT) with it and without it."""

    north: float
    east: float
    there: float
    here: float


def _best_shift(
    grid: AnomalyGrid, latitude: RealArray, longitude: RealArray, depth: RealArray, anomaly: RealArray
) -> _Shift:
    """Return the shift with which the map best describes an anomaly (n,), nT, except for a constant."""
    # Exhaustive search over a lattice of shifts: the scatter has many minima.
    shifts = np.linspace(-SEARCH, SEARCH, LATTICE)
    per_latitude, per_longitude = metres_per_degree(float(np.mean(latitude)))
    best = (0.0, 0.0, np.inf)
    origin = np.inf
    for north in shifts:
        for east in shifts:
            seen = grid.evaluate(longitude - east / per_longitude, latitude - north / per_latitude, depth)
            left = anomaly - seen.anomaly
            if np.isfinite(left).mean() < 0.8:
                continue
            scatter = float(np.nanstd(left))
            if north == 0.0 and east == 0.0:
                origin = scatter
            if scatter < best[2]:
                best = (float(north), float(east), scatter)
    return _Shift(*best, origin)


def _positions(grid: AnomalyGrid, reference_track: xr.Dataset, options: NavigationOptions) -> list[str]:
    """Return sentences on errors of the map (level, place, wrong field) by the field at known positions."""
    latitude, longitude = reference_track["latitude"].to_numpy(), reference_track["longitude"].to_numpy()
    depth = np.broadcast_to(np.nan_to_num(reference_track.get("depth", 0.0)), latitude.shape)
    time = reference_track["time"].to_numpy()
    measured = reference_track["total_field"].to_numpy() - total_field(longitude, latitude, depth, time)
    known = np.isfinite(measured + grid.evaluate(longitude, latitude, depth).anomaly)
    if "total_field_sigma" in reference_track:  # while a mass moves, the field may err by any amount
        sigma = reference_track["total_field_sigma"].to_numpy()
        known &= sigma <= MAX_MEDIAN_SIGMA_RATIO * np.nanmedian(sigma)
    if known.sum() < MIN_MAP_POSITIONS:
        return []
    # 400 positions suffice for the scatter of a map.
    thin = np.flatnonzero(known)[:: max(1, int(known.sum()) // 400)]
    measured, latitude, longitude, depth = measured[thin], latitude[thin], longitude[thin], depth[thin]
    north, east, there, here = _best_shift(grid, latitude, longitude, depth, measured)
    level = float(np.mean(measured - grid.evaluate(longitude, latitude, depth).anomaly))
    step = 2.0 * SEARCH / (LATTICE - 1)
    findings = []
    if abs(level) > MAX_BIAS_SIGMA * options.bias_sigma + here:
        findings.append(
            f"at the known positions the field is {abs(level):.0f} nT {'above' if level > 0 else 'below'} "
            "the map's level: its main field may be of another epoch, or at another altitude"
        )
    expected = DOUBLE * hypot(options.bias_sigma, options.map_sigma)
    if there < min(MAX_SHIFTED_SCATTER_FRACTION * here, expected) and hypot(north, east) > step:
        findings.append(
            f"at the known positions the map fits best when moved {hypot(north, east):.0f} m"
            f" ({_compass(north, east)}): {there:.1f} nT instead of {here:.1f} nT; another datum?"
        )
    elif here > max(sqrt(1.0 - EXPLAINED) * float(np.std(measured)), expected):
        findings.append(
            f"at the known positions the map leaves {here:.1f} nT of the field's {np.std(measured):.1f} nT "
            "unexplained: it is not a map of this field"
        )
    return findings


def _compass(north: float, east: float) -> str:
    points = ("N", "NE", "E", "SE", "S", "SW", "W", "NW")
    return points[round(float(np.degrees(np.arctan2(east, north))) / 45.0) % 8]
