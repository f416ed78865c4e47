"""PX4's logs (``.ulg``), through pyulog.

A row is a sample of the first ``sensor_mag`` (gauss, as the driver gives it: before PX4's own calibration);
every other column is the last value before it. ``heading`` is the estimator's yaw. ``depth`` is the local
position's z, down from where the vehicle was switched on. Time is UTC if a GPS message in the log gives it;
otherwise it counts from the boot, and the attribute ``time_reference = "boot"`` says so.

References
----------
PX4 user guide, "ULog File Format", https://docs.px4.io/main/en/dev_log/ulog_file_format.html
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magbridge.errors import FormatError, MissingExtra
from magbridge.logs.checks import increasing
from magbridge.logs.deployment import deployment, sliced
from magbridge.logs.resample import latest

try:
    from pyulog import ULog
    from pyulog.exceptions import ULogException
except ImportError:
    raise MissingExtra("pyulog", "formats") from None

__all__ = ["chunks"]

Floats = NDArray[np.float64]

NT_PER_GAUSS = 1e5
FIELDS: dict[str, tuple[tuple[str, str, str, float], ...]] = {
    # topic: (column, field, unit, factor); '#' is the number of the instance where it is not the first
    "vehicle_global_position": (("latitude", "lat", "deg", 1.0), ("longitude", "lon", "deg", 1.0)),
    "vehicle_local_position": (("depth", "z", "m", 1.0),),
    "battery_status": (
        ("battery#_current", "current_a", "A", 1.0),
        ("battery#_voltage", "voltage_v", "V", 1.0),
    ),
    "vehicle_air_data": (("pressure", "baro_pressure_pa", "hPa", 0.01),),
    "actuator_outputs": tuple((f"servo{k + 1}", f"output[{k}]", "us", 1.0) for k in range(16)),
    "esc_status": tuple((f"esc{k + 1}_current", f"esc[{k}].esc_current", "A", 1.0) for k in range(8)),
}
NEEDED = {
    "sensor_mag": {"timestamp", "x", "y", "z"},
    "vehicle_attitude": {"timestamp", "q[0]", "q[1]", "q[2]", "q[3]"},
    "debug_key_value": {"timestamp", "value", "key[0]"},
}
UNUSED = ("servo", "esc")
"""Outputs that a log lists in the largest possible number; those that are always 0 are not in use."""
OTHERS = ("sensor_mag", "vehicle_attitude", "vehicle_gps_position", "sensor_gps", "debug_key_value")


def chunks(path: Path, rows: int) -> Iterator[xr.Dataset]:
    """Yield the log in pieces of at most `rows` rows; it is held whole.

    Raises
    ------
    FormatError
        Not a ULog, or no ``sensor_mag`` in it.
    """
    try:
        with path.open("rb") as file, redirect_stdout(None):  # pyulog prints what it finds damaged
            log = ULog(file, [*FIELDS, *OTHERS])
    except (ULogException, ValueError, KeyError, IndexError, TypeError) as error:
        raise FormatError(path, f"expected a PX4 log: {error}") from None
    topics: dict[str, dict[int, dict[str, Floats]]] = {}
    for one in log.data_list:
        fields = {name: values.astype(np.float64) for name, values in one.data.items()}
        if NEEDED.get(one.name, {"timestamp"}) <= fields.keys():
            topics.setdefault(one.name, {})[one.multi_id] = fields
    mags = topics.get("sensor_mag")
    if not mags:
        raise FormatError(path, "expected a PX4 log with sensor_mag")
    offset = _utc_offset(topics)
    first = mags.pop(min(mags))
    time = _time(first, offset)
    keep = np.diff(time, prepend=-np.inf) > 0
    time = time[keep]
    increasing(path, time)
    columns = {f"mag_{axis}": NT_PER_GAUSS * first[axis][keep] for axis in "xyz"}
    units: dict[str, str] = {}
    for number, mag in mags.items():
        for axis in "xyz":
            column = f"mag{number + 1}_{axis}"
            columns[column], units[column] = (
                latest(time, _time(mag, offset), NT_PER_GAUSS * mag[axis]),
                "nT",
            )
    for column, unit, when, values in _telemetry(topics, offset):
        if column not in columns and (np.any(values) or not column.startswith(UNUSED)):
            columns[column], units[column] = latest(time, when, values), unit
    attrs: dict[str, Any] = {"dropouts": len(log.dropouts)}
    if not offset:
        attrs["time_reference"] = "boot"
    yield from sliced(deployment(path, time, columns, units, attrs), rows)


def _telemetry(
    topics: dict[str, dict[int, dict[str, Floats]]], offset: float
) -> Iterator[tuple[str, str, Floats, Floats]]:
    """Yield column, unit, times and values of everything but the magnetometers."""
    for attitude in topics.get("vehicle_attitude", {}).values():
        for column, values in zip(("roll", "pitch", "heading"), _angles(attitude), strict=True):
            yield column, "deg", _time(attitude, offset), values
    for topic, fields in FIELDS.items():
        for number, table in topics.get(topic, {}).items():
            for column, field, unit, factor in fields:
                if field in table:
                    name = column.replace("#", str(number + 1) if number else "")
                    yield name, unit, _time(table, offset), table[field] * factor
    for table in topics.get("debug_key_value", {}).values():
        letters = [table[f"key[{k}]"].astype(np.uint8) for k in range(10) if f"key[{k}]" in table]
        names = np.array(
            [bytes(key).split(b"\0")[0].decode("ascii", "replace") for key in zip(*letters, strict=True)]
        )
        for name in dict.fromkeys(names.tolist()):
            yield name, "1", _time(table, offset)[names == name], table["value"][names == name]


def _angles(attitude: dict[str, Floats]) -> tuple[Floats, Floats, Floats]:
    """Return roll, pitch and heading (deg) of the quaternion (w, x, y, z) from body to north-east-down."""
    w, x, y, z = (attitude[f"q[{k}]"] for k in range(4))
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.degrees(roll), np.degrees(pitch), np.degrees(heading) % 360.0


def _time(table: dict[str, Floats], offset: float) -> Floats:
    return table.get("timestamp_sample", table["timestamp"]) * 1e-6 + offset


def _utc_offset(topics: dict[str, dict[int, dict[str, Floats]]]) -> float:
    """Return UTC minus time since boot in s, from the first GPS message that has UTC; 0 without one."""
    for topic in ("vehicle_gps_position", "sensor_gps"):
        for gps in topics.get(topic, {}).values():
            known = np.flatnonzero(gps.get("time_utc_usec", np.zeros(0)) > 0)
            if len(known):
                return float(gps["time_utc_usec"][known[0]] - gps["timestamp"][known[0]]) * 1e-6
    return 0.0
