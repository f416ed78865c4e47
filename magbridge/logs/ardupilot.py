"""ArduPilot's own logs (``.BIN``): records that describe themselves.

A row is a sample of the first magnetometer that the log has; every other column is the last value before it. The log
holds the field after the autopilot's offsets and motor compensation; both are in it too and are taken off again, so
``mag_x`` is the raw channel (mG, so steps of 100 nT). Scale factors in ``COMPASS_DIA`` and ``COMPASS_ODI`` are not.

Time is UTC once the log has a GPS fix; a log without one counts from the boot, and says so in the attribute
``time_reference = "boot"``. What is damaged is passed over and counted in ``bytes_skipped``.

References
----------
ArduPilot, libraries/AP_Logger/LogStructure.h: the head (0xA3 0x95, type), FMT and the format letters.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from struct import Struct
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magbridge.errors import FormatError
from magbridge.logs.deployment import deployment, increasing, sliced
from magbridge.logs.resample import latest

__all__ = ["chunks"]

Floats = NDArray[np.float64]
Table = NDArray[np.void]

HEAD = b"\xa3\x95"
FMT = 0x80
FMT_BODY = Struct("<BB4s16s64s")
LETTERS = {
    "a": "V64", "b": "i1", "B": "u1", "h": "i2", "H": "u2", "i": "i4", "I": "u4", "f": "f4", "d": "f8", "g": "f2",
    "n": "S4", "N": "S16", "Z": "S64", "c": "i2", "C": "u2", "e": "i4", "E": "u4", "L": "i4", "M": "u1", "q": "i8",
    "Q": "u8",
}  # fmt: skip
SCALES = {"c": 0.01, "C": 0.01, "e": 0.01, "E": 0.01, "L": 1e-7}
NT_PER_MG = 100.0
MAX_AGE = 30.0
"""s; an older value is not carried to a row."""
FIELDS: dict[str, tuple[tuple[str, str, str, float], ...]] = {
    # record: (column, field, unit, factor); '#' is the number of the instance where it is not the first
    "ATT": (("roll", "Roll", "deg", 1.0), ("pitch", "Pitch", "deg", 1.0), ("heading", "Yaw", "deg", 1.0)),
    "POS": (
        ("latitude", "Lat", "deg", 1.0),
        ("longitude", "Lng", "deg", 1.0),
        ("depth", "RelHomeAlt", "m", -1.0),
    ),
    "GPS": (("latitude", "Lat", "deg", 1.0), ("longitude", "Lng", "deg", 1.0)),
    "CTUN": (("depth", "Alt", "m", -1.0),),
    "BAT": (("battery#_current", "Curr", "A", 1.0), ("battery#_voltage", "Volt", "V", 1.0)),
    "BARO": (("pressure#", "Press", "hPa", 0.01), ("pressure#_temperature", "Temp", "degC", 1.0)),
    "ESC": (("esc#_current", "Curr", "A", 1.0),),
    "IMU": (("imu#_temperature", "T", "degC", 1.0),),
    "RCOU": tuple((f"servo{k}", f"C{k}", "us", 1.0) for k in range(1, 15)),
}
INSTANCE = ("I", "Instance")
EPOCH_GPS = 315_964_800
WEEK = 604_800
LEAP = ((1_483_228_800, 18), (1_435_708_800, 17), (1_341_100_800, 16), (0, 15))
"""From this UTC on, by so many s GPS time is ahead."""


class Format(NamedTuple):
    """One kind of record."""

    name: str
    size: int
    dtype: np.dtype[np.void]
    scales: dict[str, float]


def chunks(path: Path, rows: int) -> Iterator[xr.Dataset]:
    """Yield the log in pieces of at most `rows` rows; it is held whole.

    Raises
    ------
    FormatError
        No magnetometer in it.
    """
    tables, skipped = _tables(path.read_bytes())
    if not {"TimeUS", "MagX", "MagY", "MagZ"} <= tables.get("MAG", {}).keys():
        raise FormatError(path, "expected an ArduPilot log with MAG records")
    offset = _utc_offset(tables)
    mags = _instances(tables, "MAG", offset)
    first = min(mags)
    time, mag = mags.pop(first)
    keep = np.diff(time, prepend=-np.inf) > 0
    time = time[keep]
    increasing(path, time)
    columns = {name: values[keep] for name, values in _field(mag, "mag").items()}
    units = {}
    for number, (when, other) in mags.items():
        for name, values in _field(other, f"mag{number + 1}").items():
            columns[name], units[name] = latest(time, when, values, MAX_AGE), "nT"
    for record, fields in FIELDS.items():
        for number, (when, table) in _instances(tables, record, offset).items():
            for column, field, unit, factor in fields:
                name = column.replace("#", str(number + 1) if number else "")
                if field not in table or name in columns or (record == "RCOU" and not np.any(table[field])):
                    continue  # an output that is always 0 does not exist
                columns[name] = latest(time, when, table[field] * factor, MAX_AGE)
                units[name] = unit
    attrs: dict[str, Any] = {"bytes_skipped": skipped}
    if not offset:
        attrs["time_reference"] = "boot"
    yield from sliced(deployment(path, time, columns, units, attrs), rows)


def _field(mag: dict[str, Floats], prefix: str) -> dict[str, Floats]:
    """Raw channels: what the log holds, less the offsets and the motor compensation that are in it."""
    return {
        f"{prefix}_{axis.lower()}": NT_PER_MG
        * (mag[f"Mag{axis}"] - mag.get(f"Ofs{axis}", 0) - mag.get(f"MO{axis}", 0))
        for axis in "XYZ"
    }


def _instances(
    tables: dict[str, dict[str, Floats]], record: str, offset: float
) -> dict[int, tuple[Floats, dict[str, Floats]]]:
    """Time and fields of each instance of a record, also where its number is in the name (``MAG2``)."""
    found = {}
    for number, name in enumerate((record, f"{record}2", f"{record}3")):
        if (table := tables.get(name)) is None or "TimeUS" not in table:
            continue
        which = next(
            (table[field] for field in INSTANCE if field in table), np.full(len(table["TimeUS"]), number)
        )
        for k in np.unique(which):
            fields = {field: values[which == k] for field, values in table.items()}
            found[int(k)] = fields["TimeUS"] * 1e-6 + offset, fields
    return found


def _utc_offset(tables: dict[str, dict[str, Floats]]) -> float:
    """UTC minus time since boot, from the first GPS fix; 0 without one."""
    gps = tables.get("GPS")
    if gps is None or not {"GWk", "GMS", "TimeUS"} <= gps.keys():
        return 0.0
    fixes = np.flatnonzero((gps["GWk"] > 0) & (gps.get("Status", np.full(len(gps["GWk"]), 3.0)) >= 3))
    if not len(fixes):
        return 0.0
    k = fixes[0]
    utc = EPOCH_GPS + gps["GWk"][k] * WEEK + gps["GMS"][k] * 1e-3
    leap = next(seconds for since, seconds in LEAP if utc - seconds >= since)
    return float(utc - leap - gps["TimeUS"][k] * 1e-6)


def _tables(data: bytes) -> tuple[dict[str, dict[str, Floats]], int]:
    """Return every kind of record that we use as columns, and the bytes that belonged to none."""
    wanted = {f"{name}{k}" for name in ("MAG", *FIELDS) for k in ("", "2", "3")}
    formats: dict[int, Format] = {}
    bodies: dict[int, list[bytes]] = {}
    at = skipped = 0
    while at + 3 <= len(data):
        kind = data[at + 2]
        size = FMT_BODY.size + 3 if kind == FMT else formats[kind].size if kind in formats else 0
        if data[at : at + 2] != HEAD or not size or at + size > len(data):
            following = data.find(HEAD, at + 1)
            following = len(data) if following < 0 else following
            skipped += following - at
            at = following
            continue
        body = data[at + 3 : at + size]
        if kind == FMT:
            if one := _format(body):
                formats[body[0]] = one
        elif formats[kind].name in wanted:
            bodies.setdefault(kind, []).append(body)
        at += size
    skipped += len(data) - at
    return {formats[kind].name: _columns(formats[kind], found) for kind, found in bodies.items()}, skipped


def _format(body: bytes) -> Format | None:
    """Return what a FMT record says of another kind; None where that cannot be."""
    _, size, *texts = FMT_BODY.unpack(body)
    name, letters, fields = (text.rstrip(b"\0").decode("ascii", "replace") for text in texts)
    names = fields.split(",") if fields else []
    codes = [LETTERS.get(letter) for letter in letters]
    if len(names) != len(codes) or len(set(names)) != len(names) or None in codes or "" in names:
        return None
    dtype = np.dtype(list(zip(names, codes, strict=True)))
    scales = {field: SCALES[letter] for field, letter in zip(names, letters, strict=True) if letter in SCALES}
    return Format(name, size, dtype, scales) if dtype.itemsize == size - 3 else None


def _columns(one: Format, bodies: list[bytes]) -> dict[str, Floats]:
    table = np.frombuffer(b"".join(bodies), dtype=one.dtype)
    return {
        field: table[field].astype(np.float64) * one.scales.get(field, 1.0)
        for field in one.dtype.names or ()
        if one.dtype[field].kind in "iuf"
    }
