"""The vehicle's track on a map that needs no network: longitude and latitude, and an anomaly grid beneath."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from dataclasses import dataclass
from io import BytesIO
from math import atan2, cos, isfinite, pi, sin, sqrt
from pathlib import Path
from typing import Any

from magbridge.errors import MissingExtra
from magbridge.field.geodesy import metres_per_degree
from magbridge.monitor.chart import GREY, INSIDE, TOOLS
from magbridge.monitor.history import TrackPoint

__all__ = ["Background", "ellipse", "extent", "options", "read_background", "series"]

ORANGE, BLUE = "#f97316", "#3b82f6"
ASPECT = 4.0 / 3.0
"""Width to height of the plot: both of the chart and of its margins, so that a circle is one at any width."""
MIN_MAP_WIDTH_M = 200.0
"""m across that the map shows at least."""
PIXELS = 600
"""Pixels of the picture of a grid along its longer side, at most."""
SIDES = 48
"""Corners of the polygon that is drawn for an ellipse."""
PICTURE = """(params, api) => {
    const a = api.coord([api.value(0), api.value(3)]), b = api.coord([api.value(2), api.value(1)])
    return {type: 'image', silent: true, style: {image: magbridge.map, x: a[0], y: a[1],
        width: b[0] - a[0], height: b[1] - a[1], opacity: 0.75}}
}"""


@dataclass(frozen=True)
class Background:
    """An anomaly grid as a picture."""

    box: tuple[float, float, float, float]
    """West, south, east and north edge, deg."""
    picture: str
    """A PNG as a ``data:`` address; north is up."""
    span: float
    """nT at the darkest red; the darkest blue is as far below zero."""


def read_background(path: Path) -> Background:
    """Return the anomaly grid of a file as a picture.

    FormatError: it is not a grid. MissingExtra: the analysis extra is not installed.
    """
    try:
        import numpy as np  # noqa: PLC0415 - most pages show no grid
        from matplotlib.image import imsave  # noqa: PLC0415 - as above

        from magbridge.field.read import read_grid  # noqa: PLC0415 - as above
    except ImportError as error:
        raise MissingExtra(str(error.name), "analysis") from error
    grid = read_grid(path)
    every = max(1, -(-max(grid.anomaly.shape) // PIXELS))
    values = grid.anomaly[::-every, ::every]
    span = float(np.nanpercentile(np.abs(values), 98.0)) or 1.0
    held = BytesIO()
    imsave(held, np.ma.masked_invalid(values), vmin=-span, vmax=span, cmap="RdBu_r", format="png")
    half_x, half_y = (0.5 * float(axis[1] - axis[0]) for axis in (grid.longitude, grid.latitude))
    box = (
        float(grid.longitude[0]) - half_x,
        float(grid.latitude[0]) - half_y,
        float(grid.longitude[-1]) + half_x,
        float(grid.latitude[-1]) + half_y,
    )
    return Background(box, "data:image/png;base64," + base64.b64encode(held.getvalue()).decode(), span)


def ellipse(place: TrackPoint) -> list[tuple[float, float]]:
    """Return the 2-sigma ellipse of a place as a polygon of (longitude, latitude), deg; empty if not known.

    Notes
    -----
    With the eigenvalues ``a², b²`` of the covariance and the angle θ of the longer axis from north,
    ``tan 2θ = 2 P_ne / (P_nn - P_ee)``.
    """
    nn, ne, ee = place.covariance
    middle, half = 0.5 * (nn + ee), 0.5 * (nn - ee)
    radius = sqrt(half * half + ne * ne)
    if not (isfinite(middle + radius) and 0.0 < middle + radius < 1e12 and abs(place.latitude) < 89.0):
        return []
    a, b, angle = 2 * sqrt(middle + radius), 2 * sqrt(max(middle - radius, 0.0)), 0.5 * atan2(ne, half)
    per_latitude, per_longitude = metres_per_degree(place.latitude)
    polygon = []
    for k in range(SIDES + 1):
        along, across = a * cos(2 * pi * k / SIDES), b * sin(2 * pi * k / SIDES)
        north = along * cos(angle) - across * sin(angle)
        east = along * sin(angle) + across * cos(angle)
        polygon.append((place.longitude + east / per_longitude, place.latitude + north / per_latitude))
    return polygon


def extent(places: Iterable[tuple[float, float]]) -> tuple[float, float, float, float] | None:
    """Return west, south, east, north (deg) around (longitude, latitude)s, in the shape of `ASPECT`."""
    points = list(places)
    if not points:
        return None
    west, east = min(x for x, _ in points), max(x for x, _ in points)
    south, north = min(y for _, y in points), max(y for _, y in points)
    middle_x, middle_y = 0.5 * (west + east), 0.5 * (south + north)
    per_latitude, per_longitude = metres_per_degree(max(-89.0, min(middle_y, 89.0)))
    height = 1.1 * max(
        (north - south) * per_latitude, (east - west) * per_longitude / ASPECT, MIN_MAP_WIDTH_M / ASPECT
    )
    half_x, half_y = 0.5 * ASPECT * height / per_longitude, 0.5 * height / per_latitude
    return middle_x - half_x, middle_y - half_y, middle_x + half_x, middle_y + half_y


def options() -> dict[str, Any]:
    """Return the map, still empty."""
    label = {"color": GREY, "showMinLabel": False, "showMaxLabel": False, "hideOverlap": True}
    degrees = {**label, ":formatter": "value => value.toFixed(4) + '\N{DEGREE SIGN}'"}
    axis = {"type": "value", "axisLabel": degrees, "splitLine": {"show": False}}
    inside = {**INSIDE, "filterMode": "none"}
    feature = TOOLS["feature"]
    image = {**feature["saveAsImage"], "name": "magbridge_track"}
    where = "one => one.value.slice(0, 2).reverse().map(v => v.toFixed(5)).join(', ')"
    return {
        "animation": False,
        # of a chart of this shape, so that the plot has it too
        "grid": {"left": "11%", "right": "4%", "top": "7%", "bottom": "8%"},
        "legend": {"left": 0, "top": 0, "itemHeight": 8, "itemWidth": 16, "textStyle": {"color": GREY}},
        "tooltip": {"confine": True, ":formatter": where},
        "toolbox": {**TOOLS, "feature": {"restore": feature["restore"], "saveAsImage": image}},
        "dataZoom": [{**inside, "xAxisIndex": 0}, {**inside, "yAxisIndex": 0}],
        "xAxis": {**axis, "splitNumber": 4},
        "yAxis": {**axis},
        "series": [],
    }


def series(
    reported: Iterable[TrackPoint], estimated: Iterable[TrackPoint], background: Background | None
) -> tuple[list[dict[str, Any]], tuple[float, float, float, float] | None]:
    """Return the series of the map, and its extent: grid, tracks, the last places and the ellipse."""
    own, by_field = list(reported), list(estimated)
    path = {
        "type": "line",
        "symbol": "circle",
        "symbolSize": 3,
        "showAllSymbol": False,
        "lineStyle": {"width": 2},
    }
    shape = ellipse(by_field[-1]) if by_field else []
    lines = [("Vehicle's own", ORANGE, _places(own)), ("By the field", BLUE, _places(by_field))]
    found: list[dict[str, Any]] = [
        {"type": "custom", ":renderItem": PICTURE, "silent": True, "clip": True, "tooltip": {"show": False},
         "data": [list(background.box)] if background else []}
    ]  # fmt: skip
    found += [{**path, "name": name, "color": color, "data": data} for name, color, data in lines]
    found.append(
        {**path, "name": "2\N{GREEK SMALL LETTER SIGMA}", "color": BLUE, "showSymbol": False, "data": shape,
         "lineStyle": {"width": 1.5, "type": "dashed"}}
    )  # fmt: skip
    last = [{"value": data[-1], "itemStyle": {"color": color}} for _, color, data in lines if data]
    found.append({"type": "scatter", "symbolSize": 10, "data": last})
    seen = [*lines[0][2], *lines[1][2], *shape]
    if not seen and background:
        west, south, east, north = background.box
        seen = [(west, south), (east, north)]
    return found, extent(seen)


def _places(track: Iterable[TrackPoint]) -> list[tuple[float, float]]:
    return [(round(one.longitude, 7), round(one.latitude, 7)) for one in track]
