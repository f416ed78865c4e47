"""Axes of a grid, and anomaly grids in netCDF by CF, GMT, and GMT before 2007.

The file's statements decide whether axes are in degrees or metres; without statements, the numbers decide.
Ambiguous axes are an error: metres, kilometres and indices may all lie between -180 and 180, and a map
that takes them for degrees would be wrong without a message.
"""

from __future__ import annotations

from math import isfinite, nan
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from magbridge.arrays import RealArray
from magbridge.errors import FormatError, MissingExtra
from magbridge.field.geodesy import metres_per_degree, wrap
from magbridge.field.spline import coefficients, filled
from magbridge.files import atomic_path, systems_reason

if TYPE_CHECKING:
    from magbridge.field.grid import AnomalyGrid

__all__ = [
    "ANOMALY_VARIABLES", "EVEN", "LATITUDE", "LONGITUDE", "METRES", "PROJECTED", "SIGMA", "Axes", "Parts",
    "geographic", "netcdf", "stated", "write",
]  # fmt: skip

LONGITUDE, LATITUDE = ("longitude", "lon", "long", "x"), ("latitude", "lat", "y")
"""Names of geographic axes; x and y may also be projected coordinates."""
PROJECTED = (
    ("easting", "projection_x_coordinate", "utm_x", "utm_e", "utme", "x_utm"),
    ("northing", "projection_y_coordinate", "utm_y", "utm_n", "utmn", "y_utm"),
)
METRES = {
    **dict.fromkeys(("m", "metre", "meter", "metres", "meters"), 1.0),
    **dict.fromkeys(("km", "kilometre", "kilometer", "kilometres", "kilometers"), 1000.0),
    **dict.fromkeys(("ft", "foot", "feet"), 0.3048),
    **dict.fromkeys(("us-ft", "ftus", "us_survey_foot"), 1200.0 / 3937.0),
}
"""Length in m of each unit, by the unit's name in lower case."""
MAX_REPROJECTED_NODES = 10_000_000
"""Largest number of nodes of a reprojected grid."""
EVEN = 1e-3
"""Largest deviation of rounded coordinates from an even spacing, as a fraction of a step."""


class Axes(NamedTuple):
    """Statements of a file on its axes: ``unit`` ("" if none), and ``crs``, the reference system, or None.

    ``crs`` is in a form that pyproj accepts: an authority's code, WKT, or attributes of a CF grid mapping.
    """

    unit: str = ""
    crs: str | dict[str, Any] | None = None


def stated(unit: str, *names: str) -> str:
    """Return the stated unit of an axis; else "deg" or "m" if one of its `names` implies it; else ""."""
    called = {name.lower() for name in names}
    if unit.strip() and unit.strip() != "1":
        return unit.strip()
    if called & ({*LONGITUDE, *LATITUDE} - {"x", "y"}):
        return "deg"
    return "m" if called & {*PROJECTED[0], *PROJECTED[1]} else ""


def geographic(
    path: Path, x: RealArray, y: RealArray, fields: dict[str, RealArray], axes: Axes
) -> tuple[RealArray, RealArray, dict[str, RealArray]]:
    """Return longitudes, latitudes (deg) and fields (ny, nx), reprojected if the axes are projected.

    FormatError: lengths without a known projection; axes that may or may not be degrees; a unit that is
    neither angle nor length. MissingExtra: a reference system is stated, and pyproj is not installed.
    """
    crs = _reference_system(path, axes.crs)
    if _are_degrees(path, x, y, axes.unit.lower(), crs):
        gaps = np.diff(x)
        if gaps.size and gaps.max() > 180.0 > x[-1] - 180.0:  # 179 and -179 are neighbours
            split = int(gaps.argmax()) + 1
            x = np.concatenate([x[split:], x[:split] + 360.0])
            fields = {name: np.roll(values, -split, axis=1) for name, values in fields.items()}
        return x, y, fields
    if crs is None or crs.is_geographic:
        raise FormatError(
            path,
            "projected coordinates of an unknown projection: reproject the grid to longitude and latitude, "
            f"or put its projection next to it as {path.stem}.prj",
        )
    own = crs.axis_info[0].unit_conversion_factor if crs.axis_info else 1.0
    scale = METRES.get(axes.unit.lower(), own) / own
    return _reprojected(path, x * scale, y * scale, fields, crs)


def _are_degrees(path: Path, x: RealArray, y: RealArray, unit: str, crs: Any) -> bool:
    if unit.startswith("deg") or unit == "°":
        return True
    if unit in METRES:
        return False
    if unit.startswith("rad") or unit == "unknown":
        found = "radians" if unit.startswith("rad") else "a unit that is not known"
        raise FormatError(path, f"expected axes in degrees or metres, found {found}")
    if crs is not None:
        return bool(crs.is_geographic)
    if np.abs(y).max() > 90.0 or np.abs(x).max() > 360.0:
        return False
    if x.min() <= 0.0 <= x.max() and y.min() <= 0.0 <= y.max() and np.ptp(x) < 180.0:
        raise FormatError(
            path,
            "axes without a unit that hold 0, 0: degrees, or local coordinates? name the axes longitude and "
            "latitude, or state their unit",
        )
    return True


def _reference_system(path: Path, crs: str | dict[str, Any] | None) -> Any:
    """Return pyproj's CRS from the file's statement, else from the ``.prj`` next to it; None without both."""
    sidecar = path.with_suffix(".prj")
    if not crs and not sidecar.is_file():
        return None
    try:
        from pyproj import CRS  # noqa: PLC0415  an optional dependency
        from pyproj.exceptions import CRSError  # noqa: PLC0415
    except ImportError:
        raise MissingExtra("pyproj", "grids") from None
    try:
        if isinstance(crs, dict):
            return CRS.from_cf(crs)
        return CRS.from_user_input(crs or sidecar.read_text(errors="replace"))
    except (CRSError, KeyError, ValueError):
        source = "" if crs else f" in {sidecar.name}"
        raise FormatError(path, f"expected a coordinate reference system{source}, found none known") from None


def _reprojected(
    path: Path, x: RealArray, y: RealArray, fields: dict[str, RealArray], crs: Any
) -> tuple[RealArray, RealArray, dict[str, RealArray]]:
    """Return longitudes, latitudes (deg) and fields on an even grid of the same spacing, by cubic splines.

    Nodes outside the projected grid are holes.
    """
    from pyproj import Transformer  # noqa: PLC0415

    for axis in (x, y):
        if axis.size < 4 or np.ptp(np.diff(axis)) > 2.0 * EVEN * abs(axis[1] - axis[0]):
            raise FormatError(path, "expected at least 4 evenly spaced coordinates in order")
    there = Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
    edge_x = np.concatenate([x, x, np.full(y.size, x[0]), np.full(y.size, x[-1])])
    edge_y = np.concatenate([np.full(x.size, y[0]), np.full(x.size, y[-1]), y, y])
    lon, lat = there.transform(edge_x, edge_y)
    if not np.isfinite([*lon, *lat]).all() or np.abs(lat).max() > 89.0:
        raise FormatError(path, "projected coordinates outside their projection, or at a pole")
    lon = lon[0] + wrap(lon - lon[0])
    step = min(abs(float(x[1] - x[0])), abs(float(y[1] - y[0]))) * crs.axis_info[0].unit_conversion_factor
    per_latitude, per_longitude = metres_per_degree(float(lat.mean()))
    steps = step / per_longitude, step / per_latitude
    spans = np.ptp(lon), np.ptp(lat)
    if not (spans[0] / steps[0]) * (spans[1] / steps[1]) < MAX_REPROJECTED_NODES:
        raise FormatError(path, f"reprojected it would have more than {MAX_REPROJECTED_NODES} nodes")
    longitude, latitude = (
        float(values.min()) + d * np.arange(int(span / d) + 1)
        for values, d, span in zip((lon, lat), steps, spans, strict=True)
    )
    mesh = np.meshgrid(wrap(longitude), latitude)
    back_x, back_y = there.transform(mesh[0], mesh[1], direction="INVERSE")
    at = np.stack([(back_y - y[0]) / (y[1] - y[0]), (back_x - x[0]) / (x[1] - x[0])])
    return longitude, latitude, {name: _sampled(values, at) for name, values in fields.items()}


def _sampled(values: RealArray, indices: RealArray) -> RealArray:
    """Interpolate values (ny, nx) at fractional rows and columns (2, m, n); NaN outside and at holes."""
    from scipy.ndimage import map_coordinates  # noqa: PLC0415  the live path runs without scipy

    hole = map_coordinates(np.isnan(values).astype(float), indices, order=1, mode="constant", cval=1.0)
    spline = coefficients(filled(np.asarray(values, np.float64)))  # a node more on each side
    found = map_coordinates(spline, indices + 1.0, order=3, mode="nearest", prefilter=False)
    return np.asarray(np.where(hole > 1e-9, np.nan, found))


Parts = tuple[RealArray, RealArray, RealArray, dict[str, Any]]
"""Contents of a file: coordinates x and y of the nodes, values (ny, nx), and options of AnomalyGrid. Further
options are ``units``, those of the values ("anomaly") and of options, by name, and ``axes``, the file's
statements on x and y (:class:`Axes`)."""
ANOMALY_VARIABLES = (
    "anomaly", "magnetic_anomaly", "mag_anomaly", "mag_anom", "total_field_anomaly", "tfa",
    "tmi_anomaly", "tmi", "mag", "residual", "nt", "value", "z",
)  # fmt: skip
"""Names of the anomaly, the least ambiguous first: z may be a height."""
SIGMA = ("sigma", "error", "uncertainty", "std")
EASTWARD_NORTHWARD = ("east", (*LONGITUDE, *PROJECTED[0])), ("north", (*LATITUDE, *PROJECTED[1]))
"""Direction of each axis, and its names."""


def netcdf(path: Path) -> Parts:
    """Read CF or GMT netCDF with one two-dimensional variable on even axes; FormatError: any other file."""
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
    units = {"anomaly": str(grid.attrs.get("units", ""))}
    options: dict[str, Any] = {"units": units, "axes": axes}
    if sigmas:
        sigma = flat[sigmas[0]]
        options["sigma"], units["sigma"] = (
            sigma.transpose(*order).to_numpy(),
            str(sigma.attrs.get("units", "")),
        )
        options["sigma_length"] = _stated_number(path, sigma.attrs, "length_m")
    over = grid.attrs if "altitude" in grid.attrs else data.attrs
    for name, attrs, default in (("altitude", over, nan), ("level_sigma", data.attrs, 0.0)):
        options[name] = _stated_number(path, attrs, name, default)
        units[name] = str(attrs.get(f"{name}_units", ""))
    return x, y, grid.transpose(*order).to_numpy().astype(float), options


def _stated_number(path: Path, attrs: dict[str, Any], name: str, default: float = 0.0) -> float:
    """Return the attribute `name` as a number; FormatError: it is not one."""
    try:
        return float(attrs.get(name, default))
    except (TypeError, ValueError):
        raise FormatError(path, f"expected {name} as a number, found {attrs[name]!r}") from None


Coordinates = tuple[tuple[str, str], RealArray, RealArray, Axes]
"""Names of the north and east dimension, coordinates x (nx,) and y (ny,), and statements on the axes."""


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
    """Return the coordinates of a grid that stores longitude and latitude at each node; None for others."""
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
    """Write a grid as CF netCDF; WriteError: the file cannot be written; an existing file stays as it was."""
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
    """Return the dimension in the direction `kind` ("east", "north"), by its unit or one of its `names`."""
    for dimension in map(str, grid.dims):
        attrs = grid[dimension].attrs if dimension in grid.coords else {}
        unit = str(attrs.get("units", "")).lower()
        if unit.startswith((f"degrees_{kind}", f"degree_{kind}")) or _names(dimension, attrs) & {*names}:
            return dimension
    raise FormatError(path, f"expected the axis {names[0]!r}, found {' '.join(map(str, grid.dims))}")


def _old_gmt(path: Path, data: Any) -> Parts:
    """Read GMT's netCDF from before 2007: axis ranges, and one row of all values from the north-west."""
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
    units = {"anomaly": str(data["z"].attrs.get("units", ""))}
    return axes[0], axes[1], values, {"units": units, "axes": Axes(unit)}
