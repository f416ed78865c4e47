"""One page for a fleet, one file: each vehicle's coefficients with their bands, and what left them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from html import escape
from io import StringIO
from pathlib import Path

import numpy as np
from matplotlib.dates import ConciseDateFormatter
from matplotlib.figure import Figure

from magbridge.files import atomic_path
from magbridge.fleet.drift import History
from magbridge.pictures import literal

__all__ = ["write_page"]

EXPECTED, FOUND, CHANGED = "#9db4c0", "#253237", "#c1121f"
STYLE = """
body {font: 16px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem}
body {color: #253237}
h1, h2 {font-weight: 600} h2 {margin-top: 2.5rem} svg {max-width: 100%; height: auto}
table {border-collapse: collapse} td, th {padding: .25rem .9rem .25rem 0; text-align: left}
th {border-bottom: 1px solid #9db4c0} .changed {color: #c1121f; font-weight: 600}
td.number {text-align: right; font-variant-numeric: tabular-nums}
"""


def write_page(histories: Mapping[str, History], path: Path) -> None:
    """Write the page of a fleet.

    Parameters
    ----------
    histories : mapping
        Of each vehicle, by its name.
    path : path
        The file.

    Raises
    ------
    WriteError
        It cannot be written.
    """
    body = "\n".join(
        [
            "<h1>Fleet</h1>",
            *_overview(histories),
            *(part for item in histories.items() for part in _vehicle(*item)),
        ]
    )
    text = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1"><title>Fleet</title>'
        f"<style>{STYLE}</style></head><body>{body}</body></html>\n"
    )
    with atomic_path(path) as beside:
        beside.write_text(text, encoding="utf-8")


def _overview(histories: Mapping[str, History]) -> Iterator[str]:
    yield (
        "<p>A vehicle's magnetism is compared with what its earlier deployments, and its fleet, let expect. "
        "Grey is that expectation with its 2-sigma band, black what the deployment's own runs made of it; "
        "<span class=changed>red</span> left its band.</p>"
        "<table><tr><th>vehicle</th><th>deployments</th><th>last</th><th>changes</th></tr>"
    )
    for name, one in histories.items():
        count = sum(map(bool, one.changes))
        told = f"<span class=changed>{count}</span>" if count else "none"
        last = _day(one.lessons[-1].time) if one.lessons else ""
        yield (
            f'<tr><td><a href="#{escape(name)}">{escape(name)}</a></td>'
            f"<td class=number>{len(one.lessons)}</td><td>{last}</td><td>{told}</td></tr>"
        )
    yield "</table>"


def _vehicle(name: str, one: History) -> Iterator[str]:
    yield f'<h2 id="{escape(name)}">{escape(name)}</h2>'
    if not one.lessons:
        yield "<p>No deployment has been calibrated.</p>"
        return
    yield _drawn(one)
    rows = [
        f"<tr><td>{_day(lesson.time)}</td><td>{escape(lesson.deployment)}</td><td>{escape(lesson.refit)}</td>"
        f"<td class=changed>{escape(change.what)}</td><td class=number>{change.by:+.0f} nT</td>"
        f"<td class=number>{change.sigmas:.1f}</td></tr>"
        for lesson, changes in zip(one.lessons, one.changes, strict=True)
        for change in changes
    ]
    if rows:
        yield (
            "<table><tr><th>date</th><th>deployment</th><th>refit</th><th>what moved</th><th>by</th>"
            f"<th>sigmas</th></tr>{''.join(rows)}</table>"
        )
    else:
        yield "<p>Nothing left its band.</p>"


def _drawn(one: History) -> str:
    """Return a vehicle's picture: a row for fixed iron and each mass, a column for each axis."""
    rows = len(one.names) // 3
    figure = Figure(figsize=(10.0, 0.4 + 1.7 * rows), layout="constrained")
    axes = np.atleast_2d(figure.subplots(rows, 3, sharex=True))
    when = np.array([datetime.fromtimestamp(lesson.time, UTC) for lesson in one.lessons])
    for k, (ax, name) in enumerate(zip(axes.ravel(), one.names, strict=True)):
        moved = np.array([any(change.what == name for change in changes) for changes in one.changes])
        size = 2.0 * one.expected_sigma[:, k]
        # the first deployment's expectation is the fleet's: its band would hide all others
        later = slice(1, None) if len(when) > 1 else slice(None)
        ax.errorbar(
            when[later], one.expected[later, k], size[later], fmt="none", color=EXPECTED, lw=7, alpha=0.6
        )
        ax.errorbar(when, one.found[:, k], 2.0 * one.found_sigma[:, k], fmt="o", ms=4, lw=1.2, color=FOUND)
        ax.plot(when[moved], one.found[moved, k], "o", ms=8, color=CHANGED)
        ax.set_title(name, fontsize=9, loc="left")
        ax.tick_params(labelsize=8)
        ax.margins(x=0.08)
        ax.spines[["top", "right"]].set_visible(False)
        ax.xaxis.set_major_formatter(ConciseDateFormatter(ax.xaxis.get_major_locator()))  # type: ignore[no-untyped-call]
    for ax in axes[:, 0]:
        ax.set_ylabel("nT", fontsize=8)
    literal(figure)
    drawn = StringIO()
    figure.savefig(drawn, format="svg", metadata={"Date": None})
    return drawn.getvalue()[drawn.getvalue().index("<svg") :]


def _day(time: float) -> str:
    return datetime.fromtimestamp(time, UTC).date().isoformat()
