"""Compute the events of a replay: the bytes that fluxgate and autopilot would have sent in a deployment.

The emulated fluxgate measures at the deployment's times, and sends each reading when its last channel is
sampled. The emulated autopilot sends each row's telemetry just before the reading.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import pairwise
from math import isfinite, nan, radians
from struct import error
from typing import Any

import numpy as np
import xarray as xr

from magbridge.bridge import events
from magbridge.bridge.events import Event
from magbridge.config import Config, Telemetry
from magbridge.errors import DataError
from magbridge.field.geodesy import separation
from magbridge.mavlink.codec import Codec
from magbridge.mavlink.enums import MAG_PORT_NAME, MAV_AUTOPILOT, MAV_STATE, MAV_TYPE
from magbridge.mavlink.messages import east_e7, spec, split_index
from magbridge.records import Channel, Reading
from magbridge.sensors import open_driver
from sitl.fluxgate import Encoder, open_encoder

__all__ = ["Autopilot", "emulate", "start_us", "with_motion"]

HEARTBEAT_US = 1_000_000
FIX_3D, GPS_ACCURACY = 3, 10_000
"""GPS_FIX_TYPE and accuracy (mm) of the emulated GPS receiver."""

LARGEST = 2e6
"""Largest value (m, deg or m/s) that fits every position or motion field, even 32 bits of mm."""


class Autopilot:
    """Emulated autopilot that encodes a deployment's rows as the MAVLink messages the bridge expects.

    Its time since boot counts from `boot_us`, µs since 1970 UTC.
    """

    def __init__(self, config: Config, boot_us: int) -> None:
        self._codec = Codec(config.link.system, config.link.autopilot)
        self._telemetry = config.telemetry
        self._boot_us = boot_us
        self._next_heartbeat_us = boot_us

    def heartbeats(self, until_us: int) -> list[tuple[int, bytes]]:
        """Return the heartbeats due up to `until_us`, each with its time (µs since 1970 UTC)."""
        due = []
        while self._next_heartbeat_us <= until_us:
            frame = self._codec.pack(
                "HEARTBEAT",
                type=MAV_TYPE.SUBMARINE,
                autopilot=MAV_AUTOPILOT.GENERIC,
                system_status=MAV_STATE.ACTIVE,
                mavlink_version=3,
            )
            due.append((self._next_heartbeat_us, frame))
            self._next_heartbeat_us += HEARTBEAT_US
        return due

    def row(self, time_us: int, row: Mapping[str, float]) -> list[bytes]:
        """Return the MAVLink frames for one `row`, which has values by column name, NaN if missing."""
        boot_ms = (time_us - self._boot_us) // 1000
        frames = [
            self._parameter(telemetry, row[name], boot_ms)
            for name, telemetry in self._telemetry.items()
            if isfinite(row.get(name, nan))
        ]
        if attitude := _finite(row, "roll", "pitch", "heading"):
            roll, pitch, yaw = map(radians, attitude)
            frames.append(self._codec.pack("ATTITUDE", time_boot_ms=boot_ms, roll=roll, pitch=pitch, yaw=yaw))
        return frames + self._position(row, boot_ms)

    def _position(self, row: Mapping[str, float], boot_ms: int) -> list[bytes]:
        """Return the messages of position and motion: estimated position, local track, speed, GPS."""
        pack, frames = self._codec.pack, []
        (depth,) = _finite(row, "depth") or (nan,)
        if known := _finite(row, "latitude", "longitude"):
            latitude, longitude = round(known[0] * 1e7), east_e7(known[1])
            altitude = round(-1e3 * depth) if isfinite(depth) else 0
            place = {"lat": latitude, "lon": longitude, "alt": altitude, "relative_alt": altitude}
            frames.append(pack("GLOBAL_POSITION_INT", time_boot_ms=boot_ms, **place))
        if known := _finite(row, "local_north", "local_east"):
            north, east = known
            frames.append(pack("LOCAL_POSITION_NED", time_boot_ms=boot_ms, x=north, y=east, z=depth))
        if known := _finite(row, "water_speed"):
            frames.append(pack("VFR_HUD", airspeed=known[0]))
        if known := _finite(row, "gps_latitude", "gps_longitude"):
            latitude, longitude = round(known[0] * 1e7), east_e7(known[1])
            fix = {"lat": latitude, "lon": longitude, "fix_type": FIX_3D, "h_acc": GPS_ACCURACY}
            frames.append(pack("GPS_RAW_INT", time_usec=boot_ms * 1000, **fix))
        return frames

    def _parameter(self, telemetry: Telemetry, value: float, boot_ms: int) -> bytes:
        """Return the message from which the bridge's telemetry mapping will read `value`."""
        name, index = split_index(telemetry.field)
        field = spec(telemetry.message).fields[name]
        number: Any = (value - telemetry.offset) / telemetry.scale
        if field.code not in "fd":
            number = round(number)
        fields: dict[str, Any] = dict(telemetry.match)
        if "time_boot_ms" in spec(telemetry.message).fields:
            fields["time_boot_ms"] = boot_ms
        if index is not None:
            values = [0] * field.count
            values[index] = number
            number = bytes(values) if field.code == "B" else values
        try:
            return self._codec.pack(telemetry.message, **{**fields, name: number})
        except (OverflowError, ValueError, error):
            raise DataError(f"{value!r} does not fit {telemetry.message}.{telemetry.field}") from None


def _finite(row: Mapping[str, float], *names: str) -> tuple[float, ...]:
    """Return the row's values of these names; () if a value is missing or too large for a message."""
    values = tuple(row.get(name, nan) for name in names)
    return values if all(abs(value) < LARGEST for value in values) else ()


# ---- the events of a deployment ----------------------------------------------------------------------------


LEAD_US = 2_000_000
"""Time from the bridge's start to the first row, µs."""
TELEMETRY_LEAD_US = 1_000
"""Time from a row's telemetry to its reading, µs."""
LINE_DELAY_US = 2_000
"""Time from a reading's last sample to its last byte, µs."""


def start_us(deployment: xr.Dataset) -> int:
    """Return the time at which the bridge starts, µs since 1970 UTC, shortly before the first row."""
    return _stamp(float(deployment["time"][0])) - LEAD_US


def emulate(deployment: xr.Dataset, config: Config) -> Iterator[Event]:
    """Yield the events of a deployment with ``mag_x mag_y mag_z``, in order of time.

    The bridge's configuration determines the emulated instrument and the messages of the telemetry.

    Raises
    ------
    ConfigError
        The instrument cannot be emulated.
    """
    if config.navigation is not None:
        deployment = with_motion(deployment)
    begin_us = start_us(deployment)
    autopilot = Autopilot(config, begin_us)
    times = deployment["time"].to_numpy().astype(float)
    fluxgate = open_encoder(config.sensor.driver, config.sensor.options, _rate(times), config.path)
    driver = open_driver(config.sensor.driver, config.sensor.options, config.path)
    answers = b"".join(fluxgate.feed(command) for command in driver.start())
    for port in (MAG_PORT_NAME.SENSOR, MAG_PORT_NAME.LINK):
        yield Event(begin_us, Channel.STATE, events.port_state(port))
    if answers:
        yield Event(begin_us, Channel.SENSOR, answers)
    last_us = begin_us
    for time_us, row in _rows(deployment):
        reported_us = max(last_us, time_us - TELEMETRY_LEAD_US & ~3)
        for beat_us, frame in autopilot.heartbeats(reported_us):
            yield Event(max(last_us, beat_us), Channel.LINK, frame)
        frames = autopilot.row(time_us, row)
        if frames:
            yield Event(reported_us, Channel.LINK, b"".join(frames))
        last_us = reported_us
        data, delay_us = _reading(fluxgate, (time_us - begin_us) * 1e-6, row, time_us)
        if data:
            last_us = max(reported_us, time_us + delay_us + LINE_DELAY_US & ~3)
            yield Event(last_us, Channel.SENSOR, data)


def _rows(deployment: xr.Dataset) -> Iterator[tuple[int, dict[str, float]]]:
    """Yield the time (µs since 1970 UTC) and the values by name of each row."""
    names = ["time", *(str(name) for name in deployment.data_vars)]
    columns = [deployment[name].to_numpy().astype(float).tolist() for name in names]
    for values in zip(*columns, strict=True):
        row = dict(zip(names, values, strict=True))
        yield _stamp(row["time"]), row


def _reading(fluxgate: Encoder, device_time: float, row: dict[str, float], time_us: int) -> tuple[bytes, int]:
    """Return the bytes of a row's reading, and the time (µs) until its last channel is sampled."""
    x, y, z = row["mag_x"], row["mag_y"], row["mag_z"]
    if not isfinite(x + y + z):
        return b"", 0
    dx, dy, dz = (
        delay if isfinite(delay := row.get(f"mag_time_{axis}", nan) - time_us * 1e-6) else 0.0
        for axis in "xyz"
    )
    delays = (max(dx, 0.0), max(dy, 0.0), max(dz, 0.0))
    temperature = row.get("sensor_temperature", nan)
    reading = Reading((x, y, z), device_time=device_time, channel_delay=delays, temperature=temperature)
    data = fluxgate.encode(reading)
    return data, round(max(delays) * 1e6)


def _stamp(time: float) -> int:
    return round(time * 1e6) & ~3


def _rate(times: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float:
    steps = [later - earlier for earlier, later in pairwise(times[:1000].tolist())]
    return 1.0 / float(np.median(steps)) if steps else 1.0


def with_motion(deployment: xr.Dataset) -> xr.Dataset:
    """Return the deployment with the columns that the autopilot sends to a navigator.

    These are ``gps_latitude gps_longitude`` (deg), from the log or its first position, and ``local_north
    local_east`` (m), from a logged track or velocity. If the log has only a speed or a glide, the bridge
    computes the motion. The first of :data:`~magbridge.navigate.batch.MOTIONS` that the log has is used.

    Raises
    ------
    FormatError
        The log has no position to start from, or no motion.
    """
    from magbridge.navigate.batch import MOTIONS, first_position, motion_of  # noqa: PLC0415 - takes a second

    source = str(deployment.attrs.get("source", "deployment"))
    motion = motion_of(deployment, source)
    if "gps_latitude" not in deployment:
        for name, first in zip(("latitude", "longitude"), first_position(deployment, source), strict=True):
            fix = np.where(np.arange(deployment.sizes["time"]) == 0, first, np.nan)
            deployment = deployment.assign({f"gps_{name}": ("time", fix)})
    columns = [deployment[name].to_numpy().astype(float) for name in MOTIONS[motion]]
    if motion == "velocity":
        step = np.diff(deployment["time"].to_numpy().astype(float), prepend=np.nan)
        local = [np.nancumsum(step * (velocity + np.roll(velocity, 1)) / 2) for velocity in columns]
    elif motion in ("inertial", "position"):
        latitude, longitude = columns
        known = np.flatnonzero(np.isfinite(latitude + longitude))[0]
        local = list(separation(float(latitude[known]), float(longitude[known]), latitude, longitude))
    else:
        return deployment
    return deployment.assign(local_north=("time", local[0]), local_east=("time", local[1]))
