"""ArduPilot's EKF3, as of December 2025; each rule with its file under ``libraries/``."""

from __future__ import annotations

from math import isnan
from typing import Any

from magbridge.mavlink import Message, spec
from magbridge.mavlink.enums import MAV_AUTOPILOT, MAV_FRAME, MAV_RESULT
from referee.autopilot import Autopilot, Truth, finite

PLANE_RATES_HZ = dict.fromkeys(
    ("ATTITUDE", "VFR_HUD", "GPS_RAW_INT", "GLOBAL_POSITION_INT", "LOCAL_POSITION_NED", "EKF_STATUS_REPORT"),
    1.0,
)
"""Hz after a start: ArduPlane/GCS_MAVLink_Plane.cpp, var_info (SRn_*); Rover's and Sub's are the same."""
COPTER_RATES_HZ: dict[str, float] = {}
"""ArduCopter/GCS_MAVLink_Copter.cpp, var_info: all SRn_* are 0."""

DECLARED = 1.0
"""s without GPS after which it dead-reckons: AP_NavEKF3.h, deadReckonDeclare_ms."""
POSITION_NOISE = 0.5
"""m: EK3_POSNE_M_NSE, AP_NavEKF3.cpp."""
VISO_QUAL_MIN = 0
"""Percent: the parameter of that name."""
VISO_NOISE = 0.2
"""m: VISO_POS_M_NSE, AP_VisualOdom.cpp."""
AIDED = 15.0
"""s without any aid after which it stops: AP_NavEKF3.h, tiltDriftTimeMax_ms."""
RETRY = 10.0
"""s of refused positions after which it resets to them: AP_NavEKF3.h, posRetryTimeUseVel_ms."""
GATE = 5.0
"""Sigmas: EK3_POS_I_GATE 500, AP_NavEKF3.cpp."""
ATTITUDE, VELOCITY_HORIZ, POS_HORIZ_ABS, CONST_POS_MODE = 1, 2, 16, 128
"""EKF_STATUS_REPORT.flags"""
UNHEALTHY = 0.3
"""s without data: AP_VisualOdom_Backend.cpp, healthy()."""


class ArduPilot(Autopilot):
    """A Plane (or a glider) with airspeed; without, a Rover.

    Its source set is switched to external navigation when GPS is lost, as a user or a script does.
    `internal_errors` counts numbers that were none where the firmware does not expect it.
    """

    STACK = MAV_AUTOPILOT.ARDUPILOTMEGA
    STATUS = "EKF_STATUS_REPORT"
    WALK = 5e-4
    """AP_NavEKF3_core.cpp: each 12 ms the variance grows by sq(dt * EK3_WIND_P_NSE), 0.2."""

    def __init__(self, *args: Any, **settings: Any) -> None:
        super().__init__(*args, **settings)
        self.internal_errors = 0
        self._visual_us = self._fused_us = -(10**12)  # came; was fused
        self._reset_counter: int | None = None
        self._takes[spec("ODOMETRY").id] = self._odometry

    @property
    def healthy(self) -> bool:
        """True if visual odometry came recently."""
        return (self._now_us - self._visual_us) * 1e-6 < UNHEALTHY

    @property
    def aiding(self) -> bool:
        """AP_NavEKF3_Control.cpp, setAidingMode: without speed or position for 15 s it is AID_NONE."""
        fused = (self._now_us - self._fused_us) * 1e-6
        return self._airspeed or min(self.since_gps(), fused) < AIDED

    def _advance(self, time_us: int) -> None:
        if not self.aiding:  # AID_NONE holds the last known position
            self._motion = 0.0, 0.0
        super()._advance(time_us)

    def _gps_wins(self) -> bool:
        # AP_NavEKF3_PosVelFusion.cpp: a position source that has timed out is reset to; and so is one of two
        # that the source set was just switched to
        return self._refused_for() > RETRY

    def _external(self, message: Message) -> MAV_RESULT:
        # GCS_Common.cpp, handle_command_int_external_position_estimate
        if message["frame"] not in (MAV_FRAME.GLOBAL, 5):
            return MAV_RESULT.DENIED
        # AP_NavEKF3_PosVelFusion.cpp, setLatLng: GPS still aids, nothing does, or the origin is unknown
        if self.since_gps() < DECLARED or not self.aiding or self._gps_us is None:
            return MAV_RESULT.FAILED
        accuracy = message["param3"]
        sigma = max(0.0 if isnan(accuracy) else accuracy, POSITION_NOISE)
        age = min(max(message["param2"], 0.0), 5.0)  # moved on by its own velocity, for 5 s at most
        north, east = self.local((message["x"] * 1e-7, message["y"] * 1e-7))
        vn, ve = self.filter.velocity
        self.filter.reset((north + vn * age, east + ve * age), sigma**2)
        self._resets += 1
        return MAV_RESULT.ACCEPTED

    @property
    def can_arm(self) -> bool:
        """True if it passes the check 'VisOdom: not healthy' (AP_Arming.cpp), with VISO_TYPE 1."""
        return self.healthy

    def _status(self, truth: Truth) -> bytes:  # noqa: ARG002 - as the other messages
        # AP_NavEKF3_Outputs.cpp, send_status_report: without aiding the position is held
        flags = ATTITUDE | (VELOCITY_HORIZ | POS_HORIZ_ABS if self.aiding else CONST_POS_MODE)
        return self._codec.pack("EKF_STATUS_REPORT", flags=flags)

    def _odometry(self, message: Message) -> str:
        # GCS_Common.cpp, handle_odometry
        if (message["frame_id"], message["child_frame_id"]) != (MAV_FRAME.LOCAL_FRD, MAV_FRAME.BODY_FRD):
            return "dropped: frame"
        covariance, sigma = message["pose_covariance"], 0.0
        if not isnan(covariance[0]):
            sigma = (covariance[0] ** 2 + covariance[6] ** 2 + covariance[11] ** 2) ** (1 / 3)
            angle = covariance[15] + covariance[18] + covariance[20]
            # AP_Math.cpp, constrain_value: a number that is none is an internal error, and becomes the middle
            self.internal_errors += isnan(sigma) or isnan(angle)
            sigma = 50.0 if isnan(sigma) else sigma
        # AP_VisualOdom_MAV.cpp, handle_pose_estimate
        self._visual_us = self._now_us
        if message["quality"] < VISO_QUAL_MIN:
            return "dropped: quality"
        sigma = min(max(sigma, VISO_NOISE), 100.0)
        # AP_NavEKF3_Measurements.cpp, writeExtNavData
        if not finite(message["x"], message["y"], message["z"], *message["q"]):
            return "dropped: pose"
        if self.since_gps() < DECLARED:
            return "unused: GPS is the source"
        # AP_NavEKF3_PosVelFusion.cpp, FuseVelPosNED: constrain_ftype(extNavDataDelayed.posErr, 0.01f, 10.0f)
        variance = min(sigma, 10.0) ** 2
        place, unfused = (message["x"], message["y"]), (self._now_us - self._fused_us) * 1e-6
        reset = self._reset_counter not in (None, message["reset_counter"])  # get_reset_timestamp_ms
        self._reset_counter = message["reset_counter"]
        if reset:  # ResetPositionNE: the claimed variance stays, and the position is fused as ever
            self.filter.position = place
            self._resets += 1
        if unfused > RETRY:  # ResetPosition
            self.filter.reset(place, sigma**2)
            self._resets += 1
        elif self.filter.distance(place, variance) > GATE:
            return "refused: gate"
        else:
            self.filter.fuse(place, variance)
        self._fused_us = self._now_us
        return "fused"
