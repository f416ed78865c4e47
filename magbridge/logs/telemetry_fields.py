"""The fields of MAVLink messages that become columns, with their units."""

from __future__ import annotations

from collections.abc import Callable
from math import isnan, nan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magbridge.arrays import FloatArray
from magbridge.columns import CHANNEL_TIMES, CORRECTED
from magbridge.mavlink import Message, spec
from magbridge.mavlink.enums import MAG_RAW_FLAGS
from magbridge.mavlink.messages import split_index

__all__ = [
    "IMUS",
    "MAVLINK_FIELDS",
    "POWER_CYCLE",
    "SOURCES",
    "TELEMETRY",
    "UNKNOWN_INT",
    "Columns",
    "DeclaredField",
    "Value",
    "correction",
    "is_of_main_sensor",
    "sample",
]  # fmt: skip

Columns = dict[str, float]

MAVLINK_FIELDS: dict[str, dict[str, str]] = {
    # message: {column: field}
    "ATTITUDE": {"roll": "roll", "pitch": "pitch", "heading": "yaw"},
    "GLOBAL_POSITION_INT": {"latitude": "lat", "longitude": "lon", "depth": "relative_alt"},
    "SYS_STATUS": {"battery_current": "current_battery", "battery_voltage": "voltage_battery"},
    "SCALED_PRESSURE": {"pressure": "press_abs", "pressure_temperature": "temperature"},
    "SCALED_PRESSURE2": {"pressure2": "press_abs", "pressure2_temperature": "temperature"},
    "SCALED_PRESSURE3": {"pressure3": "press_abs", "pressure3_temperature": "temperature"},
    "SERVO_OUTPUT_RAW": {f"servo{k}": f"servo{k}_raw" for k in range(1, 17)},
    "ESC_TELEMETRY_1_TO_4": {f"esc{k + 1}_current": f"current[{k}]" for k in range(4)},
    "ESC_TELEMETRY_5_TO_8": {f"esc{k + 5}_current": f"current[{k}]" for k in range(4)},
    "HIGHRES_IMU": {"imu_temperature": "temperature"},
    "RAW_IMU": {"imu_temperature": "temperature", "mag1_x": "xmag", "mag1_y": "ymag", "mag1_z": "zmag"},
    "SCALED_IMU2": {"mag2_x": "xmag", "mag2_y": "ymag", "mag2_z": "zmag"},
    "SCALED_IMU3": {"mag3_x": "xmag", "mag3_y": "ymag", "mag3_z": "zmag"},
}
MAVLINK_UNITS = {
    # the dialect's: (ours, factor)
    "rad": ("deg", 57.29577951308232),
    "degE7": ("deg", 1e-7),
    "gauss": ("nT", 1e5),
    "mgauss": ("nT", 1e2),
    "cA": ("A", 1e-2),
    "mV": ("V", 1e-3),
    "cdegC": ("degC", 1e-2),
    "mm": ("m", 1e-3),
}
UNKNOWN_INT = 0x7FFFFFFF
UNKNOWN_VALUES: dict[tuple[str, str], tuple[int, ...]] = {
    # what these fields hold when their sender does not know the value; the dialect does not declare it
    ("GLOBAL_POSITION_INT", "lat"): (0, UNKNOWN_INT),
    ("GLOBAL_POSITION_INT", "lon"): (0, UNKNOWN_INT),
    ("GLOBAL_POSITION_INT", "relative_alt"): (UNKNOWN_INT,),
    **{("SERVO_OUTPUT_RAW", f"servo{k}_raw"): (0,) for k in range(1, 17)},
    # "0: IMU does not provide temperature values"; one that is at 0 degC sends 1
    ("RAW_IMU", "temperature"): (0,),
}


class Value:
    """How one column is read from a message: ``scale * field + offset``, in `unit`."""

    def __init__(self, column: str, message: str, field: str) -> None:
        name, self._index = split_index(field)
        self._field = spec(message).fields[name]
        self._unknown = UNKNOWN_VALUES.get((message, name), ())
        self.column = column
        self.unit, self.scale = MAVLINK_UNITS.get(self._field.unit, (self._field.unit or "1", 1.0))
        if name == "relative_alt":
            self.scale = -self.scale  # depth
        self.offset = 0.0

    def get(self, payload: bytes) -> float:
        """Return the value; NaN where the sender does not know."""
        value: Any = self._field.get(payload)
        if self._index is not None:
            value = value[self._index]
        unknown = value == self._field.invalid or value in self._unknown
        return nan if unknown else float(value * self.scale + self.offset)

    def column_of(self, payloads: NDArray[np.uint8]) -> FloatArray:
        """Return the values (n,) of payloads (n, size), each as :meth:`get`."""
        layout = np.dtype(f"<{self._field.code}")
        start = self._field.offset + (self._index or 0) * layout.itemsize
        raw = payloads[:, start : start + layout.itemsize].copy().view(layout)[:, 0]
        invalid = () if self._field.invalid is None else (self._field.invalid,)
        unknown = np.isin(raw, [*self._unknown, *invalid])
        return np.where(unknown, np.nan, raw.astype(np.float64) * self.scale + self.offset)


class DeclaredField(Value):
    """A column that the log itself declares, by a ``MAG_COLUMN``.

    Attributes
    ----------
    message : int
        Id of the message that holds it.
    match : dict of str to str
        Values that other fields of the message must have, as text.
    component : int or None
        The only sender that counts.
    """

    def __init__(self, declaration: Message) -> None:
        super().__init__(declaration["column"], declaration["message"], declaration["field"])
        self.unit, self.scale, self.offset = (
            declaration["unit"] or "1",
            declaration["scale"],
            declaration["offset"],
        )
        self._unknown = ()
        layout = spec(declaration["message"])
        self.message = layout.id
        self.component: int | None = declaration["component"] or None
        self.match = dict(part.split("=", 1) for part in declaration["match"].split(",") if part)
        self._others = [(layout.fields[name], text) for name, text in self.match.items()]

    def find(self, payload: bytes) -> float | None:
        """Return the value, as :meth:`get`; None where the message is about something else."""
        if any(str(field.get(payload)) != text for field, text in self._others):
            return None
        return self.get(payload)


TELEMETRY = {
    spec(message).id: [Value(column, message, field) for column, field in columns.items()]
    for message, columns in MAVLINK_FIELDS.items()
}
"""Message id to the columns in the message."""

SAMPLE, CORRECTION = spec("MAG_RAW").struct, spec("MAG_FIELD").struct
POWER_CYCLE = int(MAG_RAW_FLAGS.POWER_CYCLE)
"""Flag of MAG_RAW: its power cycle is counted."""


def sample(payload: bytes) -> Columns:
    """Return the time of a ``MAG_RAW``, and the columns whose values it holds."""
    time_us, _, x, y, z, _, _, _, *delays, temperature, supply, cycle, _, flags = SAMPLE.unpack(payload)
    row = {"time": time_us / 1e6}
    if not (isnan(x) and isnan(y) and isnan(z)):
        row |= {"mag_x": x, "mag_y": y, "mag_z": z}
    if any(delays):
        row |= {name: (time_us + delay) / 1e6 for name, delay in zip(CHANNEL_TIMES, delays, strict=True)}
    if not isnan(temperature):
        row["sensor_temperature"] = temperature
    if not isnan(supply):
        row["sensor_supply"] = supply
    if flags & POWER_CYCLE:
        row["power_cycle"] = cycle
    return row


def correction(payload: bytes) -> Columns:
    """Return the time of a ``MAG_FIELD``, and the columns of a corrected sample."""
    time_us, total, _, _, sigma, x, y, z, _, _, _, anomaly, _, _, flags, *_ = CORRECTION.unpack(payload)
    return {
        "time": time_us / 1e6,
        **dict(zip(CORRECTED, (total, sigma, x, y, z, anomaly, flags), strict=True)),
    }


SENSOR_IDS = {spec(message).id: spec(message).fields["sensor_id"] for message in ("MAG_RAW", "MAG_FIELD")}


def is_of_main_sensor(number: int, payload: bytes) -> bool:
    """Return True unless a message (by id) is a sample of a sensor after the first."""
    field = SENSOR_IDS.get(number)
    return field is None or not field.get(payload)


IMUS = {
    message: [Value(f"mag_{axis}", message, f"{axis}mag") for axis in "xyz"]
    for message in ("HIGHRES_IMU", "RAW_IMU", "SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3")
}
"""Messages of an autopilot that hold its compass' field, the best first."""


def _field_of(message: str) -> Callable[[bytes], Columns]:
    return lambda payload: {value.column: value.get(payload) for value in IMUS[message]}


SOURCES: dict[str, Callable[[bytes], Columns]] = {
    "MAG_RAW": sample,
    "MAG_FIELD": correction,
    **{message: _field_of(message) for message in IMUS},
    "ATTITUDE": lambda _: {},
    "GLOBAL_POSITION_INT": lambda _: {},
}
"""The messages that make a row, the best first, and the function that reads the row's columns from them."""
