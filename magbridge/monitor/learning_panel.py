"""The panel of what a bridge learns: two predictions, its alarms, and buttons to accept and forget."""

from __future__ import annotations

from functools import partial

from nicegui import ui

from magbridge.monitor.link import StationLink
from magbridge.monitor.state import BridgeState
from magbridge.monitor.widgets import GRID, INK, RED, button, card, fact
from magbridge.monitor.words import learned_worth, learnt

__all__ = ["LearningPanel"]

TITLE = "Learning in flight"
DO = "MB_LEARN_CMD"
ACCEPT = "Accept"
LEARNING_COMMANDS = {
    ACCEPT: (1.0, "Use the learned calibration from now on, and acknowledge the alarm"),
    "Forget": (2.0, "Return to the first calibration, and restart learning"),
}


class LearningPanel:
    """What one bridge learns; hidden where it does not."""

    def __init__(self, station: StationLink, state: BridgeState) -> None:
        self._station, self._state = station, state
        self._box = ui.element().classes("w-full").props(f'role=region aria-label="{TITLE}"')
        with self._box, card(TITLE):
            with ui.element().classes(f"{GRID} md:grid-cols-2 gap-x-12 gap-y-1"):
                self._labels = [fact(name) for name in learnt(state)]
            with ui.row().classes("gap-x-4"):
                self._buttons = [
                    button(name, partial(self._confirm, name)).tooltip(meaning)
                    for name, (_, meaning) in LEARNING_COMMANDS.items()
                ]
            self._answer = ui.label().classes("text-xs").style(f"color: {RED}").props("role=status")

    def show(self, state: BridgeState, _now_s: float) -> None:
        """Show the last MAG_LEARNING."""
        self._box.set_visibility(bool(state.learning))
        for label, (text, well) in zip(self._labels, learnt(state).values(), strict=True):
            label.set_text(text)
            label.style(f"color: {INK if well else RED}")
        for one in self._buttons:
            one.set_enabled(DO in state.parameters)
        self._answer.set_text(state.parameters[DO].error if DO in state.parameters else "")

    def _confirm(self, name: str) -> None:
        """Ask before a command is sent; before the learned calibration is accepted, state its worth."""
        value, meaning = LEARNING_COMMANDS[name]
        text, good = learned_worth(self._state.learning) if name == ACCEPT else ("", True)

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
