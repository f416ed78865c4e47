"""Panel of alarms by cause: start, acknowledge button, and a sound until acknowledged."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from nicegui import ui

from magbridge.monitor.alarms import AlarmGroup
from magbridge.monitor.link import StationLink
from magbridge.monitor.state import BridgeState
from magbridge.monitor.widgets import AMBER, MUTED, RED, Changes, button, card, clock, nothing

__all__ = ["AlarmPanel"]

REPEAT = 5.0
"""s between two sounds while an alarm is not acknowledged."""


class Row:
    """The alarms of one cause. Its elements stay as long as they do, so that a click finds its button."""

    def __init__(self, acknowledge: Callable[[], None]) -> None:
        self._acknowledge = acknowledge
        with ui.row().classes("w-full items-center justify-between flex-nowrap border-l-4 pl-3") as self.box:
            with ui.column().classes("gap-0"):
                self._text = ui.label().classes("leading-tight text-sm")
                self._times = ui.label().classes(f"text-xs {MUTED}")
            self._seen: ui.button | None = None

    def show(self, alarm: AlarmGroup) -> None:
        """Show how it stands; the button is there until somebody has seen it."""
        color = RED if alarm.active else AMBER
        self.box.style(f"border-color: {'transparent' if alarm.acknowledged else color}")
        self._text.set_text(alarm.text)
        times = f", {alarm.count} times" if alarm.count > 1 else ""
        over = "since" if alarm.active else "over; at"
        self._times.set_text(f"{over} {clock(alarm.started_s)} UTC{times}")
        if alarm.acknowledged and self._seen is not None:
            self._seen.delete()
            self._seen = None
        elif not alarm.acknowledged:
            if self._seen is None:
                with self.box:
                    self._seen = button("Seen", self._acknowledge)
            label = f"Seen: {alarm.text}"
            if self._seen.props.get("aria-label") != label:
                self._seen.props["aria-label"] = label
                self._seen.update()


class AlarmPanel:
    """The alarms of one vehicle."""

    def __init__(self, station: StationLink, state: BridgeState, *, sound: bool) -> None:
        self._station, self._state, self._changes = station, state, Changes()
        self._sounded = -REPEAT
        with card("Alarms"):
            with ui.row().classes("w-full items-center gap-x-4"):
                self._sound = ui.switch("Sound", value=sound, on_change=self._switched)
                button("Acknowledge all", partial(self._acknowledge, None))
            self._box = ui.column().classes("w-full max-h-60 gap-2 overflow-auto flex-nowrap")
            self._box.props('tabindex=0 role=group aria-label="Alarms"')
            self._none = nothing("None")
        self._rows: dict[str, Row] = {}
        self._spoken = ui.label().classes("sr-only").props("role=alert")

    @property
    def sound(self) -> bool:
        """True if this browser sounds."""
        return bool(self._sound.value)

    def show(self, state: BridgeState, now_s: float) -> None:
        """Show the alarms; sound while one was not acknowledged."""
        alarms = state.alarms.groups
        if state.alarms.unseen and self.sound and now_s - self._sounded >= REPEAT:
            self._sounded = now_s
            ui.run_javascript("magbridge.beep()")
        if not self._changes.new(
            "alarms", [(a.cause, a.text, a.active, a.acknowledged, a.count) for a in alarms]
        ):
            return
        unseen = [alarm.text for alarm in alarms if not alarm.acknowledged]
        self._spoken.set_text(f"Alarm: {unseen[0]}" if unseen else "")
        self._none.set_visibility(not alarms)
        for cause in self._rows.keys() - {alarm.cause for alarm in alarms}:
            self._rows.pop(cause).box.delete()
        for place, alarm in enumerate(alarms):
            if alarm.cause not in self._rows:
                with self._box:
                    self._rows[alarm.cause] = Row(partial(self._acknowledge, alarm.cause))
            row = self._rows[alarm.cause]
            row.show(alarm)
            if self._box.default_slot.children[place] is not row.box:
                row.box.move(target_index=place)

    def _acknowledge(self, cause: str | None) -> None:
        with self._station.lock:
            self._state.alarms.acknowledge(cause)

    def _switched(self) -> None:
        if self.sound:  # a browser sounds only once its reader has done something
            ui.run_javascript("magbridge.beep()")
