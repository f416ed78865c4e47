"""The page itself."""

from __future__ import annotations

import socket
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from copy import deepcopy
from functools import partial
from math import nan
from typing import Any

from nicegui import ui

from magbridge.bridge.links import open_link
from magbridge.config import Align
from magbridge.errors import PortError
from magbridge.link import alignment
from magbridge.mavlink.dialect import MAV_SEVERITY
from magbridge.monitor.chart import CHART, curves, reach
from magbridge.monitor.link import StationLink, now
from magbridge.monitor.words import FLAGS, ago, health, measured, silence, whereabouts

__all__ = ["serve"]

TUNABLES = {one.name: one for one in alignment(Align())}
"""Parameters that every bridge has, with the unit and range that a PARAM_VALUE does not carry."""
STYLE = """
:root, .q-header {--ink: #1e293b; --good: #15803d; --doubt: #b45309; --bad: #b91c1c}
body.body--dark {--ink: #e2e8f0; --good: #4ade80; --doubt: #fbbf24; --bad: #f87171}
body.body--dark {color-scheme: dark; --q-negative: var(--bad) !important}
"""
"""Colours by day and, where the browser asks for it, by night; the header is the same at both."""
INK, GREEN, AMBER, RED = "var(--ink)", "var(--good)", "var(--doubt)", "var(--bad)"
MUTED = "text-slate-500 dark:text-slate-400"
GRID = "w-full grid gap-4 grid-cols-1"


def serve(
    link: str, baudrate: int, host: str, port: int, *, key: bytes | None = None, show: bool = False
) -> None:
    """Listen to `link` and serve the page until interrupted.

    Raises
    ------
    ConfigError, PortError
        `link` is no address, or it or the page's own port cannot be opened.
    """
    station = StationLink(open_link(link, baudrate, "magbridge monitor", "LINK"), key)
    ipv6 = ":" in host
    family, place = (socket.AF_INET6, f"[{host}]:{port}") if ipv6 else (socket.AF_INET, f"{host}:{port}")
    try:
        socket.create_server((host, port), family=family).close()  # the web server itself would only log it
    except OSError as error:
        raise PortError(place, error.strerror or str(error)) from error
    station.start()
    print(f"listening on {link}; the page is http://{place}", file=sys.stderr)
    options: dict[str, Any] = {"title": "magbridge", "favicon": "🧲", "show_welcome_message": False}
    with suppress(KeyboardInterrupt):  # Ctrl-C is how it ends
        ui.run(partial(Page, station), host=host, port=port, show=show, reload=False, dark=None, **options)


class Page:
    """One browser's view of what the station has heard."""

    def __init__(self, station: StationLink) -> None:
        self._station, self._state = station, station.state
        self._shown: dict[str, Any] = {}
        self._inputs: dict[str, ui.number] = {}
        ui.add_css(STYLE)
        ui.query("body").classes("bg-slate-100 dark:bg-slate-900").style(f"color: {INK}")
        with ui.header().classes("items-center gap-x-4 gap-y-1 px-6 py-2 bg-slate-800"):
            ui.label("magbridge").classes("text-lg font-semibold")
            self._from = ui.label().classes("text-sm text-slate-300 max-sm:order-last max-sm:w-full")
            ui.space()
            self._stream = ui.label().classes("text-sm px-3 py-1 rounded-full")
        facts = list(health(self._state, now()))
        with ui.column().classes("w-full max-w-screen-2xl mx-auto gap-4") as self._body:
            with ui.element().classes(f"{GRID} md:grid-cols-[18rem_1fr]") as self._field:
                with _card("Field, nT ± 2σ"):
                    self._measured = [_quantity(name) for name in measured(self._state)]
                with _card("Total field, nT ± 2σ, of the last ten minutes, UTC"):
                    self._chart = ui.echart(deepcopy(CHART)).classes("w-full h-72")
            with ui.element().classes(f"{GRID} lg:grid-cols-3"):
                with _card("Flags"):
                    self._flags = ui.column().classes("gap-2")
                with _card("Bridge"):
                    self._health = [_fact(name) for name in facts[:8]]
                with _card("Losses"):
                    self._health += [_fact(name) for name in facts[8:]]
            with (
                ui.element().classes("w-full") as self._navigation,
                _card("Position by the field; innovation and bias in nT"),
                ui.element().classes(f"{GRID} md:grid-cols-3 gap-y-1"),
            ):
                self._whereabouts = [_fact(name) for name in whereabouts(self._state, now())]
            with ui.element().classes(f"{GRID} lg:grid-cols-2"):
                with _card("Messages, UTC"):
                    self._texts = ui.column().classes("w-full h-60 gap-1 overflow-auto flex-nowrap")
                with _card("Parameters (Enter sets one)"):
                    self._parameters = ui.element().classes(
                        "w-full h-60 grid grid-cols-2 sm:grid-cols-3 content-start gap-x-4 overflow-auto"
                    )
        self._refresh()
        ui.timer(0.5, self._refresh)

    def _refresh(self) -> None:
        with self._station.lock:
            quiet = silence(self._state, now())
            if quiet and self._station.refused:
                quiet += f"; frames refused for their signature: {self._station.refused}"
            self._tell_stream(self._station.trouble or quiet)
            self._tell_figures()
            self._tell_flags()
            self._tell_texts()
            self._tell_parameters()
            self._draw()

    def _tell_stream(self, trouble: str) -> None:
        who = "vehicle {}, component {}".format(*self._state.bridge) if self._state.bridge else ""
        self._from.set_text(f"{self._station.port.name} \N{EN SPACE} {who}")
        flagged = self._state.flags.keys() - {"no_boresight"}
        self._stream.set_text(trouble or ("live, flagged" if flagged else "live"))
        self._stream.style(f"background: {RED if trouble else AMBER if flagged else GREEN}")
        field, status = "no field" in trouble, "no status" in trouble  # then the rest of the page says why
        self._body.style(f"opacity: {0.45 if trouble and not (field or status) else 1}")
        self._field.style(f"opacity: {0.45 if field else 1}")
        for label in self._health:
            label.style(f"opacity: {0.45 if status else 1}")

    def _tell_figures(self) -> None:
        for labels, texts in zip(self._measured, measured(self._state).values(), strict=True):
            for label, text in zip(labels, texts, strict=True):
                label.set_text(text)
        self._navigation.set_visibility(bool(self._state.navigation))
        for label, (text, well) in zip(
            self._whereabouts, whereabouts(self._state, now()).values(), strict=True
        ):
            label.set_text(text)
            label.style(f"color: {INK if well else RED}")
        for label, (text, well) in zip(self._health, health(self._state, now()).values(), strict=True):
            label.set_text(text if self._state.status else "–")
            label.style(f"color: {INK if well or not self._state.status else RED}")

    def _tell_flags(self) -> None:
        flags = {name: f"since {_clock(t)}, {ago(now() - t)}" for name, (t, _) in self._state.flags.items()}
        if not self._new("flags", flags or bool(self._state.field), self._flags):
            return
        with self._flags:
            if self._state.field and not flags:
                ui.label("None").style(f"color: {GREEN}")
            for name, since in flags.items():
                color = AMBER if name == "no_boresight" else RED
                with ui.column().classes("gap-0 border-l-4 pl-3").style(f"border-color: {color}"):
                    ui.label(FLAGS[name]).classes("leading-tight")
                    ui.label(f"{name}, {since}").classes(f"text-xs {MUTED}")

    def _tell_texts(self) -> None:
        if not self._new("texts", list(self._state.texts), self._texts):
            return
        with self._texts:
            if not self._state.texts:
                _nothing()
            for when, severity, text in self._state.texts:
                color = (
                    RED
                    if severity <= MAV_SEVERITY.ERROR
                    else AMBER
                    if severity <= MAV_SEVERITY.WARNING
                    else INK
                )
                with ui.row().classes("w-full gap-3 text-sm flex-nowrap items-baseline"):
                    ui.label(_clock(when)).classes(f"{MUTED} tabular-nums")
                    word = MAV_SEVERITY(severity & 7).name.lower()
                    ui.label(word).classes("w-20 shrink-0").style(f"color: {color}")
                    ui.label(text).classes("min-w-0 break-words")

    def _tell_parameters(self) -> None:
        known = self._state.parameters
        if self._new("names", sorted(known), self._parameters):
            with self._parameters:
                if not known:
                    _nothing()
                self._inputs = {name: self._input(name) for name in sorted(known)}
        for name, one in known.items():
            if self._new(name, (one.value, one.error, one.asked)):
                box = self._inputs[name]
                if one.asked is None:
                    box.set_value(float(f"{one.value:.7g}"))
                box.props["error"], box.props["error-message"] = bool(one.error), one.error
                box.update()

    def _input(self, name: str) -> ui.number:
        self._shown.pop(name, None)
        box = ui.number(name).props("dense stack-label").on("keydown.enter", partial(self._set, name))
        if known := TUNABLES.get(name):
            box.tooltip(f"{known.doc}; {known.low:g} to {known.high:g} {known.unit}")
            box.props(f'suffix="{known.unit}"')
        return box

    def _set(self, name: str) -> None:
        with self._station.lock:
            if name in self._state.parameters:
                self._shown.pop(name, None)  # so that the answer is shown, even if it is the same as before
                value = self._inputs[name].value
                self._state.set(name, nan if value is None else value)

    def _draw(self) -> None:
        trace = self._state.trace
        if trace and self._new("trace", trace[-1].time):
            shown = zip(*curves(trace), strict=True)
            for series, data in zip(self._chart.options["series"], shown, strict=True):
                series["data"] = data
            self._chart.options["yAxis"] |= reach(trace)
            self._chart.update()

    def _new(self, key: str, value: Any, box: ui.element | None = None) -> bool:
        """Return whether `value` is new to this browser; if so, empty the `box` that showed the old one."""
        new = key not in self._shown or bool(self._shown[key] != value)
        self._shown[key] = value
        if new and box is not None:
            box.clear()
        return new


@contextmanager
def _card(title: str) -> Iterator[None]:
    with ui.card().classes("w-full gap-2 p-4 shadow-sm rounded-lg dark:bg-slate-800"):
        ui.label(title).classes(f"text-sm font-semibold {MUTED}")
        yield


def _quantity(name: str) -> tuple[ui.label, ui.label]:
    with ui.column().classes("gap-0"):
        ui.label(name).classes(f"text-xs {MUTED}")
        with ui.row().classes("items-baseline gap-2"):
            size = "text-3xl" if name == "Total field" else "text-xl"
            return ui.label().classes(f"{size} tabular-nums"), ui.label().classes(f"{MUTED} tabular-nums")


def _fact(name: str) -> ui.label:
    with ui.row().classes("w-full justify-between text-sm"):
        ui.label(name).classes(MUTED)
        return ui.label().classes("font-medium tabular-nums")


def _nothing() -> None:
    ui.label("None yet").classes(f"text-sm {MUTED}")


def _clock(when: float) -> str:
    """Return the UTC of a moment on the station's clock."""
    return time.strftime("%H:%M:%S", time.gmtime(time.time() - (now() - when)))
