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

from magbridge.logs.mapping import Declared, Source

__all__ = ["declared_by_maker"]

MAKERS: dict[str, tuple[set[str], dict[str, Source]]] = {
    "MagArrow": (
        {"Counter", "Date", "Time", "Mag", "MagValid"},
        {
            "total_field": Source(heading="Mag", unit="nT", valid="MagValid"),
            "mag_x": Source(heading="CompassY", unit="nT", scale=-1.0),
            "mag_y": Source(heading="CompassX", unit="nT"),
            "mag_z": Source(heading="CompassZ", unit="nT"),
            "sensor_temperature": Source(heading="CompassTemperature", unit="degC"),
        },
    ),
    "MagMap": (
        {"READING_1", "DATE", "TIME", "LINE", "MARK"},
        {
            "total_field": Source(heading="READING_1", unit="nT"),
            "time": Source(heading="TIME", unit="%m/%d/%y %H:%M:%S"),
        },
    ),
    "DJI's DatCon": (
        {"Tick#", "offsetTime"},
        {
            "time": Source(heading="offsetTime", unit="s"),
            "latitude": Source(heading="GPS:Lat", unit="deg"),
            "longitude": Source(heading="GPS:Long", unit="deg"),
            "roll": Source(heading="IMU_ATTI(0):roll:C", unit="deg"),
            "pitch": Source(heading="IMU_ATTI(0):pitch:C", unit="deg"),
            "heading": Source(heading="IMU_ATTI(0):yaw:C", unit="deg"),
        },
    ),
    "an RM3100 logger": (
        {"ts", "rt", "lt", "x", "y", "z", "rx", "ry", "rz"},
        {f"mag_{axis}": Source(heading=axis, unit="uT") for axis in "xyz"}
        | {"sensor_temperature": Source(heading="rt", unit="degC")},
    ),
    "PX4's vehicle_magnetometer": (
        {"timestamp", "device_id", "magnetometer_ga[0]"},
        {"time": Source(heading="timestamp", unit="us")}
        | {f"mag_{axis}": Source(heading=f"magnetometer_ga[{k}]", unit="G") for k, axis in enumerate("xyz")},
    ),
    "PX4's sensor_mag": (
        {"timestamp", "device_id", "x", "error_count"},
        {"time": Source(heading="timestamp", unit="us")}
        | {f"mag_{axis}": Source(heading=axis, unit="G") for axis in "xyz"},
    ),
}
"""Instrument -> headings by which its files are known, and what its columns are."""


def declared_by_maker(headings: Sequence[str], declared: Declared) -> tuple[str, Declared]:
    """Return the instrument's name, and what its maker says of these columns; the user's word counts more.

    The name is empty where the headings are of no known instrument.
    """
    bare = {heading.replace(" ", "") for heading in headings}
    for name, (known, columns) in MAKERS.items():
        if known <= bare:
            there = {ours: source for ours, source in columns.items() if source.heading in bare}
            return name, msgspec.structs.replace(declared, columns={**there, **declared.columns})
    return "", declared
