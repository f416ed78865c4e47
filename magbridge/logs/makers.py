"""Files of instruments and autopilots whose makers say what the columns mean: what else a user declares.

PX4's topics as ``ulog2csv`` writes them are in microseconds since the boot and in gauss (PX4,
msg/SensorMag.msg, msg/VehicleMagnetometer.msg). Geometrics' MagMap writes the month first.
DatCon's ``offsetTime`` counts seconds from the start of a DJI flight. MagArrow's compass has its x to the
right, its y aft and its z down (Geometrics, MagArrow user manual, 'Data Format'); ``Mag`` is its caesium
magnetometer.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from magbridge.logs.mapping import ColumnMapping, ColumnSource

__all__ = ["declared_by_maker"]

MAKERS: dict[str, tuple[set[str], dict[str, ColumnSource]]] = {
    "MagArrow": (
        {"Counter", "Date", "Time", "Mag", "MagValid"},
        {
            "total_field": ColumnSource(heading="Mag", unit="nT", valid="MagValid"),
            "mag_x": ColumnSource(heading="CompassY", unit="nT", scale=-1.0),
            "mag_y": ColumnSource(heading="CompassX", unit="nT"),
            "mag_z": ColumnSource(heading="CompassZ", unit="nT"),
            "sensor_temperature": ColumnSource(heading="CompassTemperature", unit="degC"),
        },
    ),
    "MagMap": (
        {"READING_1", "DATE", "TIME", "LINE", "MARK"},
        {
            "total_field": ColumnSource(heading="READING_1", unit="nT"),
            "time": ColumnSource(heading="TIME", unit="%m/%d/%y %H:%M:%S"),
        },
    ),
    "DJI's DatCon": (
        {"Tick#", "offsetTime"},
        {
            "time": ColumnSource(heading="offsetTime", unit="s"),
            "latitude": ColumnSource(heading="GPS:Lat", unit="deg"),
            "longitude": ColumnSource(heading="GPS:Long", unit="deg"),
            "roll": ColumnSource(heading="IMU_ATTI(0):roll:C", unit="deg"),
            "pitch": ColumnSource(heading="IMU_ATTI(0):pitch:C", unit="deg"),
            "heading": ColumnSource(heading="IMU_ATTI(0):yaw:C", unit="deg"),
        },
    ),
    "an RM3100 logger": (
        {"ts", "rt", "lt", "x", "y", "z", "rx", "ry", "rz"},
        {f"mag_{axis}": ColumnSource(heading=axis, unit="uT") for axis in "xyz"}
        | {"sensor_temperature": ColumnSource(heading="rt", unit="degC")},
    ),
    "PX4's vehicle_magnetometer": (
        {"timestamp", "device_id", "magnetometer_ga[0]"},
        {"time": ColumnSource(heading="timestamp", unit="us")}
        | {
            f"mag_{axis}": ColumnSource(heading=f"magnetometer_ga[{k}]", unit="G")
            for k, axis in enumerate("xyz")
        },
    ),
    "PX4's sensor_mag": (
        {"timestamp", "device_id", "x", "error_count"},
        {"time": ColumnSource(heading="timestamp", unit="us")}
        | {f"mag_{axis}": ColumnSource(heading=axis, unit="G") for axis in "xyz"},
    ),
}
"""Instrument -> headings by which its files are known, and what its columns are."""


def declared_by_maker(headings: Sequence[str], declared: ColumnMapping) -> tuple[str, ColumnMapping]:
    """Return the instrument's name, and what its maker says of these columns; the user's word counts more.

    The name is empty where the headings are of no known instrument.
    """
    bare = {heading.replace(" ", "") for heading in headings}
    for name, (known, columns) in MAKERS.items():
        if known <= bare:
            there = {ours: source for ours, source in columns.items() if source.heading in bare}
            return name, msgspec.structs.replace(declared, columns={**there, **declared.columns})
    return "", declared
