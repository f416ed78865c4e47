"""Anomaly grids that are not netCDF: Surfer, Geosoft, ESRI ASCII, GeoTIFF, tables, MagNav's folder."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from magbridge.arrays import IndexArray, RealArray
from magbridge.errors import FormatError, MissingExtra
from magbridge.field.grid_netcdf import ANOMALY, LATITUDE, LONGITUDE, Parts, netcdf

__all__ = ["ascii_grid", "folder", "geotiff", "grd", "table"]

BAD_TIFF = (OSError, KeyError, AttributeError, TypeError, ValueError)
"""What Pillow, or a tag that is not as it should be, raises."""
TEXT: Any = {"encoding": "utf-8-sig", "errors": "replace"}
"""How a text is opened: with a byte order mark or without, and whatever its comments are written in."""
NETCDF = (b"CDF\x01", b"CDF\x02", b"\x89HDF")


def grd(path: Path) -> Parts:
    """Read GMT's netCDF, Surfer 6 text or binary, Surfer 7, else Geosoft; FormatError: none, or damaged."""
    with path.open("rb") as file:
        start = file.read(4)
    if start in NETCDF:
        return netcdf(path)
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


Surfer = tuple[int, int, tuple[float, float], tuple[float, float], RealArray]


def _surfer_text(path: Path) -> Surfer:
    words = path.read_text(**TEXT).split()
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


def ascii_grid(path: Path) -> Parts:
    """Read ESRI ASCII: ``ncols nrows``, a corner or centre, ``cellsize``, then rows from the north.

    Raises
    ------
    FormatError
        A header or a number is missing.
    """
    words = path.read_text(**TEXT).split()
    head: dict[str, float] = {}
    at = 0
    try:
        while words[at][0].isalpha():
            head[words[at].lower()] = float(words[at + 1])
            at += 2
        nx, ny = int(head["ncols"]), int(head["nrows"])
        dx, dy = head.get("cellsize", head.get("dx", 0.0)), head.get("cellsize", head.get("dy", 0.0))
        x0 = head["xllcenter"] if "xllcenter" in head else head["xllcorner"] + dx / 2
        y0 = head["yllcenter"] if "yllcenter" in head else head["yllcorner"] + dy / 2
        values = np.array(words[at:], float).reshape(ny, nx)[::-1]
    except (IndexError, KeyError, ValueError, OverflowError) as error:
        raise FormatError(
            path, "expected an ESRI ASCII grid: ncols, nrows, corner, cellsize, rows"
        ) from error
    values[values == head.get("nodata_value", -9999.0)] = np.nan
    return x0 + dx * np.arange(nx), y0 + dy * np.arange(ny), values, {}


def table(path: Path) -> Parts:
    """Read longitude, latitude, anomaly in columns, header or not; any order of rows; gaps are holes.

    Raises
    ------
    FormatError
        No such columns, or nodes that form no grid.
    """
    with path.open(**TEXT) as file:
        first = file.readline()
    delimiter = next((mark for mark in ",;" if mark in first), None)
    words = [word.strip() for word in first.strip().lstrip("#").lower().split(delimiter)]
    header = not all(re.fullmatch(r"[-+.\deinfa]+", word) for word in words)
    columns: tuple[int, ...] = (0, 1, 2)
    unit = ""
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
        unit = stated.group(1) if stated else ""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of a file without rows, which is seen below
            with path.open(**TEXT) as file:  # not numpy's: it takes a byte order mark for a number
                table = np.loadtxt(file, delimiter=delimiter, skiprows=int(header), usecols=columns, ndmin=2)
    except ValueError as error:
        # numpy counts rows from 0 below the header
        place = re.search(r"at row (\d+), column (\d+)", str(error))
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


def _levels(values: RealArray) -> tuple[RealArray, IndexArray]:
    """Return the distinct coordinates and where each value falls; 179 and -179 are neighbours."""
    levels, index = np.unique(np.round(values, 9), return_inverse=True)
    gaps = np.diff(levels)
    if gaps.size and gaps.max() > 180.0 > levels[-1] - 180.0:
        split = int(gaps.argmax()) + 1
        levels = np.concatenate([levels[split:], levels[:split] + 360.0])
        index = (index - split) % levels.size
    return levels, index


def folder(path: Path) -> Parts:
    """Read MagNav's example: longitudes, latitudes and altitude beside a matrix, each a CSV file.

    Raises
    ------
    FormatError
        One of the files is missing or is no table of numbers.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)  # of a file without numbers
            x, y, altitude, values = (
                np.loadtxt(path / f"{name}.csv", delimiter=",", ndmin=2, encoding="utf-8-sig")
                for name in ("xx", "yy", "alt", "map")
            )
    except (OSError, ValueError, UserWarning) as error:
        raise FormatError(path, f"expected xx.csv yy.csv alt.csv map.csv: {error}") from error
    return x.ravel(), y.ravel(), values, {"altitude": float(altitude.flat[0])}


def geotiff(path: Path) -> Parts:
    """Read one band with a pixel scale and a tie point in geographic coordinates; FormatError: any other."""
    from PIL import Image  # noqa: PLC0415  comes with matplotlib

    raw = BytesIO(path.read_bytes())  # what the system refuses is its own error, not the format's
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of damaged tags, and of a large image
            with Image.open(raw, formats=["TIFF"]) as image:
                values = np.array(image, float)
                tags: dict[int, Any] = dict(image.tag_v2)  # type: ignore[attr-defined]  # only TIFF images have it
        dx, dy = tags[33550][:2]
        column, row, _, x0, y0 = tags[33922][:5]
        keys = np.array(tags.get(34735, ()), int).reshape(-1, 4)
        hole = float(str(tags.get(42113, "nan")).strip("\x00 "))
    except (*BAD_TIFF, Image.DecompressionBombError) as error:  # its size is damaged: no survey is so large
        raise FormatError(path, "expected a GeoTIFF with a pixel scale and a tie point") from error
    settings = {int(key): int(value) for key, _, _, value in keys}
    if settings.get(1024) == 1:
        raise FormatError(path, "projected coordinates: reproject the grid to longitude and latitude")
    if values.ndim != 2:
        raise FormatError(path, f"expected one band, found an image of shape {values.shape}")
    values[values == hole] = np.nan
    half = 0.0 if settings.get(1025) == 2 else 0.5  # the tie point is a node, or a pixel's corner
    x = x0 + (np.arange(values.shape[1]) + half - column) * dx
    y = y0 - (np.arange(values.shape[0]) + half - row) * dy
    return x, y, values, {}
