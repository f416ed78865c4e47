"""A Seaglider's dive as the glider sends it: ``.eng`` (samples), ``.log`` (settings, manoeuvres, fixes).

Either name, or both, give the same deployment; without its ``.log`` a dive has neither masses nor position.
Between the fixes before and after the dive the position goes straight. See :mod:`magbridge.logs.seaglider`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import xarray as xr

from magbridge.errors import FormatError
from magbridge.logs.deployment import sliced
from magbridge.logs.resample import degrees
from magbridge.logs.seaglider import Dive, dive

__all__ = ["chunks"]

HEADER_LINE = re.compile(r"%?(\w+):\s*(.*)")
GPS_LINE = re.compile(r"\$GPS\d?,(\d{6}),(\d{6}),(-?\d+\.\d+),(-?\d+\.\d+)")


def chunks(path: Path, rows: int) -> Iterator[xr.Dataset]:
    """Yield the dive in pieces of at most `rows` rows.

    FormatError: no samples, or no magnetometer among them.
    """
    samples, log = path.with_suffix(".eng"), path.with_suffix(".log")
    if not samples.is_file():
        raise FormatError(path, f"expected {samples.name}, the samples of this dive, in the same folder")
    known = _samples(samples)
    if log.is_file():
        _add_log(known, log)
    yield from sliced(dive(path, known), rows)


def _samples(path: Path) -> Dive:
    """Return what the ``.eng`` holds."""
    header, rows = _split(path)
    names = re.split(r"[,\s]+", header.get("columns", "").replace(".", "_").strip())
    start = _start(path, header)
    width = len(names)
    whole = [fields for fields in (line.split() for line in rows) if len(fields) == width]
    try:
        table = np.array(whole, float).reshape(-1, width).T
    except ValueError as error:
        raise FormatError(path, f"expected numbers: {error}") from None
    sampled = dict(zip(names, table, strict=True))
    if "elaps_t" not in sampled or not table.shape[1]:
        raise FormatError(path, "expected rows with elaps_t, as of a Seaglider's samples")
    if "depth" in sampled:
        sampled["depth"] = sampled["depth"] * 0.01  # cm
    return Dive(start + sampled["elaps_t"], sampled, max_gap=np.inf)


def _add_log(known: Dive, path: Path) -> None:
    """Add what the ``.log`` holds: parameters, manoeuvres (s from the start of the dive), fixes."""
    header, rows = _split(path)
    start = _start(path, header)
    names: list[str] = []
    manoeuvres: list[list[float]] = []
    fixes: list[tuple[float, float, float]] = []
    for line in rows:
        name, *values = line.strip().lstrip("$").split(",")
        if name == "GCHEAD":
            names = values
        elif name == "GC" and len(values) == len(names):
            manoeuvres.append([_number(value) for value in values])
        elif found := GPS_LINE.match(line):
            when = datetime.strptime(found[1] + found[2], "%d%m%y%H%M%S").replace(tzinfo=UTC).timestamp()
            fixes.append((when, *degrees([found[3], found[4]])))
        elif len(values) in (1, 2):  # a canonical log also has the default
            known.settings[name] = _number(values[0])
    known.manoeuvres = dict(zip(names, np.array(manoeuvres, float).reshape(-1, len(names)).T, strict=True))
    for name in {"st_secs", "end_secs"} & known.manoeuvres.keys():
        known.manoeuvres[name] += start
    if fixes:
        when, latitude, longitude = np.array(sorted(fixes)).T
        known.elsewhere = {"latitude": (when, latitude), "longitude": (when, longitude)}


def _split(path: Path) -> tuple[dict[str, str], list[str]]:
    """Return the header of a file, and the lines after it."""
    lines = path.read_text(encoding="ascii", errors="replace").splitlines()
    ends = next((k for k, line in enumerate(lines) if line.lstrip("%").startswith("data:")), len(lines))
    header = {found[1]: found[2] for line in lines[:ends] if (found := HEADER_LINE.match(line))}
    return header, lines[ends + 1 :]


def _start(path: Path, header: dict[str, str]) -> float:
    """Return the s since 1970 of ``start: 02 03 126 19 35 52``, month day year-1900 hour minute second."""
    try:
        month, day, year, hour, minute, second = (int(part) for part in header["start"].split())
        return datetime(1900 + year, month, day, hour, minute, second, tzinfo=UTC).timestamp()
    except (KeyError, ValueError):
        raise FormatError(path, "expected its start, as of a Seaglider's dive", column="start") from None


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")
