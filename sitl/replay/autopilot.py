"""An emulated autopilot: sends a deployment's telemetry over MAVLink.

System 1, component 1. Once a second a heartbeat; with every row of the deployment the messages from which the
bridge's configuration takes its parameters, the attitude and the position.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite, nan, radians
from struct import error
from typing import Any

from magbridge.config import Config, Telemetry
from magbridge.errors import DataError
from magbridge.mavlink.codec import Codec
from magbridge.mavlink.enums import MAV_AUTOPILOT, MAV_STATE, MAV_TYPE
from magbridge.mavlink.messages import east_e7, spec, split_index

HEARTBEAT_US = 1_000_000
FIX_3D, GPS_ACCURACY = 3, 10_000
"""GPS_FIX_TYPE and mm of its receiver."""

LARGEST = 2e6
"""m, deg, m/s: the largest value that fits every position or motion field, 32 bits of mm included."""


class Autopilot:
    """Turns rows of a deployment into MAVLink frames, as the bridge's configuration expects them.

    The vehicle booted at `boot_us`, µs since 1970 UTC.
    """

    def __init__(self, config: Config, boot_us: int) -> None:
        self._codec = Codec(config.link.system, config.link.autopilot)
        self._telemetry = config.telemetry
        self._boot_us = boot_us
        self._next_heartbeat_us = boot_us

    def heartbeats(self, until_us: int) -> list[tuple[int, bytes]]:
        """Return the heartbeats due up to `until_us`, with their times."""
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
        """Return the frames for one row: columns by their contract names, NaN where missing."""
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
        """Return the message from which the bridge will read `value`: the inverse of its mapping."""
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
    """Return the row's values under these names; nothing if one is missing or too large for a message."""
    values = tuple(row.get(name, nan) for name in names)
    return values if all(abs(value) < LARGEST for value in values) else ()
