"""Record all inputs and outputs of the bridge for the log; a replay needs nothing else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from struct import Struct
from typing import Any, Final

from magbridge.bridge.events import StartEvent
from magbridge.config import Config, Sensor, Telemetry
from magbridge.mavlink import Codec, spec
from magbridge.mavlink.enums import MAV_PARAM_TYPE
from magbridge.records import Channel
from magbridge.sensors import Driver, is_scalar
from magbridge.version import __version__

__all__ = ["Recorder", "beginning", "declarations"]

BYTES: Final = spec("MAG_SENSOR_BYTES")
RAW: Final = spec("MAG_RAW")
BYTES_HEADER: Final = Struct("<BB")
"""The fields of MAG_SENSOR_BYTES before its data: sensor_id, length."""
RECORDED_BYTES: Final = BYTES.fields["data"].count
SENT, LINK, SENSOR, STATE = Channel


class Recorder:
    """Collect records until :meth:`drain`.

    Attributes
    ----------
    active : bool
        Whether records are collected and counted; False without a log.
    count : int
        Records collected since the start.
    """

    def __init__(self, system: int, component: int, *, active: bool) -> None:
        self.active = active
        self.count = 0
        self._records: list[tuple[int, Channel, bytes]] = []
        self._scribe = Codec(system, component)

    def sent(self, frames: list[tuple[int, bytes]]) -> None:
        """Record the frames sent over the link, each with its event time (µs)."""
        if self.active and frames:
            self._records += [(time_us, SENT, frame) for time_us, frame in frames]
            self.count += len(frames)

    def link(self, time_us: int, frames: list[bytes]) -> None:
        """Record the frames that came over the link."""
        for frame in frames:
            self._add(time_us, LINK, frame)

    def sensor(self, time_us: int, data: bytes, sensor_id: int = 0) -> None:
        """Record bytes as they came from a sensor."""
        if not self.active:
            return
        while data:
            piece, data = data[:RECORDED_BYTES], data[RECORDED_BYTES:]
            frame = self._scribe.frame(BYTES, BYTES_HEADER.pack(sensor_id, len(piece)) + piece)
            self._add(time_us, SENSOR, frame)

    def state(self, time_us: int, frame: bytes) -> None:
        """Record a frame of :mod:`magbridge.bridge.states`, or of the run's start."""
        self._add(time_us, STATE, frame)

    def raw(self, time_us: int, payload: bytes) -> None:
        """Record a MAG_RAW in the log only, because a calibration needs every sample."""
        self._add(time_us, STATE, self._scribe.frame(RAW, payload))

    def drain(self) -> list[tuple[int, Channel, bytes]]:
        """Return and clear the records collected so far, in order: event time in µs, channel, frame."""
        records, self._records = self._records, []
        return records

    def _add(self, time_us: int, channel: Channel, frame: bytes) -> None:
        if self.active:
            self._records.append((time_us, channel, frame))
            self.count += 1


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
