"""Logs of autopilots as deployments: the common part of ArduPilot, PX4 and ROS.

A row is a sample of one of the magnetometers, that in use (:mod:`.compasses`); every other column is the last
value before it. A log that does not tell UTC counts from the boot, and has the attribute
``time_reference = "boot"``. Each boot is a run with its own UTC.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.logs.checks import in_order
from magbridge.logs.compasses import LogCompass, choose, compass_notes, listed
from magbridge.logs.deployment import NOTES, deployment, noted, same_columns, sliced, uncounted
from magbridge.logs.fields import latest

__all__ = ["BootRun", "Magnetometer", "Series", "pieces"]

FieldTable = Mapping[str, FloatArray]
Series = tuple[FloatArray, str, str, FloatArray]
"""Times (m,), s; column, unit and values (m,)."""
MIN_BOOT_INTERVAL_S = 60.0
"""s between two boots whose times would overlap: no value is carried from one to the other."""


class Magnetometer(NamedTuple):
    """The samples of a magnetometer."""

    compass: LogCompass
    time: FloatArray
    """(n,), s of the log."""
    field: FieldTable
    """(n,) each, nT, by axis (``x``, ``y``, ``z``)."""


class BootRun(NamedTuple):
    """The records between one boot and the next."""

    magnetometers: list[Magnetometer]
    """At least one."""
    telemetry: Iterable[Series]
    """The first of several with one name is taken."""
    offset: float | None
    """UTC minus the log's time, s; None where it is not known."""


def pieces(
    path: Path, rows: int, runs: Sequence[BootRun], attrs: Mapping[str, Any], compass: str | None = None
) -> Iterator[xr.Dataset]:
    """Yield the log in pieces of at most `rows` rows, run by run.

    `attrs` are of the whole log: its first piece has what they count. Runs without a date are left out, and
    counted, where others have one.
    """
    dated = [run for run in runs if run.offset is not None]
    chosen = choose(path, [one.compass for one in runs[0].magnetometers], compass)
    notes = [*noted(attrs), *compass_notes(chosen, compass)]
    if len(runs) > 1:
        notes.append(f"{len(runs)} boots, each a run of its own")
    counted = {name: value for name, value in attrs.items() if name != NOTES}
    if dated and len(dated) < len(runs):
        lost = sum(len(run.magnetometers[0].time) for run in runs if run.offset is None)
        counted["rows_dropped"] = counted.get("rows_dropped", 0) + lost
        notes.append(f"{len(runs) - len(dated)} of them without GPS time are left out: they have no date")
    own = next(one for one in chosen if one.chosen)
    found = [_assembled(path, run, own) for run in dated or runs]
    notes += _one_after_the_other(found)
    kept = {**listed(chosen), **({} if dated else {"time_reference": "boot"})}
    first: dict[str, Any] = {**counted, **({NOTES: "\n".join(notes)} if notes else {})}
    columns = {str(name): dict(one.attrs) for data in found for name, one in data.data_vars.items()}
    for k, data in enumerate(found):
        whole = same_columns(data, columns).assign_attrs(kept | first)
        yield from sliced(uncounted(whole) if k else whole, rows)


def _assembled(path: Path, run: BootRun, wanted: LogCompass) -> xr.Dataset:
    """Return a run at the times of a compass; without that compass, at those of the run's own choice."""
    there = [one.compass for one in run.magnetometers]
    same = [one for one in there if (one.id, one.number) == (wanted.id, wanted.number)]
    compass = same[0] if same else next(one for one in choose(path, there, None) if one.chosen)
    mag = next(one for one in run.magnetometers if one.compass.number == compass.number)
    columns = {f"mag_{axis}": values for axis, values in mag.field.items()}
    units = dict.fromkeys(columns, "nT")
    further = (
        (other.time, f"mag{other.compass.number + 1}_{axis}", "nT", values)
        for other in run.magnetometers
        if other is not mag
        for axis, values in other.field.items()
    )
    for when, column, unit, values in chain(further, run.telemetry):
        if column not in columns:
            keep = in_order(when, strictly=False)
            columns[column], units[column] = latest(mag.time, when[keep], values[keep]), unit
    return deployment(path, mag.time + (run.offset or 0.0), columns, units)


def _one_after_the_other(runs: list[xr.Dataset]) -> list[str]:
    """Shift runs that begin before the end of the previous run, in place; return a note for each."""
    notes, ended = [], -inf
    for k, run in enumerate(runs):
        time = run["time"].values
        kept = time[in_order(time)]
        if len(kept) and kept[0] <= ended:
            later = ended + MIN_BOOT_INTERVAL_S - float(kept[0])
            runs[k] = run.assign_coords(time=run["time"].copy(data=time + later))
            notes.append(
                f"boot {k + 1} begins by its own clock before the end of the last: moved by {later:.0f} s"
            )
        if len(kept):
            ended = float(runs[k]["time"].values[in_order(time)][-1])
    return notes
