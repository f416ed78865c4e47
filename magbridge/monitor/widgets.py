"""Make the elements that the panels of the page consist of, and define its colours."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from nicegui import ui

from magbridge.monitor.link import monotonic_s

MONITOR_STYLE = """
:root, .q-header {--ink: #1e293b; --good: #15803d; --suspect: #b45309; --bad: #b91c1c; --faded: #64748b}
body.body--dark {--ink: #e2e8f0; --good: #4ade80; --suspect: #fbbf24; --bad: #f87171; --faded: #94a3b8}
body.body--dark {color-scheme: dark; --q-negative: var(--bad) !important}
[data-chart]:focus-visible {outline: 2px solid #3b82f6; outline-offset: 2px; border-radius: 4px}
.q-header .q-btn, .q-header .q-toggle {color: white}
"""
"""Style sheet with the colours of the light and the dark page; the browser selects one of the two."""
INK, GREEN, AMBER, RED = "var(--ink)", "var(--good)", "var(--suspect)", "var(--bad)"
FADED_COLOUR = "var(--faded)"
"""Colour of old values, which are also in italics."""
MUTED = "text-slate-600 dark:text-slate-400"
GRID = "w-full grid gap-4 grid-cols-1"


class Changes:
    """Values that one browser shows, by key, so that the server sends only changes."""

    def __init__(self) -> None:
        self._shown: dict[str, Any] = {}

    def new(self, key: str, value: Any, box: ui.element | None = None) -> bool:
        """Return True if `value` differs from the last value of `key`; in that case, clear `box`."""
        new = key not in self._shown or bool(self._shown[key] != value)
        self._shown[key] = value
        if new and box is not None:
            box.clear()
        return new

    def forget(self, key: str) -> None:
        """Treat the next value of `key` as new, even if it has not changed."""
        self._shown.pop(key, None)


@contextmanager
def card(title: str) -> Iterator[ui.card]:
    """Make a card with a heading; elements that the caller makes in this context belong to the card."""
    with ui.card().classes("w-full gap-2 p-4 shadow-sm rounded-lg dark:bg-slate-800") as made:
        ui.label(title).classes(f"text-sm font-semibold {MUTED}").props("role=heading aria-level=2")
        yield made


def slanted(old: bool) -> str:
    """Return the CSS style of values: italics and a faded colour if they are `old`."""
    return f"font-style: {'italic' if old else 'normal'}; color: {FADED_COLOUR if old else INK}"


def nothing(text: str = "None yet") -> ui.label:
    """Make a label with a placeholder for missing data, and return the label."""
    return ui.label(text).classes(f"text-sm {MUTED}")


def button(text: str, order: Callable[[], None]) -> ui.button:
    """Make a small button that calls `order` at a click, and return it."""
    made = ui.button(text, on_click=order).classes("!text-slate-700 dark:!text-slate-200")
    return made.props("dense no-caps outline size=md padding='3px 10px'")


def clock(moment: float) -> str:
    """Return the UTC (HH:MM:SS) of a time of the station's monotonic clock, s."""
    return time.strftime("%H:%M:%S", time.gmtime(time.time() - (monotonic_s() - moment)))
