"""Axes of a grid: degrees or metres, by the file's statements or else by the numbers.

Nothing is taken for degrees only because it stands first: metres, kilometres and indices all fit between -180
and 180, and a map that is read in them is wrong without a word.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from magbridge.arrays import RealArray
from magbridge.errors import FormatError, MissingExtra
from magbridge.field.geodesy import metres_per_degree, wrap
from magbridge.field.spline import coefficients, filled

__all__ = ["EVEN", "LATITUDE", "LONGITUDE", "METRES", "PROJECTED", "Axes", "geographic", "stated"]

LONGITUDE, LATITUDE = ("longitude", "lon", "long", "x"), ("latitude", "lat", "y")
"""What the axes are called; x and y may be degrees or not."""
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
"""Metres in a unit of length."""
MAX_REPROJECTED_NODES = 10_000_000
"""Nodes of a grid that is reprojected."""
EVEN = 1e-3
"""Share of a step by which rounded coordinates may deviate from an even spacing."""


class Axes(NamedTuple):
    """Statements of a file on its axes: ``unit`` ("" if none), and the reference system or None.

    ``crs`` is what pyproj takes: an authority's code, WKT, or the attributes of CF's grid mapping.
    """

    unit: str = ""
    crs: str | dict[str, Any] | None = None


def stated(unit: str, *names: str) -> str:
    """Return the unit of an axis: as it is stated, or "deg" or "m" where one of its `names` implies it."""
    called = {name.lower() for name in names}
    if unit.strip() and unit.strip() != "1":
        return unit.strip()
    if called & ({*LONGITUDE, *LATITUDE} - {"x", "y"}):
        return "deg"
    return "m" if called & {*PROJECTED[0], *PROJECTED[1]} else ""


def geographic(
    path: Path, x: RealArray, y: RealArray, fields: dict[str, RealArray], axes: Axes
) -> tuple[RealArray, RealArray, dict[str, RealArray]]:
    """Return longitudes, latitudes (deg) and fields (ny, nx): as they are, or reprojected.

    FormatError: lengths of no known projection; numbers that may be degrees or not; units of neither.
    MissingExtra: a projection, and no pyproj.
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
    """Return pyproj's CRS of the file's own statement, or of the ``.prj`` next to it; None without either."""
    sidecar = path.with_suffix(".prj")
    if not crs and not sidecar.is_file():
        return None
    try:
        from pyproj import CRS  # noqa: PLC0415  an extra of its own
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
    """Return the fields on an even grid of degrees as fine as theirs, by cubic splines; outside are holes."""
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
    """Return values (ny, nx) at fractional rows and columns (2, m, n): NaN outside and next to a hole."""
    from scipy.ndimage import map_coordinates  # noqa: PLC0415  the live path runs without scipy

    hole = map_coordinates(np.isnan(values).astype(float), indices, order=1, mode="constant", cval=1.0)
    spline = coefficients(filled(np.asarray(values, np.float64)))  # a node more on each side
    found = map_coordinates(spline, indices + 1.0, order=3, mode="nearest", prefilter=False)
    return np.asarray(np.where(hole > 1e-9, np.nan, found))
