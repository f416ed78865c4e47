"""ArduPilot's own logs (``.BIN``), through pymavlink.

The log holds the field with the autopilot's offsets and motor compensation applied; these are in the log,
too, and are subtracted again, so ``mag_x`` is the raw channel (mG, so steps of 100 nT). The scale factors in
``COMPASS_DIA`` and ``COMPASS_ODI`` are not undone.

UTC is that of the first GPS fix. Damaged bytes are skipped and counted in ``bytes_skipped``.

References
----------
ArduPilot, "Onboard Message Log Messages", https://ardupilot.org/copter/docs/logmessages.html
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout, suppress
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.columns import NT_PER_UNIT
from magbridge.errors import FormatError, MissingExtra
from magbridge.logs.autopilot import Fields, pieces, values_of

__all__ = ["chunks"]

Table = dict[str, FloatArray]
Tables = dict[str, Table]

FIELDS: Fields = {
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
"""UTC (s) from which GPS time is ahead of UTC by this many s."""


KINDS = {f"{name}{k}" for name in ("MAG", *FIELDS) for k in ("", "2", "3")}
COLUMNS = {
    *("TimeUS", "GWk", "GMS", "Status", *INSTANCE),
    *(f"{what}{axis}" for what in ("Mag", "Ofs", "MO") for axis in "XYZ"),
    *(field for fields in FIELDS.values() for _, field, _, _ in fields),
}
NUMBERS = (int, float)
DAMAGE = (AttributeError, LookupError, RecursionError, TypeError, ValueError, struct.error)
"""What pymavlink raises where a record, or its FMT record, is damaged."""


def chunks(path: Path, rows: int) -> Iterator[xr.Dataset]:
    """Yield the log in pieces of at most `rows` rows; it is held whole.

    Raises
    ------
    FormatError
        No magnetometer in it.
    """
    tables, skipped = _tables(path)
    mags = {
        number: (time, _field(mag))
        for number, (time, mag) in _instances(tables, "MAG").items()
        if {"MagX", "MagY", "MagZ"} <= mag.keys()
    }
    if not mags:
        raise FormatError(path, "expected an ArduPilot log with MAG records")
    yield from pieces(path, rows, _utc_offset(tables), mags, _telemetry(tables), {"bytes_skipped": skipped})


def _telemetry(tables: Tables) -> Iterator[tuple[FloatArray, str, str, FloatArray]]:
    """Yield times, column, unit and values of everything but the magnetometers."""
    for record in FIELDS:
        for number, (time, table) in _instances(tables, record).items():
            for column, unit, values in values_of(FIELDS, record, number, table):
                if record != "RCOU" or np.any(values):  # an output that is always 0 is not in use
                    yield time, column, unit, values


def _field(mag: Table) -> Table:
    """Return the raw channels in nT: the logged field less the offsets and the motor compensation."""
    return {
        axis.lower(): NT_PER_UNIT["mG"]
        * (mag[f"Mag{axis}"] - mag.get(f"Ofs{axis}", 0) - mag.get(f"MO{axis}", 0))
        for axis in "XYZ"
    }


def _instances(tables: Tables, record: str) -> dict[int, tuple[FloatArray, Table]]:
    """Return time and fields of each instance of a record, also if its number is in the name (``MAG2``)."""
    found = {}
    for number, name in enumerate((record, f"{record}2", f"{record}3")):
        if (table := tables.get(name)) is None or "TimeUS" not in table:
            continue
        which = next(
            (table[field] for field in INSTANCE if field in table), np.full(len(table["TimeUS"]), number)
        )
        for k in np.unique(which[np.isfinite(which)]):
            fields = {field: values[which == k] for field, values in table.items()}
            found[int(k)] = fields["TimeUS"] * 1e-6, fields
    return found


def _utc_offset(tables: Tables) -> float:
    """Return UTC minus time since boot in s, from the first GPS fix; 0 without one."""
    gps = tables.get("GPS")
    if gps is None or not {"GWk", "GMS", "TimeUS"} <= gps.keys():
        return 0.0
    fixes = np.flatnonzero((gps["GWk"] > 0) & (gps.get("Status", np.full(len(gps["GWk"]), 3.0)) >= 3))
    if not len(fixes):
        return 0.0
    k = fixes[0]
    utc = EPOCH_GPS + gps["GWk"][k] * WEEK + gps["GMS"][k] * 1e-3
    leap = next((seconds for since, seconds in LEAP if utc - seconds >= since), 0)
    return float(utc - leap - gps["TimeUS"][k] * 1e-6)


def _tables(path: Path) -> tuple[Tables, int]:
    """Return every kind of record that we use as columns, and the bytes that belonged to no record."""
    try:
        from pymavlink.DFReader import DFReader_binary  # noqa: PLC0415 - a slow import
    except ImportError:
        raise MissingExtra("pymavlink", "analysis") from None

    class Reader(DFReader_binary):  # type: ignore[misc]  # pymavlink is untyped
        """Reads record by record: an index would stop at an unknown record, and might never end on damage."""

        def init_arrays(self, progress_callback: object = None) -> None:
            pass

        init_arrays_fast = init_clock = init_arrays

    tables: dict[str, dict[str, array[float]]] = {}
    with redirect_stdout(None), redirect_stderr(None), Reader(str(path)) as log:
        skipped = log.data_len
        while (at := log.offset) < log.data_len - 2:
            with suppress(*DAMAGE):
                if record := log.recv_msg():
                    skipped -= record.fmt.len
                    if record.fmt.name in KINDS:
                        _add(tables.setdefault(record.fmt.name, {}), record)
            log.offset = max(log.offset, at + 3)  # a damaged FMT may give records the length 0
    return {
        name: {field: np.array(table[field]) for field in table} for name, table in tables.items()
    }, skipped


def _add(table: dict[str, array[float]], record: Any) -> None:
    """Append the numbers of a record; one that lacks a field of those before it counts as damaged."""
    kinds = zip(record.fmt.columns, record.fmt.msg_types, strict=False)
    row = {name: float(getattr(record, name)) for name, kind in kinds if name in COLUMNS and kind in NUMBERS}
    if not table:
        table.update((name, array("d")) for name in row)
    for column, value in zip(table.values(), [row[name] for name in table], strict=True):
        column.append(value)
