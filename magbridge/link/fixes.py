"""Position fixes in the messages that autopilots accept, by the source code of each receiver.

A comment at each field names what a receiver does with it, and the source file: ArduPilot's of
December 2025, PX4's of August 2026.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf, nan, sqrt
from typing import Any, NamedTuple

import msgspec

from magbridge.link.output import Outbox
from magbridge.mavlink.enums import GLOBAL_POSITION_SRC, MAV_AUTOPILOT, MAV_CMD, MAV_ESTIMATOR_TYPE, MAV_FRAME
from magbridge.mavlink.messages import east_e7

__all__ = ["FIX_MESSAGES", "SENSOR_ID", "Fix", "Kind", "Pose", "widened"]

SENSOR_ID = 1
"""GLOBAL_POSITION_SENSOR.id; PX4 takes the one that ``EKF2_AGPn_ID`` names, and 0 is off."""
LATITUDE_LONGITUDE_ONLY = 0
"""GLOBAL_POSITION_SENSOR.flags"""
GOOD = 100
"""ODOMETRY.quality, in %: only valid positions are sent."""
OTHERS_VARIANCE = 1.0
"""Variances of height (m²) and attitude (rad²) in an ODOMETRY; both are the autopilot's own."""
WALK = 1e-3
"""(m/s)²/s: how fast the wind, or the velocity error, of an autopilot's filter is taken to walk."""


class Pose(NamedTuple):
    """Content of ODOMETRY in addition to the position, from the vehicle's telemetry."""

    north: float
    east: float
    down: float
    """`north`, `east`, `down`: m, from the origin of the autopilot's local frame."""
    attitude: tuple[float, float, float, float]
    """Quaternion w, x, y, z from body to north-east-down."""


class Fix(msgspec.Struct, frozen=True, gc=False):
    """A position at the moment of sending, with its covariance."""

    time_us: int
    """µs since 1970 UTC at which it holds: that of sending."""
    latitude: float
    longitude: float
    """`latitude`, `longitude`: deg."""
    covariance_nn: float
    covariance_ne: float
    covariance_ee: float
    """`covariance_nn`, `covariance_ne`, `covariance_ee`: m²."""
    altitude: float = nan
    """m above the sea; NaN where not known."""
    pose: Pose | None = None
    """Where the message is in a local frame."""
    resets: int = 0
    """How often the estimate has jumped."""

    @property
    def sigma(self) -> float:
        """1-sigma (m) on each axis of the circle with the area of the ellipse.

        Receivers know only circles. That of the worse axis would claim less than is known, by up to a third.
        """
        return sqrt(0.5 * (self.covariance_nn + self.covariance_ee))


def widened(fix: Fix, seconds: float) -> Fix:
    """Return a fix that a filter may fuse as independent, `seconds` after the previous one.

    Notes
    -----
    The errors of successive fixes are correlated, but an autopilot's filter takes them for independent and
    would soon claim to know the position better than the fixes do. Fixes of variance R, every dt, are to it
    white noise of the density N = R dt. A filter whose velocity (or wind) walks with the density q (`WALK`),
    fed with that, comes to the variance

        P = √2 q^(1/4) N^(3/4)

    (steady state of the Riccati equation of a doubly integrated white noise). R is chosen so that P is the
    fix's own variance σ²: R = (σ²/√2)^(4/3) q^(-1/3) / dt, and never less than σ². Seen from the filter, that
    is an inflation by about the root of rate times correlation time, where the filter's own memory,
    (N/q)^(1/4), a minute or two, is the shorter of the two times. P depends on q only by its fourth root: the
    wind of ArduPilot walks with 5e-4 (``EK3_WIND_P_NSE``), PX4's with 2.5e-3 (``EKF2_WIND_NSD``), a velocity
    from accelerometers with 1e-3.
    """
    variance = fix.sigma**2
    density = (variance / 2.0**0.5) ** (4.0 / 3.0) * WALK ** (-1.0 / 3.0)
    factor = max(1.0, density / (variance * seconds)) if seconds > 0.0 and variance > 0.0 else 1.0
    return msgspec.structs.replace(
        fix,
        covariance_nn=fix.covariance_nn * factor,
        covariance_ne=fix.covariance_ne * factor,
        covariance_ee=fix.covariance_ee * factor,
    )


def external_position(outbox: Outbox, fix: Fix, system: int, autopilot: int) -> None:
    """Send MAV_CMD_EXTERNAL_POSITION_ESTIMATE: the autopilot sets its position and answers.

    ArduPilot (``AP_NavEKF3_PosVelFusion.cpp``, setLatLng) moves it on by its own velocity over the age, which
    is 0 here; PX4 (``EKF2.cpp``) insists that the age is a number.
    """
    outbox.send(
        "COMMAND_INT",
        command=MAV_CMD.EXTERNAL_POSITION_ESTIMATE,
        frame=MAV_FRAME.GLOBAL,
        param1=fix.time_us * 1e-6 % 1e5,  # s, of our clock; a float holds no more
        param2=0.0,  # s, age
        param3=fix.sigma,
        param4=nan,
        x=round(fix.latitude * 1e7),
        y=east_e7(fix.longitude),
        z=nan,
        target_system=system,
        target_component=autopilot,
    )


def global_position(outbox: Outbox, fix: Fix, system: int, autopilot: int) -> None:
    """Send GLOBAL_POSITION_SENSOR, which PX4 fuses as an auxiliary position.

    PX4 (``mavlink_receiver.cpp``, ``aux_global_position_control.cpp``) takes its arrival as its time, and a
    sigma that is not a number as 1 m.
    """
    outbox.send(
        "GLOBAL_POSITION_SENSOR",
        target_system=system,
        target_component=autopilot,
        id=SENSOR_ID,
        time_usec=fix.time_us,
        processing_time=0,
        source=GLOBAL_POSITION_SRC.MAGNETIC,
        flags=LATITUDE_LONGITUDE_ONLY,
        lat=round(fix.latitude * 1e7),
        lon=east_e7(fix.longitude),
        alt=fix.altitude,
        alt_ellipsoid=nan,
        eph=fix.sigma,
        epv=nan,
    )


def odometry(outbox: Outbox, fix: Fix, system: int, autopilot: int) -> None:  # noqa: ARG001 - it has no target
    """Send ODOMETRY in the autopilot's local frame, which is north-east-down in spite of its name.

    ArduPilot (``GCS_Common.cpp``, handle_odometry) takes these two frames only, needs the whole pose, and
    computes ``cbrt(c0² + c6² + c11²)`` and ``cbrt(c15² + c18² + c20²)`` from the covariance: a number that is
    none there is an internal error. It drops a velocity that is none.
    """
    assert fix.pose is not None
    pose = fix.pose
    covariance = [0.0] * 21  # the upper triangle of x y z roll pitch yaw, row by row
    covariance[0], covariance[1], covariance[6] = fix.covariance_nn, fix.covariance_ne, fix.covariance_ee
    for diagonal in (11, 15, 18, 20):
        covariance[diagonal] = OTHERS_VARIANCE
    outbox.send(
        "ODOMETRY",
        time_usec=fix.time_us,
        frame_id=MAV_FRAME.LOCAL_FRD,
        child_frame_id=MAV_FRAME.BODY_FRD,
        x=pose.north,
        y=pose.east,
        z=pose.down,
        q=pose.attitude,
        **dict.fromkeys(("vx", "vy", "vz", "rollspeed", "pitchspeed", "yawspeed"), nan),
        pose_covariance=covariance,
        velocity_covariance=[nan] * 21,
        reset_counter=fix.resets & 0xFF,
        estimator_type=MAV_ESTIMATOR_TYPE.VISION,
        quality=GOOD,
    )


class Kind(NamedTuple):
    """Message of a fix, and how its receiver uses it."""

    send: Callable[[Outbox, Fix, int, int], Any]
    """Sends a :class:`Fix` to a system and component."""
    rate: float
    """Hz by default; 0 is with every update."""
    refused_by: dict[int, str]
    """Autopilots that cannot use it, and what to set instead."""
    fused: bool
    """The receiver fuses it with its own position; else it puts its position there."""
    local: bool = False
    """It holds a :class:`Pose`."""
    trusted_to: float = inf
    """Sigma that ArduPilot uses instead of any larger one, m."""
    least: float = 0.0
    """Hz below which the receiver takes the source for dead."""

    def overrated(self, fix: Fix) -> bool:
        """Return True if ArduPilot would state a smaller error than such fixes have at this rate."""
        if self.trusted_to == inf:
            return False
        return widened(fix, 1.0 / max(self.rate, self.least)).sigma > self.trusted_to


FIX_MESSAGES: dict[str, Kind] = {
    "EXTERNAL_POSITION_ESTIMATE": Kind(external_position, 0.0, {}, fused=False),
    "GLOBAL_POSITION_SENSOR": Kind(
        global_position,
        0.0,
        {MAV_AUTOPILOT.ARDUPILOTMEGA: "ArduPilot ignores this message: use EXTERNAL_POSITION_ESTIMATE"},
        fused=True,
    ),
    "ODOMETRY": Kind(
        odometry,
        5.0,
        # EKF2's EV position learns our offset as a bias, and drops messages 0.25 s late (ev_control.cpp)
        {MAV_AUTOPILOT.PX4: "PX4 makes a bias of ODOMETRY: use GLOBAL_POSITION_SENSOR"},
        fused=True,
        local=True,
        trusted_to=10.0,  # AP_NavEKF3_PosVelFusion.cpp: constrain_ftype(posErr, 0.01f, 10.0f)
        least=4.0,  # AP_VisualOdom_Backend.cpp: unhealthy 300 ms after the last
    ),
}
"""What ``[navigation] fix`` may name."""
