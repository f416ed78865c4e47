"""Anomaly grids from the formats in which surveys come.

A format is a function from a path to ``(longitude, latitude, anomaly, options of AnomalyGrid)``; which one
reads a file stands in one table, by suffix, and GRD files, of which four kinds share a suffix, by how they begin.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magbridge.errors import FormatError, MissingExtra
from magbridge.field.grid import AnomalyGrid

__all__ = ["READERS", "read_grid"]

Array = NDArray[np.floating[Any]]
Parts = tuple[Array, Array, Array, dict[str, Any]]

NANOTESLA = {
    "nt": 1.0, "nanotesla": 1.0, "nanoteslas": 1.0, "gamma": 1.0, "gammas": 1.0,
    "pt": 1e-3, "ut": 1e3, "µt": 1e3, "mgauss": 1e2, "gauss": 1e5, "t": 1e9, "tesla": 1e9,
}  # fmt: skip
LONGITUDE, LATITUDE = ("longitude", "lon", "long", "x"), ("latitude", "lat", "y")
ANOMALY = ("anomaly", "magnetic_anomaly", "mag_anomaly", "tfa", "tmi", "mag", "nt", "value", "z")
SIGMA = ("sigma", "error", "uncertainty", "std")
PROJECTED = ("easting", "northing", "projection_x_coordinate", "projection_y_coordinate", "utm_x", "utm_y")


def read_grid(path: str | Path, *, variable: str | None = None, unit: str | None = None) -> AnomalyGrid:
    """Return the anomaly grid that a file holds.

    Parameters
    ----------
    path : path
        netCDF (CF, GMT), Surfer or Geosoft ``.grd``, ESRI ASCII ``.asc``, GeoTIFF, ``.csv`` or ``.xyz`` of
        longitude, latitude, anomaly; or a folder of ``xx.csv yy.csv alt.csv map.csv`` as MagNav's example has.
    variable : str, optional
        Of a netCDF file with several; default the one whose name tells it.
    unit : str, optional
        Of the values, where the file does not say or says it wrongly; default nT.

    Raises
    ------
    FormatError
        A file that is no such grid, in a unit that is no magnetic field, or in projected coordinates.
    """
    path = Path(path)
    if not path.exists():
        raise FormatError(path, "no such file")
    reader = _folder if path.is_dir() else READERS.get(path.suffix.lower())
    if reader is None:
        raise FormatError(path, f"expected a grid: one of {' '.join(READERS)} or a folder")
    if reader is _netcdf or (reader is _grd and _begins(path) in (b"CDF\x01", b"CDF\x02", b"\x89HDF")):
        longitude, latitude, values, options = _netcdf(path, variable)
    else:
        longitude, latitude, values, options = reader(path)
    stated = options.pop("unit", None)
    scale = _scale(path, unit or stated)
    if "sigma" in options:
        options["sigma"] = options["sigma"] * scale
    return AnomalyGrid(longitude, latitude, values * scale, name=str(path), **options)


def read_polygon(path: str | Path) -> Array:
    """Read a polygon: a text file with longitude and latitude (deg) in each row, (k, 2), k at least 3.

    Raises
    ------
    FormatError
        It cannot be read, or says something else.
    """
    try:
        polygon = np.loadtxt(path, delimiter=",", ndmin=2)
    except OSError as error:
        raise FormatError(path, f"cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise FormatError(path, f"expected longitude,latitude in every row: {error}") from error
    if polygon.shape[1:] != (2,) or len(polygon) < 3 or not np.isfinite(polygon).all():
        raise FormatError(path, "expected longitude,latitude (deg) in at least three rows")
    return polygon


def _scale(path: Path, unit: str | None) -> float:
    if unit is None or not unit.strip():
        return 1.0
    try:
        return NANOTESLA[unit.strip().lower()]
    except KeyError:
        raise FormatError(path, f"expected a magnetic field in nT, found the unit {unit!r}") from None


def _begins(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(4)


def _netcdf(path: Path, variable: str | None = None) -> Parts:
    """CF or GMT netCDF: one two-dimensional variable on geographic axes."""
    import xarray as xr  # noqa: PLC0415  the live path runs without xarray

    try:
        with xr.open_dataset(path, engine="netcdf4") as data:
            data.load()
    except (OSError, ValueError) as error:
        raise FormatError(path, "expected a netCDF grid") from error
    if {"x_range", "y_range", "dimension", "z"} <= set(data.variables):
        return _old_gmt(data)
    flat = {str(name): da.squeeze(drop=True) for name, da in data.data_vars.items()}
    flat = {name: da for name, da in flat.items() if da.ndim == 2 and da.dtype.kind in "fiu"}
    named = [name for name in ANOMALY if name in {n.lower() for n in flat}]
    sigmas = [name for name in flat if name.lower() in SIGMA]
    choice = variable or next((n for n in flat if named and n.lower() == named[0]), None)
    if choice is None and len(rest := [n for n in flat if n not in sigmas]) == 1:
        choice = rest[0]
    if choice is None or choice not in flat:
        raise FormatError(path, f"expected one grid, found {' '.join(flat) or 'none'}: name the variable")
    grid = flat[choice]
    x, y = (
        _coordinate(path, grid, names, kind) for names, kind in ((LONGITUDE, "east"), (LATITUDE, "north"))
    )
    options: dict[str, Any] = {"unit": grid.attrs.get("units")}
    if sigmas and variable not in sigmas:
        options["sigma"] = flat[sigmas[0]].transpose(y, x).to_numpy()
    for where in (grid.attrs, data.attrs):
        if "altitude" in where:
            options.setdefault("altitude", float(where["altitude"]))
    return grid[x].to_numpy(), grid[y].to_numpy(), grid.transpose(y, x).to_numpy().astype(float), options


def _coordinate(path: Path, grid: Any, names: tuple[str, ...], kind: str) -> str:
    """Return the dimension that runs `kind` ("east", "north"), by units, standard name or name."""
    for dimension in map(str, grid.dims):
        attrs = grid[dimension].attrs if dimension in grid.coords else {}
        called = {
            dimension.lower(),
            str(attrs.get("standard_name", "")),
            str(attrs.get("long_name", "")).lower(),
        }
        metres = str(attrs.get("units", "")).lower() in ("m", "metre", "meter", "km")
        if called & set(PROJECTED) or (metres and called & set(names)):
            raise FormatError(
                path,
                "projected coordinates: reproject the grid to longitude and latitude",
                column=dimension,
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
    return axes[0], axes[1], values, {"unit": data["z"].attrs.get("units")}


def _grd(path: Path) -> Parts:
    """Surfer 6 text or binary, Surfer 7, else Geosoft."""
    start = _begins(path)
    if start not in _SURFER:
        return _geosoft(path)
    try:
        nx, ny, x, y, values = _SURFER[start](path)
        longitude, latitude = np.linspace(*x, nx), np.linspace(*y, ny)
        return longitude, latitude, np.asarray(values, float).reshape(ny, nx), {}
    except (ValueError, IndexError) as error:
        raise FormatError(
            path, "expected a Surfer grid: it ends too early or is not what its header says"
        ) from error


Surfer = tuple[int, int, tuple[float, float], tuple[float, float], Array]


def _surfer_text(path: Path) -> Surfer:
    words = path.read_text(errors="replace").split()
    nx, ny = int(words[1]), int(words[2])
    limits = [float(word) for word in words[3:9]]
    return nx, ny, (limits[0], limits[1]), (limits[2], limits[3]), np.array(words[9:], float)


def _surfer_6(path: Path) -> Surfer:
    raw = path.read_bytes()
    nx, ny = (int(n) for n in np.frombuffer(raw, "<i2", 2, 4))
    limits = np.frombuffer(raw, "<f8", 6, 8).tolist()
    values = np.frombuffer(raw, "<f4", nx * ny, 56).astype(float)
    return nx, ny, (limits[0], limits[1]), (limits[2], limits[3]), values


def _surfer_7(path: Path) -> Surfer:
    """Tagged sections: DSRB header, GRID, DATA."""
    raw = path.read_bytes()
    at = raw.index(b"GRID") + 8
    ny, nx = (int(n) for n in np.frombuffer(raw, "<i4", 2, at))
    x0, y0, dx, dy, _, _, _, blank = np.frombuffer(raw, "<f8", 8, at + 8).tolist()
    values = np.frombuffer(raw, "<f8", nx * ny, raw.index(b"DATA", at) + 8).copy()
    values[values >= blank] = np.nan
    return nx, ny, (x0, x0 + dx * (nx - 1)), (y0, y0 + dy * (ny - 1)), values


_SURFER: dict[bytes, Callable[[Path], Surfer]] = {
    b"DSAA": _surfer_text,
    b"DSBB": _surfer_6,
    b"DSRB": _surfer_7,
}


def _geosoft(path: Path) -> Parts:
    try:
        from harmonica import load_oasis_montaj_grid  # noqa: PLC0415  an extra of its own
    except ImportError:
        raise MissingExtra("harmonica", "grids") from None
    try:
        grid = load_oasis_montaj_grid(str(path))
    except (ValueError, NotImplementedError, OSError, IndexError) as error:
        raise FormatError(path, "expected a Surfer, GMT or Geosoft grid") from error
    return grid["easting"].to_numpy(), grid["northing"].to_numpy(), grid.to_numpy().astype(float), {}


def _ascii(path: Path) -> Parts:
    """ESRI ASCII: ``ncols``, ``nrows``, a corner or centre, ``cellsize``, then rows from the north."""
    words = path.read_text(errors="replace").split()
    head: dict[str, float] = {}
    try:
        while words[2 * len(head)][0].isalpha():
            head[words[2 * len(head)].lower()] = float(words[2 * len(head) + 1])
        nx, ny = int(head["ncols"]), int(head["nrows"])
        dx, dy = head.get("cellsize", head.get("dx", 0.0)), head.get("cellsize", head.get("dy", 0.0))
        x0 = head["xllcenter"] if "xllcenter" in head else head["xllcorner"] + dx / 2
        y0 = head["yllcenter"] if "yllcenter" in head else head["yllcorner"] + dy / 2
        values = np.array(words[2 * len(head) :], float).reshape(ny, nx)[::-1]
    except (IndexError, KeyError, ValueError) as error:
        raise FormatError(
            path, "expected an ESRI ASCII grid: ncols, nrows, corner, cellsize, rows"
        ) from error
    values[values == head.get("nodata_value", -9999.0)] = np.nan
    return x0 + dx * np.arange(nx), y0 + dy * np.arange(ny), values, {}


def _table(path: Path) -> Parts:
    """Longitude, latitude, anomaly in columns, with or without a header; any order of rows; gaps are holes."""
    with path.open(errors="replace") as file:
        first = file.readline()
    delimiter = next((mark for mark in ",;" if mark in first), None)
    words = [word.strip() for word in first.strip().lstrip("#").lower().split(delimiter)]
    header = not all(re.fullmatch(r"[-+.\deinfa]+", word) for word in words)
    columns: tuple[int, ...] = (0, 1, 2)
    unit = None
    if header:
        bare = [re.sub(r"[\[(_].*", "", word).strip() for word in words]
        found = [
            next((i for i, word in enumerate(words) if word in names or bare[i] in names), None)
            for names in (LONGITUDE, LATITUDE, ANOMALY)
        ]
        if None in found:
            raise FormatError(path, "expected the columns longitude, latitude, anomaly", row=1)
        columns = tuple(i for i in found if i is not None)
        stated = re.search(r"[\[(]([^\])]+)", words[columns[2]])
        unit = stated.group(1) if stated else None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of a file without rows, which is seen below
            table = np.loadtxt(
                path, delimiter=delimiter, skiprows=int(header), usecols=columns, ndmin=2, encoding="latin-1"
            )
    except ValueError as error:
        place = re.search(
            r"at row (\d+), column (\d+)", str(error)
        )  # numpy counts rows from 0 below the header
        line, number = (int(place[1]) + 1 + header, place[2]) if place else (None, None)
        raise FormatError(path, "expected numbers", row=line, column=number) from error
    if not np.isfinite(table[:, :2]).all() or not len(table):
        raise FormatError(path, "expected rows of longitude, latitude, anomaly")
    x, column = _levels(table[:, 0])
    y, row = _levels(table[:, 1])
    if x.size * y.size > 4 * len(table):
        raise FormatError(path, f"expected a grid, found {len(table)} scattered points: grid them first")
    values = np.full((y.size, x.size), np.nan)
    values[row, column] = table[:, 2]
    return x, y, values, {"unit": unit}


def _levels(values: Array) -> tuple[Array, NDArray[np.intp]]:
    """Return the distinct coordinates and where each value falls; 179 and -179 are neighbours."""
    levels, index = np.unique(np.round(values, 9), return_inverse=True)
    gaps = np.diff(levels)
    if gaps.size and gaps.max() > 180.0 > levels[-1] - 180.0:
        split = int(gaps.argmax()) + 1
        levels = np.concatenate([levels[split:], levels[:split] + 360.0])
        index = (index - split) % levels.size
    return levels, index


def _folder(path: Path) -> Parts:
    """MagNav's example: longitudes, latitudes and altitude beside a matrix, each in its own CSV file."""
    try:
        x, y, altitude, values = (
            np.loadtxt(path / f"{name}.csv", delimiter=",", ndmin=2) for name in ("xx", "yy", "alt", "map")
        )
    except (OSError, ValueError) as error:
        raise FormatError(path, f"expected xx.csv yy.csv alt.csv map.csv: {error}") from error
    return x.ravel(), y.ravel(), values, {"altitude": float(altitude.flat[0])}


def _geotiff(path: Path) -> Parts:
    """One band with a pixel scale and a tie point, in geographic coordinates."""
    from PIL import Image, UnidentifiedImageError  # noqa: PLC0415  comes with matplotlib

    try:
        with Image.open(path) as image:
            values = np.array(image, float)
            tags: dict[int, Any] = dict(image.tag_v2)  # type: ignore[attr-defined]  # only TIFF images have it
            dx, dy = tags[33550][:2]
            column, row, _, x0, y0 = tags[33922][:5]
    except (UnidentifiedImageError, KeyError, AttributeError, ValueError) as error:
        raise FormatError(path, "expected a GeoTIFF with a pixel scale and a tie point") from error
    keys = np.array(tags.get(34735, ()), int).reshape(-1, 4)
    settings = {int(key): int(value) for key, _, _, value in keys}
    if settings.get(1024) == 1:
        raise FormatError(path, "projected coordinates: reproject the grid to longitude and latitude")
    if values.ndim != 2:
        raise FormatError(path, f"expected one band, found an image of shape {values.shape}")
    if 42113 in tags:
        values[values == float(str(tags[42113]).strip("\x00 "))] = np.nan
    half = 0.0 if settings.get(1025) == 2 else 0.5  # the tie point is a node, or a pixel's corner
    x = x0 + (np.arange(values.shape[1]) + half - column) * dx
    y = y0 - (np.arange(values.shape[0]) + half - row) * dy
    return x, y, values, {}


READERS: dict[str, Callable[..., Parts]] = {
    ".nc": _netcdf,
    ".grd": _grd,
    ".asc": _ascii,
    ".csv": _table,
    ".xyz": _table,
    ".txt": _table,
    ".dat": _table,
    ".tif": _geotiff,
    ".tiff": _geotiff,
}
