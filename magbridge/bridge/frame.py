"""The autopilot's local frame, and the vehicle's height and attitude in it, for ODOMETRY."""

from __future__ import annotations

from math import isnan, nan

from magbridge.field.geodesy import separation
from magbridge.link.attitude import quaternion
from magbridge.link.fixes import Pose
from magbridge.mavlink import Message, by_id

__all__ = ["Frame"]

MAX_STATE_AGE_US = 10_000_000
"""µs, for which a height or an attitude is the present one."""
UNSET = (0, 0)
"""GPS_GLOBAL_ORIGIN's latitude and longitude of an autopilot without an origin."""


class Frame:
    """Track the origin of the autopilot's local frame, and the vehicle's height and attitude.

    Attributes
    ----------
    origin : tuple of float or None
        deg, deg, m above the sea.
    attitude : tuple of float
        Quaternion w, x, y, z from body to north-east-down, as last heard.
    """

    def __init__(self) -> None:
        self.origin: tuple[float, float, float] | None = None
        self.attitude = 1.0, 0.0, 0.0, 0.0
        self._altitude = self._down = nan
        self._altitude_us = self._down_us = self._attitude_us = -MAX_STATE_AGE_US
        self._handlers = by_id(
            ATTITUDE=self._turn, GLOBAL_POSITION_INT=self._rise, GPS_GLOBAL_ORIGIN=self._set_origin,
            LOCAL_POSITION_NED=self._sink, ODOMETRY=self._sink,
        )  # fmt: skip

    def receive(self, message: Message, time_us: int) -> None:
        """Process a message of the autopilot."""
        if handler := self._handlers.get(message.id):
            handler(message, time_us)

    def altitude(self, time_us: int) -> float:
        """Return the altitude (m above the sea); NaN if unknown."""
        if time_us - self._altitude_us < MAX_STATE_AGE_US:
            return self._altitude
        if self.origin is not None and time_us - self._down_us < MAX_STATE_AGE_US:
            return self.origin[2] - self._down
        return nan

    def depth(self, time_us: int) -> float:
        """Return the depth (m below the sea); without an origin, the local height counts from the start."""
        altitude = self.altitude(time_us)
        return self._down if isnan(altitude) and time_us - self._down_us < MAX_STATE_AGE_US else -altitude

    def pose(self, time_us: int, latitude: float, longitude: float) -> Pose | str:
        """Return the pose of a vehicle at a position (deg), or the reason why there is none."""
        if self.origin is None:
            return "no origin of the autopilot's frame"
        if time_us - self._attitude_us >= MAX_STATE_AGE_US:
            return "no attitude from the autopilot"
        down = (
            self._down
            if time_us - self._down_us < MAX_STATE_AGE_US
            else self.origin[2] - self.altitude(time_us)
        )
        if isnan(down):
            return "no height from the autopilot"
        return Pose(*separation(*self.origin[:2], latitude, longitude), down, self.attitude)

    def _turn(self, message: Message, time_us: int) -> None:
        self.attitude = quaternion(message["roll"], message["pitch"], message["yaw"])
        self._attitude_us = time_us

    def _rise(self, message: Message, time_us: int) -> None:
        self._altitude, self._altitude_us = 1e-3 * message["alt"], time_us

    def _sink(self, message: Message, time_us: int) -> None:
        self._down, self._down_us = message["z"], time_us

    def _set_origin(self, message: Message, time_us: int) -> None:  # noqa: ARG002 - a handler like the others
        if (message["latitude"], message["longitude"]) != UNSET:
            where = message["latitude"] * 1e-7, message["longitude"] * 1e-7
            self.origin = *where, 1e-3 * message["altitude"]
