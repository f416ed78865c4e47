"""Convert the columns of a deployment to the observations of a fit."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import hypot
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.observations import Observations
from magbridge.columns import CHANNELS, COLUMNS, TEMPERATURE, require
from magbridge.datasets import standard_log
from magbridge.errors import CalibrationError, WrongUse
from magbridge.field.geodesy import separation
from magbridge.field.reference import earth_field, placed, positions, variation_level_sigma, with_true_heading
from magbridge.one_time import interpolate_to_rows

if TYPE_CHECKING:
    import xarray as xr

    from magbridge.field.grid import AnomalyGrid


MAP_ERROR = 20.0
"""1-sigma assumed for a map that does not state one, nT."""
MIN_GAP_INTERVALS = 10.0
"""Number of median sampling intervals; a longer gap begins a new run."""
FOLLOWED = (TEMPERATURE, "depth")
"""Columns that do not move a mass but may be parameters of a fit."""


def observations(
    ds: xr.Dataset, parameters: str | Sequence[str] = (), *, grid: AnomalyGrid | None = None
) -> Observations:
    """Return the observations of a fit, with arrays such as the field (n, 3), from a deployment's columns.

    Parameters
    ----------
    ds : Dataset
        A deployment, with times in s or as datetime64. :func:`~magbridge.field.reference.earth_field` gives
        its reference. Headings that it declares as magnetic are converted to true headings.
    parameters : str or sequence of str
        Names of the columns that report positions of masses.
    grid : AnomalyGrid, optional
        Anomaly map that is added to the IGRF in rows without ``reference_field``.

    Raises
    ------
    FormatError
        A column is missing, or the deployment has neither a reference nor a position.
    CalibrationError
        A column does not hold numbers, or a parameter is a column with another meaning.
    """
    if not isinstance(parameters, Iterable):
        raise WrongUse(f"parameters: expected names of columns, got {parameters!r}")
    parameters = (parameters,) if isinstance(parameters, str) else tuple(parameters)
    if others := [name for name in parameters if name in COLUMNS and name not in FOLLOWED]:
        raise CalibrationError(f"parameter {others[0]!r} is {COLUMNS[others[0]].long_name}: it moves no mass")
    names = (*CHANNELS, *parameters)
    # interpolate sequentially sampled channels first, because all other columns refer to the rows' times
    ds = at_one_time(standard_log(ds))
    columns = {name: _column(ds, name) for name in names}
    total, vector, model = earth_field(ds, grid)
    if "daily_variation" in ds:
        total = total + _column(ds, "daily_variation")
    ds = with_true_heading(ds)
    # angles that the log lacks are NaN
    attitude, unknown = None, np.full(ds.sizes["time"], np.nan)
    if "roll" in ds and "pitch" in ds:  # a boresight needs no heading
        angles = [_column(ds, name) if name in ds else unknown for name in ("roll", "pitch", "heading")]
        attitude = np.radians(np.stack(angles, axis=1))
    time = np.asarray(ds["time"].values, float)
    place, unmapped, origin = _places(ds)
    map_sigma = None
    if grid is not None:  # of the map's cells, its constant bias and the daily variation
        of_map = hypot(float(np.sqrt(np.nanmean(grid.sigma**2))), grid.level_sigma) or MAP_ERROR
        map_sigma = hypot(of_map, variation_level_sigma(ds))
    return Observations(
        field=np.stack([columns[name] for name in CHANNELS], axis=1),
        reference=total,
        parameters=np.array([columns[name] for name in parameters]).reshape(len(parameters), len(time)).T,
        names=parameters,
        units=tuple(str(ds[name].attrs.get("units", "")) for name in parameters),
        runs=_runs(ds, time),
        time=time,
        attitude=attitude,
        independent_headings=ds.attrs.get("heading_reference") == "inertial",
        reference_ned=vector,
        place=place,
        unmapped=unmapped,
        temperature=_column(ds, TEMPERATURE) if TEMPERATURE in ds else None,
        depth=_column(ds, "depth") if "depth" in ds else None,
        map_sigma=map_sigma,
        origin=origin,
        sensor=str(ds.attrs.get("sensor", "")),
        model=model,
    )


def at_one_time(ds: xr.Dataset) -> xr.Dataset:
    """Return a log whose channels were sampled sequentially, with all channels at the rows' times.

    :func:`~magbridge.one_time.interpolate_to_rows` interpolates them. In a spiral a delay of 0.3 s equals a
    rotation by one degree, always in the same direction. The coefficients would absorb this rotation and be
    wrong when the vehicle flies straight.
    """
    late = [axis for axis in "xyz" if {f"mag_{axis}", f"mag_time_{axis}"} <= set(ds.variables)]
    time, channels = np.asarray(ds["time"].values, float), {}
    for axis in late:
        name, sampled = f"mag_{axis}", _column(ds, f"mag_time_{axis}")
        channels[name] = "time", interpolate_to_rows(time, sampled, _column(ds, name))[0], ds[name].attrs
    return ds.assign(channels).drop_vars([f"mag_time_{axis}" for axis in late])


def _places(ds: xr.Dataset) -> tuple[FloatArray | None, FloatArray | None, tuple[float, float]]:
    """Return positions (n, 3), a flag (n,) for an unknown true field, and the positions' origin.

    Positions are north, east and down of the origin, m. The flag is 1 in rows without ``reference_field``.
    The origin is latitude and longitude, deg. Positions and flag are None if the log has no position, or
    every row has a ``reference_field``.
    """
    # the position of a row does not matter if its true field is known
    known = ds["reference_field"].notnull().to_numpy() if "reference_field" in ds else np.array(False)
    if not {"latitude", "longitude"} <= set(ds.variables) or known.all():
        return None, None, (0.0, 0.0)
    longitude, latitude, depth = positions(ds)
    if not np.isfinite(latitude).any():
        return None, None, (0.0, 0.0)
    latitude = np.where(placed(ds), latitude, np.nan)
    # a flat frame about the middle of the track
    origin = float(np.nanmedian(latitude)), float(np.nanmedian(longitude))
    north, east = separation(*origin, latitude, longitude)
    unmapped = np.broadcast_to(np.where(known, 0.0, 1.0), len(north))
    return np.stack([north, east, depth], axis=1), unmapped, origin


def _column(ds: xr.Dataset, name: str) -> FloatArray:
    require(ds, [name])
    values = np.asarray(ds[name].values)
    if values.dtype.kind not in "fiub":
        raise CalibrationError(f"column {name!r}: expected numbers, found {values.dtype}")
    return values.astype(float)


def _runs(ds: xr.Dataset, time: FloatArray) -> NDArray[np.generic]:
    """Return the run of each row (n,): column ``run`` or ``dive``, else numbers that gaps separate."""
    for name in ("run", "dive"):
        if name in ds:
            return np.asarray(ds[name].values)
    # a long gap separates runs: noise and attitude errors are independent across it
    step = np.diff(time, prepend=time[:1])
    usual = np.median(step[1:]) if len(time) > 1 else np.inf
    return np.cumsum(step > MIN_GAP_INTERVALS * usual)
