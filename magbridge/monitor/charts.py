"""The panels of charts: total field, masses and temperature, track."""

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

from magbridge.errors import MissingExtra
from magbridge.field.geodesy import metres_per_degree
from magbridge.monitor.history import TIERS, Point, Series, TrackPoint
from magbridge.monitor.state import TEMPERATURE_SERIES, BridgeState
from magbridge.monitor.widgets import GRID, Changes, card, nothing

CHARTS = json.loads(files("magbridge.monitor").joinpath("charts.json").read_text(encoding="utf-8"))
"""Options of ECharts by the kind of a chart. ECharts knows no variables of the page: the colours are seen by
day and by night. An axis has no labels at its ends, where they would cover the round numbers next to them."""
BREAK = 10.0
"""Time without a sample that interrupts the curve, s, unless the interval before was a third as long."""
ROOM, TAIL = 3.0, 0.02
"""The axis covers the points without the fraction `TAIL` at either end, extended by `ROOM` times their range.
A step of the field soon has more points than that fraction; a spike never has."""
MIN_AXIS_RANGE = 1e-5
"""Smallest range of the value: an axis is not shorter."""
ASPECT = 4.0 / 3.0
"""Width to height of the map: both of the chart and of its margins, so that a circle is one at any width."""
MIN_MAP_WIDTH_M = 200.0
"""Smallest width of the map, m."""
PIXELS = 600
"""Pixels of the picture of a grid along its longer side, at most."""
SIDES = 48
"""Corners of the polygon that is drawn for an ellipse."""
KEYS = "; keys: plus and minus zoom, arrows pan, 0 shows all, S saves it as PNG"
MAX_CHART_INTERVAL_S = 3.0
"""Shortest time between two drawings of a chart of telemetry, s: a phone may have to draw many."""


def chart_options(kind: str, name: str) -> dict[str, Any]:
    """Return the options of a chart of that kind, still empty; its picture is saved under the name."""
    options: dict[str, Any] = deepcopy(CHARTS[kind])
    options["toolbox"] = deepcopy(CHARTS["toolbox"])
    stem = "".join(c if c.isalnum() else "_" for c in f"magbridge {name}")
    options["toolbox"]["feature"]["saveAsImage"]["name"] = stem
    if kind == "map":  # its axes keep their shape
        del options["toolbox"]["feature"]["dataZoom"]
    return options


def drawn(points: Sequence[Point], tier: str) -> tuple[list[list[Any]], dict[str, float]]:
    """Return the data of the four series, and the ends of the y axis; all empty without points."""
    if not points:
        return [[], [], [], []], {}
    ends = axis_range(points)
    low, width, mean = (list(one) for one in zip(*curves(points, TIERS[tier][1]), strict=True))
    return [low, width, mean, spikes(points, **ends)], ends


def curves(points: Sequence[Point], width: float) -> Iterator[list[tuple[float, ...]]]:
    """Yield (ms, value) of the band's lower edge, its width and the mean; NaN where they are interrupted."""
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
    """Return round ends of the axis: all of the curve but its spikes, and what fits of the band."""
    values = sorted(point.mean for point in points)
    tail = ceil(TAIL * len(values)) if len(values) >= 10 else 0
    inner = values[tail : len(values) - tail]
    room = ROOM * (inner[-1] - inner[0]) or max(1.0, 1e-3 * abs(inner[0]))
    within = inner[0] - room, inner[-1] + room
    low = max(within[0], min(point.low for point in points))
    high = min(within[1], max(point.high for point in points))
    if high - low < MIN_AXIS_RANGE * abs(low):  # a constant is not magnified
        low, high = within
    step = 10.0 ** floor(log10(max(high - low, 1e-6)) - 0.5)
    return {"min": floor(low / step) * step, "max": ceil(high / step) * step}


def spikes(points: Sequence[Point], min: float, max: float) -> list[dict[str, Any]]:  # noqa: A002 - ECharts' names
    """Return a mark at the end of the axis for every point with a value beyond it."""
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
    """An anomaly grid as a picture."""

    box: tuple[float, float, float, float]
    """West, south, east and north edge, deg."""
    picture: str
    """A PNG as a ``data:`` address; north is up."""
    span: float
    """Anomaly at the darkest red, nT; the darkest blue is the negative of it."""


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

    Its points are ``2 L (cos t, sin t)`` with Cholesky's factor L of the covariance, ``P = L L^T``.
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


def series(
    reported: Iterable[TrackPoint], estimated: Iterable[TrackPoint], background: Background | None
) -> tuple[list[list[Any]], tuple[float, float, float, float] | None]:
    """Return the data of the map's series (grid, two tracks, ellipse, last places), and its extent."""
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
    """A quantity over a window of time."""

    def __init__(self, title: str, name: str, *, small: bool = False) -> None:
        self._changes = Changes()
        options = chart_options("curve", name)
        if small:  # one of many: without a slider, and in any unit
            options["grid"] |= {"left": 56, "bottom": 24}
            options["tooltip"][":formatter"] = "magbridge.tip(3, '')"
            options["yAxis"]["splitNumber"] = 3
            del options["dataZoom"][1]
        with frame(title):
            self._chart = ui.echart(options).classes("w-full h-44" if small else "w-full h-80 md:h-[34rem]")

    def show(self, known: Series, tier: str) -> None:
        """Draw the curve, if it has changed as far as a reader can see."""
        points = known.points(tier)
        if not self._changes.new("drawn", (tier, points and points[-1].time)):
            return
        data, ends = drawn(points, tier)
        for one, values in zip(self._chart.options["series"], data, strict=True):
            one["data"] = values
        self._chart.options["yAxis"] |= ends
        self._chart.update()


def frame(title: str) -> ui.element:
    """Make the frame of a chart that takes the focus and keys, with its name for those who do not see it."""
    box = ui.element().classes("w-full")
    box.props["tabindex"], box.props["role"], box.props["data-chart"] = 0, "img", ""
    box.props["aria-label"] = title + KEYS
    return box


class TotalField:
    """The curve of the total field, and the choice of the window for all charts."""

    def __init__(self, tier: str, on_change: Any) -> None:
        with card("Total field, nT ± 2σ, UTC") as self.box:
            with ui.row().classes("w-full justify-end -mt-8"):
                choice = ui.toggle(list(TIERS), value=tier, on_change=lambda event: on_change(event.value))
                choice.props("dense no-caps unelevated size=md padding='2px 8px' toggle-color=blue-9")
                choice.props["aria-label"] = "Window of time"
            self._curve = Curve("Total field", "total_field")

    def show(self, state: BridgeState, tier: str) -> None:
        """Draw it."""
        self._curve.show(state.total, tier)


class TelemetryChart:
    """Three charts: positions of the masses, other named values of the vehicle, and the temperature."""

    def __init__(self) -> None:
        self._changes, self._curves, self._drawn = Changes(), dict[str, Curve](), -MAX_CHART_INTERVAL_S
        with card("Masses, other telemetry, and temperature"):
            self._box = ui.element().classes(f"{GRID} md:grid-cols-2 xl:grid-cols-3")

    def show(self, state: BridgeState, tier: str, now_s: float) -> None:
        """Draw them, now and then."""
        names = sorted(state.telemetry, key=lambda name: (name == TEMPERATURE_SERIES, name))
        if self._changes.new("names", names, self._box):
            self._drawn = now_s - MAX_CHART_INTERVAL_S
            with self._box:
                if not names:
                    nothing(
                        "None heard: the link must also carry the autopilot's NAMED_VALUE_FLOAT, or MAG_RAW"
                    )
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
    """The track on the map; hidden while there is neither."""

    def __init__(self, background: Background | None) -> None:
        self._changes, self._background = Changes(), background
        title = "Track"
        if background is not None:
            span = f"{background.span:.0f}"
            title += f" on the anomaly map, blue to red: \N{MINUS SIGN}{span} to +{span} nT"
        with ui.element().classes("w-full") as self._box, card(title), frame("Track"):
            self._chart = ui.echart(chart_options("map", "track")).classes("w-full aspect-[4/3]")

    def show(self, state: BridgeState) -> None:
        """Draw the track, if the vehicle has moved on."""
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
