"""Draw the charts of the page: total field, masses and temperature, track."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass
from importlib.resources import files
from io import BytesIO
from math import ceil, cos, floor, isfinite, log10, nan, pi, sin, sqrt
from pathlib import Path
from typing import Any

from nicegui import ui

from magbridge.field.geodesy import metres_per_degree
from magbridge.monitor.history import TIERS, Point, Series, TrackPoint
from magbridge.monitor.state import TEMPERATURE_SERIES, BridgeState
from magbridge.monitor.widgets import GRID, Changes, card, nothing

CHARTS = json.loads(files("magbridge.monitor").joinpath("charts.json").read_text(encoding="utf-8"))
"""Options of ECharts by the kind of a chart. The colours suit a light and a dark page, as ECharts cannot read
the page's style variables. An axis has no labels at its ends: they would cover its round numbers."""
BREAK = 10.0
"""Shortest gap that interrupts the curve, s; it must also exceed 3 times the interval before it."""
ROOM, TAIL = 3.0, 0.02
"""Limits of the value axis: it omits values more than `ROOM` ranges outside the range of the inner values.
The inner values exclude the fraction `TAIL` at either end, so that a spike does not stretch the axis."""
MIN_AXIS_RANGE = 1e-5
"""Smallest range of the value axis, as a fraction of its lower limit."""
ASPECT = 4.0 / 3.0
"""Width over height of the map and of its margins, so that a circle on the ground is drawn as a circle."""
MIN_MAP_WIDTH_M = 200.0
"""Smallest width of the map, m."""
PIXELS = 600
"""Largest number of pixels along the longer side of the picture of a grid."""
SIDES = 48
"""Number of corners of the polygon that represents an ellipse."""
KEYS = "; keys: plus and minus zoom, arrows pan, 0 shows all, S saves it as PNG"
MAX_CHART_INTERVAL_S = 3.0
"""Shortest time between two updates of the telemetry charts, s; it limits the load of a phone."""


def chart_options(kind: str, name: str) -> dict[str, Any]:
    """Return the ECharts options of a chart without data; `name` is for the file of a saved picture."""
    options: dict[str, Any] = deepcopy(CHARTS[kind])
    options["toolbox"] = deepcopy(CHARTS["toolbox"])
    stem = "".join(c if c.isalnum() else "_" for c in f"magbridge {name}")
    options["toolbox"]["feature"]["saveAsImage"]["name"] = stem
    if kind == "map":  # zooming would change the aspect of the map
        del options["toolbox"]["feature"]["dataZoom"]
    return options


def drawn(points: Sequence[Point], tier: str) -> tuple[list[list[Any]], dict[str, float]]:
    """Return lower edge, band width, mean, spikes, and the limits of the y axis; all empty without points."""
    if not points:
        return [[], [], [], []], {}
    ends = axis_range(points)
    low, width, mean = (list(one) for one in zip(*curves(points, TIERS[tier][1]), strict=True))
    return [low, width, mean, spikes(points, **ends)], ends


def curves(points: Sequence[Point], width: float) -> Iterator[list[tuple[float, ...]]]:
    """Yield (ms, value) of the 2-sigma band's lower edge, its width, and the mean; NaN marks a gap."""
    last, usual = points[0].time, 0.0
    for point in points:
        ms, gap = 1e3 * (point.time + 0.5 * width), point.time - last
        if gap > max(BREAK, 3 * usual, 3 * width):
            yield [(ms - 1.0, nan)] * 3
        last, usual = point.time, gap
        band = round(point.high - point.low, 3)
        mean = ms, round(point.mean, 4), band, round(point.low, 3), round(point.high, 3)
        yield [(ms, round(point.low, 3)), (ms, band), mean]


def axis_range(points: Sequence[Point]) -> dict[str, float]:
    """Return rounded limits of the y axis, which include the curve without spikes and its band if it fits."""
    values = sorted(point.mean for point in points)
    tail = ceil(TAIL * len(values)) if len(values) >= 10 else 0
    inner = values[tail : len(values) - tail]
    room = ROOM * (inner[-1] - inner[0]) or max(1.0, 1e-3 * abs(inner[0]))
    within = inner[0] - room, inner[-1] + room
    low = max(within[0], min(point.low for point in points))
    high = min(within[1], max(point.high for point in points))
    if high - low < MIN_AXIS_RANGE * abs(low):  # do not magnify rounding errors of a constant
        low, high = within
    step = 10.0 ** floor(log10(max(high - low, 1e-6)) - 0.5)
    return {"min": floor(low / step) * step, "max": ceil(high / step) * step}


def spikes(points: Sequence[Point], min: float, max: float) -> list[dict[str, Any]]:  # noqa: A002 - ECharts' names
    """Return a triangle at the limit of the axis for each point with a value outside `min` to `max`."""
    marks = []
    for point in points:
        if point.most > max:
            place = [1e3 * point.time, max, point.most]
            marks.append({"value": place, "symbol": "triangle", "symbolRotate": 0})
        if point.least < min:
            place = [1e3 * point.time, min, point.least]
            marks.append({"value": place, "symbol": "triangle", "symbolRotate": 180})
    return marks


@dataclass(frozen=True)
class Background:
    """Picture of an anomaly grid, for the background of the map."""

    box: tuple[float, float, float, float]
    """West, south, east and north edge of the picture, deg."""
    picture: str
    """A PNG as a ``data:`` address; north is up."""
    span: float
    """Anomaly of the darkest red, nT; the darkest blue is the same value with a negative sign."""


def read_background(path: Path) -> Background:
    """Read the anomaly grid of a file and return it as a picture; FormatError: the file is not a grid."""
    import numpy as np  # noqa: PLC0415 - most pages show no grid
    from matplotlib.image import imsave  # noqa: PLC0415 - as above

    from magbridge.field.read import read_grid  # noqa: PLC0415 - as above

    grid = read_grid(path)
    every = max(1, -(-max(grid.anomaly.shape) // PIXELS))
    values = grid.anomaly[::-every, ::every]
    span = float(np.nanpercentile(np.abs(values), 98.0)) or 1.0
    held = BytesIO()
    imsave(held, np.ma.masked_invalid(values), vmin=-span, vmax=span, cmap="RdBu_r", format="png")
    x, y = grid.longitude, grid.latitude
    half_x, half_y = 0.5 * (x[1] - x[0]), 0.5 * (y[1] - y[0])
    edges = np.add([x[0], y[0], x[-1], y[-1]], [-half_x, -half_y, half_x, half_y])
    west, south, east, north = edges.tolist()
    picture = "data:image/png;base64," + base64.b64encode(held.getvalue()).decode()
    return Background((west, south, east, north), picture, span)


def ellipse(place: TrackPoint) -> list[tuple[float, float]]:
    """Return the 2-sigma ellipse of a position as a polygon of (longitude, latitude), deg.

    The polygon is empty if the covariance is unknown. Its points are ``2 L (cos t, sin t)`` with the Cholesky
    factor L of the covariance, ``P = L L^T``.
    """
    nn, ne, ee = place.covariance
    largest = nn + ee
    if not (isfinite(largest + ne) and 0.0 < largest < 1e12 and abs(place.latitude) < 89.0):
        return []
    north_sigma = sqrt(max(nn, 1e-12 * largest))
    shared = ne / north_sigma
    east_sigma = sqrt(max(ee - shared * shared, 0.0))
    per_latitude, per_longitude = metres_per_degree(place.latitude)
    polygon = []
    for k in range(SIDES + 1):
        cosine, sine = 2.0 * cos(2.0 * pi * k / SIDES), 2.0 * sin(2.0 * pi * k / SIDES)
        north, east = north_sigma * cosine, shared * cosine + east_sigma * sine
        polygon.append((place.longitude + east / per_longitude, place.latitude + north / per_latitude))
    return polygon


def extent(places: Iterable[tuple[float, float]]) -> tuple[float, float, float, float] | None:
    """Return west, south, east, north (deg) of a map around (longitude, latitude), deg; None without any."""
    points = list(places)
    if not points:
        return None
    west, east = min(x for x, _ in points), max(x for x, _ in points)
    south, north = min(y for _, y in points), max(y for _, y in points)
    middle_x, middle_y = 0.5 * (west + east), 0.5 * (south + north)
    per_latitude, per_longitude = metres_per_degree(max(-89.0, min(middle_y, 89.0)))
    width = max((east - west) * per_longitude, MIN_MAP_WIDTH_M)
    height = 1.1 * max((north - south) * per_latitude, width / ASPECT)
    half_x, half_y = 0.5 * ASPECT * height / per_longitude, 0.5 * height / per_latitude
    return middle_x - half_x, middle_y - half_y, middle_x + half_x, middle_y + half_y


def series(
    reported: Iterable[TrackPoint], estimated: Iterable[TrackPoint], background: Background | None
) -> tuple[list[list[Any]], tuple[float, float, float, float] | None]:
    """Return grid, tracks, ellipse and last positions, and the limits (west, south, east, north), deg."""
    own, by_field = list(reported), list(estimated)
    shape = ellipse(by_field[-1]) if by_field else []
    tracks = [_places(own), _places(by_field)]
    last = [
        {"value": track[-1], "itemStyle": {"color": CHARTS["map"]["series"][k]["color"]}}
        for k, track in enumerate(tracks, 1)
        if track
    ]
    seen = [*tracks[0], *tracks[1], *shape]
    if not seen and background:
        west, south, east, north = background.box
        seen = [(west, south), (east, north)]
    grid = [list(background.box)] if background else []
    return [grid, *tracks, shape, last], extent(seen)


def _places(track: Iterable[TrackPoint]) -> list[tuple[float, float]]:
    return [(round(one.longitude, 7), round(one.latitude, 7)) for one in track]


class Curve:
    """Chart of one quantity over a window of time."""

    def __init__(self, title: str, name: str, *, small: bool = False) -> None:
        self._changes = Changes()
        options = chart_options("curve", name)
        if small:  # a small chart has no slider, and its tooltip no unit
            options["grid"] |= {"left": 56, "bottom": 24}
            options["tooltip"][":formatter"] = "magbridge.tip(3, '')"
            options["yAxis"]["splitNumber"] = 3
            del options["dataZoom"][1]
        with frame(title):
            self._chart = ui.echart(options).classes("w-full h-44" if small else "w-full h-80 md:h-[34rem]")

    def show(self, known: Series, tier: str) -> None:
        """Draw the curve of a window (`tier`) if a new point has begun or the window has changed."""
        points = known.points(tier)
        if not self._changes.new("drawn", (tier, points and points[-1].time)):
            return
        data, ends = drawn(points, tier)
        for one, values in zip(self._chart.options["series"], data, strict=True):
            one["data"] = values
        self._chart.options["yAxis"] |= ends
        self._chart.update()


def frame(title: str) -> ui.element:
    """Return the frame of a chart, which accepts focus and keys and gives screen readers the title."""
    box = ui.element().classes("w-full")
    box.props["tabindex"], box.props["role"], box.props["data-chart"] = 0, "img", ""
    box.props["aria-label"] = title + KEYS
    return box


class TotalField:
    """Panel with the curve of the total field, and the switch that sets the window of all charts."""

    def __init__(self, tier: str, on_change: Any) -> None:
        with card("Total field, nT ± 2σ, UTC") as self.box:
            with ui.row().classes("w-full justify-end -mt-8"):
                choice = ui.toggle(list(TIERS), value=tier, on_change=lambda event: on_change(event.value))
                choice.props("dense no-caps unelevated size=md padding='2px 8px' toggle-color=blue-9")
                choice.props["aria-label"] = "Window of time"
            self._curve = Curve("Total field", "total_field")

    def show(self, state: BridgeState, tier: str) -> None:
        """Draw the total field of a bridge over the window `tier`."""
        self._curve.show(state.total, tier)


class TelemetryChart:
    """Panel with one chart for each mass position, named value, further sensor and the temperature."""

    def __init__(self) -> None:
        self._changes, self._curves, self._drawn = Changes(), dict[str, Curve](), -MAX_CHART_INTERVAL_S
        with card("Masses, other telemetry, and temperature"):
            self._box = ui.element().classes(f"{GRID} md:grid-cols-2 xl:grid-cols-3")

    def show(self, state: BridgeState, tier: str, now_s: float) -> None:
        """Draw the charts, at most once in `MAX_CHART_INTERVAL_S` unless the window changes."""
        names = sorted(state.telemetry, key=lambda name: (name == TEMPERATURE_SERIES, name))
        if self._changes.new("names", names, self._box):
            self._drawn = now_s - MAX_CHART_INTERVAL_S
            with self._box:
                if not names:
                    nothing("None heard: the link must carry the autopilot's NAMED_VALUE_FLOAT, or MAG_RAW")
                self._curves = {}
                for name in names:
                    with ui.column().classes("gap-0 w-full"):
                        ui.label(name).classes("text-sm font-medium")
                        self._curves[name] = Curve(name, name, small=True)
        if now_s - self._drawn < MAX_CHART_INTERVAL_S and not self._changes.new("tier", tier):
            return
        self._drawn = now_s
        for name, curve in self._curves.items():
            curve.show(state.telemetry[name], tier)


class TrackMap:
    """Panel with the map of the tracks; hidden while there are neither positions nor a grid."""

    def __init__(self, background: Background | None) -> None:
        self._changes, self._background = Changes(), background
        title = "Track"
        if background is not None:
            span = f"{background.span:.0f}"
            title += f" on the anomaly map, blue to red: \N{MINUS SIGN}{span} to +{span} nT"
        with ui.element().classes("w-full") as self._box, card(title), frame("Track"):
            self._chart = ui.echart(chart_options("map", "track")).classes("w-full aspect-[4/3]")

    def show(self, state: BridgeState) -> None:
        """Draw the tracks if a new position has been received."""
        added = state.reported_track.added, state.estimated.added
        self._box.set_visibility(bool(sum(added)) or self._background is not None)
        if not self._changes.new("track", added):
            return
        data, box = series(state.reported_track, state.estimated, self._background)
        for one, values in zip(self._chart.options["series"], data, strict=True):
            one["data"] = values
        if box is not None:
            west, south, east, north = box
            self._chart.options["xAxis"] |= {"min": west, "max": east}
            self._chart.options["yAxis"] |= {"min": south, "max": north}
        self._chart.update()
