"""Add the metadata of OceanGliders OG1.0 to a glider's netCDF file.

A ``metadata.toml`` describes people, platform and sensor, which a log does not. The positions of GPS fixes
come from ``gps_latitude`` and ``gps_longitude``, if a log has them. Source: OceanGliders format 1.0.0,
https://oceangliderscommunity.github.io/OG-format-user-manual/OG_Format.html
"""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np

from magbridge.errors import ConfigError, FormatError
from magbridge.logs.netcdf import EPOCH, floats
from magbridge.toml import Table, convert, load_toml

TIME_FORMAT = "%Y%m%dT%H%M%S"
MANDATORY_ATTRIBUTES = (
    *("title", "contributor_name", "contributor_email", "contributor_role", "contributor_role_vocabulary"),
    *("contributing_institutions", "contributing_institutions_role"),
    *("contributing_institutions_role_vocabulary", "rtqc_method"),
)
"""Global attributes that OG1.0 demands and that no log has."""
PLATFORM = {
    "PLATFORM_SERIAL_NUMBER": "glider serial number",
    "PLATFORM_MODEL": "model of the glider",
    "WMO_IDENTIFIER": "wmo id",
}
"""Mandatory variable of the platform -> its long name."""
SENSOR_ATTRIBUTES = (
    *("sensor_model", "sensor_model_vocabulary", "sensor_type_vocabulary", "sensor_serial_number"),
)
"""Mandatory attributes of the sensor's variable, and the serial number that is part of its name."""
GLIDERS = {
    "platform": "sub-surface gliders",
    "platform_vocabulary": "https://vocab.nerc.ac.uk/collection/L06/current/27/",
}
OG1_POSITIONS = {
    "TIME": {"valid_min": 1e9, "valid_max": 4e9, "vocabulary": "TIME"},
    "LATITUDE": {"valid_min": -90.0, "valid_max": 90.0, "vocabulary": "LAT"},
    "LONGITUDE": {"valid_min": -180.0, "valid_max": 180.0, "vocabulary": "LON"},
    "DEPTH": {"valid_max": 10_000.0, "vocabulary": "DEPTH"},  # a surface at -2 cm must not be masked
}
MEASURED = ("MAG_X", "MAG_Y", "MAG_Z", "TOTAL_FIELD", "FIELD_X", "FIELD_Y", "FIELD_Z", "ANOMALY")
"""Variables that come from the magnetometer."""
FIX_COLUMNS = {"LATITUDE": "gps_latitude", "LONGITUDE": "gps_longitude"}
NO_FIXES = "the log does not say which positions are fixes"


class OgMetadata(Table, frozen=True):
    """Content of a ``metadata.toml``."""

    attributes: dict[str, str]
    """Global attributes of the file."""
    platform: dict[str, str]
    """Variables of the platform, as ``WMO_IDENTIFIER``."""
    sensor: dict[str, str]
    """Attributes of the magnetometer's variable, as ``sensor_model``."""


def read_metadata(path: Path) -> OgMetadata:
    """Read a ``metadata.toml``; ConfigError: missing, not TOML, or without a key that OG1.0 demands."""
    found = convert(load_toml(path), OgMetadata, path)
    demanded = {"attributes": MANDATORY_ATTRIBUTES, "platform": PLATFORM, "sensor": SENSOR_ATTRIBUTES}
    for table, keys in demanded.items():
        for key in keys:
            if not getattr(found, table).get(key):
                raise ConfigError(path, f"{table}.{key}", "missing key")
    return found


def complete(path: Path, metadata: OgMetadata) -> None:
    """Complete a file of :mod:`.netcdf`, in place, with the variables and attributes that OG1.0 demands.

    FormatError: the file lacks time, position or depth.
    """
    with netCDF4.Dataset(path, "a") as file:
        for name in OG1_POSITIONS:
            if name not in file.variables:
                raise FormatError(path, "expected this column: OG1.0 demands it", column=name.lower())
        known = {name: floats(file[name]) for name in OG1_POSITIONS}
        # the mission begins at the first row with a known position
        first = int(np.argmax(np.isfinite(known["LATITUDE"]) & np.isfinite(known["LONGITUDE"])))
        when = {"standard_name": "time", "calendar": "gregorian", "units": EPOCH}
        _scalar(file, "DEPLOYMENT_TIME", "f8", known["TIME"][first], long_name="date of deployment", **when)
        for name, unit in (("latitude", "degrees_north"), ("longitude", "degrees_east")):
            place = {"long_name": f"{name} of deployment", "standard_name": name, "units": unit}
            _scalar(file, f"DEPLOYMENT_{name.upper()}", "f8", known[name.upper()][first], **place)
        start = datetime.fromtimestamp(float(known["TIME"][first]), UTC).strftime(TIME_FORMAT)
        trajectory = f"{metadata.platform['PLATFORM_SERIAL_NUMBER']}_{start}"
        file["TRAJECTORY"][...] = trajectory
        file.setncatts(
            GLIDERS
            | {"id": f"{trajectory}_delayed", "start_date": start}
            | {"date_created": datetime.now(UTC).strftime(TIME_FORMAT)}
            | metadata.attributes
            | {"Conventions": f"{file.Conventions}, OG-1.0"}
        )
        for name, text in metadata.platform.items():
            _scalar(file, name, str, text, long_name=PLATFORM.get(name, name.replace("_", " ").lower()))
        for name, attributes in OG1_POSITIONS.items():
            term = attributes["vocabulary"]
            attached = {key: value for key, value in attributes.items() if key != "vocabulary"}
            vocabulary = f"https://vocab.nerc.ac.uk/collection/OG1/current/{term}/"
            file[name].setncatts(attached | {f"{name.lower()}_vocabulary": vocabulary})
        _fixes(file, known)
        _sensor(file, metadata.sensor)


def _scalar(file: Any, name: str, kind: Any, value: object, **attributes: object) -> None:
    variable = file.createVariable(name, kind)
    variable.setncatts(attributes)
    variable[...] = value


def _fixes(file: Any, known: dict[str, Any]) -> None:
    """Add variables with the times and positions of GPS fixes; all NaN if the log has no separate fixes."""
    there = {name: file.variables.get(column.upper()) for name, column in FIX_COLUMNS.items()}
    nothing = np.full(len(known["TIME"]), np.nan)
    fixed = {name: nothing if one is None else floats(one) for name, one in there.items()}
    when = np.where(np.isfinite(fixed["LATITUDE"]), known["TIME"], np.nan)
    for name, values in {"TIME": when, **fixed}.items():
        stored = {"zlib": True, "complevel": 1, "fill_value": np.nan}
        variable = file.createVariable(f"{name}_GPS", "f8", file[name].dimensions, **stored)
        kept = ("standard_name", "calendar", "units")
        variable.setncatts({key: file[name].getncattr(key) for key in kept if key in file[name].ncattrs()})
        variable.long_name = f"{name.lower()} of each GPS location"
        if None in there.values():
            variable.comment = NO_FIXES
        variable[:] = values


def _sensor(file: Any, sensor: dict[str, str]) -> None:
    """Add the magnetometer's variable, and name it in the variables that it measured."""
    name = "SENSOR_MAGNETOMETER_" + "".join(c if c.isalnum() else "_" for c in sensor["sensor_serial_number"])
    variable = file.createVariable(name, str)
    variable.setncatts({"long_name": sensor["sensor_model"], **sensor})
    for measured in MEASURED:
        if measured in file.variables:
            file[measured].sensor = name
