"""Messages and NMEA sentences with position fixes and headings, in the form that each receiver expects.

Docstrings state how a receiver uses a field, and name its source file: ArduPilot's of December 2025
(headings: 856c2a1), PX4's of August 2026 (headings: bb59c63).
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from math import cos, degrees, inf, isfinite, nan, radians, sin, sqrt
from typing import Any, Final, NamedTuple

import msgspec

from magbridge.link.output import Output
from magbridge.mavlink.enums import GLOBAL_POSITION_SRC, MAV_AUTOPILOT, MAV_CMD, MAV_ESTIMATOR_TYPE, MAV_FRAME
from magbridge.mavlink.messages import east_e7
from magbridge.sensors.framing import nmea_checksum

__all__ = [
    "FIX_MESSAGES", "HEADING_SENDERS", "NO_ATTITUDE", "Attitude", "Fix", "Kind", "Pose", "nmea_sentences",
    "quaternion", "send_attitude", "widened",
]  # fmt: skip

IGNORED_VARIANCE: Final = 1e4
"""Variance of position (m²), roll and pitch (rad²) in a message of which the autopilot shall use only the
yaw."""
FULL_QUALITY: Final = 100
"""Value of ODOMETRY.quality, %."""


class Attitude(NamedTuple):
    """Attitude of the vehicle at one time, with the heading computed from the corrected field."""

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
    """`roll`, `pitch`: Angles from the autopilot, rad."""
    rates: tuple[float, float, float]
    """Angular velocity about the body axes, from the autopilot, rad/s."""
    tilt_sigma: float
    """Standard deviation of roll and of pitch, rad."""


NO_ATTITUDE: Final = Attitude(nan, nan, inf, nan, nan, nan, (nan, nan, nan), inf)
"""Attitude with an unknown heading."""


def quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """Return the quaternion w, x, y, z from body to north-east-down of Euler angles (3-2-1), rad."""
    sr, cr = sin(0.5 * roll), cos(0.5 * roll)
    sp, cp = sin(0.5 * pitch), cos(0.5 * pitch)
    sy, cy = sin(0.5 * yaw), cos(0.5 * yaw)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def send_attitude(output: Output, attitude: Attitude, time_us: int) -> None:
    """Send ATTITUDE_QUATERNION_COV with `attitude` and the covariance of roll, pitch and heading (rad²)."""
    tilt, turn = attitude.tilt_sigma**2, radians(attitude.sigma) ** 2
    roll_rate, pitch_rate, yaw_rate = attitude.rates
    output.send(
        "ATTITUDE_QUATERNION_COV",
        time_usec=time_us,
        q=quaternion(attitude.roll, attitude.pitch, radians(attitude.heading)),
        rollspeed=roll_rate,
        pitchspeed=pitch_rate,
        yawspeed=yaw_rate,
        covariance=(tilt, 0.0, 0.0, 0.0, tilt, 0.0, 0.0, 0.0, turn),
    )


def _pose(attitude: Attitude, stack: int) -> tuple[tuple[float, float, float], list[float]]:
    """Return position and pose covariance from which the autopilot `stack` derives the heading's sigma.

    Notes
    -----
    ArduPilot (``GCS_Common.cpp``) computes ``cbrt(c15^2 + c18^2 + c20^2)`` and uses it as the standard
    deviation in rad. So sigma^1.5 as the only variance gives sigma. It needs a finite position, and does not
    use the position unless ``EK3_SRCn_POSXY`` is 6. PX4 (``mavlink_receiver.cpp``) reads the variance in
    entry 20, and ignores a position of NaN.
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


def _odometry(output: Output, attitude: Attitude, time_us: int, stack: int) -> None:
    """Send the heading as ODOMETRY.

    ArduPilot accepts only the frame LOCAL_FRD. PX4 interprets the yaw as relative to true north only in
    LOCAL_NED.
    """
    position, covariance = _pose(attitude, stack)
    frame = MAV_FRAME.LOCAL_NED if stack == MAV_AUTOPILOT.PX4 else MAV_FRAME.LOCAL_FRD
    turn = quaternion(attitude.roll, attitude.pitch, radians(attitude.heading))
    _send_odometry(output, time_us, frame, position, turn, covariance)


def _send_odometry(
    output: Output,
    time_us: int,
    frame: MAV_FRAME,
    position: tuple[float, float, float],
    turn: tuple[float, float, float, float],
    covariance: list[float],
    resets: int = 0,
) -> None:
    """Send ODOMETRY with position (m), quaternion `turn` and pose covariance, but without velocities."""
    x, y, z = position
    output.send(
        "ODOMETRY",
        time_usec=time_us,
        frame_id=frame,
        child_frame_id=MAV_FRAME.BODY_FRD,
        x=x,
        y=y,
        z=z,
        q=turn,
        **dict.fromkeys(("vx", "vy", "vz", "rollspeed", "pitchspeed", "yawspeed"), nan),
        pose_covariance=covariance,
        velocity_covariance=[nan] * 21,
        reset_counter=resets & 0xFF,
        estimator_type=MAV_ESTIMATOR_TYPE.VISION,
        quality=FULL_QUALITY,
    )


def _vision_position(output: Output, attitude: Attitude, time_us: int, stack: int) -> None:
    """Send the heading as VISION_POSITION_ESTIMATE."""
    (x, y, z), covariance = _pose(attitude, stack)
    yaw = radians((attitude.heading + 180.0) % 360.0 - 180.0)
    output.send(
        "VISION_POSITION_ESTIMATE", usec=time_us, x=x, y=y, z=z, roll=attitude.roll, pitch=attitude.pitch,
        yaw=yaw, covariance=covariance,
    )  # fmt: skip


HEADING_SENDERS: Final[dict[str, Callable[[Output, Attitude, int, int], None]]] = {
    "odometry": _odometry,
    "vision_position_estimate": _vision_position,
}
"""Values of ``[heading] send``, each with the function that sends the heading in that message."""


def nmea_sentences(attitude: Attitude, utc_us: int) -> bytes:
    """Return the NMEA 0183 sentences HDG, HDT and PASHR of one attitude.

    HDT and PASHR are omitted if the declination is unknown.

    `attitude`: its magnetic heading must be known.
    `utc_us`: time of the attitude, µs since 1970 UTC.
    """
    variation = ","
    if isfinite(attitude.declination):
        variation = f"{abs(attitude.declination):.1f},{'E' if attitude.declination >= 0.0 else 'W'}"
    # the second and third field are the deviation, which the calibration has removed
    bodies = [f"$HCHDG,{_wrapped(attitude.magnetic, 1)},0.0,E,{variation}"]
    if isfinite(attitude.heading):
        clock = datetime.fromtimestamp(utc_us * 1e-6, UTC)
        seconds = f"{clock:%H%M%S}.{clock.microsecond // 1000:03d}"
        roll, pitch, tilt = map(degrees, (attitude.roll, attitude.pitch, attitude.tilt_sigma))
        accuracy = f"{tilt:.3f},{tilt:.3f},{attitude.sigma:.3f}"
        bodies += [
            f"$HCHDT,{_wrapped(attitude.heading, 1)},T",
            f"$PASHR,{seconds},{_wrapped(attitude.heading, 2)},T,{roll:+.2f},{pitch:+.2f},,{accuracy},0,0",
        ]
    return b"".join(b"%s*%02X\r\n" % (body.encode(), nmea_checksum(body.encode())) for body in bodies)


def _wrapped(angle: float, decimals: int) -> str:
    """Return an angle (deg) as text, rounded to `decimals` and wrapped to at least 0 and less than 360."""
    return f"{round(angle, decimals) % 360.0:.{decimals}f}"


SENSOR_ID = 1
"""Value of GLOBAL_POSITION_SENSOR.id; PX4 uses the messages whose id is ``EKF2_AGPn_ID`` (0: none)."""
LATITUDE_LONGITUDE_ONLY = 0
"""Value of GLOBAL_POSITION_SENSOR.flags: only latitude and longitude are valid."""
OTHERS_VARIANCE = 1.0
"""Variance of height (m²) and attitude (rad²) in ODOMETRY, both of which come from the autopilot itself."""
WALK = 1e-3
"""Assumed random-walk density of the wind, or of the velocity error, in an autopilot's filter, (m/s)²/s."""


class Pose(NamedTuple):
    """Pose of the vehicle in the autopilot's local frame, for ODOMETRY."""

    north: float
    east: float
    down: float
    """`north`, `east`, `down`: Position from the origin of the autopilot's local frame, m."""
    attitude: tuple[float, float, float, float]
    """Quaternion w, x, y, z from body to north-east-down."""


class Fix(msgspec.Struct, frozen=True, gc=False):
    """Estimate of the vehicle's position at the time of sending, with its covariance."""

    time_us: int
    """Time of the position and of sending, µs since 1970 UTC."""
    latitude: float
    longitude: float
    """`latitude`, `longitude`: Position, deg."""
    covariance_nn: float
    covariance_ne: float
    covariance_ee: float
    """`covariance_nn`, `covariance_ne`, `covariance_ee`: Covariance of north and east, m²."""
    altitude: float = nan
    """Altitude above mean sea level, m; NaN if unknown."""
    pose: Pose | None = None
    """Pose in the autopilot's local frame; None unless the message needs it."""
    resets: int = 0
    """Number of jumps of the estimate so far."""

    @property
    def sigma(self) -> float:
        """Standard deviation per axis, m: the root of the mean variance of north and east.

        Receivers accept only one standard deviation for both axes.
        """
        return sqrt(0.5 * (self.covariance_nn + self.covariance_ee))


def widened(fix: Fix, seconds: float) -> Fix:
    """Return `fix` with its covariance inflated, for a filter that assumes independent errors.

    `seconds`: time since the previous fix, s.

    Notes
    -----
    The errors of successive fixes are correlated, but an autopilot's filter assumes that they are
    independent. Its variance would soon be smaller than the variance of the fixes. For the filter, fixes of
    variance R every dt are white noise of the density N = R dt. If the filter's velocity (or wind) is a
    random walk of the density q (`WALK`), its position variance converges to

        P = √2 q^(1/4) N^(3/4)

    (steady state of the Riccati equation of a doubly integrated white noise). R is chosen so that P is the
    fix's own variance σ²: R = (σ²/√2)^(4/3) q^(-1/3) / dt, and never less than σ². P depends on q only by its
    fourth root. ArduPilot uses 5e-4 for the wind (``EK3_WIND_P_NSE``), PX4 2.5e-3 (``EKF2_WIND_NSD``); a
    velocity from accelerometers has 1e-3.
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


def external_position(output: Output, fix: Fix, system: int, autopilot: int) -> None:
    """Send MAV_CMD_EXTERNAL_POSITION_ESTIMATE, with which the autopilot resets its position to the fix.

    ArduPilot (``AP_NavEKF3_PosVelFusion.cpp``, setLatLng) extrapolates the position by its velocity over the
    age of the fix, which is 0 here. PX4 (``EKF2.cpp``) rejects an age of NaN.
    """
    output.send(
        "COMMAND_INT",
        command=MAV_CMD.EXTERNAL_POSITION_ESTIMATE,
        frame=MAV_FRAME.GLOBAL,
        param1=fix.time_us * 1e-6 % 1e5,  # time of the bridge's clock, s; modulo, to fit a float32
        param2=0.0,  # age, s
        param3=fix.sigma,
        param4=nan,
        x=round(fix.latitude * 1e7),
        y=east_e7(fix.longitude),
        z=nan,
        target_system=system,
        target_component=autopilot,
    )


def global_position(output: Output, fix: Fix, system: int, autopilot: int) -> None:
    """Send GLOBAL_POSITION_SENSOR, which PX4 fuses as an auxiliary position.

    PX4 (``mavlink_receiver.cpp``, ``aux_global_position_control.cpp``) uses the time of arrival as the time
    of the position, and replaces a sigma of NaN by 1 m.
    """
    output.send(
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


def odometry(output: Output, fix: Fix, system: int, autopilot: int) -> None:  # noqa: ARG001 - it has no target
    """Send ODOMETRY in the frame LOCAL_FRD, whose axes are north-east-down in ArduPilot in spite of the name.

    ArduPilot (``GCS_Common.cpp``, handle_odometry) accepts only LOCAL_FRD with BODY_FRD, and needs the whole
    pose. It computes ``cbrt(c0² + c6² + c11²)`` and ``cbrt(c15² + c18² + c20²)`` from the covariance, where a
    NaN causes an internal error. It ignores a velocity of NaN.
    """
    assert fix.pose is not None
    north, east, down, attitude = fix.pose
    covariance = [0.0] * 21  # the upper triangle of x y z roll pitch yaw, row by row
    covariance[0], covariance[1], covariance[6] = fix.covariance_nn, fix.covariance_ne, fix.covariance_ee
    for diagonal in (11, 15, 18, 20):
        covariance[diagonal] = OTHERS_VARIANCE
    frame = MAV_FRAME.LOCAL_FRD
    _send_odometry(output, fix.time_us, frame, (north, east, down), attitude, covariance, fix.resets)


class Kind(NamedTuple):
    """Properties of one message type that can carry a position fix."""

    send: Callable[[Output, Fix, int, int], Any]
    """Function that sends a :class:`Fix` to a system id and component id."""
    rate: float
    """Default rate, Hz; 0 sends every update."""
    refused_by: dict[int, str]
    """Autopilots (MAV_AUTOPILOT) that cannot use the message, each with an error text and the alternative."""
    fused: bool
    """True if the receiver fuses the fix with its position, False if it resets its position to the fix."""
    local: bool = False
    """True if the message contains a :class:`Pose`."""
    trusted_to: float = inf
    """Largest standard deviation (m) that ArduPilot applies; it limits larger values to this one."""
    least: float = 0.0
    """Rate (Hz) below which the receiver assumes that the source has failed."""

    def overrated(self, fix: Fix) -> bool:
        """Return True if ArduPilot would limit the inflated sigma of `fix` to a smaller value."""
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
        # EKF2 takes the offset of an EV position for a bias, and drops messages 0.25 s late (ev_control.cpp)
        {MAV_AUTOPILOT.PX4: "PX4 makes a bias of ODOMETRY: use GLOBAL_POSITION_SENSOR"},
        fused=True,
        local=True,
        trusted_to=10.0,  # AP_NavEKF3_PosVelFusion.cpp: constrain_ftype(posErr, 0.01f, 10.0f)
        least=4.0,  # AP_VisualOdom_Backend.cpp: unhealthy 300 ms after the last
    ),
}
"""Messages that ``[navigation] fix`` may name."""
