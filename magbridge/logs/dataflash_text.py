"""ArduPilot's log as text, a record a line (``.log``), as Mission Planner and ``mavlogdump.py`` write it.

``FMT`` lines describe the others as in the binary log; values are already in the unit of the field. Lines
without a record are counted.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from magbridge.logs.dataflash import Flash, Records, number_of

__all__ = ["read_text"]

TEXT_TYPES = frozenset("nNZaM")


def read_text(path: Path, wanted: Mapping[str, Collection[str]]) -> Flash:
    """Return the records of the `wanted` kinds, and of each the wanted fields."""
    described: dict[str, tuple[str, tuple[str, ...]]] = {}
    lines: dict[str, list[list[str]]] = {}
    at: dict[str, list[int]] = {}
    skipped = 0
    with path.open(encoding="latin-1", newline="\n") as file:
        for k, line in enumerate(file):
            parts = [part.strip() for part in line.split(",")]
            if parts[0] == "FMT" and len(parts) > 5:
                described[parts[3]] = parts[4], tuple(parts[5:])
            elif parts[0] not in described:
                skipped += parts != [""]
            elif parts[0] in wanted:
                if len(parts) - 1 == len(described[parts[0]][1]):
                    lines.setdefault(parts[0], []).append(parts[1:])
                    at.setdefault(parts[0], []).append(k)
                else:
                    skipped += 1
    records: dict[str, Records] = {}
    kept: dict[tuple[str, str], str] = {}
    for name, rows in lines.items():
        letters, columns = described[name]

        kept |= {(name, one): letter for one, letter in zip(columns, letters, strict=False)}
        records[name] = _records(at[name], rows, letters, columns, wanted[name])
    return Flash(records, kept, skipped)


def _records(
    at: list[int], rows: list[list[str]], letters: str, columns: tuple[str, ...], wanted: Collection[str]
) -> Records:
    fields, texts = {}, {}
    for name, letter, values in zip(columns, letters, zip(*rows, strict=True), strict=False):
        if name in wanted and letter in TEXT_TYPES:
            texts[name] = list(values)
        elif name in wanted:
            try:
                fields[name] = np.array(values, dtype=np.float64)
            except ValueError:  # one of them is damaged
                fields[name] = np.array([number_of(value) for value in values])
    return Records(np.array(at, dtype=np.intp), fields, texts)
