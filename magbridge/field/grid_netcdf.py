"""Anomaly grids in netCDF by CF, GMT, and GMT before 2007."""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from magbridge.arrays import RealArray
from magbridge.errors import FormatError
from magbridge.field.coordinates import EVEN, LATITUDE, LONGITUDE, METRES, PROJECTED, Axes, stated
from magbridge.files import atomic_path, systems_reason

if TYPE_CHECKING:
    from magbridge.field.grid import AnomalyGrid

__all__ = ["ANOMALY_VARIABLES", "Parts", "netcdf", "write"]

Parts = tuple[RealArray, RealArray, RealArray, dict[str, Any]]
"""Coordinates x and y of the nodes, values, options of AnomalyGrid; among them ``unit``, that of the values,
and ``axes``, what the file states of x and y (:class:`~magbridge.field.coordinates.Axes`)."""
ANOMALY_VARIABLES = (
    "anomaly", "magnetic_anomaly", "mag_anomaly", "mag_anom", "total_field_anomaly", "tfa",
    "tmi_anomaly", "tmi", "mag", "residual", "nt", "value", "z",
)  # fmt: skip
"""What the anomaly is called, the surest first: z may be a height."""
SIGMA = ("sigma", "error", "uncertainty", "std")
EASTWARD_NORTHWARD = ("east", (*LONGITUDE, *PROJECTED[0])), ("north", (*LATITUDE, *PROJECTED[1]))
"""Direction of an axis, and its names."""


def netcdf(path: Path) -> Parts:
    """Read CF or GMT netCDF, one two-dimensional variable on even axes; FormatError: any other."""
    import xarray as xr  # noqa: PLC0415  the live path runs without xarray

    try:
        with xr.open_dataset(path, engine="netcdf4") as data:
            data.load()
    except (OSError, ValueError, RuntimeError) as error:  # RuntimeError: netCDF's for damaged data
        raise FormatError(path, "expected a netCDF grid") from error
    if {"x_range", "y_range", "dimension", "z"} <= set(data.variables):
        return _old_gmt(path, data)
    flat = {str(name): da.squeeze(drop=True) for name, da in data.data_vars.items()}
    flat = {name: da for name, da in flat.items() if da.ndim == 2 and da.dtype.kind in "fiu"}
    flat = {name: da for name, da in flat.items() if not _names(name, da.attrs) & {*LONGITUDE, *LATITUDE}}
    named = [name for name in ANOMALY_VARIABLES if name in {n.lower() for n in flat}]
    sigmas = [name for name in flat if name.lower() in SIGMA]
    choices = [n for n in flat if named and n.lower() == named[0]] or [n for n in flat if n not in sigmas]
    if len(choices) != 1:
        found = " ".join(flat) or "none"
        raise FormatError(path, f"expected one grid, found {found}: call the one to use anomaly")
    grid = flat[choices[0]]
    bent = _two_dimensional(path, grid, data)
    if bent:
        order, x, y, axes = bent
    else:
        order, x, y, axes = _along_its_axes(path, grid, data)
    options: dict[str, Any] = {"unit": str(grid.attrs.get("units", "")), "axes": axes}
    if sigmas:
        options["sigma"] = flat[sigmas[0]].transpose(*order).to_numpy()
        length = flat[sigmas[0]].attrs.get("length_m", 0.0)
        options["sigma_length"] = float(length) if isinstance(length, (int, float, np.number)) else 0.0
    altitude = grid.attrs.get("altitude", data.attrs.get("altitude"))
    level = data.attrs.get("level_sigma", 0.0)
    options["level_sigma"] = float(level) if isinstance(level, (int, float, np.number)) else 0.0
    if altitude is not None:
        try:
            options["altitude"] = float(altitude)
        except (TypeError, ValueError):
            raise FormatError(path, f"expected the altitude as a number of m, found {altitude!r}") from None
    return x, y, grid.transpose(*order).to_numpy().astype(float), options


Coordinates = tuple[tuple[str, str], RealArray, RealArray, Axes]
"""Dimensions north and east, x and y along them, and the attributes of the axes."""


def _along_its_axes(path: Path, grid: Any, data: Any) -> Coordinates:
    """Return the coordinates of a grid on one-dimensional axes."""
    x, y = (_dimension(path, grid, *names) for names in EASTWARD_NORTHWARD)
    for name in (x, y):
        if name not in grid.coords or grid[name].dtype.kind not in "fiu":
            raise FormatError(path, "expected the coordinates of this axis", column=name)
    units = [stated(str(grid[n].attrs.get("units", "")), *_names(n, grid[n].attrs)) for n in (x, y)]
    mapping = grid.attrs.get("grid_mapping", grid.encoding.get("grid_mapping"))
    crs = dict(data[mapping].attrs) if mapping in data.variables else None
    return (y, x), grid[x].to_numpy().astype(float), grid[y].to_numpy().astype(float), Axes(units[0], crs)


def _two_dimensional(path: Path, grid: Any, data: Any) -> Coordinates | None:
    """Return the coordinates of a grid with longitudes and latitudes at each node, if it has them."""
    found = {}
    for names in (LONGITUDE[:-1], LATITUDE[:-1]):
        for name, variable in data.variables.items():
            if set(variable.dims) == set(grid.dims) and _names(str(name), variable.attrs) & {*names}:
                found[names] = variable
    if len(found) < 2:
        return None
    longitude, latitude = found.values()
    for y, x in (grid.dims, grid.dims[::-1]):
        lon, lat = (v.transpose(y, x).to_numpy().astype(float) for v in (longitude, latitude))
        steps = np.abs(np.diff(lon[0])).max(), np.abs(np.diff(lat[:, 0])).max()
        if np.ptp(lon, axis=0).max() <= EVEN * steps[0] and np.ptp(lat, axis=1).max() <= EVEN * steps[1]:
            return (str(y), str(x)), lon[0], lat[:, 0], Axes("deg")
    if any(str(grid[d].attrs.get("units", "")).lower() in METRES for d in grid.dims if d in grid.coords):
        return None  # a projection's
    raise FormatError(
        path, "longitudes and latitudes that are not an even grid: regrid it to longitude and latitude"
    )


def write(grid: AnomalyGrid, path: str | Path) -> None:
    """Write a grid as CF netCDF; WriteError: the file cannot be written; it is as it was before."""
    import xarray as xr  # noqa: PLC0415  the live path runs without xarray

    over = ("latitude", "longitude")
    axes = {
        name: (name, getattr(grid, name), {"units": f"degrees_{way}", "standard_name": name})
        for name, way in zip(over, ("north", "east"), strict=True)
    }
    fields: dict[str, tuple[Any, RealArray, dict[str, Any]]] = {
        "anomaly": (over, grid.anomaly, {"units": "nT", "long_name": "magnetic anomaly"}),
        "sigma": (over, grid.sigma, {"units": "nT", "long_name": "1-sigma of the magnetic anomaly"}),
    }
    if grid.sigma_length:
        fields["sigma"][2]["length_m"] = grid.sigma_length  # correlation length of its errors
    attrs: dict[str, object] = {"Conventions": "CF-1.8", "title": "magnetic anomaly"}
    if isfinite(grid.altitude):
        attrs |= {"altitude": grid.altitude, "altitude_units": "m above the ellipsoid"}
    if grid.level_sigma:
        attrs |= {"level_sigma": grid.level_sigma, "level_sigma_units": "nT"}  # of the whole map
    packed = {name: {"zlib": True, "dtype": "float32"} for name in fields}
    with atomic_path(path) as temporary, systems_reason(temporary):
        xr.Dataset(fields, axes, attrs).to_netcdf(temporary, engine="netcdf4", encoding=packed)


def _names(name: str, attrs: Any) -> set[str]:
    """Return name, standard name and long name of a variable in lower case."""
    return {str(one).lower() for one in (name, attrs.get("standard_name", ""), attrs.get("long_name", ""))}


def _dimension(path: Path, grid: Any, kind: str, names: tuple[str, ...]) -> str:
    """Return the dimension that runs `kind` ("east", "north"), by its unit or by one of its `names`."""
    for dimension in map(str, grid.dims):
        attrs = grid[dimension].attrs if dimension in grid.coords else {}
        unit = str(attrs.get("units", "")).lower()
        if unit.startswith((f"degrees_{kind}", f"degree_{kind}")) or _names(dimension, attrs) & {*names}:
            return dimension
    raise FormatError(path, f"expected the axis {names[0]!r}, found {' '.join(map(str, grid.dims))}")


def _old_gmt(path: Path, data: Any) -> Parts:
    """GMT's netCDF of before 2007: ranges and one long row, from the north-west corner."""
    nx, ny = (int(n) for n in data["dimension"].to_numpy())
    if min(nx, ny) < 1 or nx * ny != data["z"].size:
        raise FormatError(path, f"expected {nx} x {ny} values, found {data['z'].size}: damaged")
    values = data["z"].to_numpy().reshape(ny, nx)[::-1].astype(float)
    half = 0.5 * int(data["z"].attrs.get("node_offset", 0))
    axes = []
    for name, n in (("x_range", nx), ("y_range", ny)):
        low, high = (float(v) for v in data[name].to_numpy())
        step = (high - low) / max(n - 1 + 2 * half, 1)
        axes.append(low + (np.arange(n) + half) * step)
    unit = stated(str(data["x_range"].attrs.get("units", "")))
    return axes[0], axes[1], values, {"unit": str(data["z"].attrs.get("units", "")), "axes": Axes(unit)}
