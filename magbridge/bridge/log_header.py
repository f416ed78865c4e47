"""Beginning of a log: the start of the run, and the source of each column."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from magbridge.bridge.events import StartEvent
from magbridge.config import Config, Sensor, Telemetry
from magbridge.mavlink import Codec
from magbridge.mavlink.enums import MAV_PARAM_TYPE
from magbridge.sensors import Driver, is_scalar
from magbridge.version import __version__

__all__ = ["beginning", "declarations"]


def beginning(
    config: Config, start: StartEvent, calibration_id: int, parameters: Mapping[str, float]
) -> list[bytes]:
    """Return the frames that record how a run started, with these values of the parameters by name."""
    codec = Codec(config.link.system, config.link.component)
    frames = [
        codec.pack(
            "MAG_BRIDGE_START",
            time_usec=start.time_us,
            signing_timestamp=start.signing_timestamp,
            calibration_id=calibration_id,
            config_digest=bytes.fromhex(config.digest),
            version=__version__,
            driver=config.sensor.driver,
        )
    ]
    for link, system, sender, ahead, stamp in start.signing_streams:
        stream = {"link": link, "system": system, "sender": sender, "ahead": ahead, "stamp": stamp}
        frames.append(codec.pack("MAG_SIGNING_STREAM", **stream))
    for name, value in parameters.items():
        real = MAV_PARAM_TYPE.REAL32
        frames.append(codec.pack("PARAM_VALUE", param_id=name, param_value=value, param_type=real))
    return frames


def declarations(
    system: int,
    component: int,
    telemetry: Mapping[str, Telemetry],
    nt_per_count: float = 0.0,
    settings: Mapping[str, float] | None = None,
    sensors: Sequence[tuple[Sensor, Driver]] = (),
) -> list[bytes]:
    """Return the frames that declare source and correction of each column of the log.

    Parameters
    ----------
    system, component : int
        The bridge's own.
    telemetry : mapping of str to Telemetry
        By parameter.
    nt_per_count : float
        nT per count of the sensor, 0 for one without counts. A reader then takes the channels from the
        counts, because MAG_RAW's float32 fields are less precise than the values that were corrected.
    settings : mapping of str to float, optional
        What decides about flags and sigmas, by its key in the configuration: attributes of the log.
    sensors : sequence of (Sensor, Driver)
        The sensors after the first. Their columns have the name of the sensor: ``NAME`` for a scalar, else
        ``NAME_x``, ``NAME_y`` and ``NAME_z``; ``NAME_time`` is the time of the reading.
    """
    codec = Codec(system, component)
    columns: list[dict[str, Any]] = [
        {"column": key, "scale": value} for key, value in (settings or {}).items()
    ]
    columns += [
        {
            "column": name,
            "unit": one.unit,
            "message": one.message,
            "field": one.field,
            "match": ",".join(f"{field}={value}" for field, value in one.match.items()),
            "scale": one.scale,
            "offset": one.offset,
            "component": one.component or 0,
        }
        for name, one in telemetry.items()
    ]
    if nt_per_count:
        raw = {"unit": "nT", "message": "MAG_RAW", "scale": nt_per_count}
        columns += [raw | {"column": f"mag_{axis}", "field": f"count_{axis}"} for axis in "xyz"]
    for sensor, driver in sensors:
        columns += _sensor_columns(sensor, driver)
    return [codec.pack("MAG_COLUMN", **column) for column in columns]


def _sensor_columns(sensor: Sensor, driver: Driver) -> list[dict[str, Any]]:
    """Return the columns of a sensor after the first."""
    raw: dict[str, Any] = {"message": "MAG_RAW", "match": f"sensor_id={sensor.id}", "unit": "nT"}
    prefix = "count_" if driver.nt_per_count else ""
    raw["scale"] = driver.nt_per_count or 1.0
    names = {"x": sensor.name} if is_scalar(driver) else {axis: f"{sensor.name}_{axis}" for axis in "xyz"}
    columns = [raw | {"column": name, "field": f"{prefix}{axis}"} for axis, name in names.items()]
    time = {"column": f"{sensor.name}_time", "field": "time_usec", "unit": "s", "scale": 1e-6}
    return [*columns, raw | time]
