"""Write HTML pages about a fleet, without scripts: an overview, and details of each vehicle."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from io import BytesIO, StringIO
from itertools import pairwise
from pathlib import Path
from typing import Any
from urllib.parse import quote

import msgspec
import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.dates import ConciseDateFormatter
from matplotlib.figure import Figure

from magbridge.errors import MagbridgeError, WriteError
from magbridge.field.read import read_grid
from magbridge.files import atomic_path, new_folder
from magbridge.fleet.learn import FALSE_ALARM_PROBABILITY, History
from magbridge.fleet.register import is_file_name
from magbridge.pictures import literal
from magbridge.plot import grid

INK, BAND, CHANGED, REFIT = "#010101", "#020202", "#030303", "#040404"
"""Colours in the pictures that are replaced by the colour variables of the page."""
PAGE_COLOURS = {INK: "var(--ink)", BAND: "var(--band)", CHANGED: "var(--changed)", REFIT: "var(--faint)"}
SVG_SETTINGS: Any = {
    "svg.hashsalt": "fleet", "svg.fonttype": "none", "font.size": 8.0, "text.color": INK,
    "axes.labelcolor": INK, "axes.edgecolor": REFIT, "xtick.color": INK, "ytick.color": INK,
}  # fmt: skip
MAX_BAND_RATIO = 6.0
"""Largest ratio of a band's width to the range of the estimates at which the whole band is visible."""
Maps = Mapping[str, tuple[str, Path]]
"""Vehicle -> deployment and file of its newest anomaly map."""
Findings = Mapping[str, Sequence[Mapping[str, Any]]]
"""Vehicle -> rows of the causes that ``diagnose`` found in its deployments."""


def write_pages(
    histories: Mapping[str, History], path: Path, findings: Findings, maps: Maps | None = None
) -> None:
    """Write the pages of a fleet: one file (.html) with all vehicles, or a folder.

    The folder receives index.html about the fleet, VEHICLE.html about each vehicle, and all numbers as
    fleet.json. `findings` may lack vehicles without a diagnosed deployment, `maps` vehicles without a map.

    WriteError: a vehicle's name is not a file name, or the pages cannot be written.
    """
    is_single = path.suffix == ".html"
    for name in histories:
        if not (is_single or is_file_name(name)):
            raise WriteError(path, f"vehicle {name!r}: expected a name without slashes or leading dot")
    vehicles = []
    for name, one in histories.items():
        shown = _shown(name, one, findings.get(name, ()), (maps or {}).get(name))
        vehicles.append({**shown, "link": f"#{quote(name)}" if is_single else quote(f"{name}.html")})
    if is_single:
        _write(path, "Fleet", vehicles, vehicles)
        return
    with new_folder(path):
        numbers = {"vehicles": {name: one.facts for name, one in histories.items()}}
        with atomic_path(path / "fleet.json") as temporary:
            temporary.write_bytes(msgspec.json.encode(numbers))
        for vehicle in vehicles:
            _write(path / f"{vehicle['name']}.html", vehicle["name"], [], [vehicle])
        _write(path / "index.html", "Fleet", vehicles, [])


def _write(
    path: Path, title: str, listed: Sequence[dict[str, Any]], detailed: Sequence[dict[str, Any]]
) -> None:
    """Write a page with a list of the vehicles `listed` and the details of the vehicles `detailed`."""
    loader = FileSystemLoader(Path(__file__).parent)
    engine = Environment(loader=loader, autoescape=True, undefined=StrictUndefined)
    text = engine.get_template("page.html").render(
        title=title, vehicles=listed, detailed=detailed, alarm=FALSE_ALARM_PROBABILITY,
        is_overview=bool(listed), heading="h2" if listed else "h1",
    )  # fmt: skip
    with atomic_path(path) as temporary:
        temporary.write_text(f"{text}\n", encoding="utf-8")


def _shown(
    name: str, history: History, found: Sequence[Mapping[str, Any]], last: tuple[str, Path] | None
) -> dict[str, Any]:
    """Return the values about a vehicle that the template of the page needs."""
    deployments = history.facts["deployments"]
    for one in deployments:
        one["masses"] = list(dict.fromkeys(change["what"].partition(",")[0] for change in one["changes"]))
    panels = [_panel(history, k) for k in range(len(history.names))] if deployments else []
    return {
        "name": name, "deployments": deployments, "panels": panels, "findings": found, "map": _survey(last),
    }  # fmt: skip


def _survey(last: tuple[str, Path] | None) -> dict[str, str] | None:
    """Return deployment and PNG (base64) of a vehicle's newest map; None without a readable map."""
    if last is None:
        return None
    deployment, path = last
    try:
        anomaly = read_grid(path)
    except MagbridgeError:
        return None
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    grid(anomaly, ax=figure.subplots()).ticklabel_format(useOffset=False)
    picture = BytesIO()
    figure.savefig(picture, format="png", dpi=110)
    return {"deployment": deployment, "picture": b64encode(picture.getvalue()).decode()}


def _panel(history: History, k: int) -> str:
    """Return the SVG of the chart of coefficient `k` over the deployments."""
    with rc_context(SVG_SETTINGS):
        figure = Figure(figsize=(3.4, 2.0))
        figure.subplots_adjust(0.15, 0.2, 0.98, 0.88)
        ax = figure.subplots()
        each, name = history.deployments, history.names[k]
        when = np.array([datetime.fromtimestamp(one.lesson.time, UTC) for one in each])
        moved = np.array([any(change.what == name for change in one.changes) for one in each])
        found = np.array([one.found[k] for one in each])
        bars = 2.0 * np.array([one.found_sigma[k] for one in each])
        # the first prediction is so wide that its band would hide the others
        later = slice(1, None) if len(when) > 1 else slice(None)
        expected = np.array([one.expected[k] for one in each[later]])
        bands = 2.0 * np.array([one.expected_sigma[k] for one in each[later]])
        ax.errorbar(when[later], expected, bands, fmt="none", color=BAND, lw=7)
        ax.errorbar(when, found, bars, fmt="o", ms=4, lw=1.2, color=INK)
        ax.plot(when[moved], found[moved], "o", ms=7, color=CHANGED)
        for before, after in pairwise(each):
            if before.lesson.refit != after.lesson.refit:
                middle = datetime.fromtimestamp((before.lesson.time + after.lesson.time) / 2.0, UTC)
                ax.axvline(middle, color=REFIT, lw=0.8, ls=":")  # type: ignore[arg-type]
        low, high, half = float((found - bars).min()), float((found + bars).max()), float(bands.max())
        if 2.0 * half > MAX_BAND_RATIO * (high - low):
            # limit the axis to the estimates; the band stands above the axes, where no other hides it
            ax.set_ylim(low - (high - low), high + (high - low))
            ax.set_title(f"expected {expected[-1]:,.0f} ± {half:,.0f}", fontsize=7, loc="right")
        ax.set_title(f"{name}, nT", fontsize=9, loc="left")
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
    """Set the time axis: a tick at each of one or two deployments, else ticks at regular dates."""
    aside = max(0.08 * (dates[-1] - dates[0]), timedelta(days=10))  # one deployment has no range of dates
    ax.set_xlim(dates[0] - aside, dates[-1] + aside)  # type: ignore[arg-type]
    if len(dates) == 1 or (len(dates) == 2 and dates[1] - dates[0] >= aside):
        ax.set_xticks(list(dates), [f"{one:%Y-%m-%d}" for one in dates])  # type: ignore[arg-type]
    else:
        ax.xaxis.set_major_formatter(ConciseDateFormatter(ax.xaxis.get_major_locator()))  # type: ignore[no-untyped-call]
