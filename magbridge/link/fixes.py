"""A position fix, in the message that the navigation stack takes."""

from __future__ import annotations

from collections.abc import Callable
from math import isfinite, nan
from typing import Any, NamedTuple

import msgspec

from magbridge.field.geodesy import worse_axis
from magbridge.link.outbox import Outbox
from magbridge.mavlink.dialect import MAV_CMD, MAV_ESTIMATOR_TYPE, MAV_FRAME

__all__ = ["FIXES", "Fix", "Kind"]

UNKNOWN_SOURCE = 0
"""GLOBAL_POSITION_UNKNOWN"""
LATITUDE_LONGITUDE_ONLY = 0
"""GLOBAL_POSITION_SENSOR.flags"""


class Fix(msgspec.Struct, frozen=True, gc=False):
    """A position with its covariance.

    Attributes
    ----------
    time_us : int
        µs since 1970 UTC at which it holds.
    age : float
        s, since then.
    latitude, longitude : float
        deg.
    covariance_nn, covariance_ne, covariance_ee : float
        m^2.
    north, east : float
        m, from the first GPS position.
    resets : int
        How often the estimate has jumped.
    """

    time_us: int
    age: float
    latitude: float
    longitude: float
    covariance_nn: float
    covariance_ne: float
    covariance_ee: float
    north: float
    east: float
    resets: int

    @property
    def sigma(self) -> float:
        """m, 1-sigma of the worse axis."""
        return worse_axis(self.covariance_nn, self.covariance_ne, self.covariance_ee)


def external_position(outbox: Outbox, fix: Fix, system: int, autopilot: int) -> None:
    """Send MAV_CMD_EXTERNAL_POSITION_ESTIMATE: ArduPilot resets its position to it while it dead-reckons."""
    outbox.send(
        "COMMAND_INT",
        command=MAV_CMD.EXTERNAL_POSITION_ESTIMATE,
        frame=MAV_FRAME.GLOBAL,
        param1=outbox.codec.now_us * 1e-6 % 1e5,
        param2=fix.age,
        param3=fix.sigma,
        param4=nan,
        x=round(fix.latitude * 1e7),
        y=round(fix.longitude * 1e7),
        z=nan,
        target_system=system,
        target_component=autopilot,
    )


def global_position(outbox: Outbox, fix: Fix, system: int, autopilot: int) -> None:
    """Send GLOBAL_POSITION_SENSOR, which PX4 fuses as an auxiliary position."""
    outbox.send(
        "GLOBAL_POSITION_SENSOR",
        target_system=system,
        target_component=autopilot,
        id=0,
        time_usec=fix.time_us,
        processing_time=round(fix.age * 1e6),
        source=UNKNOWN_SOURCE,
        flags=LATITUDE_LONGITUDE_ONLY,
        lat=round(fix.latitude * 1e7),
        lon=round(fix.longitude * 1e7),
        alt=nan,
        alt_ellipsoid=nan,
        eph=fix.sigma,
        epv=nan,
    )


def odometry(outbox: Outbox, fix: Fix, system: int, autopilot: int) -> None:  # noqa: ARG001 - it has no target
    """Send ODOMETRY in the local frame, from the first GPS position; for ArduPilot and PX4."""
    covariance = [nan] * 21  # the upper triangle of x y z roll pitch yaw, row by row
    covariance[0], covariance[1], covariance[6] = fix.covariance_nn, fix.covariance_ne, fix.covariance_ee
    outbox.send(
        "ODOMETRY",
        time_usec=fix.time_us,
        frame_id=MAV_FRAME.LOCAL_NED,
        child_frame_id=MAV_FRAME.BODY_FRD,
        x=fix.north,
        y=fix.east,
        z=nan,
        q=(nan,) * 4,
        vx=nan,
        vy=nan,
        vz=nan,
        rollspeed=nan,
        pitchspeed=nan,
        yawspeed=nan,
        pose_covariance=covariance,
        velocity_covariance=[nan] * 21,
        reset_counter=fix.resets & 0xFF,
        estimator_type=MAV_ESTIMATOR_TYPE.NAIVE,
        quality=100 if isfinite(fix.sigma) else -1,
    )


class Kind(NamedTuple):
    """How a fix is sent, and its default rate in Hz; 0 is with every update."""

    send: Callable[[Outbox, Fix, int, int], Any]
    rate: float


FIXES: dict[str, Kind] = {
    "EXTERNAL_POSITION_ESTIMATE": Kind(external_position, 0.0),
    "GLOBAL_POSITION_SENSOR": Kind(global_position, 0.0),
    "ODOMETRY": Kind(odometry, 5.0),  # ArduPilot takes nothing below 4 Hz
}
"""What ``[navigation] fix`` may name."""
