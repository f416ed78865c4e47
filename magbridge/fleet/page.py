"""A fleet as pages: one of all vehicles and one of each, with pictures and no script, in light and dark."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from html import escape
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any
from urllib.parse import quote

import msgspec
import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.dates import ConciseDateFormatter
from matplotlib.figure import Figure

from magbridge.errors import MagbridgeError, WriteError
from magbridge.field.read import read_grid
from magbridge.files import atomic_path, new_folder
from magbridge.fleet.drift import ALARM, History, facts
from magbridge.fleet.register import is_file_name
from magbridge.pictures import literal

__all__ = ["write_page", "write_pages"]

INK, BAND, CHANGED, REFIT = "#010101", "#020202", "#030303", "#040404"
"""Stand-ins in the pictures, for the page's own colours."""
PAGE_COLOURS = {INK: "var(--ink)", BAND: "var(--band)", CHANGED: "var(--changed)", REFIT: "var(--faint)"}
SVG_SETTINGS: Any = {
    "svg.hashsalt": "fleet", "svg.fonttype": "none", "font.size": 8.0, "text.color": INK,
    "axes.labelcolor": INK, "axes.edgecolor": REFIT, "xtick.color": INK, "ytick.color": INK,
}  # fmt: skip
FLEET_STYLE = """
:root {color-scheme: light dark;
  --ink: #22303c; --paper: #fff; --faint: #9aa5b1; --band: #9db4c0; --changed: #b3261e}
@media (prefers-color-scheme: dark) {
  :root {--ink: #dfe5ea; --paper: #12181d; --faint: #6c7883; --band: #42586a; --changed: #ff8a80}
}
body {font: 16px/1.5 system-ui, sans-serif; max-width: 66rem; margin: 2rem auto; padding: 0 1rem;
  color: var(--ink); background: var(--paper)}
h1, h2 {font-weight: 600; line-height: 1.25} h2 {margin-top: 2.5rem; font-size: 1.2rem}
a {color: inherit} .faint {opacity: .75}
.panels {display: grid; grid-template-columns: repeat(auto-fill, minmax(17rem, 1fr)); gap: .6rem}
.panels svg {width: 100%; height: auto; font-family: inherit}
.wide {overflow-x: auto} table {border-collapse: collapse; margin: .8rem 0}
td, th {padding: .25rem .9rem .25rem 0; text-align: left; white-space: nowrap}
th {border-bottom: 1px solid var(--faint)} .changed {color: var(--changed); font-weight: 600}
td.words {white-space: normal; min-width: 14rem}
.number {text-align: right; font-variant-numeric: tabular-nums}
"""
EXPLANATION = (
    "<p>A vehicle's magnetism is compared with the prediction from earlier deployments and its fleet. "
    "The broad band is that prediction (2 sigma); for a first deployment, the fleet's. The dot is the "
    "estimate with the deployment's own runs, its bar 2 sigma. A dotted line is a refit. "
    f"<span class=changed>Red</span>: the runs moved the coefficient farther than chance does once in "
    f"{1.0 / ALARM:,.0f} deployments. Of many coefficients, some lie outside their bands by chance.</p>"
)
"""The sentences above the charts."""
MAX_BAND_RATIO = 6.0
"""Largest width of a band over the range of the estimates at which the whole band is drawn."""
UNCHANGED = "No coefficient moved farther than by chance."
FIRST_ONLY = (
    "One deployment: its bands are what the fleet alone predicts; the second one shows what has changed."
)
Maps = Mapping[str, tuple[str, Path]]
"""Vehicle -> deployment and file of its last anomaly map."""
Findings = Mapping[str, Sequence[Mapping[str, Any]]]
"""Vehicle -> rows of the findings in its deployments."""


def write_pages(
    histories: Mapping[str, History], folder: Path, findings: Findings, maps: Maps | None = None
) -> None:
    """Write index.html of a fleet, VEHICLE.html of each, and all numbers as fleet.json.

    Parameters
    ----------
    histories : mapping
        Of each vehicle, by its name.
    folder : path
        Where to; made where it is not there.
    findings : mapping
        Of the vehicles whose deployments were diagnosed: deployment, verdict, cause, channel, improvement.
    maps : mapping, optional
        Deployment and file of each vehicle's last anomaly map.

    Raises
    ------
    WriteError
        A vehicle's name is not a file name, or the pages cannot be written.
    """
    for name in histories:
        if not is_file_name(name):
            raise WriteError(
                folder, f"vehicle {name!r}: expected a name without slashes, not beginning with a dot"
            )
    with new_folder(folder):
        numbers = {"vehicles": {name: facts(one) for name, one in histories.items()}}
        with atomic_path(folder / "fleet.json") as temporary:
            temporary.write_bytes(msgspec.json.encode(numbers))
        for name, one in histories.items():
            back = '<p><a href="index.html">Fleet</a></p>'
            last = (maps or {}).get(name)
            body = [back, *_vehicle(name, one, findings.get(name, ()), "h1"), *_survey(last)]
            _write(folder / f"{name}.html", name, body)
        links = {name: quote(f"{name}.html") for name in histories}
        _write(folder / "index.html", "Fleet", ["<h1>Fleet</h1>", *_overview(histories, links)])


def write_page(
    histories: Mapping[str, History], path: Path, findings: Findings, maps: Maps | None = None
) -> None:
    """Write the same as one page; parameters and errors as of :func:`write_pages`."""
    body = ["<h1>Fleet</h1>", *_overview(histories, {name: f"#{quote(name)}" for name in histories})]
    for name, one in histories.items():
        body += [*_vehicle(name, one, findings.get(name, ()), "h2"), *_survey((maps or {}).get(name))]
    _write(path, "Fleet", body)


def _write(path: Path, title: str, body: Sequence[str]) -> None:
    text = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><title>{escape(title)}</title>'
        f"<style>{FLEET_STYLE}</style></head><body>{''.join(body)}</body></html>\n"
    )
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _table(headings: str, rows: Sequence[str]) -> str:
    named = "".join(f"<th>{heading}</th>" for heading in headings.split(", "))
    return f"<div class=wide tabindex=0><table><tr>{named}</tr>{''.join(rows)}</table></div>"


def _overview(histories: Mapping[str, History], links: Mapping[str, str]) -> Iterator[str]:
    yield EXPLANATION
    rows = []
    for name, one in histories.items():
        evidence = "; ".join(f"{_day(when)} {escape(', '.join(what))}" for when, what in _changed(one)[-2:])
        last = _day(one.lessons[-1].time) if one.lessons else ""
        rows.append(
            f'<tr><td><a href="{escape(links[name])}">{escape(name)}</a></td><td class=number>'
            f"{len(one.lessons)}</td><td>{last}</td><td class=number>{len(_changed(one))}</td>"
            f"<td class=changed>{evidence}</td></tr>"
        )
    yield _table("vehicle, deployments, last, with changes, latest changes", rows)


def _changed(history: History) -> list[tuple[float, list[str]]]:
    """Return when a vehicle changed, and in what."""
    return [
        (lesson.time, list(dict.fromkeys(change.what.rpartition(",")[0] for change in changes)))
        for lesson, changes in zip(history.lessons, history.changes, strict=True)
        if changes
    ]


def _vehicle(name: str, history: History, found: Sequence[Mapping[str, Any]], heading: str) -> Iterator[str]:
    yield f'<{heading} id="{escape(name)}">{escape(name)}</{heading}>'
    if not history.lessons:
        yield "<p>No deployment has been calibrated.</p>"
        return
    if heading == "h1":
        yield EXPLANATION
    rows = [
        f"<tr><td>{_day(lesson.time)}</td><td>{escape(lesson.deployment)}</td><td>{escape(lesson.refit)}</td>"
        f"<td class=changed>{escape(change.what)}</td><td class=number>{change.by:+.0f} nT</td>"
        f"<td class=number>{change.sigmas:.1f}</td><td class=words>{escape(change.cause)}</td></tr>"
        for lesson, changes in zip(history.lessons, history.changes, strict=True)
        for change in changes
    ]
    yield (
        _table("date, deployment, refit, what moved, by, sigmas, as if by", rows)
        if rows
        else f"<p>{UNCHANGED if len(history.lessons) > 1 else FIRST_ONLY}</p>"
    )
    yield f"<div class=panels>{''.join(_panel(history, k) for k in range(len(history.names)))}</div>"
    if found:
        rows = [_found(row) for row in found]
        yield _table("deployment, verdict, cause, RMS with its correction, follows", rows)


def _found(row: Mapping[str, Any]) -> str:
    words = {
        key: str(row[key] or "").replace("_", " ") for key in ("deployment", "verdict", "cause", "channel")
    }
    gain = ""
    if row.get("ratio") is not None:
        gain = f"{row['ratio']:.2f} times ({row['low']:.2f} to {row['high']:.2f})"
        gain += ", no improvement is shown" * (row["high"] >= 1.0)
    cells = words["deployment"], words["verdict"], words["cause"], gain, words["channel"]
    return f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in cells)}</tr>"


def _survey(last: tuple[str, Path] | None) -> Iterator[str]:
    """Yield the picture of a vehicle's last anomaly map; nothing where its file cannot be read."""
    if last is None:
        return
    deployment, path = last
    try:
        grid = read_grid(path)
    except MagbridgeError:
        return
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    ax = figure.subplots()
    limit = float(np.nanquantile(np.abs(grid.anomaly), 0.98)) or 1.0
    drawn = ax.pcolormesh(
        grid.longitude, grid.latitude, grid.anomaly, cmap="RdBu_r", vmin=-limit, vmax=limit, rasterized=True
    )
    figure.colorbar(drawn, label="anomaly, nT")
    ax.set_aspect(1.0 / np.cos(np.radians(float(np.mean(grid.latitude)))))
    ax.set_xlabel("longitude, deg")
    ax.set_ylabel("latitude, deg")
    ax.ticklabel_format(useOffset=False)
    picture = BytesIO()
    figure.savefig(picture, format="png", dpi=110)
    source = f"data:image/png;base64,{b64encode(picture.getvalue()).decode()}"
    label = escape(f"Anomaly map of deployment {deployment}")
    yield f'<h3>{label}</h3><img alt="{label}" src="{source}" style="max-width:100%">'


def _panel(history: History, k: int) -> str:
    """Return the picture of one coefficient from deployment to deployment."""
    with rc_context(SVG_SETTINGS):
        figure = Figure(figsize=(3.4, 2.0))
        figure.subplots_adjust(0.15, 0.2, 0.98, 0.88)
        ax = figure.subplots()
        when = np.array([datetime.fromtimestamp(lesson.time, UTC) for lesson in history.lessons])
        moved = np.array(
            [any(change.what == history.names[k] for change in changes) for changes in history.changes]
        )
        # the first deployment's expectation is the fleet's: its band would hide all others
        later = slice(1, None) if len(when) > 1 else slice(None)
        band = history.expected[later, k], 2.0 * history.expected_sigma[later, k]
        ax.errorbar(when[later], *band, fmt="none", color=BAND, lw=7)
        ax.errorbar(
            when, history.found[:, k], 2.0 * history.found_sigma[:, k], fmt="o", ms=4, lw=1.2, color=INK
        )
        ax.plot(when[moved], history.found[moved, k], "o", ms=7, color=CHANGED)
        for before, after in zip(history.lessons, history.lessons[1:], strict=False):
            if before.refit != after.refit:
                middle = datetime.fromtimestamp((before.time + after.time) / 2.0, UTC)
                ax.axvline(middle, color=REFIT, lw=0.8, ls=":")  # type: ignore[arg-type]
        _limit(ax, history, k, later)
        ax.set_title(f"{history.names[k]}, nT", fontsize=9, loc="left")
        _dates(ax, when.tolist())
        ax.spines[["top", "right"]].set_visible(False)
        literal(figure)
        drawn = StringIO()
        figure.savefig(drawn, format="svg", transparent=True, metadata={"Date": None})
    text = drawn.getvalue()
    for stand_in, colour in PAGE_COLOURS.items():
        text = text.replace(stand_in, colour)
    return text[text.index("<svg") :]


def _dates(ax: Axes, dates: Sequence[datetime]) -> None:
    """Set the horizontal axis: a date at each deployment where few dates fit, else at intervals."""
    aside = max(0.08 * (dates[-1] - dates[0]), timedelta(days=10))  # one deployment alone has no span
    ax.set_xlim(dates[0] - aside, dates[-1] + aside)  # type: ignore[arg-type]
    if len(dates) == 1 or (len(dates) == 2 and dates[1] - dates[0] >= aside):
        ax.set_xticks(list(dates), [f"{one:%Y-%m-%d}" for one in dates])  # type: ignore[arg-type]
    else:
        ax.xaxis.set_major_formatter(ConciseDateFormatter(ax.xaxis.get_major_locator()))  # type: ignore[no-untyped-call]


def _limit(ax: Axes, history: History, k: int, later: slice) -> None:
    """Set the vertical axis by the estimates where a band is far wider, and state that band."""
    low = float((history.found[:, k] - 2.0 * history.found_sigma[:, k]).min())
    high = float((history.found[:, k] + 2.0 * history.found_sigma[:, k]).max())
    half = float(2.0 * history.expected_sigma[later, k].max())
    if 2.0 * half <= MAX_BAND_RATIO * (high - low):
        return
    ax.set_ylim(low - (high - low), high + (high - low))
    note = f"expected {history.expected[later, k][-1]:,.0f} ± {half:,.0f}"
    ax.set_title(note, fontsize=7, loc="right")  # above the axes, where no band hides it


def _day(time: float) -> str:
    return datetime.fromtimestamp(time, UTC).date().isoformat()
