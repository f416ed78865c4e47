"""Read a scalar magnetometer and a vector sensor from a log, fit it, and compensate a log with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from magbridge.arrays import BoolArray, FloatArray
from magbridge.calibration.correct import correct
from magbridge.calibration.figure_of_merit import box_flight, figure_of_merit
from magbridge.calibration.fitting.observe import at_one_time
from magbridge.calibration.fitting.scalar_fit import ScalarFit, adapt_to_log, fit_scalar
from magbridge.calibration.model import Calibration
from magbridge.calibration.scalar import (
    CorrectedScalar,
    ScalarQuality,
    ScalarSensor,
    ScalarSeries,
    SensorDisagreement,
    compare_sensors,
    correct_scalar,
    scalar_design,
    term_columns,
    unknown_direction_variance,
)
from magbridge.columns import CHANNELS, COLUMNS, NT_PER_UNIT, require, usual
from magbridge.errors import DataError, FormatError
from magbridge.field.geodesy import metres_per_degree
from magbridge.field.reference import reference_field
from magbridge.records import Quality

if TYPE_CHECKING:
    import xarray as xr

    from magbridge.field.grid import AnomalyGrid

__all__ = [
    "SCALAR_COLUMNS", "Compensation", "calibrate_scalar", "compensate", "merit_of", "moved_to_sensor",
    "scalar_reading", "telemetry_columns", "with_scalar",
]  # fmt: skip

SCALAR_COLUMNS = "scalar_field", "scalar_field_sigma", "scalar_level_sigma", "scalar_quality"
"""Columns that compensation adds."""
MAX_CHANNEL_GAP_S = 30.0
"""s between two values of a channel, across which it is not interpolated."""
MAX_MODES, MIN_MODE_NT = 24, 0.02
"""Uncertain combinations of a compensation at most, and the RMS effect, nT, below which one is left out."""
MIN_DEAD_READINGS = 5
"""Equal readings in a row, from which on a scalar magnetometer may be in its dead zone."""
SMALL_STEP_QUANTILE = 0.05
"""Quantile of the steps between different readings that stands for the sensor's resolution."""
EXPECTED_STEPS = 10.0
"""Steps of the expected field from sample to sample that are a change."""
TELEMETRY_OF_SENSOR = ("sensor_temperature", "depth")
"""Columns with a meaning of their own that may also be telemetry channels."""
SAMPLE_LABELS = {"run", "dive", "line", "line_type", "power_cycle"}
NOT_TELEMETRY_PREFIXES = ("mag_", "age_", "gps_", "dr_", "truth_", "local_")
"""Columns that number, time or place a sample."""


def telemetry_columns(ds: xr.Dataset, column: str) -> tuple[str, ...]:
    """Return the telemetry columns of a log with the scalar `column`: numbers without another meaning."""
    names = []
    for name in map(str, ds.data_vars):
        own = (name in COLUMNS and name not in TELEMETRY_OF_SENSOR) or name in SAMPLE_LABELS
        if own or name == column or name.startswith(NOT_TELEMETRY_PREFIXES):
            continue
        if ds[name].dtype.kind not in "fiub" or ds[name].ndim != 1:
            continue
        values = ds[name].to_numpy().astype(float)
        values = values[np.isfinite(values)]
        unit = usual(str(ds[name].attrs.get("units", "")))  # a magnetic field is another sensor's
        if len(values) > 1 and values.min() < values.max() and unit not in NT_PER_UNIT:
            names.append(name)
    return tuple(names)


def calibrate_scalar(
    ds: xr.Dataset,
    calibration: Calibration,
    column: str,
    names: Sequence[str],
    *,
    grid: AnomalyGrid | None = None,
    map_known: bool = False,
    lag: float | None = None,
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> ScalarFit:
    """Fit the compensation of a log's scalar magnetometer, `column` (nT), by the telemetry channels `names`.

    `calibration` is that of the vector sensor, which gives the directions. The reference is the log's, or the
    main field plus `grid`; with `map_known` it includes the crustal field. `lag` is that of the scalar behind
    the vector, s, estimated if not given; `lever` leads from positions to scalar, m forward, starboard, down.

    FormatError: a column is missing, or there is neither a reference nor a position. DataError: the reading
    is not nT. CalibrationError: too few samples.
    """
    require(ds, (*CHANNELS, column, *names))
    reference = reference_field(moved_to_sensor(ds, lever), grid)
    if "daily_variation" in ds:
        reference = reference + ds["daily_variation"].to_numpy()
    rows = at_one_time(ds)
    time = np.asarray(ds["time"].to_numpy(), float)
    field = np.stack([rows[name].to_numpy().astype(float) for name in CHANNELS], axis=1)
    corrected = correct(calibration, field, _channels(ds, calibration.channels), time)
    series = _series(ds, column, names, corrected.vector, reference)
    units = tuple(str(ds[name].attrs.get("units", "")) for name in names)
    fit = fit_scalar(
        series, tuple(names), column=column, units=units, lag=lag, map_known=map_known, lever=lever
    )
    after = correct_scalar(fit.sensor, series).field - reference
    return replace(fit, merit=merit_of(ds, series.scalar - reference, after))


def scalar_reading(ds: xr.Dataset, column: str) -> FloatArray:
    """Return a scalar magnetometer's reading (n,), nT, NaN for 0, from its declared unit.

    DataError: it is not a total field.
    """
    reading = ds[column].to_numpy().astype(float)
    unit = usual(str(ds[column].attrs.get("units", "")))
    reading = np.where(reading == 0.0, np.nan, reading * NT_PER_UNIT.get(unit, 1.0))
    median = float(np.nanmedian(reading)) if np.isfinite(reading).any() else np.nan
    if not 1e4 < median < 1e5:
        source = ds.attrs.get("source", "the log")
        raise DataError(
            f"{source}: column {column!r}: expected the total field in nT, got a median of {median:g}"
        )
    return reading


def _without_repeated(reading: FloatArray, expected: FloatArray) -> FloatArray:
    """Return a reading (n,), nT, with NaN where it is repeated while the `expected` (n,), nT, changes.

    In its dead zone a sensor may repeat its last reading. A coarse sensor on a vehicle at rest repeats its
    reading, too, so `expected` must change by more than the resolution and its own noise during the run.
    """
    if len(reading) < MIN_DEAD_READINGS:
        return reading
    step = np.diff(reading)
    small = np.abs(step[np.isfinite(step) & (step != 0.0)])
    least = float(np.quantile(small, SMALL_STEP_QUANTILE)) if len(small) else 0.0
    noise = np.abs(np.diff(expected))
    least += EXPECTED_STEPS * float(np.median(noise[np.isfinite(noise)])) if np.isfinite(noise).any() else 0.0
    first = np.flatnonzero(np.append(True, step != 0.0))
    change = np.fmax.reduceat(expected, first) - np.fmin.reduceat(expected, first)
    length = np.diff(np.append(first, len(reading)))
    stuck = (length >= MIN_DEAD_READINGS) & (change > least)
    return np.where(np.repeat(stuck, length), np.nan, reading)


def merit_of(ds: xr.Dataset, measured: FloatArray, compensated: FloatArray) -> dict[str, Any] | None:
    """Return the figure of merit of a log's box flight; None if it holds none, or no attitude.

    `measured`, `compensated` (n,): nT, the scalar minus its reference, before and after compensation.
    """
    if not {"roll", "pitch", "heading"} <= set(ds.variables):
        return None
    roll, pitch, heading = (ds[name].to_numpy().astype(float) for name in ("roll", "pitch", "heading"))
    box = box_flight(np.asarray(ds["time"].to_numpy(), float), roll, pitch, heading)
    return None if box is None else figure_of_merit(box, measured, compensated)


def with_scalar(corrected: xr.Dataset, log: xr.Dataset, sensors: Sequence[ScalarSensor]) -> xr.Dataset:
    """Return a corrected log with :data:`SCALAR_COLUMNS` of the first of the sensors that the log has.

    ``total_field_sigma`` is larger where the two sensors differ and the vector sensor may be the cause. The
    log is unchanged where it has no such column. FormatError: it lacks a telemetry channel.
    """
    sensor = next((one for one in sensors if one.column in log), None)
    if sensor is None:
        return corrected
    found, seen, adapted, series = _compensated(corrected, log, sensor)
    doubtful = _doubtful_direction(corrected)
    variance = seen.scalar_variance
    variance[doubtful] += unknown_direction_variance(adapted, series.channels)[doubtful]
    quality = int(ScalarQuality.EXTRAPOLATED) * found.extrapolated
    quality = quality + int(ScalarQuality.DISAGREES) * (seen.disagrees | doubtful)
    quality += int(ScalarQuality.JUMP) * seen.jump + int(ScalarQuality.MISSING) * found.missing
    widened = np.sqrt(found.sigma**2 + variance)
    columns = found.field, widened, found.level_sigma, quality.astype(float)
    added = {
        name: ("time", values, COLUMNS[name]._asdict())
        for name, values in zip(SCALAR_COLUMNS, columns, strict=True)
    }
    wider = np.sqrt(corrected["total_field_sigma"].to_numpy() ** 2 + seen.vector_variance)
    own = {"total_field_sigma": ("time", wider, corrected["total_field_sigma"].attrs)}
    return corrected.assign(own | added)


def _doubtful_direction(corrected: xr.Dataset) -> BoolArray:
    """Return the samples (n,) whose vector is implausible; all, if it is at more than half of them."""
    # the checks need some samples after a turn, so that a wrong axis is not flagged everywhere
    flags = np.asarray(corrected.get("quality", np.zeros(corrected.sizes["time"])), float)
    implausible = (np.nan_to_num(flags).astype(int) & int(Quality.IMPLAUSIBLE)) > 0
    return np.asarray(implausible | (implausible.mean() > 0.5))


class Compensation(NamedTuple):
    """A compensated scalar of a survey, n samples."""

    field: FloatArray
    """Compensated total field, nT, (n,); NaN where an input is missing or the vector disagrees."""
    modes: FloatArray
    """Effect of each uncertain combination of coefficients, 1-sigma, nT, (n, r)."""
    contribution: dict[str, float]
    """Standard deviation of the effect of each block of coefficients, nT."""


def compensate(corrected: xr.Dataset, log: xr.Dataset, sensor: ScalarSensor) -> Compensation:
    """Compensate a log's scalar and return the parts of it, for a joint fit with a survey's terms.

    FormatError: the log lacks a telemetry channel of the compensation.
    """
    found, seen, adapted, series = _compensated(corrected, log, sensor)
    mean = np.array(adapted.coefficients)
    design = scalar_design(series, adapted.channels, adapted.reference_field, mean)
    size = design.shape[1]
    contribution = {
        name: float(np.nanstd(design[:, columns] @ mean[columns]))
        for name, columns in term_columns(adapted.channels).items()
    }
    values, vectors = np.linalg.eigh(adapted.total_covariance[:size, :size])
    effects = design @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    known = np.isfinite(effects).all(axis=1)
    centred = effects - effects[known].mean(axis=0)  # the level is the survey's own
    _, sizes, turned = np.linalg.svd(centred[known], full_matrices=False)
    large = sizes[:MAX_MODES] / np.sqrt(max(known.sum(), 1)) > MIN_MODE_NT
    modes = centred @ turned[:MAX_MODES][large].T
    return Compensation(np.where(seen.disagrees, np.nan, found.field), modes, contribution)


def _compensated(
    corrected: xr.Dataset, log: xr.Dataset, sensor: ScalarSensor
) -> tuple[CorrectedScalar, SensorDisagreement, ScalarSensor, ScalarSeries]:
    """Return compensation and comparison with the vector, the sensor adapted to the log, and its samples."""
    if missing := [channel.name for channel in sensor.channels if channel.name not in log]:
        source = log.attrs.get("source", "the log")
        raise FormatError(source, f"column {missing[0]!r} is missing: the scalar's compensation needs it")
    log = log.sel(time=corrected["time"]) if log.sizes["time"] != corrected.sizes["time"] else log
    vector = np.stack([corrected[f"field_{axis}"].to_numpy() for axis in "xyz"], axis=1)
    total, sigma = (corrected[name].to_numpy() for name in ("total_field", "total_field_sigma"))
    reference = total - corrected["anomaly"].to_numpy()
    series = _series(log, sensor.column, [channel.name for channel in sensor.channels], vector, reference)
    adapted = adapt_to_log(sensor, series.channels)
    found = correct_scalar(adapted, series)
    return found, compare_sensors(found.field, found.sigma, total, sigma, reference), adapted, series


def _series(
    ds: xr.Dataset, column: str, names: Sequence[str], vector: FloatArray, reference: FloatArray
) -> ScalarSeries:
    """Return the rows of a log as arrays, telemetry interpolated to them."""
    time = np.asarray(ds["time"].to_numpy(), float)
    expected = reference if np.isfinite(reference).any() else np.linalg.norm(vector, axis=1)
    cycle = ds["power_cycle"].to_numpy().astype(float) if "power_cycle" in ds else np.full(len(time), np.nan)
    return ScalarSeries(
        time,
        _without_repeated(scalar_reading(ds, column), expected),
        vector,
        reference,
        _channels(ds, names),
        cycle,
    )


def _channels(ds: xr.Dataset, names: Sequence[str]) -> FloatArray:
    """Return channels (n, k) at every row: interpolated between values that are close enough in time."""
    time = np.asarray(ds["time"].to_numpy(), float)
    table = np.empty((len(time), len(names)))
    for k, name in enumerate(names):
        table[:, k] = values = ds[name].to_numpy().astype(float)
        known = np.isfinite(values)
        if known.all() or known.sum() < 2:
            continue
        filled = np.interp(time, time[known], values[known], left=np.nan, right=np.nan)
        after = np.searchsorted(time[known], time).clip(1, known.sum() - 1)
        far = time[known][after] - time[known][after - 1] > MAX_CHANNEL_GAP_S
        table[:, k] = np.where(known, values, np.where(far, np.nan, filled))
    return table


def moved_to_sensor(ds: xr.Dataset, lever: tuple[float, float, float]) -> xr.Dataset:
    """Return a log with the positions of the scalar sensor instead of its own.

    A log without roll or pitch is taken to be level. FormatError: it has positions but no heading.
    """
    if not any(lever) or not {"latitude", "longitude"} <= set(ds.variables):
        return ds
    require(ds, ("heading",))
    angles = np.zeros((ds.sizes["time"], 3))
    for k, name in enumerate(("heading", "pitch", "roll")):
        angles[:, k] = ds.get(name, 0.0)
    known = np.isfinite(angles).all(axis=1)
    turned = np.zeros_like(angles)
    turned[known] = Rotation.from_euler("ZYX", angles[known], degrees=True).apply(lever)
    moved = {}
    degrees = metres_per_degree(ds["latitude"].to_numpy())
    for k, name in enumerate(("latitude", "longitude")):
        moved[name] = "time", ds[name].to_numpy() + turned[:, k] / degrees[k], ds[name].attrs
    return ds.assign(moved)
