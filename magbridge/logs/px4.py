"""PX4's logs (``.ulg``), through pyulog.

``sensor_mag`` is in gauss, as the driver gives it: before PX4's own calibration. ``heading`` is the
estimator's yaw. ``depth`` is the local position's z, down from where the vehicle was switched on. UTC is that
of the first GPS message that has it.

References
----------
PX4 user guide, "ULog File Format", https://docs.px4.io/main/en/dev_log/ulog_file_format.html
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.columns import NT_PER_UNIT
from magbridge.errors import FormatError, MissingExtra
from magbridge.logs.autopilot import Fields, pieces, values_of

try:
    from pyulog import ULog
    from pyulog.exceptions import ULogException
except ImportError:
    raise MissingExtra("pyulog", "formats") from None

__all__ = ["chunks"]

Table = dict[str, FloatArray]
Topics = dict[str, dict[int, Table]]

FIELDS: Fields = {
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
    topics: Topics = {}
    for one in log.data_list:
        fields = {name: values.astype(np.float64) for name, values in one.data.items()}
        if NEEDED.get(one.name, {"timestamp"}) <= fields.keys():
            topics.setdefault(one.name, {})[one.multi_id] = fields
    mags = {
        number: (_time(mag), {axis: NT_PER_UNIT["G"] * mag[axis] for axis in "xyz"})
        for number, mag in topics.get("sensor_mag", {}).items()
    }
    if not mags:
        raise FormatError(path, "expected a PX4 log with sensor_mag")
    # pyulog tells that there is damage, not in how many places
    lost = {"dropouts": len(log.dropouts), "damages": int(log.file_corruption)}
    yield from pieces(path, rows, _utc_offset(topics), mags, _telemetry(topics), lost)


def _telemetry(topics: Topics) -> Iterator[tuple[FloatArray, str, str, FloatArray]]:
    """Yield times, column, unit and values of everything but the magnetometers."""
    for attitude in topics.get("vehicle_attitude", {}).values():
        for column, values in zip(("roll", "pitch", "heading"), _angles(attitude), strict=True):
            yield _time(attitude), column, "deg", values
    for topic in FIELDS:
        for number, table in topics.get(topic, {}).items():
            for column, unit, values in values_of(FIELDS, topic, number, table):
                if np.any(values) or not column.startswith(UNUSED):
                    yield _time(table), column, unit, values
    for table in topics.get("debug_key_value", {}).values():
        letters = [table[f"key[{k}]"].astype(np.uint8) for k in range(10) if f"key[{k}]" in table]
        names = np.array(
            [bytes(key).split(b"\0")[0].decode("ascii", "replace") for key in zip(*letters, strict=True)]
        )
        for name in dict.fromkeys(names.tolist()):
            yield _time(table)[names == name], name, "1", table["value"][names == name]


def _angles(attitude: Table) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return roll, pitch and heading (deg) of the quaternion (w, x, y, z) from body to north-east-down."""
    w, x, y, z = (attitude[f"q[{k}]"] for k in range(4))
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.degrees(roll), np.degrees(pitch), np.degrees(heading) % 360.0


def _time(table: Table) -> FloatArray:
    return table.get("timestamp_sample", table["timestamp"]) * 1e-6


def _utc_offset(topics: Topics) -> float:
    """Return UTC minus time since boot in s, from the first GPS message that has UTC; 0 without one."""
    for topic in ("vehicle_gps_position", "sensor_gps"):
        for gps in topics.get(topic, {}).values():
            known = np.flatnonzero(gps.get("time_utc_usec", np.zeros(0)) > 0)
            if len(known):
                return float(gps["time_utc_usec"][known[0]] - gps["timestamp"][known[0]]) * 1e-6
    return 0.0
