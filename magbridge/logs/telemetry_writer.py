"""Write a deployment as a MAVLink telemetry log, with the messages that a bridge and an autopilot would send.

A row becomes these messages, all with its time: ``ATTITUDE`` (float32), ``GLOBAL_POSITION_INT`` (1e-7 deg,
mm), a ``NAMED_VALUE_FLOAT`` (float32) for every other column, ``MAG_RAW`` (float32 nT, µs) and, where the
deployment is corrected, ``MAG_FIELD``. A reader obtains a column to 6e-8 of its value, and time to 1 µs.
``MAG_COLUMN`` messages at the start of the log hold the full name of columns with more than ten letters,
units, and attributes that change the meaning of values.
"""

from __future__ import annotations

from collections.abc import Collection
from math import isfinite, isnan, nan, radians
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.columns import CHANNEL_TIMES, CHANNELS, CORRECTED
from magbridge.errors import WriteError
from magbridge.logs.deployment import lasting
from magbridge.mavlink import Codec, Spec, pack_record, spec
from magbridge.mavlink.enums import MAG_RAW_FLAGS
from magbridge.mavlink.messages import east_e7
from magbridge.records import Channel, Quality

VEHICLE, AUTOPILOT, BRIDGE = 1, 1, 191
ATTITUDE = ("roll", "pitch", "heading")
POSITION_COLUMNS = ("latitude", "longitude", "depth")
SAMPLE = (*CHANNELS, "sensor_temperature", "sensor_supply", "power_cycle")
STANDARD = {*ATTITUDE, *POSITION_COLUMNS, *SAMPLE, *CHANNEL_TIMES, *CORRECTED, "level_sigma"}
"""Columns that are fields of ``ATTITUDE``, ``GLOBAL_POSITION_INT``, ``MAG_RAW`` or ``MAG_FIELD``."""
ATTITUDE_, POSITION_, NAMED_, RAW_, FIELD_ = (
    spec(name) for name in ("ATTITUDE", "GLOBAL_POSITION_INT", "NAMED_VALUE_FLOAT", "MAG_RAW", "MAG_FIELD")
)
UNKNOWN_HEADING = 0xFFFF
UNKNOWN_INT = 0x7FFFFFFF
POWER_CYCLE = int(MAG_RAW_FLAGS.POWER_CYCLE)
"""Flag of MAG_RAW: the message holds a count of power cycles."""
NAMED_VALUE = {"message": "NAMED_VALUE_FLOAT", "field": "value", "scale": 1.0, "offset": 0.0}

Row = dict[str, float]


class FileWriter:
    """Writer of successive deployments with the columns of the first."""

    def __init__(self, path: Path) -> None:
        self._path, self._file = path, path.open("wb")
        self._autopilot = Codec(VEHICLE, AUTOPILOT)
        self._bridge = Codec(VEHICLE, BRIDGE)
        self._start_us = 0
        self._named: list[tuple[str, bytes]] = []
        self._sequence = 0

    def append(self, dataset: xr.Dataset, *, first: bool) -> None:
        """Write the rows; if `first`, write the declarations of the columns before.

        WriteError: a time before 1970, which the stamps of a .tlog cannot represent.
        """
        columns = [str(name) for name in dataset.data_vars]
        times = np.round(dataset["time"].values * 1e6).astype(np.int64).tolist()
        if times and times[0] < 0:
            raise WriteError(self._path, "a .tlog has no times before 1970")
        if first:
            self._start_us = times[0] if times else 0
            self._declare(dataset)
        senders = [self._attitude] * any(name in columns for name in ATTITUDE)
        senders += [self._position] * any(name in columns for name in POSITION_COLUMNS)
        senders += [self._telemetry, self._raw]
        senders += [self._field] * ("total_field" in columns)
        values = [_single(name, dataset[name].values).tolist() for name in columns]
        for time_us, *row in zip(times, *values, strict=True):
            named = dict(zip(columns, row, strict=True))
            for one in senders:
                one(time_us, named)

    def close(self) -> None:
        """Write everything to the file and close it."""
        self._file.close()

    def _declare(self, dataset: xr.Dataset) -> None:
        declared: list[dict[str, Any]] = [
            {"column": key, "unit" if isinstance(value, str) else "scale": value}
            for key, value in lasting(dataset.attrs).items()
        ]
        taken: set[str] = set()
        for name in map(str, dataset.data_vars):
            if name in STANDARD:
                continue
            short = short_name(name, taken)
            taken.add(short)
            self._named.append((name, short.encode()))
            unit = str(dataset[name].attrs.get("units", "1"))
            if (short, unit) != (name, "1"):
                declared.append({"column": name, "unit": unit, "match": f"name={short}"} | NAMED_VALUE)
        for one in declared:
            frame = self._bridge.pack("MAG_COLUMN", **one)
            self._file.write(pack_record(self._start_us, Channel.STATE, frame))

    def _write_message(
        self, time_us: int, channel: Channel, codec: Codec, layout: Spec, *values: Any
    ) -> None:
        frame = codec.frame(layout, layout.struct.pack(*values))
        self._file.write(pack_record(time_us, channel, frame))

    def _boot_ms(self, time_us: int) -> int:
        return (time_us - self._start_us) // 1000 & 0xFFFFFFFF

    def _attitude(self, time_us: int, row: Row) -> None:
        angles = [radians(row.get(name, nan)) for name in ATTITUDE]
        fields = self._boot_ms(time_us), *angles, nan, nan, nan
        self._write_message(time_us, Channel.LINK, self._autopilot, ATTITUDE_, *fields)

    def _position(self, time_us: int, row: Row) -> None:
        # autopilots send 0 for an unknown position
        latitude = _integer(row.get("latitude", nan) * 1e7) or 1
        east = row.get("longitude", nan)
        longitude = east_e7(east) or 1 if isfinite(east) else UNKNOWN_INT
        altitude = _integer(-row.get("depth", nan) * 1e3)
        boot_ms = self._boot_ms(time_us)
        fields = boot_ms, latitude, longitude, altitude, altitude, 0, 0, 0, UNKNOWN_HEADING
        self._write_message(time_us, Channel.LINK, self._autopilot, POSITION_, *fields)

    def _telemetry(self, time_us: int, row: Row) -> None:
        boot_ms = self._boot_ms(time_us)
        for name, short in self._named:
            self._write_message(time_us, Channel.LINK, self._autopilot, NAMED_, boot_ms, row[name], short)

    def _raw(self, time_us: int, row: Row) -> None:
        x, y, z, temperature, supply, cycle = (row.get(name, nan) for name in SAMPLE)
        delays_us = [row.get(name, nan) * 1e6 - time_us for name in CHANNEL_TIMES]
        delays = [round(delay) if abs(delay) < UNKNOWN_INT else 0 for delay in delays_us]
        fields = time_us, 0, x, y, z, 0, 0, 0, *delays, temperature, supply
        power = (int(cycle) & 0xFFFF, 0, POWER_CYCLE) if isfinite(cycle) else (0, 0, 0)
        self._write_message(time_us, Channel.SENT, self._bridge, RAW_, *fields, *power)

    def _field(self, time_us: int, row: Row) -> None:
        total, sigma, x, y, z, anomaly, quality = (row.get(name, nan) for name in CORRECTED)
        if isnan(total):
            return
        flags = int(Quality.UNCALIBRATED) if isnan(quality) else int(quality)
        self._sequence += 1
        fields = time_us, total, self._sequence, 0, sigma, x, y, z, nan, nan, nan, anomaly, nan, nan, flags, 0
        heading = 0.0, 0.0, 0.0  # unknown: these columns have messages of their own
        self._write_message(time_us, Channel.SENT, self._bridge, FIELD_, *fields, *heading)


def short_name(name: str, taken: Collection[str]) -> str:
    """Return a name of at most ten letters, for a NAMED_VALUE_FLOAT, that is not in `taken`."""
    short = name.encode("ascii", "replace")[:10].decode() or "_"
    return next(s for s in (short, *(f"{short[:6]}{k:04d}" for k in range(10_000))) if s not in taken)


def _single(name: str, values: FloatArray) -> FloatArray:
    """Return values (n,) rounded to float32; return columns that are not sent as float32 unchanged."""
    if name in (*POSITION_COLUMNS, *CHANNEL_TIMES, "total_field"):
        return values
    with np.errstate(over="ignore"):
        return values.astype(np.float32).astype(np.float64)


def _integer(value: float) -> int:
    return round(value) if abs(value) < UNKNOWN_INT else UNKNOWN_INT
