"""Describe the contents of logs, and the commands that could use them."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magbridge.cli.common import (
    AS_THEY_SAY,
    Json,
    ReadingOptions,
    command,
    complain,
    logs_to_read,
    print_result,
)
from magbridge.cli.remarks import note_losses
from magbridge.progress import waiting
from magbridge.wording import counted

if TYPE_CHECKING:
    from rich.table import Table

WIDE_TERMINAL = 110
"""Characters of a terminal from which on the meanings are shown."""
MAX_LISTED_LOGS = 3
"""Largest number of logs whose names are listed above what they hold together."""


@command("info FILE... [OPTIONS]")
def info(*files: Path, reading: ReadingOptions = AS_THEY_SAY, json: Json = False) -> None:
    """Describe logs: columns, units, rates, gaps, ranges, and the commands that could use them.

    Several logs are described one after the other; a sensor's own log and a vehicle's logs also together.

    Parameters
    ----------
    files
        The logs.
    """
    logs_to_read(files)

    from magbridge.logs import read
    from magbridge.logs.deployment import join
    from magbridge.logs.info import info as facts_of
    from magbridge.logs.reading import without_companions
    from magbridge.logs.sensor_log import combine

    logs = {}
    with waiting("reading"):
        for file in without_companions(list(dict.fromkeys((*files, *reading.sensor_log)))):
            logs[str(file)] = read(file, options=reading.without_sensor_logs)
        named = [Path(name) in reading.sensor_log for name in logs]
        combined = combine(list(logs.values()), named, reading.clock_offset)
        if len(combined) < len(logs):
            names = [Path(name).name for name in logs]
            listed = " and ".join(names) if len(names) <= MAX_LISTED_LOGS else f"{len(names)} logs"
            logs[f"{listed} together"] = join(combined)
    found = {}
    for name, log in logs.items():
        found[name] = facts_of(log)
        if not json:
            note_losses(log.attrs)
            _show(name, found[name])
    print_result(found, "", json)


def _show(file: str, facts: dict[str, Any]) -> None:
    from msgspec import convert
    from rich.console import Console

    from magbridge.logs.compasses import LogCompass

    console = Console(highlight=False, soft_wrap=False)
    console.print(f"[bold]{_plain(file)}[/bold]: {_plain(summary(facts))}", soft_wrap=True)
    for compass in facts["compasses"]:
        one = convert(compass, LogCompass)
        console.print(_plain(f"  {one.words}{', read as mag_x mag_y mag_z' * one.chosen}"))
    console.print(_columns(facts, meanings=console.width >= WIDE_TERMINAL))
    console.print(_uses(facts))
    for hint in facts["hints"]:
        complain(f"{file}: {hint}")


def summary(facts: dict[str, Any]) -> str:
    """Return a log's rows, its time, its rate and its gaps in a sentence."""
    if not facts["rows"]:
        return "no rows"
    boot = facts["references"]["time_reference"] == "boot"
    first, last = (f"{facts[end]:.1f} s" if boot else _utc(facts[end]) for end in ("start", "end"))
    rate = f", {facts['rate_hz']:.4g} Hz" if facts["rate_hz"] else ""
    gaps = ""
    if facts["gaps"]:
        gaps = f", {counted(facts['gaps'], 'gap')}, the longest of {facts['longest_gap_s']:.4g} s"
    return f"{counted(facts['rows'], 'row')}, {first} to {last}{rate}{gaps}"


def _utc(time: float) -> str:
    return f"{datetime.fromtimestamp(time, UTC):%Y-%m-%d %H:%M:%S} UTC"


def _columns(facts: dict[str, Any], *, meanings: bool) -> Table:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from magbridge.columns import CHANNEL_TIMES

    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for name in ("column", "unit"):
        table.add_column(name, overflow="fold")
    for name in ("known", "lowest", "highest", "changes every"):
        table.add_column(name, justify="right", no_wrap=True)
    if meanings:
        table.add_column("meaning")
    for one in facts["columns"]:
        every = one["changes_every_s"]
        ends = ("", "") if one["name"] in CHANNEL_TIMES else (one["lowest"], one["highest"])
        table.add_row(
            _plain(one["name"]),
            "" if one["unit"] == "1" else _plain(one["unit"]),
            f"{one['known']:.0%}",
            *(f"{end:.6g}" if isinstance(end, float) else "" for end in ends),
            "" if every is None else f"{every:.3g} s",
            *([_plain(one["meaning"])] if meanings and one["meaning"] != one["name"] else []),
        )
    return table


def _uses(facts: dict[str, Any]) -> Table:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table("command", "could use it?", box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for name, lacks in facts["uses"].items():
        table.add_row(name, f"lacks {'; and '.join(lacks)}" if lacks else "yes")
    return table


def _plain(text: str) -> str:
    """Return a text whose brackets are not taken for rich's markup."""
    from rich.markup import escape

    return escape(text)
