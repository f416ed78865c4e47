"""Read a Seaglider's dive: raw compass, attitude and the positions of the moving masses.

The source is a basestation's netCDF, or the ``.eng`` (samples) and ``.log`` (settings, manoeuvres, fixes)
that a glider sends; the two are read together by either name. Without its ``.log`` a dive has neither masses
nor position. With it, the position is interpolated between the fixes before and after the dive. Regression of
the raw counts on the IGRF, rotated by the logged attitude, verified the conventions with dives of SG167,
SG171, SG180, SG236, SG249, SG272 and SG686:

- ``mag_x/y/z`` are x forward, y starboard, z down, as in magbridge. The 3x3 matrix of the regression is the
  identity to 5 %, with few elements off the diagonal above 0.05.
- The type of the compass determines the nT per count (:data:`COMPASS_NT_PER_COUNT`). The matrix's diagonal is
  0.95 to 1.04 counts/mG for the types 1, 2 and 6, and 1.75 to 1.91 for type 4.
- ``head`` is magnetic: the file states it, and the matrix's elements between x and y then vanish. The
  attribute ``magnetic_variation_deg`` holds the declination, in steps of 0.1 deg.
- ``pitchCtl`` is in cm, ``rollCtl`` in deg, ``vbdCC`` in cc: ``(AD - centre) * CNV`` of each mass's
  potentiometer. Older firmware logs them with every sample (the formula gives SG167's to 2e-4 cm). Newer
  firmware logs them around each manoeuvre only (``gc_*``), during which the reader interpolates linearly.

Temperature, pressure, latitude and longitude of the CTD are interpolated to the compass samples. The file
holds one mean current per motor and manoeuvre: it is the value of all rows in the manoeuvre; others have 0.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.columns import CHANNELS
from magbridge.errors import FormatError
from magbridge.field.igrf import total_field
from magbridge.field.reference import sphere_radius
from magbridge.logs.deployment import deployment, sliced, with_losses
from magbridge.logs.fields import Track, degrees, field_maps, fields_of, interpolated, linear, number_of

DIMENSION = "sg_data_point"
COMPASS_NT_PER_COUNT = {1: 100.0, 2: 100.0, 4: 56.0, 6: 100.0}
"""Type of the compass -> nT per count; ``COMPASS_DEVICE`` is 16 times the type plus the port."""
SECOND_COMPASS_BIT = 2048
"""Bit of ``COMPASS_USE``: the second compass is in use."""
MAX_CTD_GAP_S = 120.0
"""Longest interval between samples of the CTD that is interpolated, s."""
# the channels are in counts here; dive() multiplies them by the nT per count
SAMPLED, CTD_FIELDS = field_maps("seaglider").values()
PLACE = "longitude", "latitude"
MASSES = {"pitchCtl": ("pitch", "C_PITCH"), "rollCtl": ("roll", "C_ROLL_DIVE"), "vbdCC": ("vbd", "C_VBD")}
"""Column -> name of its motor, and parameter that holds its centre, AD counts."""


@dataclass
class Dive:
    """Data of one dive, as the files hold them."""

    time: FloatArray
    """(n,): Times of the compass samples, s since 1970 UTC."""
    sampled: dict[str, FloatArray]
    """Engineering columns by their names in the file, (n,) each; the depth in m."""
    settings: dict[str, float] = field(default_factory=dict)
    """Parameters of the log, as ``COMPASS_DEVICE``."""
    manoeuvres: dict[str, FloatArray] = field(default_factory=dict)
    """(m,) each: Start ``st_secs``, end ``end_secs`` (s since 1970), logged values, as ``pitch_ctl``."""
    elsewhere: dict[str, Track] = field(default_factory=dict)
    """Times (k,), s, and values (k,) of variables with times of their own: positions and the CTD's data."""
    max_gap: float = MAX_CTD_GAP_S
    """Longest interval between two times in `elsewhere` that is interpolated, s."""


def dive(path: Path, known: Dive) -> xr.Dataset:
    """Return one dive as a deployment; if it lacks a raw compass, without the field and with a note."""
    raw = [name for name in CHANNELS if name in known.sampled]
    for axis in "xyz":
        if raw and f"mag_{axis}" not in raw:
            expected = "expected this variable, as of a Seaglider with a raw compass"
            raise FormatError(path, expected, column=f"eng_mag_{axis}")
    columns = {column: values for column, _, values in fields_of(SAMPLED, known.sampled)}
    units = {one.column: one.unit for one in (*SAMPLED, *CTD_FIELDS)}
    columns |= interpolated(CTD_FIELDS, known.elsewhere, known.time, known.max_gap)[0]
    for column in MASSES:
        if column not in columns and (moved := _position(known, column)) is not None:
            columns[column] = moved
    for motor, _ in MASSES.values():
        if (current := _current(known, motor)) is not None:
            columns[f"{motor}_current"], units[f"{motor}_current"] = current, "A"
    attrs: dict[str, Any] = {"heading_reference": "magnetic"}
    if raw:
        count, remarks = _count(path, known, columns)
        columns |= {name: columns[name] * count for name in raw}
        attrs["mag_scale_nT_per_count"] = count
    else:
        remarks = [f"{path}: no raw compass (eng_mag_x eng_mag_y eng_mag_z): attitude and masses are read"]
    if (declination := known.settings.get("magnetic_variation")) is not None:
        attrs["magnetic_variation_deg"] = declination
    return with_losses(deployment(path, known.time, columns, units, attrs), {}, remarks)


def _count(path: Path, known: Dive, columns: Mapping[str, FloatArray]) -> tuple[float, list[str]]:
    """Return the nT per count of the compass in use, and a note if the value is assumed or estimated.

    For an unknown type, the sphere through the counts is scaled to the total field of the IGRF.
    """
    use = known.settings.get("COMPASS_USE", 0.0)
    name = "COMPASS2_DEVICE" if np.isfinite(use) and int(use) & SECOND_COMPASS_BIT else "COMPASS_DEVICE"
    device = known.settings.get(name)
    if device is None or not np.isfinite(device):
        return COMPASS_NT_PER_COUNT[2], [f"{path}: no {name}: a count of the compass is taken as 100 nT"]
    kind = int(device) // 16
    if kind in COMPASS_NT_PER_COUNT:
        return COMPASS_NT_PER_COUNT[kind], []
    # the IGRF over the radius of the sphere through the counts
    estimated = COMPASS_NT_PER_COUNT[2]
    counts = np.column_stack([columns[f"mag_{axis}"] for axis in "xyz"])
    counts = counts[np.isfinite(counts).all(axis=1)]
    place = [columns[name][np.isfinite(columns[name])][:1] for name in PLACE if name in columns]
    if len(counts) >= 4 and sum(map(len, place)) == 2:
        estimated = float(total_field(place[0], place[1], 0.0, known.time[0])[0]) / sphere_radius(counts)
    unknown = f"{path}: {name} {int(device)} is not known: counts of unknown size"
    return estimated, [f"{unknown}, taken as {estimated:.3g} nT, with which they are as long as the field"]


def _position(known: Dive, column: str) -> FloatArray | None:
    """Return the position (n,) of a mass at each sample, measured or else commanded; None without either."""
    motor, centre = MASSES[column]
    each = known.manoeuvres
    if not {"st_secs", "end_secs"} <= each.keys():
        return None
    zero, scale = known.settings.get(centre, np.nan), known.settings.get(f"{motor.upper()}_CNV", np.nan)
    if f"{motor}_ad" in each and np.isfinite(zero) and np.isfinite(scale):
        after = (each[f"{motor}_ad"] - zero) * scale
        before = (each.get(f"{motor}_ad_start", np.roll(each[f"{motor}_ad"], 1)) - zero) * scale
    elif f"{motor}_ctl" in each:
        after = each[f"{motor}_ctl"]
        before = np.roll(after, 1)
        before[:1] = np.nan
    else:
        return None
    when = np.column_stack([each["st_secs"], each["end_secs"]]).ravel()
    where = np.column_stack([before, after]).ravel()
    order = np.argsort(when, kind="stable")
    sure = order[np.isfinite(when[order]) & np.isfinite(where[order])]
    where_it_was = linear(known.time, when[sure], where[sure], np.inf, column)
    return np.where(known.time < when[sure][:1].min(initial=np.inf), np.nan, where_it_was)


def _current(known: Dive, motor: str) -> FloatArray | None:
    """Return the mean current (A) of one motor in the manoeuvre at each sample; 0 outside manoeuvres."""
    each = known.manoeuvres
    if not {"st_secs", "end_secs", f"{motor}_i"} <= each.keys():
        return None
    current = np.zeros(len(known.time))
    for start, end, ampere in zip(each["st_secs"], each["end_secs"], each[f"{motor}_i"], strict=True):
        current[(known.time >= start) & (known.time <= end)] = ampere
    return current


HEADER_LINE = re.compile(r"%?(\w+):\s*(.*)")
GPS_LINE = re.compile(r"\$GPS\d?,(\d{6}),(\d{6}),(-?\d+\.\d+),(-?\d+\.\d+)")


def chunks(path: Path, rows: int) -> Iterator[xr.Dataset]:
    """Yield the dive in a glider's ``.eng`` and ``.log`` in pieces of at most `rows` rows."""
    samples, log = path.with_suffix(".eng"), path.with_suffix(".log")
    if not samples.is_file():
        raise FormatError(path, f"expected {samples.name}, the samples of this dive, in the same folder")
    known = _samples(samples)
    if log.is_file():
        _add_log(known, log)
    yield from sliced(dive(path, known), rows)


def _samples(path: Path) -> Dive:
    """Return a dive with the samples of its ``.eng``."""
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
    """Add the parameters, manoeuvres and fixes in a ``.log`` to the dive."""
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
            manoeuvres.append([number_of(value) for value in values])
        elif found := GPS_LINE.match(line):
            when = datetime.strptime(found[1] + found[2], "%d%m%y%H%M%S").replace(tzinfo=UTC).timestamp()
            fixes.append((when, *degrees([found[3], found[4]])))
        elif len(values) in (1, 2):  # a canonical log also states the default
            known.settings[name] = number_of(values[0])
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
    """Return the s since 1970 of ``start: 02 03 126 19 35 52`` (month, day, year - 1900, hour, min, s)."""
    try:
        month, day, year, hour, minute, second = (int(part) for part in header["start"].split())
        return datetime(1900 + year, month, day, hour, minute, second, tzinfo=UTC).timestamp()
    except (KeyError, ValueError):
        raise FormatError(path, "expected its start, as of a Seaglider's dive", column="start") from None
