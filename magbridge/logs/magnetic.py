"""The magnetic columns of a text file that does not state their units, or calls the total field otherwise."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from magbridge.columns import CHANNELS, COLUMNS, NT_PER_UNIT, usual
from magbridge.logs.headings import bare

if TYPE_CHECKING:
    from magbridge.logs.layout import Layout

__all__ = ["EARTHS", "find_total", "units_of_axes"]

EARTHS = 15_000.0, 90_000.0
"""nT, within which the Earth's field lies, with a vehicle's own."""
TOTAL = re.compile(
    "f|nt|mag|tm[fi]|field|(mag|b)total|total(magnetic)?(field|intensity)|reading1|scalar.*|magnitude"
)
"""What the one column of a scalar magnetometer is called, with neither capitals nor punctuation."""


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
        found.units |= dict.fromkeys(CHANNELS, unit)


def _unit_by_length(found: Layout, rows: Sequence[Sequence[str]]) -> str:
    """Return the unit in which the field has the length of the Earth's; "" for nT, or where there is none."""
    length = _length(found, rows, [found.names.index(name) for name in CHANNELS])
    if EARTHS[0] < length < EARTHS[1]:
        return ""
    factors = ((unit, factor) for unit, factor in NT_PER_UNIT.items() if unit != "nT")
    return next((unit for unit, factor in factors if EARTHS[0] < length * factor < EARTHS[1]), "")


def find_total(found: Layout, rows: Sequence[Sequence[str]]) -> None:
    """Find a scalar magnetometer's column: the only one of its kind, and as large as the Earth's field."""
    if not found.foreign or {*CHANNELS, "total_field"} & {*found.names}:
        return
    fields = [k for k, name in enumerate(found.names) if TOTAL.fullmatch(bare(name)) and name not in COLUMNS]
    if len(fields) == 1:
        name = found.names[fields[0]]
        factor = NT_PER_UNIT.get(usual(found.units.get(name, "nT")), 0.0)
        if EARTHS[0] < _length(found, rows, fields) * factor < EARTHS[1]:
            found.names[fields[0]] = "total_field"
            found.units["total_field"] = found.units.pop(name, "nT")
            found.guesses.append(f"total_field is {found.headings[fields[0]]!r}")


def _length(found: Layout, rows: Sequence[Sequence[str]], places: Sequence[int]) -> float:
    """Return the median length of the vector that stands in some columns; 0 where there are no numbers."""
    lengths = []
    for row in rows:
        try:
            texts = (row[k].replace(",", ".") if found.decimal == "," else row[k] for k in places)
            lengths.append(float(np.linalg.norm([float(text) for text in texts])))
        except (ValueError, IndexError):
            continue
    return float(np.median(lengths)) if lengths else 0.0
