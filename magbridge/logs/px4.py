"""Read PX4's logs (``.ulg``) through pyulog.

The field is the driver's, before PX4's own calibration. It comes from ``sensor_mag``, or from
``vehicle_magnetometer`` if this topic has a higher rate. In that case the reader removes the offsets and
scales of ``CAL_MAGn``. The oldest logs have the field in ``sensor_combined``. The compass is the one that
``vehicle_magnetometer`` names most often, if it is enabled (``CAL_MAGn_PRIO`` is not 0).

``heading`` is the estimator's yaw. ``depth`` is the local position's z, down from the place at which the
vehicle was switched on. UTC minus the time since boot is the median over the GPS messages.

References
----------
PX4 user guide, "ULog File Format", https://docs.px4.io/main/en/dev_log/ulog_file_format.html
PX4, ``src/lib/sensor_calibration/Magnetometer.hpp``, ``Correct``
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.columns import NT_PER_UNIT
from magbridge.errors import FormatError, MissingExtra
from magbridge.logs.compasses import BootRun, Magnetometer, Series, pieces, rate, sampled, symmetric
from magbridge.logs.fields import euler_deg, field_maps, fields_of
from magbridge.logs.mapping import Options

try:
    from pyulog import ULog
    from pyulog.exceptions import ULogException
except ImportError:
    raise MissingExtra("pyulog", "formats") from None

Table = dict[str, FloatArray]
Topics = dict[str, dict[int, Table]]
Parameters = Mapping[str, float]

PX4_FIELDS = field_maps("px4")
# heights above the sea are preferred: the local position, above the start, comes last
PX4_FIELDS["vehicle_gps_position"] = PX4_FIELDS["sensor_gps"]
PX4_FIELDS["vehicle_local_position"] = PX4_FIELDS.pop("vehicle_local_position")
GAUSS_AXES = tuple(f"magnetometer_ga[{k}]" for k in range(3))
"""The three axes in ``vehicle_magnetometer`` and ``sensor_combined``."""
NEEDED_FIELDS = {
    "sensor_mag": {"timestamp", "x", "y", "z"},
    "vehicle_magnetometer": {"timestamp", *GAUSS_AXES},
    "sensor_combined": {"timestamp", *GAUSS_AXES},
    "vehicle_attitude": {"timestamp", "q[0]", "q[1]", "q[2]", "q[3]"},
    "debug_key_value": {"timestamp", "value", "key[0]"},
}
UNUSED = ("servo", "esc", "motor")
"""Prefixes of outputs of which a log lists the largest possible number; outputs always 0 are not in use."""
GPS = ("vehicle_gps_position", "sensor_gps")
MIN_FIX_TYPE = 3
"""Lowest ``fix_type`` of a three-dimensional fix."""
MAX_CALIBRATIONS = 4
FASTER = 1.5
"""Ratio of rates above which ``vehicle_magnetometer`` is read instead of ``sensor_mag``."""


def chunks(path: Path, rows: int, options: Options | None = None) -> Iterator[xr.Dataset]:
    """Yield the log in pieces of at most `rows` rows; the whole log is in memory."""
    try:
        with path.open("rb") as file, redirect_stdout(None):  # pyulog prints a line for each damage
            log = ULog(file, [*PX4_FIELDS, *NEEDED_FIELDS])
    except (ULogException, ValueError, KeyError, IndexError, TypeError) as error:
        raise FormatError(path, f"expected a PX4 log: {error}") from None
    topics: Topics = {}
    for one in log.data_list:
        fields = {name: values.astype(np.float64) for name, values in one.data.items()}
        if NEEDED_FIELDS.get(one.name, {"timestamp"}) <= fields.keys() and len(fields["timestamp"]):
            topics.setdefault(one.name, {})[one.multi_id] = fields
    mags = _magnetometers(topics, log.initial_parameters)
    if not mags:
        raise FormatError(path, "expected a PX4 log with a magnetometer")
    # pyulog reports damage, but not the number of damaged places
    lost = {"dropouts": len(log.dropouts), "damages": int(log.file_corruption)}
    run = BootRun(mags, _telemetry(topics), _utc_offset(topics))
    yield from pieces(path, rows, [run], lost, (), options.compass if options else None)


def _magnetometers(topics: Topics, parameters: Parameters) -> list[Magnetometer]:
    """Return the compasses, each from the topic that has it at the highest rate, as the driver gave it."""
    used = {
        device: table
        for table in topics.get("vehicle_magnetometer", {}).values()
        for device in np.unique(table.get("device_id", np.zeros(1))).tolist()
    }
    current = _most(topics.get("vehicle_magnetometer", {}))
    found: list[Magnetometer] = []
    for number, table in sorted(topics.get("sensor_mag", {}).items()):
        device = _most({0: table})
        mag = _magnetometer(number, device, table, ("x", "y", "z"), parameters, device and device == current)
        faster = _of_device(used.pop(device, None), device)
        if faster is not None and rate(_time(faster)) > FASTER * mag.compass.rate:
            mag = _uncalibrated(number, device, faster, parameters, in_use=device == current)
        found.append(mag)
    numbers = {one.compass.number for one in found}
    for device, table in used.items():  # compasses that are logged only after PX4's calibration
        part = _of_device(table, device)
        if part is not None and (device or not found):
            number = next(k for k in range(len(numbers) + 1) if k not in numbers)
            numbers.add(number)
            found.append(_uncalibrated(number, device, part, parameters, in_use=device == current))
    if not found:
        found = [
            _magnetometer(number, 0.0, table, GAUSS_AXES, parameters, True)
            for number, table in topics.get("sensor_combined", {}).items()
        ]
    return found


def _of_device(table: Table | None, device: float) -> Table | None:
    """Return the samples of one device, since a topic may change from one compass to another."""
    if table is None or "device_id" not in table:
        return table
    here = table["device_id"] == device
    return {name: values[here] for name, values in table.items()}


def _most(tables: Mapping[int, Table]) -> float:
    """Return the most frequent device id of the first instance that has device ids; 0 without one."""
    for _, table in sorted(tables.items()):
        if "device_id" in table:
            devices, counts = np.unique(table["device_id"], return_counts=True)
            return float(devices[counts.argmax()])
    return 0.0


def _magnetometer(
    number: int, device: float, table: Table, axes: Sequence[str], parameters: Parameters, in_use: Any
) -> Magnetometer:
    priority = parameters.get(f"CAL_MAG{_calibration(device, parameters)}_PRIO", -1)
    facts: dict[str, Any] = {"enabled": priority != 0, "priority": int(priority)} if priority >= 0 else {}
    facts |= {"id": f"{device:.0f}" if device else "", "in_use": bool(in_use)}
    return sampled(number, _time(table), NT_PER_UNIT["G"] * np.stack([table[name] for name in axes]), **facts)


def _uncalibrated(
    number: int, device: float, table: Table, parameters: Parameters, *, in_use: bool
) -> Magnetometer:
    """Return a compass from ``vehicle_magnetometer``, with PX4's calibration undone.

    PX4 computes ``R S (raw - offset - power compensation)``, where the symmetric S holds scales and
    off-diagonals, and R rotates the mounting to the vehicle. S and the offset are undone if R is the
    identity; else the values remain calibrated. The power compensation is not in the log and remains.
    """
    slot = _calibration(device, parameters)
    rotated = slot is not None and parameters.get(f"CAL_MAG{slot}_ROT", 0) > 0
    if slot is not None and not rotated:
        header = f"CAL_MAG{slot}_"
        scales = [parameters.get(f"{header}{axis}SCALE", 1.0) or 1.0 for axis in "XYZ"]
        matrix = symmetric(scales, [parameters.get(f"{header}{axis}ODIAG", 0.0) for axis in "XYZ"])
        offset = np.array([[parameters.get(f"{header}{axis}OFF", 0.0)] for axis in "XYZ"])
        raw = np.linalg.solve(matrix, np.stack([table[axis] for axis in GAUSS_AXES])) + offset
        table = {**table, **dict(zip(GAUSS_AXES, raw, strict=True))}
    return _magnetometer(number, device, table, GAUSS_AXES, parameters, in_use)


def _calibration(device: float, parameters: Parameters) -> int | None:
    """Return the n of the parameters ``CAL_MAGn`` of a device; None if no n belongs to it."""
    slots = (k for k in range(MAX_CALIBRATIONS) if device and parameters.get(f"CAL_MAG{k}_ID") == device)
    return next(slots, None)


def _telemetry(topics: Topics) -> Iterator[Series]:
    """Yield attitude, the columns in :data:`PX4_FIELDS` and named debug values."""
    for attitude in topics.get("vehicle_attitude", {}).values():
        angles = euler_deg(*(attitude[f"q[{k}]"] for k in range(4)))
        for column, values in zip(("roll", "pitch", "heading"), angles, strict=True):
            yield _time(attitude), column, "deg", values % 360.0 if column == "heading" else values
    for topic in PX4_FIELDS:
        for number, table in topics.get(topic, {}).items():
            fixed = table.get("fix_type", np.full(len(table["timestamp"]), MIN_FIX_TYPE)) >= MIN_FIX_TYPE
            for column, unit, values in fields_of(PX4_FIELDS[topic], table, number):
                if np.any(np.nan_to_num(values)) or not column.startswith(UNUSED):
                    yield _time(table), column, unit, np.where(fixed, values, np.nan)
    for table in topics.get("debug_key_value", {}).values():
        letters = [table[f"key[{k}]"].astype(np.uint8) for k in range(10) if f"key[{k}]" in table]
        keys = [bytes(key).split(b"\0")[0] for key in zip(*letters, strict=True)]
        names = np.array([key.decode("ascii", "replace") for key in keys])
        for name in dict.fromkeys(names.tolist()):
            yield _time(table)[names == name], name, "1", table["value"][names == name]


def _time(table: Table) -> FloatArray:
    return table.get("timestamp_sample", table["timestamp"]) * 1e-6


def _utc_offset(topics: Topics) -> float | None:
    """Return UTC minus time since boot in s, the median of the GPS messages with UTC; None without UTC."""
    ahead = [
        (gps["time_utc_usec"] - gps["timestamp"])[gps["time_utc_usec"] > 0] * 1e-6
        for topic in GPS
        for gps in topics.get(topic, {}).values()
        if "time_utc_usec" in gps
    ]
    known = np.concatenate(ahead) if ahead else np.empty(0)
    return float(np.median(known)) if len(known) else None
