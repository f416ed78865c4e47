"""Define the functions of ``import magbridge`` that combine several packages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast, overload

import numpy as np
from numpy.typing import ArrayLike

from magbridge.calibration.correct import CorrectedArrays, Corrector
from magbridge.calibration.correct import correct as correct_arrays
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.model import Calibration
from magbridge.datasets import expect, standard_log
from magbridge.errors import CalibrationError, WrongUse
from magbridge.records import Corrected
from magbridge.rows import correct_rows

if TYPE_CHECKING:
    import xarray as xr

    from magbridge.field.grid import AnomalyGrid
    from magbridge.navigate.options import NavigationOptions
    from magbridge.survey.run import Result

__all__ = ["calibrate", "correct", "navigate", "survey"]


def calibrate(
    deployment: xr.Dataset,
    parameters: str | Sequence[str] = (),
    *,
    scalar: str = "",
    channels: Sequence[str] | None = None,
    grid: AnomalyGrid | None = None,
    lag: float | None = None,
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0),
    **options: Any,
) -> Calibration:
    """Fit the calibration of a log's vector magnetometer, and of a scalar magnetometer if `scalar` is given.

    Parameters
    ----------
    deployment : Dataset
        Log on ``time``, with ``mag_x mag_y mag_z`` (nT), and ``reference_field`` or positions.
    parameters : str or sequence of str
        Columns with the positions of moving masses, for the vector magnetometer.
    scalar : str
        Column of a scalar magnetometer's reading, nT; its compensation is in ``sensors`` of the result.
    channels : sequence of str, optional
        Telemetry channels that disturb the scalar; by default all telemetry of the log.
    grid : AnomalyGrid, optional
        Crustal field to add to the main field. Without it and without ``reference_field``, the crustal
        field along the track is estimated together with the scalar's compensation.
    lag : float, optional
        Delay of the scalar's readings, s; estimated if not given.
    lever : tuple of 3 float
        Position of the scalar relative to the logged positions, m forward, starboard and down.
    **options
        Options of :func:`magbridge.fit`: ``method``, ``order``.

    Returns
    -------
    Calibration
        Calibration of the vector magnetometer, with the scalar's compensation.

    Raises
    ------
    FormatError
        A column is missing.
    DataError
        The scalar's reading is not in nT.
    CalibrationError
        The samples do not suffice.
    """
    from magbridge.calibration.fitting.fit import fit  # noqa: PLC0415 - scipy only where it is used
    from magbridge.calibration.fitting.scalar_log import calibrate_scalar, telemetry_columns  # noqa: PLC0415

    log = standard_log(deployment)
    found = fit(observations(log, parameters, grid=grid), **options).calibration
    if not scalar:
        return found
    names = telemetry_columns(log, scalar) if channels is None else channels
    map_known = grid is not None or "reference_field" in log
    known = calibrate_scalar(log, found, scalar, names, grid=grid, map_known=map_known, lag=lag, lever=lever)
    doubts = (known.doubt,) if known.doubt else ()
    return replace(found, sensors=(known.sensor,), warnings=(*found.warnings, *doubts))


@overload
def correct(calibration: Calibration, field: xr.Dataset) -> xr.Dataset: ...
@overload
def correct(
    calibration: Calibration, field: ArrayLike, channels: ArrayLike = (), time: ArrayLike = 0.0
) -> Corrected | CorrectedArrays: ...
def correct(
    calibration: Calibration,
    field: ArrayLike | xr.Dataset,
    channels: ArrayLike = (),
    time: ArrayLike = 0.0,
) -> Corrected | CorrectedArrays | xr.Dataset:
    """Correct one reading, arrays of readings, or a log.

    Parameters
    ----------
    calibration : Calibration
        Calibration of the sensor that took the samples.
    field : (3,) or (n, 3) array, or Dataset
        Raw field in sensor axes, nT, or a log. A log is corrected as by the bridge, and with its scalar
        magnetometer if the calibration has one.
    channels : (k,) or (n, k) array
        Values of ``calibration.channels``, in that order; NaN if unknown.
    time : float or (n,) array
        Ascending times, s since 1970 UTC or ``datetime64``; only effects with a state use the times.

    Returns
    -------
    Corrected, CorrectedArrays or Dataset
        Result for one reading, for n readings, or for a log. The latter has the columns of
        :func:`magbridge.correct_rows`, and with a scalar magnetometer ``scalar_field``, its sigma and flags.

    Raises
    ------
    CalibrationError
        The field has another shape, or the number of channels differs from the calibration's.
    FormatError
        The log lacks a column.
    WrongUse
        An argument is of another type.
    """
    expect("calibration", calibration, Calibration, "magbridge.load(path)")
    if hasattr(field, "data_vars") or hasattr(field, "iloc"):
        return _corrected_log(calibration, cast("xr.Dataset", field))
    try:
        readings, values = np.asarray(field, float), np.asarray(channels, float)
    except (TypeError, ValueError):
        raise WrongUse("field, channels: expected numbers, got values that are not") from None
    if readings.shape[-1:] != (3,) or readings.ndim > 2:
        raise CalibrationError(f"field: expected shape (3,) or (n, 3), got {readings.shape}")
    moments = np.asarray(time)
    if moments.dtype.kind == "M":
        moments = (moments - np.datetime64(0, "ns")) / np.timedelta64(1, "s")
    if readings.ndim == 1:
        x, y, z = readings.tolist()
        return Corrector(calibration).step(round(float(moments) * 1e6), (x, y, z), values.ravel().tolist())
    moments = np.broadcast_to(moments.astype(float), len(readings))
    return correct_arrays(calibration, readings, values, moments)


def _corrected_log(calibration: Calibration, deployment: xr.Dataset) -> xr.Dataset:
    """Return the corrected log, with its scalar magnetometer if the calibration has one."""
    from magbridge.calibration.fitting.scalar_log import with_scalar  # noqa: PLC0415 - scipy only where it is used
    from magbridge.correction import Correction  # noqa: PLC0415 - as the other imports of this function

    log = standard_log(deployment)
    corrected = with_scalar(correct_rows(Correction(calibration), log), log, calibration.sensors)
    return corrected.assign_coords(time=deployment["time"])


def navigate(
    deployment: xr.Dataset,
    grid: AnomalyGrid | None = None,
    options: NavigationOptions | None = None,
    **more: Any,
) -> xr.Dataset:
    """Estimate the track from the field and a map, as :func:`magbridge.navigate.batch.navigate`.

    Without a map, estimate the track from the places at which it crosses itself, as
    :func:`magbridge.navigate.own_survey.localise`.
    """
    from magbridge.navigate import NavigationOptions, batch, own_survey  # noqa: PLC0415 - filterpy only where it is used

    if grid is None:
        return own_survey.localise(standard_log(deployment), options or NavigationOptions())
    return batch.navigate(standard_log(deployment), grid, options, **more)


def survey(
    deployments: Sequence[xr.Dataset], *calibrations: Calibration, scalar: str = "", **options: Any
) -> Result:
    """Level and grid the corrected samples of several logs; :func:`magbridge.survey.run.survey`.

    Parameters
    ----------
    deployments : sequence of Dataset
        Logs with ``total_field`` or ``anomaly``, or with a raw vector, which is corrected first.
    *calibrations : Calibration
        One calibration for all logs with a raw vector, or one for each of these logs.
    scalar : str
        Column of a scalar magnetometer to use instead of the vector.
    **options
        Options of :func:`magbridge.survey.run.scalar_survey`: ``names``, ``lag``, ``lever``.

    Raises
    ------
    WrongUse
        `deployments` is empty.
    """
    from magbridge.survey import run  # noqa: PLC0415 - scipy only where it is used

    if not deployments:
        raise WrongUse("deployments: expected at least one Dataset, got none")
    for calibration in calibrations:
        expect("calibrations", calibration, Calibration, "magbridge.load(path)")
    logs = [standard_log(log) for log in deployments]
    if scalar:
        return run.scalar_survey(logs, scalar, calibrations=calibrations, **options)
    return run.survey(run.samples_of(logs, calibrations))
