"""The panel of what a bridge learns: two predictions, its alarms, and buttons to accept and forget."""

from __future__ import annotations

from functools import partial

from nicegui import ui

from magbridge.monitor.link import StationLink
from magbridge.monitor.state import State
from magbridge.monitor.widgets import GRID, INK, RED, button, card, fact
from magbridge.monitor.words import learnt

__all__ = ["LearningPanel"]

TITLE = "Learning in flight"
DO = "MB_LEARN_CMD"
LEARNING_COMMANDS = {
    "Accept": (1.0, "Use the learned calibration from now on, and acknowledge the alarm"),
    "Forget": (2.0, "Return to the first calibration, and restart learning"),
}


class LearningPanel:
    """What one bridge learns; hidden where it does not."""

    def __init__(self, station: StationLink, state: State) -> None:
        self._station, self._state = station, state
        self._box = ui.element().classes("w-full").props(f'role=region aria-label="{TITLE}"')
        with self._box, card(TITLE):
            with ui.element().classes(f"{GRID} md:grid-cols-2 gap-x-12 gap-y-1"):
                self._labels = [fact(name) for name in learnt(state)]
            with ui.row().classes("gap-x-4"):
                self._buttons = [
                    button(name, partial(self._order, value)).tooltip(meaning)
                    for name, (value, meaning) in LEARNING_COMMANDS.items()
                ]
            self._answer = ui.label().classes("text-xs").style(f"color: {RED}").props("role=status")

    def show(self, state: State, _now: float) -> None:
        """Show the last MAG_LEARNING."""
        self._box.set_visibility(bool(state.learning))
        for label, (text, well) in zip(self._labels, learnt(state).values(), strict=True):
            label.set_text(text)
            label.style(f"color: {INK if well else RED}")
        for one in self._buttons:
            one.set_enabled(DO in state.parameters)
        self._answer.set_text(state.parameters[DO].error if DO in state.parameters else "")

    def _order(self, value: float) -> None:
        with self._station.lock:
            if DO in self._state.parameters:
                self._state.set(DO, value)
