"""Attitude with the magnetic heading, in the messages and sentences that receivers read.

Each message is filled as the receiver's source reads it: ArduPilot 856c2a1, PX4 bb59c63.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from functools import reduce
from math import cos, inf, isfinite, nan, radians, sin
from operator import xor
from typing import Final, NamedTuple

from magbridge.link.output import Outbox
from magbridge.mavlink.enums import MAV_AUTOPILOT, MAV_ESTIMATOR_TYPE, MAV_FRAME

__all__ = ["HEADING_SENDERS", "NO_ATTITUDE", "Attitude", "nmea_sentences", "quaternion", "send_attitude"]

IGNORED_VARIANCE: Final = 1e4
"""Variance of position, m², and of roll and pitch, rad², in a message of which the autopilot shall only use
the yaw."""
FULL_QUALITY: Final = 100
"""ODOMETRY.quality, %."""


class Attitude(NamedTuple):
    """Attitude of the vehicle at one time, with the heading that follows from the corrected field."""

    magnetic: float
    """Heading clockwise from magnetic north, deg; NaN where unknown."""
    heading: float
    """Heading clockwise from true north, deg; NaN where the declination is unknown."""
    sigma: float
    """Standard deviation of the heading, deg; infinite where the heading is unknown."""
    declination: float
    """Declination, deg, east positive; NaN where unknown."""
    roll: float
    pitch: float
    """`roll`, `pitch`: rad, by the autopilot."""
    rates: tuple[float, float, float]
    """Angular velocity about the body axes, rad/s, by the autopilot."""
    tilt_sigma: float
    """Standard deviation of roll and of pitch, rad."""

    @property
    def is_known(self) -> bool:
        """Return True if there is a magnetic heading."""
        return isfinite(self.magnetic) and isfinite(self.sigma)

    @property
    def heading_fields(self) -> tuple[float, float, float]:
        """The three heading fields of MAG_FIELD, deg."""
        return self.magnetic, self.heading, self.sigma


NO_ATTITUDE: Final = Attitude(nan, nan, inf, nan, nan, nan, (nan, nan, nan), inf)
"""The attitude where the heading is unknown."""


def quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """Return w, x, y, z of the rotation from body to north-east-down by three angles, rad (3-2-1)."""
    sr, cr = sin(0.5 * roll), cos(0.5 * roll)
    sp, cp = sin(0.5 * pitch), cos(0.5 * pitch)
    sy, cy = sin(0.5 * yaw), cos(0.5 * yaw)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def send_attitude(outbox: Outbox, attitude: Attitude, time_us: int) -> None:
    """Send ATTITUDE_QUATERNION_COV; its covariance is that of roll, pitch and heading, rad²."""
    tilt, turn = attitude.tilt_sigma**2, radians(attitude.sigma) ** 2
    roll_rate, pitch_rate, yaw_rate = attitude.rates
    outbox.send(
        "ATTITUDE_QUATERNION_COV",
        time_usec=time_us,
        q=quaternion(attitude.roll, attitude.pitch, radians(attitude.heading)),
        rollspeed=roll_rate,
        pitchspeed=pitch_rate,
        yawspeed=yaw_rate,
        covariance=(tilt, 0.0, 0.0, 0.0, tilt, 0.0, 0.0, 0.0, turn),
    )


def _pose(attitude: Attitude, stack: int) -> tuple[tuple[float, float, float], list[float]]:
    """Return the position and the pose covariance with which an autopilot reads the heading's sigma.

    Notes
    -----
    ArduPilot (``GCS_Common.cpp``) computes ``cbrt(c15^2 + c18^2 + c20^2)`` and uses it as the standard
    deviation in rad: sigma^1.5 as the only variance gives sigma. It needs a finite position, and does not use
    the position unless ``EK3_SRCn_POSXY`` is 6. PX4 (``mavlink_receiver.cpp``) reads the variance in
    entry 20, and takes a position that is NaN as none.
    """
    sigma = radians(attitude.sigma)
    covariance = [0.0] * 21  # the upper triangle of x y z roll pitch yaw, row by row
    if stack == MAV_AUTOPILOT.PX4:
        for diagonal in (0, 6, 11, 15, 18):
            covariance[diagonal] = IGNORED_VARIANCE
        covariance[20] = sigma**2
        return (nan, nan, nan), covariance
    for diagonal in (0, 6, 11):
        covariance[diagonal] = IGNORED_VARIANCE
    covariance[20] = sigma**1.5
    return (0.0, 0.0, 0.0), covariance


def _odometry(outbox: Outbox, attitude: Attitude, time_us: int, stack: int) -> None:
    """Send the heading as ODOMETRY.

    ArduPilot takes the frame LOCAL_FRD only; PX4 takes a yaw as from true north in LOCAL_NED only.
    """
    (x, y, z), covariance = _pose(attitude, stack)
    frame = MAV_FRAME.LOCAL_NED if stack == MAV_AUTOPILOT.PX4 else MAV_FRAME.LOCAL_FRD
    outbox.send(
        "ODOMETRY",
        time_usec=time_us,
        frame_id=frame,
        child_frame_id=MAV_FRAME.BODY_FRD,
        x=x,
        y=y,
        z=z,
        q=quaternion(attitude.roll, attitude.pitch, radians(attitude.heading)),
        **dict.fromkeys(("vx", "vy", "vz", "rollspeed", "pitchspeed", "yawspeed"), nan),
        pose_covariance=covariance,
        velocity_covariance=[nan] * 21,
        estimator_type=MAV_ESTIMATOR_TYPE.VISION,
        quality=FULL_QUALITY,
    )


def _vision_position(outbox: Outbox, attitude: Attitude, time_us: int, stack: int) -> None:
    """Send the heading as VISION_POSITION_ESTIMATE."""
    (x, y, z), covariance = _pose(attitude, stack)
    yaw = radians((attitude.heading + 180.0) % 360.0 - 180.0)
    outbox.send(
        "VISION_POSITION_ESTIMATE", usec=time_us, x=x, y=y, z=z, roll=attitude.roll, pitch=attitude.pitch,
        yaw=yaw, covariance=covariance,
    )  # fmt: skip


HEADING_SENDERS: Final[dict[str, Callable[[Outbox, Attitude, int, int], None]]] = {
    "odometry": _odometry,
    "vision_position_estimate": _vision_position,
}
"""What ``[heading] send`` may name, and the function that sends the heading to an autopilot."""


def nmea_sentences(attitude: Attitude, utc_us: int) -> bytes:
    """Return the NMEA 0183 sentences HDG, HDT and PASHR of one attitude.

    HDT and PASHR are left out where the declination is unknown.

    Parameters
    ----------
    attitude : Attitude
        With a known magnetic heading.
    utc_us : int
        Time of the attitude, µs since 1970 UTC.
    """
    variation = ","
    if isfinite(attitude.declination):
        variation = f"{abs(attitude.declination):.1f},{'E' if attitude.declination >= 0.0 else 'W'}"
    # the second and third field are the deviation, which the calibration has removed
    bodies = [f"HCHDG,{_wrapped(attitude.magnetic, 1)},0.0,E,{variation}"]
    if isfinite(attitude.heading):
        clock = datetime.fromtimestamp(utc_us * 1e-6, UTC)
        seconds = f"{clock:%H%M%S}.{clock.microsecond // 1000:03d}"
        roll, pitch, tilt = (
            57.29577951308232 * one for one in (attitude.roll, attitude.pitch, attitude.tilt_sigma)
        )
        accuracy = f"{tilt:.3f},{tilt:.3f},{attitude.sigma:.3f}"
        bodies += [
            f"HCHDT,{_wrapped(attitude.heading, 1)},T",
            f"PASHR,{seconds},{_wrapped(attitude.heading, 2)},T,{roll:+.2f},{pitch:+.2f},,{accuracy},0,0",
        ]
    return b"".join(b"$%s*%02X\r\n" % (body.encode(), reduce(xor, body.encode())) for body in bodies)


def _wrapped(angle: float, decimals: int) -> str:
    """Return an angle (deg) as text below 360, also after rounding."""
    return f"{round(angle, decimals) % 360.0:.{decimals}f}"
