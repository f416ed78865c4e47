"""The compasses of a log, their descriptions, and the choice of the one that is read as ``mag_x``.

A log tells which compass was in use by the vehicle's settings and by its state: the one that the estimator
names, that is enabled and healthy. Unless the user asks for another, this one becomes ``mag_x``, ``mag_y``,
``mag_z``; the others keep their number, as in ``mag2_x`` of the second.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import xarray as xr

from magbridge.columns import CHANNELS, COLUMNS
from magbridge.errors import FormatError
from magbridge.wording import counted

__all__ = [
    "COMPASSES_ATTRIBUTE", "HEALTHY", "LogCompass", "by_columns", "choose", "compass_notes", "compasses_in",
    "compasses_of", "further", "listed", "rate",
]  # fmt: skip

OTHER = re.compile(r"mag[1-9]\d*_x$")
"""Name of the first axis of another compass than the first."""
AXIS = re.compile(r"mag([1-9]\d*)?_[xyz]$")
"""Name of an axis of any compass."""
HEALTHY = 0.5
"""Least share of its samples in which a compass in use is healthy."""
COMPASSES_ATTRIBUTE = "compasses"


class LogCompass(msgspec.Struct, frozen=True, omit_defaults=True):
    """One compass of a log."""

    number: int
    """From 0, as the log counts; the option ``--compass`` takes it."""
    samples: int
    rate: float
    """Median rate, Hz."""
    id: str = ""
    """The device's id or topic; the option takes it, too. Empty where the log does not say."""
    enabled: bool | None = None
    """True if the vehicle's settings allow its use; None if the log does not say."""
    healthy: float | None = None
    """Share of its samples that the vehicle found healthy."""
    priority: int | None = None
    """The vehicle's own: of ArduPilot 1 is the first, of PX4 100 the highest."""
    in_use: bool = False
    """The log says that the vehicle used this one."""
    chosen: bool = False
    """It is ``mag_x`` of the deployment."""

    @property
    def fit(self) -> bool:
        """Return True if the log states no reason against the use of the compass."""
        return self.enabled is not False and (self.healthy is None or self.healthy >= HEALTHY)

    @property
    def words(self) -> str:
        """Short description of the compass."""
        facts = [f"id {self.id}"] if self.id else []
        facts.append(f"{self.rate:.3g} Hz, {counted(self.samples, 'sample')}")
        facts += ["disabled"] if self.enabled is False else []
        facts += [f"healthy in {self.healthy:.0%}"] if self.healthy is not None and self.healthy < 1 else []
        facts += [f"priority {self.priority}"] if self.priority is not None else []
        facts += ["in use"] if self.in_use else []
        return f"compass {self.number}: {', '.join(facts)}"


def rate(time: Sequence[float] | np.ndarray[Any, Any]) -> float:
    """Return the median rate, Hz, of times in s; 0 of fewer than two."""
    steps = np.diff(np.asarray(time, dtype=np.float64))
    steps = steps[steps > 0]
    return float(1 / np.median(steps)) if len(steps) else 0.0


def choose(path: Path, found: Sequence[LogCompass], wanted: str | None) -> list[LogCompass]:
    """Return the compasses with one marked as chosen.

    Parameters
    ----------
    path : path
        Named in the error.
    found : sequence of LogCompass
        At least one.
    wanted : str or None
        A number or an id; None: the one in use, else the first that is enabled and healthy.

    Raises
    ------
    FormatError
        No compass has that number or id.
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
    """Return notes on the choice: which compass was chosen of which, and reasons against it."""
    best = next(one for one in found if one.chosen)
    words = []
    if wanted is None and len(found) > 1:
        others = ", ".join(one.words for one in found if one is not best)
        words.append(f"{best.words} is read, of {len(found)} (--compass chooses another): {others}")
    if not best.fit:
        words.append(f"{best.words}: the log says that it was not fit for use")
    return words


def listed(found: Sequence[LogCompass]) -> dict[str, str]:
    """Return the attribute of a deployment that holds its compasses; none where there is only one unnamed."""
    return {COMPASSES_ATTRIBUTE: msgspec.json.encode(found).decode()}


def by_columns(deployment: xr.Dataset, wanted: str | None) -> xr.Dataset:
    """Return a deployment whose ``mag_x`` is another of its columns, as ``mag2_x`` for the compass 1.

    For formats that know columns, but no compasses: the rows stay those of the first.

    FormatError: there are no such columns.
    """
    if wanted in (None, "0"):
        return deployment
    numbers = [one.number for one in _by_names(deployment)]
    if not wanted.isdecimal() or int(wanted) not in numbers:
        known = " ".join(str(number) for number in numbers)
        raise FormatError(
            deployment.attrs.get("source", ""), f"expected a compass {wanted!r}; there are: {known}"
        )
    moved = {f"mag_{axis}": f"mag1_{axis}" for axis in "xyz"}
    moved |= {f"mag{int(wanted) + 1}_{axis}": f"mag_{axis}" for axis in "xyz"}
    renamed = deployment.rename({old: new for old, new in moved.items() if old in deployment})
    for name in CHANNELS:
        if name in renamed:
            renamed[name].attrs = dict(COLUMNS[name]._asdict())
    return renamed


def further(deployment: xr.Dataset) -> xr.Dataset:
    """Return a deployment whose ``mag_x`` is ``mag2_x``, or has the first free number after that."""
    found = {name: match for name in map(str, deployment.data_vars) if (match := AXIS.match(name))}
    highest = max((int(match[1] or 1) for match in found.values()), default=1)
    return deployment.rename({name: f"mag{highest + 1}_{name[-1]}" for name in CHANNELS if name in found})


def compasses_in(log: xr.Dataset) -> list[LogCompass]:
    """Return the compasses of a deployment: those that it lists, or those that its columns are."""
    return compasses_of(log.attrs) or _by_names(log)


def _by_names(log: xr.Dataset) -> list[LogCompass]:
    """Return a compass for ``mag_x mag_y mag_z``, and for each ``mag2_x ...`` that is there."""
    others = [str(name) for name in log.data_vars if OTHER.match(str(name))]
    prefixes = {0: "mag", **{int(name[3:-2]) - 1: name[:-2] for name in others}}
    found = []
    for number, prefix in sorted(prefixes.items()):
        names = [f"{prefix}_{axis}" for axis in "xyz"]
        if all(name in log for name in names):
            known = log["time"].to_numpy()[log[names[0]].notnull().to_numpy()]
            found.append(LogCompass(number, len(known), rate(known), chosen=not number))
    return found


def compasses_of(attrs: Mapping[Any, Any]) -> list[LogCompass]:
    """Return the compasses that the attributes of a deployment list; none where they do not.

    A log of several boots lists those of its first.
    """
    text = attrs.get(COMPASSES_ATTRIBUTE)
    return msgspec.json.decode(text, type=list[LogCompass]) if isinstance(text, str) else []
