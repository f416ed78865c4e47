"""The curve of the total field, as ECharts takes it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import ceil, floor, isfinite, log10, nan
from typing import Any

from magbridge.monitor.state import Point

__all__ = ["CHART", "curves", "reach"]

BREAK = 10.0
"""s without a sample that interrupt the curve, unless the interval before was at least a third as long."""
BLUE, GREY, GREYER = "#3b82f6", "#778599", "#77859950"
"""It knows no variables of the page: these are seen by day and by night."""
LINE = {"type": "line", "symbol": "none", "color": BLUE}
BAND = {**LINE, "stack": "band", "stackStrategy": "all", "lineStyle": {"opacity": 0}}
ROOM, LEAST = 5.0, 50.0
"""Above and below the curve, the axis leaves at most `ROOM` times the curve's range plus `LEAST` nT for the
band: with more, the curve would look like a straight line."""
ROUND = {"showMinLabel": False, "showMaxLabel": False, "color": GREY}
"""No labels at the ends of an axis: they would be written over the round numbers beside them."""
APART = "value => value.toLocaleString('en').replaceAll(',', '\N{NARROW NO-BREAK SPACE}')"
"""Separates thousands, as everywhere on the page."""
CHART: dict[str, Any] = {
    "useUTC": True,
    "animation": False,
    "grid": {"left": 70, "right": 32, "top": 12, "bottom": 28},
    "xAxis": {"type": "time", "axisLabel": {"hideOverlap": True, **ROUND}},
    "yAxis": {
        "type": "value",
        "scale": True,
        "axisLabel": {":formatter": APART, **ROUND},
        "splitLine": {"lineStyle": {"color": GREYER}},
    },
    "series": [BAND, {**BAND, "areaStyle": {"opacity": 0.2}}, {**LINE, "lineStyle": {"width": 1.5}}],
}


def curves(trace: Sequence[Point]) -> Iterator[list[tuple[float, float]]]:
    """Yield (ms, nT) of the band's lower edge, its width and the mean; NaN where the curve is interrupted."""
    last, usual = trace[0].time, 0.0
    for point in trace:
        ms, gap = 1e3 * point.time, point.time - last
        if gap > max(BREAK, 3 * usual):
            yield [(ms - 1.0, nan)] * 3
        last, usual = point.time, gap
        yield [(ms, point.low), (ms, point.high - point.low), (ms, point.sum / point.count)]


def reach(trace: Sequence[Point]) -> dict[str, float]:
    """Return round ends of the axis in nT: all of the curve, and as much of the band as leaves it visible."""
    curve = [point.sum / point.count for point in trace if isfinite(point.sum)]
    if not curve:
        return {}
    low, high = min(curve), max(curve)
    room = ROOM * (high - low) + LEAST
    low, high = max(low - room, min(p.low for p in trace)), min(high + room, max(p.high for p in trace))
    step = 10.0 ** floor(log10(max(high - low, 1.0)) - 0.5)
    return {"min": floor(low / step) * step, "max": ceil(high / step) * step}
