"""A quantity over time, as ECharts takes it: curve, band, and marks where a value lies beyond the axis."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import deepcopy
from math import ceil, floor, log10, nan
from typing import Any

from magbridge.monitor.history import TIERS, Point

__all__ = ["GREY", "INSIDE", "TOOLS", "axis_range", "curves", "drawn", "options", "spikes"]

BLUE, RED, GREY, GREYER = "#3b82f6", "#ef4444", "#778599", "#77859950"
"""ECharts knows no variables of the page: these are seen by day and by night."""
BREAK = 10.0
"""s without a sample that interrupt the curve, unless the interval before was at least a third as long."""
ROOM, TAIL = 3.0, 0.02
"""The axis holds all but the share `TAIL` of the points at either end, and `ROOM` times their range beyond. A
step of the field is more than that share within seconds; a spike never is."""
MIN_AXIS_RANGE = 1e-5
"""Smallest range of the value: an axis is not shorter."""
ROUND = {"showMinLabel": False, "showMaxLabel": False, "color": GREY}
"""No labels at the ends of an axis: they would be written over the round numbers next to them."""
NUMBER_FORMAT = "value => value.toLocaleString('en').replaceAll(',', '\N{NARROW NO-BREAK SPACE}')"
"""Separates thousands, as everywhere on the page."""
TOOLTIP = """seen => {
    const number = value => magbridge.number(value, DIGITS)
    const mean = seen.find(one => one.seriesName === 'mean' && one.value[1] !== null)
    const mark = seen.find(one => one.seriesName === 'beyond')
    const time = new Date(seen[0].value[0]).toISOString().slice(0, 19).replace('T', ' ') + ' UTC'
    return [time, mean && number(mean.value[1]) + ' UNIT',
        mean && mean.value[2] > 0 && number(mean.value[3]) + ' to ' + number(mean.value[4]) + ' with 2σ',
        mark && 'beyond the axis: ' + number(mark.value[2]) + ' UNIT'].filter(Boolean).join('<br>')
}"""
"""Made of numbers alone: no name that somebody sent gets into the page's HTML."""
TOOLS: dict[str, Any] = {
    "right": 8,
    "top": -2,
    "itemSize": 13,
    "iconStyle": {"borderColor": GREY},
    "feature": {
        "dataZoom": {"yAxisIndex": "none", "title": {"zoom": "Zoom into a span", "back": "Zoom back"}},
        "restore": {"title": "Show all"},
        "saveAsImage": {"title": "Save as PNG", "pixelRatio": 2},
    },
}
"""Controls of every chart in addition to the wheel with Ctrl, two fingers, and dragging."""
INSIDE = {"type": "inside", "zoomOnMouseWheel": "ctrl", "preventDefaultMouseMove": False}


def options(name: str, unit: str, *, small: bool = False) -> dict[str, Any]:
    """Return the chart of a quantity, still empty.

    Parameters
    ----------
    name, unit : str
        Quantity shown, for the name of the picture that is saved; and in what.
    small : bool
        One of many, without a slider.
    """
    tools = deepcopy(TOOLS)
    tools["feature"]["saveAsImage"]["name"] = "".join(c if c.isalnum() else "_" for c in f"magbridge {name}")
    tooltip = TOOLTIP.replace("UNIT", unit if unit.isascii() else unit[-2:]).replace(
        "DIGITS", "3" if small else "2"
    )
    line = {"type": "line", "symbol": "none", "color": BLUE}
    unseen = {"lineStyle": {"opacity": 0}, "tooltip": {"show": False}}
    band = {**line, **unseen, "stack": "band", "stackStrategy": "all"}
    grey = {"borderColor": "transparent", "textStyle": {"color": GREY}}
    slider = {"type": "slider", "height": 16, "bottom": 2, **grey}
    return {
        "useUTC": True,
        "animation": False,
        "grid": {"left": 56 if small else 70, "right": 24, "top": 34, "bottom": 24 if small else 48},
        "tooltip": {"trigger": "axis", "confine": True, ":formatter": tooltip},
        "toolbox": tools,
        "dataZoom": [INSIDE] if small else [INSIDE, slider],
        "xAxis": {"type": "time", "axisLabel": {"hideOverlap": True, **ROUND}},
        "yAxis": {
            "type": "value",
            "scale": True,
            "splitNumber": 3 if small else 5,
            "axisLabel": {":formatter": NUMBER_FORMAT, **ROUND},
            "splitLine": {"lineStyle": {"color": GREYER}},
        },
        "series": [
            {**band, "name": "low"},
            {**band, "name": "high", "areaStyle": {"opacity": 0.2}},
            {**line, "name": "mean", "lineStyle": {"width": 1.5}},
            {"type": "scatter", "name": "beyond", "color": RED, "symbolSize": 9},
        ],
    }


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
        for beyond, value, end, rotate in (
            (point.most > max, point.most, max, 0),
            (point.least < min, point.least, min, 180),
        ):
            if beyond:
                place = [1e3 * point.time, end, value]
                marks.append({"value": place, "symbol": "triangle", "symbolRotate": rotate})
    return marks
