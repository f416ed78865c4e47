"""The panel of alarms: what began when, a button to say that it was seen, and a sound until then."""

from __future__ import annotations

from functools import partial

from nicegui import ui

from magbridge.monitor.link import StationLink
from magbridge.monitor.state import State
from magbridge.monitor.widgets import AMBER, MUTED, RED, Changes, card, clock, nothing

__all__ = ["AlarmPanel"]

REPEAT = 5.0
"""s between two sounds while an alarm is not acknowledged."""


class AlarmPanel:
    """The alarms of one vehicle."""

    def __init__(self, station: StationLink, state: State, *, sound: bool) -> None:
        self._station, self._state, self._changes = station, state, Changes()
        self._sounded = -REPEAT
        with card("Alarms"):
            with ui.row().classes("w-full items-center gap-x-4"):
                self._sound = ui.switch("Sound", value=sound, on_change=self._switched)
                ui.button("Acknowledge all", on_click=partial(self._acknowledge, None)).props(
                    "dense no-caps outline size=sm padding='4px 10px'"
                ).classes("!text-slate-700 dark:!text-slate-200")
            self._box = ui.column().classes("w-full max-h-60 gap-2 overflow-auto flex-nowrap")
            self._box.props('tabindex=0 role=group aria-label="Alarms"')
        self._spoken = ui.label().classes("sr-only").props("role=alert")

    @property
    def sound(self) -> bool:
        """Whether this browser is to sound."""
        return bool(self._sound.value)

    def show(self, state: State, now: float) -> None:
        """Show the alarms; sound while one was not acknowledged."""
        alarms = list(state.alarms)
        if state.alarms.unseen and self.sound and now - self._sounded >= REPEAT:
            self._sounded = now
            ui.run_javascript("magbridge.beep()")
        if not self._changes.new(
            "alarms", [(a.key, a.text, a.active, a.acknowledged, a.count) for a in alarms], self._box
        ):
            return
        unseen = [alarm.text for alarm in alarms if not alarm.acknowledged]
        self._spoken.set_text(f"Alarm: {unseen[0]}" if unseen else "")
        with self._box:
            if not alarms:
                nothing("None")
            for alarm in alarms:
                color = RED if alarm.active else AMBER
                edge = color if not alarm.acknowledged else "transparent"
                with (
                    ui.row()
                    .classes("w-full items-center justify-between flex-nowrap border-l-4 pl-3")
                    .style(f"border-color: {edge}")
                ):
                    with ui.column().classes("gap-0"):
                        ui.label(alarm.text).classes("leading-tight text-sm")
                        times = f", {alarm.count} times" if alarm.count > 1 else ""
                        over = "since" if alarm.active else "over; at"
                        ui.label(f"{over} {clock(alarm.since)} UTC{times}").classes(f"text-xs {MUTED}")
                    if not alarm.acknowledged:
                        button = ui.button("Seen", on_click=partial(self._acknowledge, alarm.key))
                        button.props("dense no-caps outline size=sm padding='4px 10px'")
                        button.classes("!text-slate-700 dark:!text-slate-200")
                        button.props["aria-label"] = f"Seen: {alarm.text}"

    def _acknowledge(self, key: str | None) -> None:
        with self._station.lock:
            self._state.alarms.acknowledge(key)

    def _switched(self) -> None:
        if self.sound:  # a browser sounds only once its reader has done something
            ui.run_javascript("magbridge.beep()")
