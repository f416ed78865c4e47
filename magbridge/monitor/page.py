"""Build the page, select the vehicle that it shows, and update its panels."""

from __future__ import annotations

import csv
import json
import platform
import time
from collections.abc import Sequence
from functools import partial
from importlib.metadata import version
from importlib.resources import files
from io import BytesIO, StringIO
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile

from nicegui import ui

from magbridge.mavlink import spec
from magbridge.monitor import words
from magbridge.monitor.charts import Background, TelemetryChart, TotalField, TrackMap
from magbridge.monitor.history import TIERS
from magbridge.monitor.link import StationLink, monotonic_s
from magbridge.monitor.panels import AlarmPanel, LearningPanel, Panel, ParameterPanel
from magbridge.monitor.state import BridgeState
from magbridge.monitor.widgets import AMBER, GREEN, GRID, INK, MONITOR_STYLE, RED, Changes, slanted
from magbridge.version import __version__
from magbridge.wording import counted

LIBRARIES = ("nicegui", "numpy", "msgspec", "pyserial")


def bundle(state: BridgeState, now_s: float, link: str) -> bytes:
    """Return the ZIP file of a bug report at `now_s`, s of the monotonic clock; `link` is the port's name."""
    wall = time.time() - now_s

    def utc(moment: float) -> str:
        return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(wall + moment))

    health = words.health(state, now_s) | words.losses(state)
    about: dict[str, Any] = {
        "made": utc(now_s),
        "magbridge": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "libraries": {name: version(name) for name in LIBRARIES},
        "link": link,
        "bridge": state.bridge,
        "measured": words.measured(state),
        "health": {name: text for name, (text, _) in health.items()},
        "navigation": {name: text for name, (text, _) in words.whereabouts(state, now_s).items()},
        "flags": {name: utc(since) for name, (since, _) in state.flags.items()},
        "MAG_STATUS": {name: repr(value) for name, value in state.status.items()},
    }
    texts = [(utc(one.time), one.severity, one.text) for one in state.texts]
    alarms = [
        (utc(one.since), utc(one.last), one.active, one.acknowledged, one.count, one.text)
        for one in state.alarms
    ]
    parameters = [(name, repr(one.value), one.error) for name, one in sorted(state.parameters.items())]
    tables: dict[str, list[Sequence[Any]]] = {
        "texts": [("time", "severity", "text"), *texts],
        "alarms": [("since", "last", "active", "acknowledged", "count", "alarm"), *alarms],
        "parameters": [("name", "value", "error"), *parameters],
        "samples": [list(spec("MAG_FIELD").fields), *(list(sample.values()) for sample in state.samples)],
    }
    held = BytesIO()
    with ZipFile(held, "w", ZIP_DEFLATED) as archive:
        archive.writestr("about.json", json.dumps(about, indent=1, ensure_ascii=False))
        for name, rows in tables.items():
            text = StringIO()
            csv.writer(text, lineterminator="\n").writerows(rows)
            archive.writestr(f"{name}.csv", text.getvalue())
    return held.getvalue()


SCRIPT = files("magbridge.monitor").joinpath("page.js").read_text(encoding="utf-8")
PERIOD = 0.5
"""Time between two checks of received data, s."""
BUTTON = "flat dense no-caps color=white size=md padding='4px 10px'"

Bridge = tuple[int, int]


class Page:
    """Page of one browser, which shows one of the bridges that the station receives."""

    def __init__(self, station: StationLink, background: Background | None = None) -> None:
        self._station, self._background = station, background
        self._bridge: Bridge | None = None
        self._state = BridgeState()
        self._tier, self._sound = next(iter(TIERS)), False
        self._changes = Changes()
        ui.add_css(MONITOR_STYLE)
        picture = f"magbridge.map = {json.dumps(background.picture)};" if background else ""
        ui.add_head_html(f"<script>{SCRIPT}{picture}</script>")
        ui.query("body").classes("bg-slate-100 dark:bg-slate-900").style(f"color: {INK}")
        self._header()
        self._body = ui.column().classes("w-full max-w-screen-2xl mx-auto gap-4")
        with station.lock:
            self._choose(next(iter(station.fleet.states), None))
            self._show()
        ui.timer(PERIOD, self._refresh)

    def _header(self) -> None:
        with ui.header().classes("items-center gap-x-4 gap-y-1 px-6 py-2 bg-slate-800"):
            ui.label("magbridge").classes("text-lg font-semibold").props("role=heading aria-level=1")
            self._from = ui.label().classes("text-sm text-slate-300 max-sm:order-last max-sm:w-full")
            self._choice = ui.row().classes("gap-1").props('role=group aria-label="Vehicle"')
            ui.space()
            ui.button("Picture", on_click=self._snapshot, icon="photo_camera").props(BUTTON)
            ui.button("Report", on_click=self._report, icon="bug_report").props(BUTTON)
            self._stream = ui.label().classes("text-sm px-3 py-1 rounded-full text-white")
            self._stream.props("role=status")

    def _choose(self, bridge: Bridge | None) -> None:
        """Show another bridge: build all panels of the page again."""
        self._bridge = bridge
        self._state = self._station.fleet.states.get(bridge) or BridgeState() if bridge else BridgeState()
        state = self._state
        self._body.clear()
        with self._body:
            with ui.element().classes(f"{GRID} md:grid-cols-[18rem_minmax(0,1fr)]"):
                with ui.column().classes("w-full gap-4"):
                    field = Panel("Field, nT ± 2σ", "figures"), Panel("Heading ± 2σ", "rose")
                self._total = TotalField(self._tier, self._set_tier)
            with ui.element().classes(f"{GRID} lg:grid-cols-2"):
                with ui.column().classes("w-full gap-4"):
                    self._alarms = AlarmPanel(self._station, state, sound=self._sound)
                    flags = Panel("Flags", "flags")
                with ui.element().classes(f"{GRID} sm:grid-cols-2 content-start"):
                    status = Panel("Bridge", "health"), Panel("Losses", "losses")
            more = (
                Panel("Sensors, nT ± 2σ", "sensors"),
                Panel("Position by the field; innovation and bias in nT", "navigation"),
                LearningPanel(self._station, state),
            )
            with ui.element().classes(f"{GRID} lg:grid-cols-[minmax(0,2fr)_minmax(0,3fr)] items-start"):
                self._track = TrackMap(self._background)
                self._telemetry = TelemetryChart()
            with ui.element().classes(f"{GRID} lg:grid-cols-2"):
                texts = Panel("Messages, UTC", "texts")
                text = texts.html.classes("max-h-60 overflow-auto")
                text.props('tabindex=0 role=log aria-label="Messages"')
                parameters = ParameterPanel(self._station, state)
        self._panels = *field, flags, *status, *more, texts, parameters

    def _set_tier(self, tier: str) -> None:
        self._tier = tier
        self._refresh()

    def _refresh(self) -> None:
        with self._station.lock:
            self._show()

    def _show(self) -> None:
        states = self._station.fleet.states
        if self._bridge not in states and states:
            self._choose(next(iter(states)))
        self._offer()
        state, moment = self._state, monotonic_s()
        self._show_stream(state, moment)
        for panel in self._panels:
            panel.show(state, moment)
        self._sound = self._alarms.sound
        self._alarms.show(state, moment)
        self._total.show(state, self._tier)
        self._telemetry.show(state, self._tier, moment)
        self._track.show(state)

    def _offer(self) -> None:
        """Show a button for each of several bridges, with its number of unacknowledged alarms."""
        unseen = {bridge: state.alarms.unseen for bridge, state in self._station.fleet.states.items()}
        is_new = self._changes.new("vehicles", (unseen, self._bridge), self._choice)
        if not is_new or len(unseen) < 2:
            return
        with self._choice:
            for bridge, count in unseen.items():
                text = "{}.{}".format(*bridge) + (f" ({count})" if count else "")
                button = ui.button(text, on_click=partial(self._switch, bridge)).props(BUTTON)
                alarms = f", {counted(count, 'alarm')}" if count else ""
                button.props["aria-label"] = "Vehicle {}, component {}".format(*bridge) + alarms
                button.props["aria-pressed"] = "true" if bridge == self._bridge else "false"
                if bridge == self._bridge:
                    button.classes("!bg-slate-600")

    def _switch(self, bridge: Bridge) -> None:
        with self._station.lock:
            self._choose(bridge)
            self._show()

    def _show_stream(self, state: BridgeState, moment: float) -> None:
        quiet = words.silence(state, moment)
        if quiet and self._station.refused:
            quiet += f"; frames refused for their signature: {self._station.refused}"
        trouble = self._station.trouble or quiet
        who = "vehicle {}, component {}".format(*state.bridge) if state.bridge else ""
        self._from.set_text(f"{self._station.port.name} \N{EN SPACE} {who}")
        flagged = state.flags.keys() - {"no_boresight"}
        self._stream.set_text(trouble or ("live, flagged" if flagged else "live"))
        self._stream.style(f"background: {RED if trouble else AMBER if flagged else GREEN}")
        partly = "no field" in trouble or "no status" in trouble  # the panels mark the missing stream
        gone = bool(trouble) and not partly
        self._body.style(f"{slanted(gone)}; filter: grayscale({int(gone)})")

    def _name(self) -> str:
        vehicle = "_{}_{}".format(*self._bridge) if self._bridge else ""
        return f"magbridge{vehicle}_{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}"

    def _snapshot(self) -> None:
        """Make the browser save all charts and the present values as one PNG."""
        with self._station.lock:
            figures = [f"{name}: {' '.join(texts)} nT" for name, texts in words.measured(self._state).items()]
            flags = ", ".join(self._state.flags) or "none"
            who = self._from.text
        shown = [*figures[:2], ";  ".join(figures[2:]), f"Flags: {flags}", self._stream.text]
        lines = [self._name(), who, *shown]
        ui.run_javascript(f"magbridge.snapshot({json.dumps(lines)}, {json.dumps(self._name() + '.png')})")

    def _report(self) -> None:
        """Send a bug report to the browser as a download."""
        with self._station.lock:
            data = bundle(self._state, monotonic_s(), self._station.port.name)
        ui.download.content(data, f"{self._name()}.zip", "application/zip")
