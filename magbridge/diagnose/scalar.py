"""Findings for a scalar magnetometer: its lag, its heading error, and the channels that disturb it.

Notes
-----
The compensated scalar is fitted by the model of :mod:`magbridge.calibration.scalar` again. Each block of
coefficients that remains, with the covariance of this fit and of the calibration's, must be zero. A block
that is not, at the level of :func:`~magbridge.calibration.fitting.scalar_fit.is_significant`, is a finding.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.scalar_fit import ScalarFit, is_significant
from magbridge.calibration.fitting.scalar_log import calibrate_scalar, telemetry_columns, with_scalar
from magbridge.calibration.model import Calibration
from magbridge.calibration.scalar import (
    PLATFORM_TERMS,
    ScalarSensor,
    ScalarSeries,
    moved_earlier,
    scalar_design,
    term_columns,
)
from magbridge.correction import Correction
from magbridge.diagnose.evidence import REMNANT
from magbridge.diagnostics import Diagnostic
from magbridge.errors import CalibrationError
from magbridge.field.grid import AnomalyGrid
from magbridge.rows import correct_rows

if TYPE_CHECKING:
    import xarray as xr

HEADING_TERMS = slice(0, 9)
"""Permanent and induced terms, which depend on the direction of the field in the vehicle."""
LAG_TERM = slice(PLATFORM_TERMS - 1, PLATFORM_TERMS)


def scalar_findings(
    datasets: Sequence[xr.Dataset], calibration: Calibration, grid: AnomalyGrid | None
) -> tuple[Diagnostic, ...]:
    """Return the findings for each scalar sensor of the calibration in each log that holds its column.

    FormatError: a log lacks a telemetry channel of the compensation.
    """
    found: list[Diagnostic] = []
    for ds in datasets:
        for sensor in calibration.sensors:
            if sensor.column not in ds:
                continue
            try:
                found += _of_sensor(ds, calibration, sensor, grid)
            except CalibrationError as error:
                found.append(Diagnostic("scalar.untested", {"column": sensor.column, "reason": str(error)}))
    return tuple(found)


class _Remainder(NamedTuple):
    """What the compensation leaves in a log: the fit of its terms, and their covariance."""

    fit: ScalarFit
    covariance: FloatArray
    """(m, m) covariance of this fit and of the calibration's coefficients."""
    corrected: xr.Dataset
    names: tuple[str, ...]
    """Telemetry channels of the fit."""

    def is_zero(self, term: slice) -> bool:
        """Return True if the coefficients at `term` may be zero."""
        mean = np.array(self.fit.sensor.without_shift().coefficients)
        return not is_significant(mean[term], self.covariance[term, term], len(self.names) + 2)


def _of_sensor(
    ds: xr.Dataset, calibration: Calibration, sensor: ScalarSensor, grid: AnomalyGrid | None
) -> list[Diagnostic]:
    """Return the lag, the heading error and the disturbing channels that the compensation leaves."""
    column, found = sensor.column, []
    least = 0.0
    late, variance = _lag(ds, calibration, sensor, grid)
    if is_significant(np.array([late]), np.array([[variance]]), len(sensor.channels) + 2):
        found.append(Diagnostic("scalar.lag", {"column": column, "lag_s": late, "sigma_s": variance**0.5}))
        # The other terms imitate the platform's field that is late: move the reading, and do not name the
        # lag's remnant
        moved = _moved(ds, column, late)
        least = REMNANT * float(np.nanstd((moved[column] - ds[column]).to_numpy()))
        ds = moved
    rest = _remainder(ds, calibration, sensor, grid)
    fit = rest.fit
    effect = _heading_effect(
        rest.corrected, np.array(fit.sensor.coefficients)[HEADING_TERMS], fit.sensor.reference_field
    )
    if effect >= least and not rest.is_zero(HEADING_TERMS):
        found.append(Diagnostic("scalar.heading_error", {"column": column, "effect_nT": effect}))
    terms = term_columns(fit.sensor.channels)
    for name in sorted(rest.names, key=lambda name: -fit.contribution[name]):
        effect = fit.contribution[name]
        if effect >= least and not rest.is_zero(terms[name]):
            values = {"column": column, "channel": name, "effect_nT": effect}
            found.append(Diagnostic("scalar.channel", values))
    return found


def _lag(
    ds: xr.Dataset, calibration: Calibration, sensor: ScalarSensor, grid: AnomalyGrid | None
) -> tuple[float, float]:
    """Return the lag that the calibration leaves, s, and its variance, s^2: a fit of the reading."""
    fit = calibrate_scalar(
        ds, calibration, sensor.column, telemetry_columns(ds, sensor.column), grid=grid,
        map_known=grid is not None or "reference_field" in ds, lever=sensor.lever,
    )  # fmt: skip
    k = LAG_TERM.start
    variance = fit.sensor.total_covariance[k, k] + sensor.total_covariance[k, k]
    return fit.sensor.lag - sensor.lag, float(variance)


def _moved(ds: xr.Dataset, column: str, lag: float) -> xr.Dataset:
    """Return the log with a column read `lag` (s) earlier."""
    time, reading = (ds[name].to_numpy().astype(float) for name in ("time", column))
    return ds.assign({column: ("time", moved_earlier(reading, time, lag), ds[column].attrs)})


def _compensated(ds: xr.Dataset, calibration: Calibration, sensor: ScalarSensor) -> xr.Dataset:
    return with_scalar(correct_rows(Correction(calibration), ds), ds, [sensor])


def _remainder(
    ds: xr.Dataset, calibration: Calibration, sensor: ScalarSensor, grid: AnomalyGrid | None
) -> _Remainder:
    """Return the fit of the model to the compensated scalar of a log."""
    column = sensor.column
    corrected = _compensated(ds, calibration, sensor)
    rows = ds.sel(time=corrected["time"]) if ds.sizes["time"] != corrected.sizes["time"] else ds
    compensated = rows.assign({column: ("time", corrected["scalar_field"].to_numpy(), ds[column].attrs)})
    names = telemetry_columns(compensated, column)
    fit = calibrate_scalar(
        compensated, calibration, column, names, grid=grid,
        map_known=grid is not None or "reference_field" in ds, lever=sensor.lever,
    )  # fmt: skip
    covariance = np.array(fit.sensor.covariance) + _compensation_covariance(sensor, fit.sensor)
    return _Remainder(fit, covariance, corrected, names)


def _compensation_covariance(given: ScalarSensor, fitted: ScalarSensor) -> FloatArray:
    """Return the covariance (m, m) of the calibration's coefficients in the terms of another fit.

    A channel's coefficients are per swing, which differs between the logs. Terms that the calibration lacks
    have no variance.
    """
    size = len(fitted.coefficients)
    M = np.zeros((size, len(given.coefficients)))
    M[:PLATFORM_TERMS, :PLATFORM_TERMS] = np.eye(PLATFORM_TERMS)
    own, others = term_columns(given.channels), term_columns(fitted.channels)
    swings = {channel.name: channel.scale for channel in given.channels}
    for channel in fitted.channels:
        if channel.name in swings:
            scale = channel.scale / swings[channel.name]
            M[others[channel.name], own[channel.name]] = scale * np.eye(3)
    return np.asarray(M @ np.array(given.covariance) @ M.T)


def _heading_effect(corrected: xr.Dataset, coefficients: FloatArray, reference_field: float) -> float:
    """Return the standard deviation, nT, of the permanent and induced terms with these coefficients (9,)."""
    time = corrected["time"].to_numpy().astype(float)
    vector = np.stack([corrected[f"field_{axis}"].to_numpy() for axis in "xyz"], axis=1)
    total = corrected["total_field"].to_numpy()
    nothing = np.empty((len(time), 0))
    series = ScalarSeries(time, total, vector, total, nothing, np.zeros(len(time)))
    return float(np.nanstd(scalar_design(series, (), reference_field)[:, HEADING_TERMS] @ coefficients))
