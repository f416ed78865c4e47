"""Navigation of a whole log on a map: the navigator over all rows, a smoother's backward pass, findings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from filterpy.kalman import rts_smoother

from magbridge.arrays import FloatArray, RealArray
from magbridge.datasets import increasing
from magbridge.errors import FormatError
from magbridge.field.geodesy import offset
from magbridge.field.grid import AnomalyGrid
from magbridge.logs.deployment import deployment as made
from magbridge.navigate.deadreckoning import GLIDE
from magbridge.navigate.findings import REFERENCES, findings_of, reference_track, with_errors
from magbridge.navigate.navigator import NO_POSITION_FLAGS, Navigator
from magbridge.navigate.options import NavigationOptions
from magbridge.navigate.record import Record
from magbridge.progress import track

__all__ = ["COLUMN_UNITS", "MOTIONS", "columns_of", "first_position", "motion_of", "navigate", "samples_of"]

MOTIONS: dict[str, dict[str, str]] = {
    "velocity": {"velocity_north": "velocity_north", "velocity_east": "velocity_east"},
    "speed": {"water_speed": "speed", "heading": "heading"},
    "local": {"local_north": "north", "local_east": "east"},
    "inertial": {"dr_latitude": "dr_latitude", "dr_longitude": "dr_longitude"},
    "glide": {"depth": "depth", "pitch": "pitch", "heading": "heading"},
    "position": {"latitude": "dr_latitude", "longitude": "dr_longitude"},
}
"""Kinds of motion, the best first: the log's columns, and their names in :meth:`DeadReckoning.telemetry`."""

COLUMN_UNITS = {
    "latitude": "deg", "longitude": "deg", "smoothed_latitude": "deg", "smoothed_longitude": "deg",
    "depth": "m", "covariance_nn": "m2", "covariance_ne": "m2", "covariance_ee": "m2",
    "innovation": "nT", "innovation_variance": "nT2", "anomaly": "nT", "map_anomaly": "nT",
    "bias": "nT", "bias_sigma": "nT", "map_error": "nT", "current_north": "m s-1", "current_east": "m s-1",
    "north": "m", "east": "m", "smoothed_sigma_north": "m", "smoothed_sigma_east": "m",
}  # fmt: skip


def navigate(
    deployment: xr.Dataset,
    grid: AnomalyGrid,
    options: NavigationOptions | None = None,
    *,
    start: tuple[float, float] | None = None,
) -> xr.Dataset:
    """Estimate the track of a log from its total field and a map.

    Parameters
    ----------
    deployment : Dataset
        On ``time``, with ``total_field`` (nT), ``total_field_sigma`` if known (else 1 nT), and the columns of
        one of :data:`MOTIONS`.
    grid : AnomalyGrid
        The anomaly map, at the altitude where the vehicle is (:func:`~.options.at_depth`).
    options : NavigationOptions, optional
        How well start, current, calibration and map are known.
    start : (latitude, longitude), optional
        Position at the start, deg; default: the log's first position.

    Returns
    -------
    Dataset
        On ``time`` of the updates: every field of :class:`~magbridge.navigate.record.Record`,
        ``smoothed_*`` from the backward pass, and ``error_*`` (m) if the log has a better position. The
        attributes are ``findings`` (one sentence a line), ``motion`` and ``reference_track``.

    Raises
    ------
    FormatError
        No total field, no motion, no start, time that does not increase, or no usable sample.
    OutOfRange
        A date that the IGRF does not cover.
    """
    source = str(deployment.attrs.get("source", "deployment"))
    options = options or NavigationOptions()
    time, field, sigma = samples_of(deployment, source)
    motion = motion_of(deployment, source)
    navigator = Navigator(grid, options)
    latitude, longitude = start if start is not None else first_position(deployment, source)
    moves = columns_of(deployment, MOTIONS[motion] | {"depth": "depth"})
    records: list[Record] = []
    states: list[tuple[FloatArray, FloatArray, FloatArray, FloatArray, int]] = []

    def keep(record: Record | None) -> None:
        if record is not None:
            records.append(record)
            now = navigator.estimate
            states.append((now.x, now.P, *now.moved, len(now.jumps)))

    # Forward pass: the navigator of the bridge over all rows, its states kept for the smoother.
    time_us = np.round(time * 1e6).astype(np.int64)
    navigator.fix(int(time_us[0]) - 1, latitude, longitude)
    rows = {name: values.tolist() for name, values in moves.items()}
    samples = zip(time_us.tolist(), field.tolist(), sigma.tolist(), strict=True)
    for i, (t, f, s) in enumerate(track(samples, "navigating", total=len(time_us))):
        navigator.telemetry(t, **{name: values[i] for name, values in rows.items()})
        keep(navigator.measure(t, f, s))
    keep(navigator.finish())
    if not records:
        raise FormatError(source, "expected samples of the total field at known times: none was usable")
    attrs = {"source": source, "map": grid.name, "motion": motion}
    result = _dataset(records, _smooth(states)).assign_attrs(attrs)
    known = reference_track(deployment, frozenset(MOTIONS[motion]))
    result = with_errors(result, known)
    findings = findings_of(result, grid, options, navigator.estimate.jumps, known)
    return result.assign_attrs(findings="\n".join(findings))


def samples_of(deployment: xr.Dataset, source: str) -> tuple[RealArray, RealArray, RealArray]:
    """Return time (n,), s, and total field and its sigma (n,), nT; the field is NaN where flagged unusable.

    FormatError: the total field is missing, or time does not increase.
    """
    if "total_field" not in deployment:
        raise FormatError(source, "expected total_field: correct the log with a calibration first")
    time = deployment["time"].to_numpy().astype(float)
    increasing(source, time)
    quality = np.nan_to_num(np.asarray(deployment.get("quality", 0.0), float)).astype(int)
    field = np.where(quality & NO_POSITION_FLAGS, np.nan, deployment["total_field"].to_numpy())
    sigma = np.broadcast_to(np.asarray(deployment.get("total_field_sigma", 1.0), float), time.shape)
    return time, field, sigma


def motion_of(deployment: xr.Dataset, source: str) -> str:
    """Return the name of the first of :data:`MOTIONS` that the log has; else raise FormatError."""
    for name, columns in MOTIONS.items():
        there = all(column in deployment and deployment[column].notnull().any() for column in columns)
        if there and (name != "glide" or _glides(deployment)):
            return name
    raise FormatError(
        source, "expected a motion: " + ", or ".join(" ".join(columns) for columns in MOTIONS.values())
    )


def _glides(deployment: xr.Dataset) -> bool:
    """Return True if the vehicle sinks nose down and rises nose up, as a glider does."""
    # A glider sinks with its nose down: depth rate and pitch have opposite signs.
    known = deployment[["depth", "pitch"]].dropna("time", how="any")
    rate = np.gradient(known["depth"].to_numpy().astype(float)) if known.sizes["time"] > 2 else np.zeros(0)
    steep = np.abs(known["pitch"].to_numpy()[: rate.size]) > GLIDE
    agree = rate[steep] * known["pitch"].to_numpy()[: rate.size][steep] < 0.0
    return bool(steep.mean() > 0.5 and agree.mean() > 0.8) if steep.size else False


def columns_of(deployment: xr.Dataset, names: Mapping[str, str]) -> dict[str, RealArray]:
    """Return the log's columns (n,) that are keys of `names`, under the values of `names`."""
    return {
        name: deployment[column].to_numpy().astype(float)
        for column, name in names.items()
        if column in deployment
    }


def first_position(deployment: xr.Dataset, source: str) -> tuple[float, float]:
    """Return the log's first latitude and longitude, deg; else raise FormatError."""
    for pair in (*REFERENCES[1:], ("dr_latitude", "dr_longitude")):
        if all(name in deployment for name in pair):
            known = deployment[list(pair)].to_dataframe().dropna()
            if len(known):
                return float(known.iloc[0][pair[0]]), float(known.iloc[0][pair[1]])
    raise FormatError(source, "expected a position to start from: latitude and longitude")


def _smooth(
    states: list[tuple[FloatArray, FloatArray, FloatArray, FloatArray, int]],
) -> tuple[FloatArray, FloatArray]:
    """Return smoothed means (n, 6) and covariances (n, 6, 6); the smoother does not cross restarts.

    Each of `states` is mean, covariance, F and Q of the prediction, and the number of restarts before.
    """
    x, P, F, Q = (np.stack([state[k] for state in states]) for k in range(4))
    jumps = np.array([state[4] for state in states])
    for piece in np.split(np.arange(jumps.size), np.flatnonzero(np.diff(jumps)) + 1):
        # Rauch-Tung-Striebel pass; it must not cross a restart, where the state is not continuous.
        ahead = piece[1:].tolist() + piece[-1:].tolist()  # filterpy's F[k] leads from k to k + 1
        x[piece], P[piece], _, _ = rts_smoother(x[piece], P[piece], F[ahead], Q[ahead] + 1e-12 * np.eye(6))
    return x, P


def _dataset(records: list[Record], smoothed: tuple[FloatArray, FloatArray]) -> xr.Dataset:
    columns: dict[str, Any] = {
        name: np.array([getattr(record, name) for record in records], float)
        for name in Record.__struct_fields__
        if name not in ("time_us", "gate")
    }
    # The smoothed state is an offset from dead reckoning: move each position by the difference.
    x, P = smoothed
    moved = x[:, :2] - np.stack([columns["north"], columns["east"]], axis=1)
    places = offset(columns["latitude"], columns["longitude"], *moved.T)
    columns["smoothed_latitude"], columns["smoothed_longitude"] = places
    columns["smoothed_sigma_north"], columns["smoothed_sigma_east"] = np.sqrt([P[:, 0, 0], P[:, 1, 1]])
    time = np.array([record.time_us for record in records]) * 1e-6
    return made("track", time, columns, COLUMN_UNITS)
