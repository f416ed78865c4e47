"""The panels of charts: total field, masses and temperature, track."""

from __future__ import annotations

from typing import Any

from nicegui import ui

from magbridge.monitor.chart import drawn, options
from magbridge.monitor.history import TIERS, Series
from magbridge.monitor.state import TEMPERATURE_SERIES, BridgeState
from magbridge.monitor.track import Background, series
from magbridge.monitor.track import options as map_options
from magbridge.monitor.widgets import GRID, Changes, card, nothing

__all__ = ["TelemetryChart", "TotalField", "TrackMap"]

KEYS = "; keys: plus and minus zoom, arrows pan, 0 shows all, S saves it as PNG"
MAX_CHART_INTERVAL_S = 3.0
"""s between two drawings of a chart of telemetry: there may be many, and a phone draws them."""


class Curve:
    """A quantity over a window of time."""

    def __init__(self, title: str, name: str, unit: str, *, small: bool = False) -> None:
        self._changes = Changes()
        height = "h-44" if small else "h-80 md:h-[34rem]"
        with frame(title):
            self._chart = ui.echart(options(name, unit, small=small)).classes(f"w-full {height}")

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
            self._curve = Curve("Total field", "total_field", "nT")

    def show(self, state: BridgeState, tier: str) -> None:
        """Draw it."""
        self._curve.show(state.total, tier)


class TelemetryChart:
    """A chart each for the positions of the masses, whatever else the vehicle names, and the temperature."""

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
                        self._curves[name] = Curve(name, name, "", small=True)
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
            self._chart = ui.echart(map_options()).classes("w-full aspect-[4/3]")

    def show(self, state: BridgeState) -> None:
        """Draw the track, if the vehicle has moved on."""
        added = state.reported_track.added, state.estimated.added
        self._box.set_visibility(bool(sum(added)) or self._background is not None)
        if not self._changes.new("track", added):
            return
        drawn_series, box = series(state.reported_track, state.estimated, self._background)
        self._chart.options["series"] = drawn_series
        if box is not None:
            west, south, east, north = box
            self._chart.options["xAxis"] |= {"min": west, "max": east}
            self._chart.options["yAxis"] |= {"min": south, "max": north}
        self._chart.update()
