"""From deployments to a survey: every column at the times of the rows, with the reference field."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from magbridge.arrays import BoolArray, FloatArray
from magbridge.calibration.fitting.survey_samples import beside_motion
from magbridge.calibration.model import Calibration
from magbridge.columns import CHANNELS, require, require_units
from magbridge.diagnose.compare.survey import MIN_SURVEY_SAMPLES, Survey, assemble
from magbridge.errors import DataError
from magbridge.field.grid import AnomalyGrid
from magbridge.field.reference import positions, reference_field
from magbridge.one_time import interpolate_to_rows
from magbridge.records import MAX_MEASURED_NT
from magbridge.wording import counted

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["load_survey"]

TRUSTED = 0.5
"""Largest cubic term in the interpolation of an axis to the time of its row, as a multiple of the noise;
where it is exceeded the sample is not used."""
MAX_HALF_RANGES = 10.0
"""Distance from the middle of the calibrated range, in half ranges, beyond which a parameter's value is
not the position of a mass but a code for "not known"."""


def load_survey(
    datasets: Sequence[xr.Dataset],
    calibration: Calibration,
    training_logs: Sequence[xr.Dataset] = (),
    grid: AnomalyGrid | None = None,
) -> Survey:
    """Gather deployments.

    Parameters
    ----------
    datasets : sequence of Dataset
        To be diagnosed.
    calibration : Calibration
        Decides which channels a deployment must have.
    training_logs : sequence of Dataset
        The logs that the calibration was fitted to, if available; those of them that are among `datasets`,
        too, are diagnosed.
    grid : AnomalyGrid, optional
        Added to the main field where a log has no reference of its own.

    Raises
    ------
    DataError
        A column is missing, too few samples are complete, or a parameter is out of all range: one line
        that says which.
    """
    own = [any(ds is one for one in training_logs) for ds in datasets]
    apart = [ds for ds in training_logs if not any(ds is one for one in datasets)]
    logs = (*datasets, *apart)
    source = _sources(logs)
    table = _joined(
        [
            *(_columns(ds, calibration, grid, fitted) for ds, fitted in zip(datasets, own, strict=True)),
            *(_columns(ds, calibration, grid, fitted=True, learned=True) for ds in apart),
        ]
    )
    twice = int(np.sum(np.diff(table["time"]) == 0.0))
    if twice > 0.1 * table["time"].size:
        raise DataError(
            f"{source}: {twice} samples are given twice: a log is either diagnosed or learned from"
        )
    table = _comparable(table, calibration, source)
    for parameter in calibration.parameters:
        far = np.abs(table[parameter.name] - parameter.centre) > MAX_HALF_RANGES * parameter.scale
        if far.any():
            raise DataError(
                f"{source}: {parameter.name!r} is {table[parameter.name][far][0]:g} in {int(far.sum())} of "
                f"{far.size} samples, and {parameter.low:g} to {parameter.high:g} in the calibration: "
                "expected its unit, and nothing where it is not known"
            )
    if not any(np.ptp(table[f"mag_{axis}"]) for axis in "xyz"):
        raise DataError(f"{source}: columns mag_x, mag_y, mag_z never change: nothing was measured")
    units = {str(k): str(v.attrs.get("units", "")) for ds in logs for k, v in ds.data_vars.items()}
    return assemble(table, units, _sources(datasets), calibration.channels)


def _sources(logs: Sequence[xr.Dataset]) -> str:
    """Name logs, each once."""
    return ", ".join(dict.fromkeys(str(ds.attrs.get("source", "deployment")) for ds in logs))


def _joined(parts: Sequence[dict[str, FloatArray]]) -> dict[str, FloatArray]:
    """Return the columns of all logs in order of time; NaN where a log lacks one."""
    names = {name for part in parts for name in part}
    table = {
        name: np.concatenate([part.get(name, np.full(part["time"].size, np.nan)) for part in parts])
        for name in names
    }
    order = np.argsort(table["time"], kind="stable")
    return {name: column[order] for name, column in table.items()}


def _comparable(table: dict[str, FloatArray], calibration: Calibration, source: str) -> dict[str, FloatArray]:
    """Return the rows that have field, reference and parameters, each instant once."""
    needed = [*CHANNELS, "reference_field", *calibration.units]
    size = table["time"].size
    if size < MIN_SURVEY_SAMPLES:
        raise DataError(f"{source}: {counted(size, 'sample')}, at least {MIN_SURVEY_SAMPLES} needed")
    for name in CHANNELS:
        table[name][~(np.abs(table[name]) < MAX_MEASURED_NT)] = np.nan
    whole = np.all([np.isfinite(table[name]) for name in needed], axis=0)
    if whole.sum() < MIN_SURVEY_SAMPLES:
        worst = min(needed, key=lambda name: int(np.isfinite(table[name]).sum()))
        raise DataError(
            f"{source}: only {int(whole.sum())} of {whole.size} samples can be compared, at least "
            f"{MIN_SURVEY_SAMPLES} "
            f"needed (column {worst!r} has {int(np.isfinite(table[worst]).sum())} numbers)"
        )
    table = {name: column[whole] for name, column in table.items()}
    once = np.diff(table["time"], prepend=-np.inf) > 0.0  # a sample that two logs share is kept once
    return {name: column[once] for name, column in table.items()}


def _columns(
    ds: xr.Dataset, calibration: Calibration, grid: AnomalyGrid | None, fitted: bool, learned: bool = False
) -> dict[str, FloatArray]:
    """Return every numeric column, the axes interpolated to the rows' times, and the reference field."""
    source = str(ds.attrs.get("source", "deployment"))
    sensor = str(ds.attrs.get("sensor", ""))
    if not calibration.sensor.may_be(sensor):
        raise DataError(f"{source}: sensor {sensor!r}, but the calibration is of {calibration.sensor.name!r}")
    require(ds, (*CHANNELS, *calibration.units))
    require_units(ds, calibration.units)
    once = np.unique(ds["time"], return_index=True)[1]
    if once.size < ds.sizes["time"]:
        ds = ds.isel(time=once)
    time = ds["time"].to_numpy().astype(float)
    table = {
        str(name): column.to_numpy().astype(float)
        for name, column in ds.data_vars.items()
        if column.dtype.kind in "fiub" and not str(name).startswith("truth_")
    }
    in_turn, trusted = False, TRUSTED * calibration.noise.sensor
    for axis in "xyz":  # a log of axes that were sampled in turn has a time for each
        sampled = table.pop(f"mag_time_{axis}", None)
        if sampled is not None and np.isfinite(sampled).all() and not np.array_equal(sampled, time):
            values, cubic = interpolate_to_rows(time, sampled, table[f"mag_{axis}"])
            # where the cubic term is large or unknown, the channel is not known well enough
            table[f"mag_{axis}"] = np.where(np.abs(cubic) <= trusted, values, np.nan)
            in_turn = True
    marks = {"fitted": fitted, "learned": learned}
    table |= {"time": time} | {name: np.full(time.size, float(mark)) for name, mark in marks.items()}
    if in_turn:
        for axis in "xyz":
            table[f"mag_{axis}"][_moving(table, calibration)] = np.nan
    table["reference_field"] = reference_field(ds, grid, calibration.reference.bias)
    if {"latitude", "longitude"} <= set(table):
        table["longitude"], table["latitude"], _ = positions(ds)
    return table


def _moving(table: dict[str, FloatArray], calibration: Calibration) -> BoolArray:
    """(n,) samples next to which a mass moves, by the bridge's own criterion.

    There the axes, sampled in turn, saw the mass at different places and form no vector. With
    simultaneous sampling such samples are kept: only they reveal an offset of the clocks.
    """
    parameters = calibration.parameters
    time = table["time"]
    values = np.array([table[one.name] for one in parameters]).reshape(len(parameters), time.size)
    return beside_motion(time, values.T, np.array([one.high - one.low for one in parameters]))
