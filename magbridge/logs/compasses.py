"""Choose one of several magnetometers in a log, and form rows at its samples.

By default, ``mag_x mag_y mag_z`` are the compass that the vehicle's estimator used, if it is enabled and
healthy. Every other compass has its number in the name of its columns: ``mag2_x`` is the second.

In logs of ArduPilot, PX4 and ROS, each row is a sample of the chosen magnetometer. Every other column is the
last value at or before the row. Times of a log without UTC count from the boot, and its attribute
``time_reference`` is ``"boot"``. Each boot is a run with its own UTC offset.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.columns import CHANNELS, COLUMNS
from magbridge.errors import FormatError
from magbridge.logs.checks import in_order
from magbridge.logs.clocks import BETWEEN_RUNS_S
from magbridge.logs.deployment import deployment, same_columns, shifted, sliced, uncounted, with_notes
from magbridge.logs.fields import latest
from magbridge.wording import counted

Series = tuple[FloatArray, str, str, FloatArray]
"""Times (m,), s, name and unit of a column, and its values (m,)."""
OTHER = re.compile(r"mag[1-9]\d*_x$")
"""Name of the x axis of a numbered compass, as ``mag2_x``."""
AXIS = re.compile(r"mag([1-9]\d*)?_[xyz]$")
"""Name of an axis of any compass."""
HEALTHY = 0.5
"""Smallest fraction of healthy samples of a compass that is fit for use."""
COMPASSES_ATTRIBUTE = "compasses"


class LogCompass(msgspec.Struct, frozen=True, omit_defaults=True):
    """Description of one compass in a log."""

    number: int
    """Number in the log, from 0; the option ``--compass`` accepts it."""
    samples: int
    rate: float
    """Median rate, Hz."""
    id: str = ""
    """Device id or topic, which ``--compass`` also accepts; empty if the log does not state it."""
    enabled: bool | None = None
    """True if the vehicle's settings allow its use; None if the log does not say."""
    healthy: float | None = None
    """Fraction of the samples that the vehicle found healthy; None if the log does not say."""
    priority: int | None = None
    """Priority set in the vehicle: in ArduPilot 1 is the first, in PX4 100 is the highest."""
    in_use: bool = False
    """True if the log states that the vehicle used this compass."""
    chosen: bool = False
    """True if this compass is ``mag_x mag_y mag_z`` of the deployment."""

    @property
    def fit(self) -> bool:
        """Return True if the log states no reason against the use of the compass."""
        return self.enabled is not False and (self.healthy is None or self.healthy >= HEALTHY)

    @property
    def words(self) -> str:
        """Return a short description of the compass."""
        facts = [f"id {self.id}"] if self.id else []
        facts.append(f"{self.rate:.3g} Hz, {counted(self.samples, 'sample')}")
        facts += ["disabled"] if self.enabled is False else []
        facts += [f"healthy in {self.healthy:.0%}"] if self.healthy is not None and self.healthy < 1 else []
        facts += [f"priority {self.priority}"] if self.priority is not None else []
        facts += ["in use"] if self.in_use else []
        return f"compass {self.number}: {', '.join(facts)}"


class Magnetometer(NamedTuple):
    """Samples of one magnetometer."""

    compass: LogCompass
    time: FloatArray
    """(n,): Times on the log's clock, s."""
    field: Mapping[str, FloatArray]
    """Field by axis (``x``, ``y``, ``z``), (n,) each, nT."""


def sampled(number: int, time: FloatArray, axes: FloatArray, **facts: Any) -> Magnetometer:
    """Return a magnetometer sampled at `time` (n,), s, with `axes` (3, n), nT; `facts` describe it."""
    compass = LogCompass(number, len(time), rate(time), **facts)
    return Magnetometer(compass, time, dict(zip("xyz", axes, strict=True)))


def symmetric(diagonal: Sequence[float], off_diagonal: Sequence[float]) -> FloatArray:
    """Return a symmetric matrix (3, 3) from its elements xx, yy, zz and xy, xz, yz."""
    x, y, z = diagonal
    xy, xz, yz = off_diagonal
    return np.array([[x, xy, xz], [xy, y, yz], [xz, yz, z]])


class BootRun(NamedTuple):
    """Records between one boot and the next."""

    magnetometers: list[Magnetometer]
    """Magnetometers of the run, at least one."""
    telemetry: Iterable[Series]
    """Other columns; of several with the same name, the first is used."""
    offset: float | None
    """UTC minus the log's time, s; None if UTC is not known."""


def rate(time: Sequence[float] | np.ndarray[Any, Any]) -> float:
    """Return the median rate, Hz, of times (n,), s; 0 for fewer than two times."""
    steps = np.diff(np.asarray(time, dtype=np.float64))
    steps = steps[steps > 0]
    return float(1 / np.median(steps)) if len(steps) else 0.0


def choose(path: Path, found: Sequence[LogCompass], wanted: str | None) -> list[LogCompass]:
    """Return the compasses with one marked as chosen: the compass with the number or id `wanted`.

    If `wanted` is None, prefer an enabled and healthy compass, then the compass in use, then the first.
    FormatError: no compass has this number or id.
    """
    if wanted is None:
        best = min(found, key=lambda one: (not one.fit, not one.in_use, one.number))
    else:
        named = [one for one in found if wanted in (str(one.number), one.id)]
        if not named:
            there = "; ".join(one.words for one in found)
            raise FormatError(path, f"expected a compass {wanted!r}; there are: {there}")
        best = named[0]
    return [msgspec.structs.replace(one, chosen=one is best) for one in found]


def compass_notes(found: Sequence[LogCompass], wanted: str | None) -> list[str]:
    """Return notes for the user: which of several compasses was chosen, and whether it is unfit for use."""
    best = next(one for one in found if one.chosen)
    words = []
    if wanted is None and len(found) > 1:
        others = ", ".join(one.words for one in found if one is not best)
        words.append(f"{best.words} is read, of {len(found)} (--compass chooses another): {others}")
    if not best.fit:
        words.append(f"{best.words}: the log says that it was not fit for use")
    return words


def listed(found: Sequence[LogCompass]) -> dict[str, str]:
    """Return the attribute of a deployment that lists its compasses as JSON."""
    return {COMPASSES_ATTRIBUTE: msgspec.json.encode(found).decode()}


def by_columns(deployment: xr.Dataset, wanted: str | None) -> xr.Dataset:
    """Return the deployment with compass `wanted` as ``mag_x mag_y mag_z``: ``mag2_x`` if `wanted` is 1.

    The rows remain at the samples of compass 0. FormatError: the deployment has no columns of the compass.
    """
    if wanted in (None, "0"):
        return deployment
    numbers = [one.number for one in _by_names(deployment)]
    if not wanted.isdecimal() or int(wanted) not in numbers:
        known = " ".join(str(number) for number in numbers)
        source = deployment.attrs.get("source", "")
        raise FormatError(source, f"expected a compass {wanted!r}; there are: {known}")
    moved = {f"mag_{axis}": f"mag1_{axis}" for axis in "xyz"}
    moved |= {f"mag{int(wanted) + 1}_{axis}": f"mag_{axis}" for axis in "xyz"}
    renamed = deployment.rename({old: new for old, new in moved.items() if old in deployment})
    for name in CHANNELS:
        if name in renamed:
            renamed[name].attrs = dict(COLUMNS[name]._asdict())
    return renamed


def further(deployment: xr.Dataset) -> xr.Dataset:
    """Return the deployment with ``mag_x mag_y mag_z`` renamed to a number above all others, at least 2."""
    found = {name: match for name in map(str, deployment.data_vars) if (match := AXIS.match(name))}
    highest = max((int(match[1] or 1) for match in found.values()), default=1)
    return deployment.rename({name: f"mag{highest + 1}_{name[-1]}" for name in CHANNELS if name in found})


def compasses_in(log: xr.Dataset) -> list[LogCompass]:
    """Return the compasses that an attribute of the deployment lists, else one for each vector of columns.

    A log of several boots lists the compasses of its first boot.
    """
    text = log.attrs.get(COMPASSES_ATTRIBUTE)
    return msgspec.json.decode(text, type=list[LogCompass]) if isinstance(text, str) else _by_names(log)


def _by_names(log: xr.Dataset) -> list[LogCompass]:
    """Return a compass for each vector in the columns: ``mag_x mag_y mag_z``, ``mag2_x ...``."""
    others = [str(name) for name in log.data_vars if OTHER.match(str(name))]
    prefixes = {0: "mag", **{int(name[3:-2]) - 1: name[:-2] for name in others}}
    found = []
    for number, prefix in sorted(prefixes.items()):
        names = [f"{prefix}_{axis}" for axis in "xyz"]
        if all(name in log for name in names):
            known = log["time"].to_numpy()[log[names[0]].notnull().to_numpy()]
            found.append(LogCompass(number, len(known), rate(known), chosen=not number))
    return found


def pieces(
    path: Path,
    rows: int,
    runs: Sequence[BootRun],
    attrs: Mapping[str, Any],
    notes: Sequence[str],
    compass: str | None = None,
) -> Iterator[xr.Dataset]:
    """Yield the log run by run in pieces of at most `rows` rows; the first has `notes` and counts in `attrs`.

    If some runs have UTC, runs without UTC are left out, and their rows are counted as dropped.
    """
    dated = [run for run in runs if run.offset is not None]
    chosen = choose(path, [one.compass for one in runs[0].magnetometers], compass)
    attrs = {**attrs, **listed(chosen), **({} if dated else {"time_reference": "boot"})}
    notes = [*notes, *compass_notes(chosen, compass)]
    if len(runs) > 1:
        notes.append(f"{len(runs)} boots, each a run of its own")
    if dated and len(dated) < len(runs):
        lost = sum(len(run.magnetometers[0].time) for run in runs if run.offset is None)
        attrs["rows_dropped"] = attrs.get("rows_dropped", 0) + lost
        notes.append(f"{len(runs) - len(dated)} of them without GPS time are left out: they have no date")
    own = next(one for one in chosen if one.chosen)
    found = [_assembled(path, run, own) for run in dated or runs]
    notes += _one_after_the_other(found)
    columns = {str(name): dict(one.attrs) for data in found for name, one in data.data_vars.items()}
    for k, data in enumerate(found):
        whole = with_notes(same_columns(data, columns).assign_attrs(attrs), notes)
        yield from sliced(uncounted(whole) if k else whole, rows)


def _assembled(path: Path, run: BootRun, wanted: LogCompass) -> xr.Dataset:
    """Return a run as a deployment at the samples of compass `wanted`, or of another if the run lacks it."""
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
    """Shift runs that begin before the previous run ends, in place; return a note for each shifted run."""
    notes, ended = [], -inf
    for k, run in enumerate(runs):
        time = run["time"].values
        kept = time[in_order(time)]
        if len(kept) and kept[0] <= ended:
            later = ended + BETWEEN_RUNS_S - float(kept[0])
            runs[k] = shifted(run, later)
            why = "begins by its own clock before the end of the last"
            notes.append(f"boot {k + 1} {why}: moved by {later:.0f} s")
        if len(kept):
            ended = float(runs[k]["time"].values[in_order(time)][-1])
    return notes
