"""The fields of MAVLink messages that become columns, with their units."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magbridge.arrays import BoolArray, FloatArray
from magbridge.columns import CHANNEL_TIMES, CORRECTED
from magbridge.logs.fields import DEG_PER_RAD, FieldMap, by_record
from magbridge.mavlink import Message, spec
from magbridge.mavlink.enums import MAG_RAW_FLAGS
from magbridge.mavlink.messages import split_index

__all__ = [
    "MAVLINK_FIELDS", "POWER_CYCLE", "SOURCES", "TELEMETRY", "UNKNOWN_INT", "DeclaredField", "MessageField",
    "are_of_main_sensor", "source_columns",
]  # fmt: skip

Payloads = NDArray[np.uint8]
"""(n, size): the payloads of messages of one kind, without zeros cut off."""
UNKNOWN_INT = 0x7FFFFFFF
MAVLINK_FIELDS = by_record(
    (
        FieldMap("ATTITUDE", "roll", "roll", "deg", DEG_PER_RAD),
        FieldMap("ATTITUDE", "pitch", "pitch", "deg", DEG_PER_RAD),
        FieldMap("ATTITUDE", "yaw", "heading", "deg", DEG_PER_RAD),
        FieldMap("GLOBAL_POSITION_INT", "lat", "latitude", "deg", 1e-7, (0, UNKNOWN_INT)),
        FieldMap("GLOBAL_POSITION_INT", "lon", "longitude", "deg", 1e-7, (0, UNKNOWN_INT)),
        FieldMap("GLOBAL_POSITION_INT", "relative_alt", "depth", "m", -1e-3, (UNKNOWN_INT,)),
        FieldMap("SYS_STATUS", "current_battery", "battery_current", "A", 1e-2),
        FieldMap("SYS_STATUS", "voltage_battery", "battery_voltage", "V", 1e-3),
        FieldMap("SCALED_PRESSURE", "press_abs", "pressure", "hPa"),
        FieldMap("SCALED_PRESSURE", "temperature", "pressure_temperature", "degC", 1e-2),
        FieldMap("SCALED_PRESSURE2", "press_abs", "pressure2", "hPa"),
        FieldMap("SCALED_PRESSURE2", "temperature", "pressure2_temperature", "degC", 1e-2),
        FieldMap("SCALED_PRESSURE3", "press_abs", "pressure3", "hPa"),
        FieldMap("SCALED_PRESSURE3", "temperature", "pressure3_temperature", "degC", 1e-2),
        *(
            FieldMap("SERVO_OUTPUT_RAW", f"servo{k}_raw", f"servo{k}", "us", missing=(0,))
            for k in range(1, 17)
        ),
        *(
            FieldMap("ESC_TELEMETRY_1_TO_4", f"current[{k}]", f"esc{k + 1}_current", "A", 1e-2)
            for k in range(4)
        ),
        *(
            FieldMap("ESC_TELEMETRY_5_TO_8", f"current[{k}]", f"esc{k + 5}_current", "A", 1e-2)
            for k in range(4)
        ),
        FieldMap("HIGHRES_IMU", "temperature", "imu_temperature", "degC"),
        # "0: IMU does not provide temperature values"; one that is at 0 degC sends 1
        FieldMap("RAW_IMU", "temperature", "imu_temperature", "degC", 1e-2, (0,)),
        *(FieldMap("RAW_IMU", f"{axis}mag", f"mag1_{axis}", "nT", 1e2) for axis in "xyz"),
        *(FieldMap("SCALED_IMU2", f"{axis}mag", f"mag2_{axis}", "nT", 1e2) for axis in "xyz"),
        *(FieldMap("SCALED_IMU3", f"{axis}mag", f"mag3_{axis}", "nT", 1e2) for axis in "xyz"),
    )
)
"""Message to its fields; the values that the dialect declares to be invalid are missing, too."""
SOURCES = {
    "MAG_RAW": (
        *(FieldMap("MAG_RAW", axis, f"mag_{axis}", "nT") for axis in "xyz"),
        FieldMap("MAG_RAW", "temperature", "sensor_temperature", "degC"),
        FieldMap("MAG_RAW", "supply", "sensor_supply", "V"),
        FieldMap("MAG_RAW", "power_cycle", "power_cycle", ""),
    ),
    "MAG_FIELD": tuple(
        FieldMap("MAG_FIELD", field, column, "")
        for column, field in zip(
            CORRECTED, ("total_field", "total_field_sigma", "x", "y", "z", "anomaly", "flags"), strict=True
        )
    ),
    "HIGHRES_IMU": tuple(FieldMap("HIGHRES_IMU", f"{axis}mag", f"mag_{axis}", "nT", 1e5) for axis in "xyz"),
    **{
        message: tuple(FieldMap(message, f"{axis}mag", f"mag_{axis}", "nT", 1e2) for axis in "xyz")
        for message in ("RAW_IMU", "SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3")
    },
    "ATTITUDE": (),
    "GLOBAL_POSITION_INT": (),
}
"""The messages that make a row, the best first, and the fields whose values the row has from them."""
POWER_CYCLE = int(MAG_RAW_FLAGS.POWER_CYCLE)
"""Flag of MAG_RAW: its power cycle is counted."""


class MessageField:
    """How a column is read from the payloads of a message: ``factor * field + offset``, in `unit`.

    Attributes
    ----------
    column, unit : str
        Of the column.
    message : int
        Id of the message.
    factor, offset : float
        Of the field's numbers.
    """

    def __init__(self, source: FieldMap, offset: float = 0.0) -> None:
        name, index = split_index(source.field)
        field = spec(source.record).fields[name]
        if field.code == "s":
            raise ValueError(f"{source.record}.{name}: expected a field of numbers")
        self.message = spec(source.record).id
        self.column, self.unit, self.factor, self.offset = source.column, source.unit, source.factor, offset
        self._layout = np.dtype(f"<{field.code}")
        self._start = field.offset + (index or 0) * self._layout.itemsize
        self._missing = [*source.missing, *(() if field.invalid is None else (field.invalid,))]

    def values(self, payloads: Payloads) -> FloatArray:
        """Return the values (n,) of the column in payloads (n, size); NaN where the sender knows none."""
        raw = payloads[:, self._start : self._start + self._layout.itemsize].copy().view(self._layout)[:, 0]
        values = raw.astype(np.float64) * self.factor + self.offset
        return np.where(np.isin(raw, self._missing), np.nan, values) if self._missing else values


class DeclaredField(MessageField):
    """A column that the log itself declares, by a ``MAG_COLUMN``.

    Attributes
    ----------
    match : dict of str to str
        Values that other fields of the message must have, as text.
    component : int or None
        The only sender that counts.
    """

    def __init__(self, declaration: Message) -> None:
        layout = spec(declaration["message"])
        unit = declaration["unit"] or "1"
        source = FieldMap(
            layout.name, declaration["field"], declaration["column"], unit, declaration["scale"]
        )
        super().__init__(source, declaration["offset"])
        self.component: int | None = declaration["component"] or None
        self.match = dict(part.split("=", 1) for part in declaration["match"].split(",") if part)
        self._others = [(layout.fields[name], text) for name, text in self.match.items()]

    def matches(self, payloads: Payloads) -> BoolArray:
        """Return the payloads (n,) of the messages that hold the column."""
        found = np.ones(len(payloads), bool)
        for field, text in self._others:
            part = payloads[:, field.offset : field.offset + field.struct.size]
            kinds, first, kind = np.unique(part, axis=0, return_index=True, return_inverse=True)
            equal = [str(field.get(payloads[k].tobytes())) == text for k in first.tolist()]
            found &= np.array(equal, bool)[kind.ravel()] if len(kinds) else found
        return found


TELEMETRY = {
    spec(message).id: [MessageField(one) for one in fields] for message, fields in MAVLINK_FIELDS.items()
}
"""Message id to the columns in the message."""
SOURCE_FIELDS = {
    spec(message).id: [MessageField(one) for one in fields] for message, fields in SOURCES.items()
}
RAW, FIELD = spec("MAG_RAW").id, spec("MAG_FIELD").id
SENSOR_IDS = {spec(name).id: spec(name).fields["sensor_id"].offset for name in ("MAG_RAW", "MAG_FIELD")}
STAMP_FIELDS = {
    spec(name).id: MessageField(FieldMap(name, "time_usec", "time", "us"))
    for name in ("MAG_RAW", "MAG_FIELD")
}
DELAY_FIELDS = [
    MessageField(FieldMap("MAG_RAW", f"delay_{axis}", name, "us"))
    for axis, name in zip("xyz", CHANNEL_TIMES, strict=True)
]
RAW_FLAGS = MessageField(FieldMap("MAG_RAW", "flags", "flags", ""))


def are_of_main_sensor(number: int, payloads: Payloads) -> BoolArray:
    """Return the messages (n,) of one id that are not samples of a sensor after the first."""
    if number not in SENSOR_IDS:
        return np.ones(len(payloads), bool)
    return np.asarray(payloads[:, SENSOR_IDS[number]] == 0)


def source_columns(number: int, payloads: Payloads) -> dict[str, FloatArray]:
    """Return the columns (n,) of the rows that messages of one id make, NaN where they hold no value.

    ``time`` is among them for the messages of a bridge.
    """
    columns = {one.column: one.values(payloads) for one in SOURCE_FIELDS[number]}
    if number not in SENSOR_IDS:
        return columns
    time_us = STAMP_FIELDS[number].values(payloads)
    columns["time"] = time_us / 1e6
    if number == RAW:
        delays_us = [field.values(payloads) for field in DELAY_FIELDS]
        in_turn = np.any(delays_us, axis=0)
        for one, delay_us in zip(DELAY_FIELDS, delays_us, strict=True):
            columns[one.column] = np.where(in_turn, (time_us + delay_us) / 1e6, np.nan)
        counted = RAW_FLAGS.values(payloads).astype(np.int64) & POWER_CYCLE
        columns["power_cycle"] = np.where(counted > 0, columns["power_cycle"], np.nan)
    return columns
