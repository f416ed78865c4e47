"""Anomaly grids from the formats in which surveys come.

A format is a function from a path to ``(longitude, latitude, anomaly, options of AnomalyGrid)``. The table
:data:`READERS` chooses it by the file's suffix; the kinds of GRD file, which share one, are told apart by
their first bytes.
"""

from __future__ import annotations

from collections.abc import Callable
from math import isfinite, nan
from pathlib import Path

import numpy as np

from magbridge.arrays import RealArray
from magbridge.columns import NT_PER_UNIT, usual
from magbridge.errors import FormatError
from magbridge.field.grid import AnomalyGrid
from magbridge.field.grid_formats import ascii_grid, folder, geotiff, grd, table
from magbridge.field.grid_netcdf import Parts, netcdf

__all__ = ["READERS", "read_grid", "read_polygon"]

NANOTESLA = {unit.lower(): factor for unit, factor in NT_PER_UNIT.items()}
"""nT in one unit, by the unit's name in lower case."""

READERS: dict[str, Callable[..., Parts]] = {
    ".nc": netcdf,
    ".grd": grd,
    ".asc": ascii_grid,
    ".csv": table,
    ".xyz": table,
    ".txt": table,
    ".dat": table,
    ".tif": geotiff,
    ".tiff": geotiff,
}


def read_grid(path: str | Path) -> AnomalyGrid:
    """Return the anomaly grid that a file holds.

    Parameters
    ----------
    path : path
        netCDF (CF, GMT), Surfer or Geosoft ``.grd``, ESRI ASCII ``.asc``, GeoTIFF, ``.csv`` or ``.xyz`` of
        longitude, latitude, anomaly; or a folder of ``xx.csv yy.csv alt.csv map.csv`` as
        MagNav's example has.

    Raises
    ------
    FormatError
        A file that is no such grid, in a unit that is no magnetic field, or in projected coordinates.
    """
    path = Path(path)
    if not path.exists():
        raise FormatError(path, "no such file")
    if not (path.is_file() or path.is_dir()):  # opening a pipe waits for whoever writes to it
        raise FormatError(path, "expected a file, not a pipe or a device")
    reader = folder if path.is_dir() else READERS.get(path.suffix.lower())
    if reader is None:
        raise FormatError(path, f"expected a grid: one of {' '.join(READERS)} or a folder")
    longitude, latitude, values, options = reader(path)
    scale = _scale(path, options.pop("unit", ""))
    if "sigma" in options:
        options["sigma"] = options["sigma"] * scale
    return AnomalyGrid(longitude, latitude, values * scale, name=str(path), **options)


def read_polygon(path: str | Path) -> RealArray:
    """Read a polygon: a text file with longitude and latitude (deg) in each row, (k, 2), k at least 3.

    A header that begins with ``longitude`` is skipped.

    Raises
    ------
    FormatError
        It cannot be read or is not a polygon.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8-sig").splitlines()
    except OSError as error:
        raise FormatError(path, f"cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError:
        raise FormatError(path, "expected text in UTF-8") from None
    corners = []
    for row, line in enumerate(lines, 1):
        text = line.partition("#")[0].strip()
        if not text or (row == 1 and text.lower().startswith("longitude")):
            continue
        try:
            longitude, latitude = map(float, text.split(","))
        except ValueError:
            longitude = latitude = nan
        if not (isfinite(longitude) and isfinite(latitude)):
            raise FormatError(path, f"expected longitude,latitude (deg), not {text!r}", row=row)
        corners.append((longitude, latitude))
    if len(corners) < 3:
        raise FormatError(path, "expected longitude,latitude (deg) in at least three rows")
    return np.array(corners)


def _scale(path: Path, unit: str) -> float:
    if not unit.strip():
        return 1.0
    try:
        return NANOTESLA[usual(unit.strip().lower()).lower()]
    except KeyError:
        raise FormatError(path, f"expected a magnetic field in nT, found the unit {unit!r}") from None
