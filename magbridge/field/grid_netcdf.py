"""Anomaly grids in netCDF: CF's, today's GMT's, and GMT's of before 2007."""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from magbridge.arrays import RealArray
from magbridge.errors import FormatError
from magbridge.files import atomic_path, systems_reason

if TYPE_CHECKING:
    from magbridge.field.grid import AnomalyGrid

__all__ = ["ANOMALY", "LATITUDE", "LONGITUDE", "Parts", "netcdf", "write"]

Parts = tuple[RealArray, RealArray, RealArray, dict[str, Any]]
"""Longitudes and latitudes (deg) of the nodes, values, options of AnomalyGrid; among them ``unit``, where the
file states one."""
LONGITUDE, LATITUDE = ("longitude", "lon", "long", "x"), ("latitude", "lat", "y")
ANOMALY = ("anomaly", "magnetic_anomaly", "mag_anomaly", "tfa", "tmi", "mag", "nt", "value", "z")
SIGMA = ("sigma", "error", "uncertainty", "std")
PROJECTED = ("easting", "northing", "projection_x_coordinate", "projection_y_coordinate", "utm_x", "utm_y")


def netcdf(path: Path) -> Parts:
    """Read CF or GMT netCDF, one two-dimensional variable on geographic axes; FormatError: any other."""
    import xarray as xr  # noqa: PLC0415  the live path runs without xarray

    try:
        with xr.open_dataset(path, engine="netcdf4") as data:
            data.load()
    except (OSError, ValueError, RuntimeError) as error:  # RuntimeError: netCDF's for damaged data
        raise FormatError(path, "expected a netCDF grid") from error
    if {"x_range", "y_range", "dimension", "z"} <= set(data.variables):
        return _old_gmt(data)
    flat = {str(name): da.squeeze(drop=True) for name, da in data.data_vars.items()}
    flat = {name: da for name, da in flat.items() if da.ndim == 2 and da.dtype.kind in "fiu"}
    named = [name for name in ANOMALY if name in {n.lower() for n in flat}]
    sigmas = [name for name in flat if name.lower() in SIGMA]
    choices = [n for n in flat if named and n.lower() == named[0]] or [n for n in flat if n not in sigmas]
    if len(choices) != 1:
        found = " ".join(flat) or "none"
        raise FormatError(path, f"expected one grid, found {found}: call the one to use anomaly")
    grid = flat[choices[0]]
    x, y = (
        _coordinate(path, grid, names, kind) for names, kind in ((LONGITUDE, "east"), (LATITUDE, "north"))
    )
    options: dict[str, Any] = {"unit": str(grid.attrs.get("units", ""))}
    if sigmas:
        options["sigma"] = flat[sigmas[0]].transpose(y, x).to_numpy()
    altitude = grid.attrs.get("altitude", data.attrs.get("altitude"))
    if altitude is not None:
        try:
            options["altitude"] = float(altitude)
        except (TypeError, ValueError):
            raise FormatError(path, f"expected the altitude as a number of m, found {altitude!r}") from None
    return grid[x].to_numpy(), grid[y].to_numpy(), grid.transpose(y, x).to_numpy().astype(float), options


def write(grid: AnomalyGrid, path: str | Path) -> None:
    """Write a grid as CF netCDF.

    Raises
    ------
    WriteError
        The file cannot be written; it is as it was before.
    """
    import xarray as xr  # noqa: PLC0415  the live path runs without xarray

    over = ("latitude", "longitude")
    axes = {
        name: (name, getattr(grid, name), {"units": f"degrees_{way}", "standard_name": name})
        for name, way in zip(over, ("north", "east"), strict=True)
    }
    fields = {
        "anomaly": (over, grid.anomaly, {"units": "nT", "long_name": "magnetic anomaly"}),
        "sigma": (over, grid.sigma, {"units": "nT", "long_name": "1-sigma of the magnetic anomaly"}),
    }
    attrs: dict[str, object] = {"Conventions": "CF-1.8", "title": "magnetic anomaly"}
    if isfinite(grid.altitude):
        attrs |= {"altitude": grid.altitude, "altitude_units": "m above the ellipsoid"}
    packed = {name: {"zlib": True, "dtype": "float32"} for name in fields}
    with atomic_path(path) as beside, systems_reason(beside):
        xr.Dataset(fields, axes, attrs).to_netcdf(beside, engine="netcdf4", encoding=packed)


def _coordinate(path: Path, grid: Any, names: tuple[str, ...], kind: str) -> str:
    """Return the dimension that runs `kind` ("east", "north"), by units, standard name or name."""
    for dimension in map(str, grid.dims):
        attrs = grid[dimension].attrs if dimension in grid.coords else {}
        names_it = (dimension, attrs.get("standard_name", ""), attrs.get("long_name", ""))
        called = {str(name).lower() for name in names_it}
        metres = str(attrs.get("units", "")).lower() in ("m", "metre", "meter", "km")
        if called & set(PROJECTED) or (metres and called & set(names)):
            raise FormatError(
                path, "projected coordinates: reproject the grid to longitude and latitude", column=dimension
            )
        if str(attrs.get("units", "")).lower().startswith(f"degrees_{kind}") or called & set(names):
            return dimension
    raise FormatError(path, f"expected the axis {names[0]!r}, found {' '.join(map(str, grid.dims))}")


def _old_gmt(data: Any) -> Parts:
    """GMT's netCDF of before 2007: ranges and one long row, from the north-west corner."""
    nx, ny = (int(n) for n in data["dimension"].to_numpy())
    half = 0.5 * int(data["z"].attrs.get("node_offset", 0))
    axes = []
    for name, n in (("x_range", nx), ("y_range", ny)):
        low, high = (float(v) for v in data[name].to_numpy())
        step = (high - low) / (n - 1 + 2 * half)
        axes.append(low + (np.arange(n) + half) * step)
    values = data["z"].to_numpy().reshape(ny, nx)[::-1].astype(float)
    return axes[0], axes[1], values, {"unit": str(data["z"].attrs.get("units", ""))}
