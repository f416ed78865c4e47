"""Read anomaly grids from all supported formats.

A reader is a function from a path to ``(longitude, latitude, anomaly, options of AnomalyGrid)``. The table
:data:`READERS` selects it by the file's suffix. Formats that share the suffix ``.grd`` are distinguished by
their first bytes.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib import import_module
from math import isfinite, nan
from pathlib import Path

import numpy as np

from magbridge.arrays import RealArray
from magbridge.columns import NT_PER_UNIT, usual
from magbridge.errors import FormatError
from magbridge.field.grid import HOLE, AnomalyGrid
from magbridge.field.grid_formats import ascii_grid, folder, geotiff, grd, libraries, table
from magbridge.field.grid_netcdf import METRES, Axes, Parts, geographic, netcdf
from magbridge.files import contents, existing
from magbridge.guard import guarded

__all__ = ["READERS", "read_grid", "read_polygon", "without_fill"]

FILLS = tuple(sign * number for number in (99999.0, 9999.0, 32768.0, 32767.0, 999.0) for sign in (-1.0, 1.0))
"""Missing-value codes of files without NaN."""
CERTAIN = 9_000.0
"""Smallest absolute value of a missing-value code that is never an anomaly, nT; -999 may be an anomaly."""
TINY = 1.0
"""Smallest maximum of a map without a unit; a map with smaller values is hardly in nT."""
UNITS_OF_FIELD = "a magnetic field in nT", {unit.lower(): factor for unit, factor in NT_PER_UNIT.items()}
UNITS_OF_HEIGHT = "a height in m", METRES
"""Quantity, and size of each of its units, by the unit's name in lower case."""

READERS: dict[str, Callable[..., Parts]] = {
    ".nc": netcdf,
    ".grd": grd,
    ".asc": ascii_grid,
    **dict.fromkeys((".csv", ".xyz", ".txt", ".dat"), table),
    **dict.fromkeys((".tif", ".tiff"), geotiff),
}
GUARDED = {".nc", ".grd", ".tif", ".tiff"}
"""Formats that third-party libraries read in a child process, because a damaged file may crash them."""


def read_grid(path: str | Path) -> AnomalyGrid:
    """Return the anomaly grid of a file.

    Parameters
    ----------
    path : path
        File in netCDF (CF, GMT), Surfer or Geosoft ``.grd``, ESRI ASCII ``.asc``, GeoTIFF, or ``.csv`` or
        ``.xyz`` of longitude, latitude, anomaly; or a folder of ``xx.csv yy.csv alt.csv map.csv``, as in
        MagNav's example.

    Raises
    ------
    FormatError
        A file of another format, damaged, in a unit that is not one of its quantity, or on axes that are
        neither degrees nor lengths of a known projection.

    Notes
    -----
    The units, names, reference system and range of the axes determine their meaning
    (:mod:`~magbridge.field.grid_netcdf`). If the file does not state its projection, a ``.prj`` file next to
    it may. Third-party libraries read files in a child process (:mod:`magbridge.guard`).
    """
    path = Path(path)
    if not path.is_dir():
        existing(path)  # opening a pipe would wait for a writer
    reader = folder if path.is_dir() else READERS.get(path.suffix.lower())
    if reader is None:
        raise FormatError(path, f"expected a grid: one of {' '.join(READERS)} or a folder")
    parts = partial(reader, path)
    if path.suffix.lower() in GUARDED:
        for library in libraries(path):
            import_module(library)  # import in the parent once, not in every child process
        (found,) = guarded(path, lambda: [parts()])
    else:
        found = parts()
    x, y, values, options = found
    units = options.get("units", {})
    scale = _scale(path, unit := units.get("anomaly", ""), *UNITS_OF_FIELD)
    anomaly = without_fill(path, values) * scale
    # Mark holes before reprojection: a spline would spread a hole of 1e32 over the whole map.
    fields = {"anomaly": np.where(np.abs(anomaly) < HOLE, anomaly, nan)}
    if not unit and 0.0 < np.nanmax(np.abs(fields["anomaly"]), initial=0.0) < TINY:
        raise FormatError(path, f"no value is beyond {TINY:g}: state the unit, nT, uT or T")
    if "sigma" in options:
        fields["sigma"] = options["sigma"] * _scale(path, units.get("sigma") or unit, *UNITS_OF_FIELD)
    longitude, latitude, fields = geographic(path, x, y, fields, options.get("axes", Axes()))
    altitude, level = options.get("altitude", nan), options.get("level_sigma", 0.0)
    # a height's unit may name its zero: "m above the ellipsoid"
    above, _, _ = units.get("altitude", "").strip().partition(" ")
    return AnomalyGrid(
        longitude, latitude, fields["anomaly"], fields.get("sigma", 0.0),
        altitude * _scale(path, above, *UNITS_OF_HEIGHT), name=str(path),
        sigma_length=options.get("sigma_length", 0.0),
        level_sigma=level * _scale(path, units.get("level_sigma", ""), *UNITS_OF_FIELD),
    )  # fmt: skip


def without_fill(path: str | Path, values: RealArray) -> RealArray:
    """Return the values (...,) with undeclared missing-value codes as NaN.

    A value in :data:`FILLS` is a hole if it lies outside the other values by more than half their range.
    FormatError, which names `path`: a value such as -9999 lies among the others (:data:`CERTAIN`).
    """
    for fill in FILLS:
        here = values == fill
        if not here.any():
            continue
        others = values[np.isfinite(values) & ~here & (np.abs(values) < HOLE)]
        if not others.size:
            continue
        beyond = max(others.min() - fill, fill - others.max())
        if beyond > 0.5 * np.ptp(others):
            values = np.where(here, np.nan, values)
        elif abs(fill) >= CERTAIN:
            count = f"{int(here.sum())} nodes are exactly {fill:g}"
            raise FormatError(path, f"{count}: holes, or values? declare it as the fill value, or write NaN")
    return values


def read_polygon(path: str | Path) -> RealArray:
    """Read a polygon (k, 2), k at least 3, from text rows of longitude and latitude, deg.

    A header that begins with ``longitude`` is skipped.

    FormatError: the file is not UTF-8 text, or is not a polygon.
    """
    try:
        lines = contents(path).decode("utf-8-sig").splitlines()
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


def _scale(path: Path, unit: str, quantity: str, sizes: dict[str, float]) -> float:
    """Return the size of a unit, 1 if it is not stated; FormatError: it is not one of the `quantity`."""
    if not unit.strip():
        return 1.0
    try:
        return sizes[usual(unit.strip().lower()).lower()]
    except KeyError:
        raise FormatError(path, f"expected {quantity}, found the unit {unit!r}") from None
