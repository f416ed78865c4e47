"""The compass rose: the heading with its band of two standard deviations."""

from __future__ import annotations

from math import cos, isfinite, radians, sin
from typing import Any

from nicegui import ui

from magbridge.monitor.state import BridgeState
from magbridge.monitor.widgets import MUTED, Changes, card, slanted
from magbridge.monitor.words import silence

__all__ = ["CompassRose", "heading_text", "rose_picture"]

RADIUS = 80.0
"""Radius of the circle in units of the picture, which is 200 wide."""
MAX_BAND_DEG = 180.0
"""deg either side of the heading: the band is then the whole circle."""
BLUE, GREY = "#3b82f6", "#778599"


def current_heading(field: dict[str, Any]) -> tuple[float, float, str] | None:
    """Return heading, 1-sigma (deg) and its reference; None where the last MAG_FIELD has no heading."""
    sigma = field.get("heading_sigma", 0.0)
    if not (isfinite(sigma) and sigma > 0.0):
        return None
    true, magnetic = field["heading"], field["magnetic_heading"]
    if isfinite(true):
        return true % 360.0, sigma, "true"
    return (magnetic % 360.0, sigma, "magnetic") if isfinite(magnetic) else None


def heading_text(field: dict[str, Any]) -> str:
    """Return the heading with its 2-sigma in words."""
    found = current_heading(field)
    if found is None:
        return "No heading: it needs a boresight and the autopilot's ATTITUDE"
    heading, sigma, reference = found
    return f"{round(heading, 1) % 360.0:05.1f}\N{DEGREE SIGN} {reference} ± {2.0 * sigma:.1f}\N{DEGREE SIGN}"


def rose_picture(field: dict[str, Any]) -> str:
    """Return the rose as an SVG: letters, the band of two standard deviations, and a needle.

    The picture is made of numbers and fixed text alone, so that no text of a sender gets into the page.
    """
    parts = [f'<circle r="{RADIUS}" fill="none" stroke="{GREY}" stroke-width="1.5"/>']
    for bearing in range(0, 360, 30):
        (x, y), (u, v) = _point(bearing, RADIUS), _point(bearing, RADIUS - (10 if bearing % 90 == 0 else 5))
        parts.append(f'<line x1="{x}" y1="{y}" x2="{u}" y2="{v}" stroke="{GREY}"/>')
    for letter, bearing in zip("NESW", range(0, 360, 90), strict=True):
        x, y = _point(bearing, RADIUS + 12.0)
        parts.append(
            f'<text x="{x}" y="{y}" fill="{GREY}" font-size="15" text-anchor="middle" '
            f'dominant-baseline="central">{letter}</text>'
        )
    if found := current_heading(field):
        heading, sigma, _ = found
        x, y = _point(heading, RADIUS - 12.0)
        parts.append(_band(heading, min(2.0 * sigma, MAX_BAND_DEG)))
        parts.append(f'<line x1="0" y1="0" x2="{x}" y2="{y}" stroke="{BLUE}" stroke-width="3"/>')
    label = f'role="img" aria-label="Compass rose. {heading_text(field)}"'
    return f'<svg viewBox="-100 -100 200 200" {label} style="max-width: 14rem">{"".join(parts)}</svg>'


def _band(heading: float, half: float) -> str:
    """Return the sector `half` deg either side of the heading."""
    if half >= MAX_BAND_DEG:
        return f'<circle r="{RADIUS}" fill="{BLUE}" fill-opacity="0.25"/>'
    (x, y), (u, v) = _point(heading - half, RADIUS), _point(heading + half, RADIUS)
    is_large = int(half > 90.0)
    path = f"M 0 0 L {x} {y} A {RADIUS} {RADIUS} 0 {is_large} 1 {u} {v} Z"
    return f'<path d="{path}" fill="{BLUE}" fill-opacity="0.25"/>'


def _point(bearing: float, radius: float) -> tuple[float, float]:
    """Return x (right) and y (down) of a point at a bearing, deg clockwise from the top."""
    angle = radians(bearing)
    return round(radius * sin(angle), 2), round(-radius * cos(angle), 2)


class CompassRose:
    """The panel of the compass rose."""

    def __init__(self) -> None:
        self._changes = Changes()
        with card("Heading ± 2σ") as self.box:
            self._picture = ui.html("", sanitize=False).classes("w-full flex justify-center")
            self._text = ui.label().classes(f"w-full text-center tabular-nums {MUTED}")

    def show(self, state: BridgeState, now_s: float) -> None:
        """Show the heading of the last sample."""
        picture = rose_picture(state.field)
        if self._changes.new("rose", picture):
            self._picture.set_content(picture)
            self._text.set_text(heading_text(state.field))
        self.box.style(slanted("no field" in silence(state, now_s)))
