"""The magnetic columns of a text file that does not state their units, or calls the total field otherwise."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from magbridge.arrays import FloatArray
from magbridge.columns import CHANNELS, COLUMNS, FURTHER_AXIS, NT_PER_UNIT, usual
from magbridge.logs.headings import bare

if TYPE_CHECKING:
    from magbridge.logs.layout import Layout

__all__ = ["READING_RANGE_NT", "find_total", "units_of_angles", "units_of_axes"]

READING_RANGE_NT = 15_000.0, 90_000.0
"""nT, within which the Earth's field lies, with a vehicle's own."""
TOTAL_NAME = re.compile(
    "f|nt|mag|tm[fi]|field(mag1?)?|(mag|b)total|magtot1?|total(magnetic)?(field|intensity)|magneticfield"
    "|reading1|scalar.*|magnitude"
)
"""What the one column of a scalar magnetometer is called, with neither capitals nor punctuation."""


SCALAR_NAME = re.compile("tm[fi]|total(magnetic)?intensity|scalar.*")
"""Names of a scalar sensor next to a vector, whose length may be there under the other names."""
ANGLES = "roll", "pitch", "heading"
NEAR_HALF_TURN_RAD = 0.1
"""Largest distance, rad, of the extreme heading from half a turn or a whole turn, to be in rad."""


def units_of_angles(found: Layout, rows: Sequence[Sequence[str]]) -> None:
    """Find the unit of an attitude whose unit the file does not state: rad, if headings end at a turn.

    Headings in rad that cover half a circle end just below pi or 2 pi.
    """
    names = [name for name in ANGLES if name in found.names and name not in found.units]
    if "heading" not in names:
        return
    values = {name: _numbers(found, rows, found.names.index(name)) for name in names}
    heading = values["heading"]
    if len(heading) < 3 or any(np.abs(one).max(initial=0.0) > 2.0 * np.pi + 1e-3 for one in values.values()):
        return
    largest = float(np.abs(heading).max())
    ends = [end - NEAR_HALF_TURN_RAD < largest < end + 1e-3 for end in (np.pi, 2.0 * np.pi)]
    if any(ends) and np.ptp(heading) > np.pi:
        found.units |= dict.fromkeys(names, "rad")
        found.guesses.append(f"{', '.join(names)} in rad, since headings end at {largest:.4g}")


def units_of_axes(found: Layout, rows: Sequence[Sequence[str]]) -> None:
    """Find the unit of the axes where the file does not state it: one that has it, or the field's length."""
    undeclared = found.foreign and not set(CHANNELS) & set(found.declared.columns)
    if not undeclared or not set(CHANNELS) <= set(found.names):
        return
    stated = {found.units.get(name, "") for name in CHANNELS}
    if stated == {""}:
        unit = _unit_by_length(found, rows)
        if unit:
            found.guesses.append(f"mag_x, mag_y, mag_z in {unit}, by the field's length")
    elif len(stated) == 2 and "" in stated:
        unit = max(stated)
        found.guesses.append(f"mag_x, mag_y, mag_z all in {unit}")
    else:
        return
    if unit:
        further = [name for name in found.names if FURTHER_AXIS.fullmatch(name) and name not in found.units]
        found.units |= dict.fromkeys([*CHANNELS, *further], unit)


def _unit_by_length(found: Layout, rows: Sequence[Sequence[str]]) -> str:
    """Return the unit in which the field has the length of the Earth's; "" for nT, or where there is none."""
    length = _length(found, rows, [found.names.index(name) for name in CHANNELS])
    if READING_RANGE_NT[0] < length < READING_RANGE_NT[1]:
        return ""
    factors = ((unit, factor) for unit, factor in NT_PER_UNIT.items() if unit != "nT")
    return next(
        (unit for unit, factor in factors if READING_RANGE_NT[0] < length * factor < READING_RANGE_NT[1]), ""
    )


def find_total(found: Layout, rows: Sequence[Sequence[str]]) -> None:
    """Find a scalar magnetometer's column: the only one of its kind, and as large as the Earth's field."""
    if not found.foreign or "total_field" in found.names:
        return
    has_vector = set(CHANNELS) <= set(found.names)
    pattern = SCALAR_NAME if has_vector else TOTAL_NAME
    fields = [
        k for k, name in enumerate(found.names) if pattern.fullmatch(bare(name)) and name not in COLUMNS
    ]
    if len(fields) == 1:
        name = found.names[fields[0]]
        factor = NT_PER_UNIT.get(usual(found.units.get(name, "nT")), 0.0)
        if READING_RANGE_NT[0] < _length(found, rows, fields) * factor < READING_RANGE_NT[1]:
            found.names[fields[0]] = "total_field"
            found.units["total_field"] = found.units.pop(name, "nT")
            found.guesses.append(f"total_field is {found.headings[fields[0]]!r}")


def _numbers(found: Layout, rows: Sequence[Sequence[str]], place: int) -> FloatArray:
    """Return the numbers (m,) in one column, without cells that are none."""
    texts = [
        row[place].replace(",", ".") if found.decimal == "," else row[place]
        for row in rows
        if place < len(row)
    ]
    numbers = np.asarray(pd.to_numeric(pd.Series(texts, dtype="str"), errors="coerce"), np.float64)
    return numbers[np.isfinite(numbers)]


def _length(found: Layout, rows: Sequence[Sequence[str]], places: Sequence[int]) -> float:
    """Return the median length of the vector that stands in some columns; 0 without numbers."""
    lengths = []
    for row in rows:
        try:
            texts = (row[k].replace(",", ".") if found.decimal == "," else row[k] for k in places)
            lengths.append(float(np.linalg.norm([float(text) for text in texts])))
        except (ValueError, IndexError):
            continue
    return float(np.median(lengths)) if lengths else 0.0
