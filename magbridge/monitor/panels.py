"""Show the panels of values and texts: field, flags, health, navigation, alarms, learning, parameters."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import cos, nan, radians, sin
from typing import Any

from jinja2 import Environment, PackageLoader
from nicegui import ui

from magbridge.config import Align, Telemetry
from magbridge.link.parameters import alignment, file_rate, learning, rates, telemetry_ages
from magbridge.link.publish import DEFAULT_RATES_HZ, LIMITS
from magbridge.mavlink.enums import MAV_SEVERITY
from magbridge.monitor import widgets, words
from magbridge.monitor.history import Alarm
from magbridge.monitor.link import StationLink
from magbridge.monitor.state import BridgeState
from magbridge.monitor.widgets import AMBER, INK, MUTED, RED, Changes, button, card, clock, nothing

TUNABLES = {
    one.name: one
    for one in (*alignment(Align()), *file_rate(), *learning(enabled=True), *rates(DEFAULT_RATES_HZ, LIMITS))
}
"""Parameters of a bridge by name, with unit and range, which a PARAM_VALUE does not contain."""
(AGE,) = telemetry_ages({"telemetry": Telemetry(message="", field="")})
"""Parameter of the largest telemetry age; it describes every MB_AGE_ parameter of a bridge."""


ROSE_RADIUS = 80.0
"""Radius of the compass circle in ``rose.svg``, in units of the picture, whose width is 200."""
ENGINE = Environment(loader=PackageLoader("magbridge.monitor", ""), autoescape=True)


def rose_picture(field: dict[str, Any]) -> str:
    """Return the compass rose as an SVG with a needle and the 2-sigma band of the heading."""
    heading, sigma, _ = words.current_heading(field) or (None, 0.0, "")
    half = radians(2.0 * sigma)
    # the right end of the band, in a picture that is rotated to the heading
    x, y = round(ROSE_RADIUS * sin(half), 2), round(-ROSE_RADIUS * cos(half), 2)
    label = words.heading_text(field)
    picture = ENGINE.get_template("rose.svg")
    return picture.render(heading=heading, half_width=2.0 * sigma, x=x, y=y, label=label)


ENGINE.globals |= {
    "words": words, "widgets": widgets, "rose_picture": rose_picture, "MAV_SEVERITY": MAV_SEVERITY
}  # fmt: skip
CONTENTS: Any = ENGINE.get_template("panels.html").module
"""Macros that return the contents of the panels as HTML."""


class Panel:
    """Panel whose content is the macro `content` of ``panels.html``; hidden while the content is empty."""

    def __init__(self, title: str, content: str) -> None:
        self._content = getattr(CONTENTS, content)
        with ui.element().classes("w-full") as self.box, card(title) as self.card:
            self.html = ui.html("", sanitize=False).classes("w-full")

    def show(self, state: BridgeState, now_s: float) -> None:
        """Show the state at `now_s`."""
        content = str(self._content(state, now_s))
        if content != self.html.content:
            self.html.set_content(content)
        self.box.set_visibility(bool(content))


class ParameterPanel:
    """Panel in which a user reads and sets the parameters of the bridge."""

    def __init__(self, station: StationLink, state: BridgeState) -> None:
        self._station, self._state = station, state
        self._changes, self._inputs = Changes(), dict[str, ui.number]()
        with card("Parameters (Enter sets one)"):
            self._box = ui.element().classes(
                "w-full max-h-60 grid grid-cols-2 sm:grid-cols-3 content-start gap-x-4 overflow-auto"
            )
            self._box.props('tabindex=0 role=group aria-label="Parameters"')

    def show(self, state: BridgeState, _now_s: float) -> None:
        """Show the values of the parameters, and why the bridge rejected a requested value."""
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
                self._changes.forget(name)  # show the answer, even if it equals the previous answer
                value = self._inputs[name].value
                self._state.set(name, nan if value is None else value)


REPEAT = 5.0
"""Time between two sounds of an unacknowledged alarm, s."""


class Row:
    """Row for the alarms of one cause; it is updated in place, so that a click finds its button."""

    def __init__(self, acknowledge: Callable[[], None]) -> None:
        with ui.row().classes("w-full items-center justify-between flex-nowrap border-l-4 pl-3") as self.box:
            with ui.column().classes("gap-0"):
                self._text = ui.label().classes("leading-tight text-sm")
                self._times = ui.label().classes(f"text-xs {MUTED}")
            self._seen = button("Seen", acknowledge)

    def show(self, alarm: Alarm) -> None:
        """Show text and start of the alarms, and a button until a user acknowledges them."""
        color = RED if alarm.active else AMBER
        self.box.style(f"border-color: {'transparent' if alarm.acknowledged else color}")
        self._text.set_text(alarm.text)
        times = f", {alarm.count} times" if alarm.count > 1 else ""
        over = "since" if alarm.active else "over; at"
        self._times.set_text(f"{over} {clock(alarm.since)} UTC{times}")
        self._seen.set_visibility(not alarm.acknowledged)
        self._seen.props["aria-label"] = f"Seen: {alarm.text}"
        self._seen.update()


class AlarmPanel:
    """Panel of the alarms of one vehicle, with a sound for unacknowledged alarms."""

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
        """True if the user has switched the sound on in this browser."""
        return bool(self._sound.value)

    def show(self, state: BridgeState, now_s: float) -> None:
        """Show the alarms; play a sound while an alarm is unacknowledged and the sound is on."""
        alarms = state.alarms.groups
        if state.alarms.unseen and self.sound and now_s - self._sounded >= REPEAT:
            self._sounded = now_s
            ui.run_javascript("magbridge.beep()")
        if not self._changes.new("alarms", alarms):
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
        if self.sound:  # browsers play sound only after an action of the user
            ui.run_javascript("magbridge.beep()")


TITLE = "Learning in flight"
DO = "MB_LEARN_CMD"
ACCEPT = "Accept"
LEARNING_COMMANDS = {
    ACCEPT: (1.0, "Use the learned calibration from now on, and acknowledge the alarm"),
    "Forget": (2.0, "Return to the first calibration, and restart learning"),
}


class LearningPanel(Panel):
    """Panel of the online calibration (learning) of a bridge; hidden if the bridge does not learn."""

    def __init__(self, station: StationLink, state: BridgeState) -> None:
        self._station, self._state = station, state
        super().__init__(TITLE, "learning")
        self.box.props(f'role=region aria-label="{TITLE}"')
        with self.card:
            with ui.row().classes("gap-x-4"):
                self._buttons = [
                    button(name, partial(self._confirm, name)).tooltip(meaning)
                    for name, (_, meaning) in LEARNING_COMMANDS.items()
                ]
            self._answer = ui.label().classes("text-xs").style(f"color: {RED}").props("role=status")

    def show(self, state: BridgeState, now_s: float) -> None:
        """Show the last MAG_LEARNING, and the error of the last command."""
        super().show(state, now_s)
        for one in self._buttons:
            one.set_enabled(DO in state.parameters)
        self._answer.set_text(state.parameters[DO].error if DO in state.parameters else "")

    def _confirm(self, name: str) -> None:
        """Ask the user to confirm a command; for Accept, show how well the learned calibration predicts."""
        value, meaning = LEARNING_COMMANDS[name]
        text, good = words.learned_worth(self._state.learning) if name == ACCEPT else ("", True)

        def answered(*, yes: bool) -> None:
            dialog.close()
            if yes:
                self._order(value)

        with ui.dialog() as dialog, ui.card():
            ui.label(f"{meaning}?").classes("font-semibold")
            ui.label(text).style(f"color: {INK if good else RED}").set_visibility(bool(text))
            with ui.row():
                button(f"{name} now" if good else f"{name} all the same", partial(answered, yes=True))
                button("Cancel", partial(answered, yes=False))
        dialog.on("hide", dialog.delete)
        dialog.open()

    def _order(self, value: float) -> None:
        with self._station.lock:
            if DO in self._state.parameters:
                self._state.set(DO, value)
