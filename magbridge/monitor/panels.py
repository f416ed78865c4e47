"""The panels of figures and words: field, flags, condition, position by the field, messages, parameters."""

from __future__ import annotations

from functools import partial
from math import nan

from nicegui import ui

from magbridge.config import Align, Telemetry
from magbridge.link.parameters import alignment, file_rate, learning, rates, telemetry_ages
from magbridge.link.publish import DEFAULT_RATES_HZ, LIMITS
from magbridge.mavlink.enums import MAV_SEVERITY
from magbridge.monitor.link import StationLink
from magbridge.monitor.state import BridgeState
from magbridge.monitor.widgets import (
    AMBER,
    GREEN,
    GRID,
    INK,
    MUTED,
    RED,
    Changes,
    card,
    clock,
    fact,
    nothing,
    slanted,
)
from magbridge.monitor.words import FLAG_TEXTS, duration, health, measured, sensor_rows, silence, whereabouts

__all__ = ["Figures", "Flags", "Health", "NavigationPanel", "ParameterPanel", "SensorPanel", "Texts"]

TUNABLES = {
    one.name: one
    for one in (*alignment(Align()), *file_rate(), *learning(enabled=True), *rates(DEFAULT_RATES_HZ, LIMITS))
}
"""The parameters of a bridge, with the unit and range that a PARAM_VALUE does not carry."""
(AGE,) = telemetry_ages({"telemetry": Telemetry(message="", field="")})
"""Any telemetry's largest age: which there is depends on the bridge."""


class Figures:
    """The field in nT."""

    def __init__(self, state: BridgeState) -> None:
        with card("Field, nT ± 2σ") as self.box:
            self._labels = [self._quantity(name) for name in measured(state)]

    @staticmethod
    def _quantity(name: str) -> tuple[ui.label, ui.label]:
        with ui.column().classes("gap-0"):
            ui.label(name).classes(f"text-xs {MUTED}")
            with ui.row().classes("items-baseline gap-2"):
                size = "text-3xl" if name == "Total field" else "text-xl"
                return ui.label().classes(f"{size} tabular-nums"), ui.label().classes(f"{MUTED} tabular-nums")

    def show(self, state: BridgeState, now_s: float) -> None:
        """Show the present figures."""
        for labels, texts in zip(self._labels, measured(state).values(), strict=True):
            for label, text in zip(labels, texts, strict=True):
                label.set_text(text)
        self.box.style(slanted("no field" in silence(state, now_s)))


class Flags:
    """The flags, and since when they stand."""

    def __init__(self) -> None:
        self._changes = Changes()
        with card("Flags"):
            self._box = ui.column().classes("gap-2")

    def show(self, state: BridgeState, now_s: float) -> None:
        """Show the flags that stand."""
        flags = {name: f"since {clock(t)}, {duration(now_s - t)}" for name, (t, _) in state.flags.items()}
        if not self._changes.new("flags", flags or bool(state.field), self._box):
            return
        with self._box:
            if state.field and not flags:
                ui.label("None").style(f"color: {GREEN}")
            for name, since in flags.items():
                color = AMBER if name == "no_boresight" else RED
                with ui.column().classes("gap-0 border-l-4 pl-3").style(f"border-color: {color}"):
                    ui.label(FLAG_TEXTS[name]).classes("leading-tight")
                    ui.label(f"{name}, {since}").classes(f"text-xs {MUTED}")


class Health:
    """The bridge's condition and its losses."""

    def __init__(self, state: BridgeState, now_s: float) -> None:
        facts = list(health(state, now_s))
        with card("Bridge"):
            self._labels = [fact(name) for name in facts[:8]]
        with card("Losses"):
            self._labels += [fact(name) for name in facts[8:]]

    def show(self, state: BridgeState, now_s: float) -> None:
        """Show the last status."""
        old = "no status" in silence(state, now_s)
        for label, (text, well) in zip(self._labels, health(state, now_s).values(), strict=True):
            label.set_text(text if state.status else "–")
            label.style(slanted(old))
            if not old:
                label.style(f"color: {INK if well or not state.status else RED}")


class SensorPanel:
    """The sensors of a bridge that has several; hidden otherwise."""

    def __init__(self) -> None:
        self._changes = Changes()
        with ui.element().classes("w-full") as self._box, card("Sensors, nT ± 2σ"):
            self._table = ui.element().classes(f"{GRID} sm:grid-cols-2 lg:grid-cols-4 gap-x-8")

    def show(self, state: BridgeState, now_s: float) -> None:
        """Show what each measures, and how far it differs from the first."""
        rows = sensor_rows(state, now_s)
        self._box.set_visibility(bool(rows))
        if not self._changes.new("rows", rows, self._table):
            return
        with self._table:
            for row in rows:
                texts = {
                    "Total field": (row.total, True),
                    f"Minus {rows[0].name}": (row.difference, row.agrees),
                    "Line": (row.line, row.is_well),
                    "Flags": (row.flags or "none", True),
                }
                with ui.column().classes("w-full gap-0"):
                    ui.label(row.name).classes("font-medium")
                    for name, (text, well) in texts.items():
                        label = fact(name)
                        label.set_text(text)
                        label.style(f"color: {INK if well else RED}")


class NavigationPanel:
    """The position filter's condition; hidden where there is none."""

    def __init__(self, state: BridgeState, now_s: float) -> None:
        with (
            ui.element().classes("w-full") as self._box,
            card("Position by the field; innovation and bias in nT"),
            ui.element().classes(f"{GRID} md:grid-cols-3 gap-y-1"),
        ):
            self._labels = [fact(name) for name in whereabouts(state, now_s)]

    def show(self, state: BridgeState, now_s: float) -> None:
        """Show the last MAG_NAVIGATION."""
        self._box.set_visibility(bool(state.navigation))
        for label, (text, well) in zip(self._labels, whereabouts(state, now_s).values(), strict=True):
            label.set_text(text)
            label.style(f"color: {INK if well else RED}")


class Texts:
    """What the bridge announced."""

    def __init__(self) -> None:
        self._changes = Changes()
        with card("Messages, UTC"):
            self._box = ui.column().classes("w-full max-h-60 gap-1 overflow-auto flex-nowrap")
            self._box.props('tabindex=0 role=log aria-label="Messages"')

    def show(self, state: BridgeState, _now_s: float) -> None:
        """Show the texts, the newest first."""
        if not self._changes.new("texts", list(state.texts), self._box):
            return
        with self._box:
            if not state.texts:
                nothing()
            for received in state.texts:
                bad, warned = (
                    received.severity <= MAV_SEVERITY.ERROR,
                    received.severity == MAV_SEVERITY.WARNING,
                )
                with ui.row().classes("gap-3 flex-nowrap text-sm"):
                    ui.label(clock(received.time)).classes(f"{MUTED} tabular-nums")
                    ui.label(received.text).style(f"color: {RED if bad else AMBER if warned else INK}")


class ParameterPanel:
    """The bridge's parameters, which can be set."""

    def __init__(self, station: StationLink, state: BridgeState) -> None:
        self._station, self._state = station, state
        self._changes, self._inputs = Changes(), dict[str, ui.number]()
        with card("Parameters (Enter sets one)"):
            self._box = ui.element().classes(
                "w-full max-h-60 grid grid-cols-2 sm:grid-cols-3 content-start gap-x-4 overflow-auto"
            )
            self._box.props('tabindex=0 role=group aria-label="Parameters"')

    def show(self, state: BridgeState, _now_s: float) -> None:
        """Show values and refusals."""
        known = state.parameters
        if self._changes.new("names", sorted(known), self._box):
            with self._box:
                if not known:
                    nothing()
                self._inputs = {name: self._input(name) for name in sorted(known)}
        for name, one in known.items():
            if self._changes.new(name, (one.value, one.error, one.asked)):
                box = self._inputs[name]
                if one.asked is None:
                    box.set_value(float(f"{one.value:.7g}"))
                box.props["error"], box.props["error-message"] = bool(one.error), one.error
                box.update()

    def _input(self, name: str) -> ui.number:
        self._changes.forget(name)
        box = ui.number(name).props("dense stack-label").on("keydown.enter", partial(self._set, name))
        if known := TUNABLES.get(name, AGE if name.startswith("MB_AGE_") else None):
            box.tooltip(f"{known.doc}; {known.low:g} to {known.high:g} {known.unit}".rstrip())
            box.props(f'suffix="{known.unit}"')
        return box

    def _set(self, name: str) -> None:
        with self._station.lock:
            if name in self._state.parameters:
                self._changes.forget(name)  # so that the answer is shown, even if it is the same as before
                value = self._inputs[name].value
                self._state.set(name, nan if value is None else value)
