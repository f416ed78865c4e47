"""Readers of anomaly grids in Surfer, Geosoft, ESRI ASCII, GeoTIFF and text files, and in MagNav's folder."""

from __future__ import annotations

import re
import warnings
import zlib
from collections.abc import Callable
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from magbridge.arrays import RealArray
from magbridge.errors import FormatError, MissingExtra
from magbridge.field.grid_netcdf import (
    ANOMALY_VARIABLES,
    LATITUDE,
    LONGITUDE,
    PROJECTED,
    SIGMA,
    Axes,
    Parts,
    netcdf,
    stated,
)
from magbridge.wording import counted

__all__ = ["ascii_grid", "folder", "geotiff", "grd", "libraries", "table"]

BAD_GEOSOFT = (ValueError, NotImplementedError, OSError, IndexError, UnboundLocalError, OverflowError)
"""Exceptions that harmonica raises for a damaged file or another format, in addition to zlib's."""
BAD_TIFF = (OSError, KeyError, AttributeError, TypeError, ValueError)
"""Exceptions that Pillow or a missing or malformed tag raises."""
TEXT_OPTIONS: Any = {"encoding": "utf-8-sig", "errors": "replace"}
"""Options for opening a text file, with or without a byte order mark, whose comments may not be UTF-8."""
LENGTH_UNITS = {9001: "m", 9002: "ft", 9003: "us-ft", 9036: "km"}
"""Units of a GeoTIFF's coordinates, by EPSG code."""
NETCDF = (b"CDF\x01", b"CDF\x02", b"\x89HDF")


def grd(path: Path) -> Parts:
    """Read a ``.grd`` file: GMT's netCDF, Surfer 6 text or binary, Surfer 7, or Geosoft.

    FormatError: the file is damaged or of another format.
    """
    with path.open("rb") as file:
        start = file.read(4)
    if start in NETCDF:
        return netcdf(path)
    if start not in _SURFER:
        return _geosoft(path)
    try:
        nx, ny, x, y, values = _SURFER[start](path)
    except FormatError:
        raise
    except (ValueError, IndexError) as error:
        raise FormatError(
            path, "expected a Surfer grid: it ends too early or is not what its header says"
        ) from error
    if min(nx, ny) < 1 or nx * ny != values.size:
        raise FormatError(
            path, f"expected a Surfer grid: its header claims {nx} x {ny} values, it holds {values.size}"
        )
    return np.linspace(*x, nx), np.linspace(*y, ny), values.astype(float).reshape(ny, nx), {}


def libraries(path: Path) -> list[str]:
    """Return the installed third-party modules that reading a file needs, by its suffix and first bytes."""
    if path.suffix.lower().startswith(".tif"):
        names = ["PIL.Image"]
    else:
        with path.open("rb") as file:
            start = file.read(4)
        netcdf_like = path.suffix.lower() == ".nc" or start in NETCDF
        names = ["xarray", "netCDF4"] if netcdf_like else [] if start in _SURFER else ["harmonica"]
    return [name for name in names if find_spec(name.partition(".")[0])]


Surfer = tuple[int, int, tuple[float, float], tuple[float, float], RealArray]


def _surfer_text(path: Path) -> Surfer:
    words = path.read_text(**TEXT_OPTIONS).split()
    nx, ny = int(words[1]), int(words[2])
    limits = [float(word) for word in words[3:9]]
    return nx, ny, (limits[0], limits[1]), (limits[2], limits[3]), np.array(words[9:], float)


def _surfer_6(path: Path) -> Surfer:
    raw = path.read_bytes()
    nx, ny = (int(n) for n in np.frombuffer(raw, "<i2", 2, 4))
    limits = np.frombuffer(raw, "<f8", 6, 8).tolist()
    values = np.frombuffer(raw, "<f4", _held(raw, 56, 4, nx * ny), 56)
    return nx, ny, (limits[0], limits[1]), (limits[2], limits[3]), values


def _surfer_7(path: Path) -> Surfer:
    """Read Surfer 7, a file of tagged sections: DSRB header, GRID, DATA."""
    raw = path.read_bytes()
    at = raw.index(b"GRID") + 8
    ny, nx = (int(n) for n in np.frombuffer(raw, "<i4", 2, at))
    x0, y0, dx, dy, _, _, rotation, blank = np.frombuffer(raw, "<f8", 8, at + 8).tolist()
    if 0.0 < abs(rotation) < 360.0:  # other values are damage, which a later check finds
        raise FormatError(path, f"rotated by {rotation:g} degrees: expected rows along x")
    start = raw.index(b"DATA", at) + 8
    values = np.frombuffer(raw, "<f8", _held(raw, start, 8, nx * ny), start).copy()
    values[values >= blank if blank > 0.0 else values == blank] = np.nan
    return nx, ny, (x0, x0 + dx * (nx - 1)), (y0, y0 + dy * (ny - 1)), values


def _held(raw: bytes, start: int, size: int, claimed: int) -> int:
    """Return how many of `claimed` values, `size` bytes each from byte `start` on, the file contains."""
    return max(min(claimed, (len(raw) - start) // size), 0)


_SURFER: dict[bytes, Callable[[Path], Surfer]] = {
    b"DSAA": _surfer_text, b"DSBB": _surfer_6, b"DSRB": _surfer_7
}  # fmt: skip


def _geosoft(path: Path) -> Parts:
    try:
        from harmonica import load_oasis_montaj_grid  # noqa: PLC0415  an extra of its own
    except ImportError:
        raise MissingExtra("harmonica", "grids") from None
    try:
        grid = load_oasis_montaj_grid(str(path))
    except (*BAD_GEOSOFT, zlib.error) as error:
        raise FormatError(path, "expected a Surfer, GMT or Geosoft grid: it is none, or damaged") from error
    return grid["easting"].to_numpy(), grid["northing"].to_numpy(), grid.to_numpy().astype(float), {}


def ascii_grid(path: Path) -> Parts:
    """Read ESRI ASCII: ``ncols nrows``, a corner or centre, ``cellsize``, then rows from north to south.

    FormatError: a header or a number is missing.
    """
    words = path.read_text(**TEXT_OPTIONS).split()
    header: dict[str, float] = {}
    at = 0
    try:
        while words[at][0].isalpha():
            header[words[at].lower()] = float(words[at + 1])
            at += 2
        nx, ny = int(header["ncols"]), int(header["nrows"])
        dx, dy = header.get("cellsize", header.get("dx", 0.0)), header.get("cellsize", header.get("dy", 0.0))
        x0 = header["xllcenter"] if "xllcenter" in header else header["xllcorner"] + dx / 2
        y0 = header["yllcenter"] if "yllcenter" in header else header["yllcorner"] + dy / 2
        values = np.array(words[at:], float).reshape(ny, nx)[::-1]
    except (IndexError, KeyError, ValueError, OverflowError) as error:
        raise FormatError(
            path, "expected an ESRI ASCII grid: ncols, nrows, corner, cellsize, rows"
        ) from error
    values[values == header.get("nodata_value", -9999.0)] = np.nan
    return x0 + dx * np.arange(nx), y0 + dy * np.arange(ny), values, {}


def folder(path: Path) -> Parts:
    """Read a folder as of MagNav's example: CSV files of longitudes, latitudes, altitude and the map.

    FormatError: one of the files is missing or is not a table of numbers.
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
    """Read a GeoTIFF of one band with a pixel scale and a tie point; FormatError: any other file."""
    from PIL import Image  # noqa: PLC0415  comes with matplotlib

    raw = BytesIO(path.read_bytes())  # outside of try: an error of the system is not one of the format
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
        scale, offset, unit = _gdal(str(tags.get(42112, "")))
    except (*BAD_TIFF, Image.DecompressionBombError) as error:  # no survey is so large: its size is damaged
        raise FormatError(path, "expected a GeoTIFF with a pixel scale and a tie point") from error
    settings = {int(key): int(value) for key, _, _, value in keys}
    if values.ndim != 2:
        raise FormatError(path, f"expected one band, found an image of shape {values.shape}")
    values[values == hole] = np.nan
    half = 0.0 if settings.get(1025) == 2 else 0.5  # the tie point is a node, or a pixel's corner
    x = x0 + (np.arange(values.shape[1]) + half - column) * dx
    y = y0 - (np.arange(values.shape[0]) + half - row) * dy
    kind, code = settings.get(1024), settings.get(3072, 0)
    unit_of_length = LENGTH_UNITS.get(settings.get(3076, 0), "unknown" if 3076 in settings else "")
    projected = Axes(unit_of_length, f"EPSG:{code}") if 1024 <= code < 32767 else Axes("m")
    axes = projected if kind == 1 else Axes("deg" if kind == 2 else "")
    return x, y, values * scale + offset, {"axes": axes, "units": {"anomaly": unit}}


def _gdal(text: str) -> tuple[float, float, str]:
    """Return scale, offset and unit of the first band from GDAL's XML, ``<Item role="scale">0.1</Item>``."""
    declared = {}
    for attributes, value in re.findall(r"<Item([^>]*)>([^<]*)</Item>", text):
        role = re.search(r'role="(\w+)"', attributes)
        if role and 'sample="0"' in attributes:
            declared[role[1].lower()] = value.strip()
    return float(declared.get("scale", 1.0)), float(declared.get("offset", 0.0)), declared.get("unittype", "")


REMARK = re.compile(r"\s*([#%/]|(line|tie)[\s:]*[\w.:]+\s*$|$)", re.IGNORECASE)
"""A comment, an empty line, or the heading of a survey line as Geosoft writes it."""
NUMBER_PATTERN = re.compile(r"[-+.\deinfa]+")
UNIT_SUFFIXES = ("nt", "ut", "µt", "deg", "m", "km", "ft")
"""Units that may end a column's name, after an underscore."""
ALTITUDE, DEPTH = ("altitude", "alt", "height"), ("depth",)
OTHERS = {*SIGMA, *ALTITUDE, *DEPTH, "line", "flight", "date", "time", "fid", "elev"}
"""Names of columns that are never the anomaly."""
LEVEL_TOLERANCE = 1.0
"""Largest range of the altitudes of a level grid, in their unit."""
HEADER_HINT = "name the columns in the first row: longitude,latitude,anomaly"


class GridColumn(NamedTuple):
    """Column of a table: its index, its name in lower case without the unit, and its unit."""

    place: int
    name: str
    unit: str


def table(path: Path) -> Parts:
    """Read a grid from a table of x, y and anomaly, with or without column names, rows in any order.

    Missing nodes are holes. FormatError: missing or ambiguous columns, nodes that do not form a grid, or
    altitudes that vary.
    """
    words, delimiter, skip = _beginning(path)
    header = not all(NUMBER_PATTERN.fullmatch(word) for word in words)
    axes, units, further = Axes(), {}, {}
    if header:
        x, y, z, *others = _named(path, words)
        axes, units["anomaly"] = Axes(stated(x.unit, x.name)), z.unit
        further = {("sigma" if c.name in SIGMA else "altitude"): c for c in others}
        units |= {name: c.unit for name, c in further.items()}
        places = [c.place for c in (x, y, z, *further.values())]
    elif len(words) == 3:
        places = [0, 1, 2]
    else:
        raise FormatError(path, f"{counted(len(words), 'column')} without names: {HEADER_HINT}", row=1)
    rows = _numbers(path, delimiter, skip, places)
    if not header:
        rows = rows[:, _order(path, rows)]
    (x_levels, column), (y_levels, row) = (
        np.unique(np.round(rows[:, k], 9), return_inverse=True) for k in (0, 1)
    )
    if x_levels.size * y_levels.size > 4 * len(rows):
        raise FormatError(path, f"expected a grid, found {len(rows)} scattered points: grid them first")
    if np.unique(row * x_levels.size + column).size < len(rows):
        raise FormatError(path, "expected one row for each node, some are there twice")
    fields = np.full((len(places) - 2, y_levels.size, x_levels.size), np.nan)
    fields[:, row, column] = rows[:, 2:].T
    options: dict[str, Any] = dict(zip(further, fields[1:], strict=True))
    if "altitude" in options:
        options["altitude"] = _level(path, further["altitude"], options["altitude"])
    return x_levels, y_levels, fields[0], {"units": units, "axes": axes, **options}


def _level(path: Path, column: GridColumn, heights: RealArray) -> float:
    """Return the altitude of a grid from the heights or depths of its nodes; FormatError: they vary."""
    low, high = np.nanquantile(heights, [0.0, 1.0]) if np.isfinite(heights).any() else (np.nan, np.nan)
    if high - low > LEVEL_TOLERANCE:
        raise FormatError(
            path,
            f"expected one height of all nodes, found {low:g} to {high:g}: grid the samples at one height by "
            "magbridge survey, or leave the column out",
            column=column.name,
        )
    return float(0.5 * (low + high)) * (-1.0 if column.name in DEPTH else 1.0)


def _beginning(path: Path) -> tuple[list[str], str | None, int]:
    """Return the words of the header (else of the first row), the separator, and the number of lines to skip.

    The header may be in a comment.
    """
    remarks: list[str] = []
    with path.open(**TEXT_OPTIONS) as file:
        for first in file:
            if not REMARK.match(first):
                break
            remarks.append(first)
        else:
            first = ""
    delimiter = next((mark for mark in ",;\t" if mark in first), None)
    candidates = [first, *(line.strip().lstrip("#%/") for line in reversed(remarks))]
    rows = [[word.strip() for word in line.strip().lower().split(delimiter)] for line in candidates]
    eastward = {*LONGITUDE, *PROJECTED[0]}
    alike = (row for row in rows[1:] if len(row) == len(rows[0]))
    named = (row for row in alike if any(_column(0, word).name in eastward for word in row))
    words = rows[0]
    if all(NUMBER_PATTERN.fullmatch(word) for word in words):
        return next(named, words), delimiter, len(remarks)
    return words, delimiter, len(remarks) + 1


def _named(path: Path, words: list[str]) -> list[GridColumn]:
    """Return the columns of x, y, anomaly, and if given of sigma and height, by their names in `words`."""
    columns = [_column(place, word) for place, word in enumerate(words)]
    kinds = (
        (*LONGITUDE, *PROJECTED[0]),
        (*LATITUDE, *PROJECTED[1]),
        ANOMALY_VARIABLES,
        SIGMA,
        ALTITUDE + DEPTH,
    )
    x, y, z, *others = (
        next((c for name in names for c in columns if c.name == name), None) for names in kinds
    )
    if x is None or y is None:
        raise FormatError(path, "expected the columns longitude, latitude, anomaly", row=1)
    unknown = [c.name for c in columns if c not in (x, y, z) and c.name not in OTHERS]
    if z is None or (z.name in ("z", "value") and unknown):  # z may be a height
        listed = " or ".join([*([z.name] if z else []), *unknown])
        which = f": which of {listed} is it?" if listed else ""
        raise FormatError(
            path, f"expected the columns longitude, latitude, anomaly{which} call it anomaly", row=1
        )
    return [x, y, z, *(c for c in others if c)]


def _column(place: int, word: str) -> GridColumn:
    """Return the column that a header's `word` names: ``mag``, ``mag [uT]``, ``mag (uT)`` or ``mag_uT``."""
    name, *inside = re.split(r"\s*[\[(]\s*", word.strip("\"' "), maxsplit=1)
    name = re.sub(r"_(dd|wgs84|decimal_degrees)$", "", name.strip().replace(" ", "_"))
    unit = inside[0].rstrip("]) ") if inside else ""
    stem, _, ending = name.rpartition("_")
    if not unit and stem and ending in UNIT_SUFFIXES:
        name, unit = stem, ending
    return GridColumn(place, name, unit)


def _order(path: Path, rows: RealArray) -> list[int]:
    """Return the indices of longitude, latitude and anomaly; values beyond 90 deg cannot be latitudes."""
    first, second = np.abs(rows[:, :2]).max(axis=0)
    if second > 90.0 >= first:
        return [1, 0, 2]
    if first > 90.0 >= second:
        return [0, 1, 2]
    raise FormatError(path, f"longitude or latitude first? {HEADER_HINT}", row=1)


def _numbers(path: Path, delimiter: str | None, skip: int, places: list[int]) -> RealArray:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # for a file without rows; checked after this
            with path.open(**TEXT_OPTIONS) as file:  # numpy would read a byte order mark as a number
                rows = np.loadtxt(file, delimiter=delimiter, skiprows=skip, usecols=places, ndmin=2)
    except ValueError as error:
        # numpy counts rows from 0 below the header
        place = re.search(r"at row (\d+), column (\d+)", str(error))
        line, number = (int(place[1]) + 1 + skip, place[2]) if place else (None, None)
        raise FormatError(path, "expected numbers", row=line, column=number) from error
    if not np.isfinite(rows[:, :2]).all() or not len(rows):
        raise FormatError(path, "expected rows of longitude, latitude, anomaly")
    return np.asarray(rows)
