"""Emulation of ArduPilot's EKF3 of December 2025; each rule names its file under ``libraries/``."""

from __future__ import annotations

from math import isnan
from typing import Any

from magbridge.mavlink import Message, spec
from magbridge.mavlink.enums import MAV_AUTOPILOT, MAV_FRAME, MAV_RESULT
from referee.autopilot import Autopilot, Truth, finite

PLANE_RATES_HZ = {
    "ATTITUDE": 1.0, "VFR_HUD": 1.0, "GPS_RAW_INT": 1.0, "GLOBAL_POSITION_INT": 1.0,
    "LOCAL_POSITION_NED": 1.0, "EKF_STATUS_REPORT": 1.0, "SYS_STATUS": 1.0,
}  # fmt: skip
"""Rates of messages after a start, Hz: ArduPlane/GCS_MAVLink_Plane.cpp, var_info (SRn_*); also Rover, Sub."""
COPTER_RATES_HZ: dict[str, float] = {}
"""Rates of messages after a start, Hz: ArduCopter/GCS_MAVLink_Copter.cpp, var_info: all SRn_* are 0."""

DECLARED = 1.0
"""Time without GPS until the EKF dead-reckons, s: AP_NavEKF3.h, deadReckonDeclare_ms."""
POSITION_NOISE = 0.5
"""Minimum 1-sigma of a position, m: EK3_POSNE_M_NSE, AP_NavEKF3.cpp."""
VISO_QUAL_MIN = 0
"""Minimum quality of visual odometry, percent: the parameter VISO_QUAL_MIN."""
VISO_NOISE = 0.2
"""Minimum 1-sigma of visual odometry, m: VISO_POS_M_NSE, AP_VisualOdom.cpp."""
AIDED = 15.0
"""Time without any aid until the EKF stops aiding, s: AP_NavEKF3.h, tiltDriftTimeMax_ms."""
RETRY = 10.0
"""Duration of rejected positions until the EKF resets to them, s: AP_NavEKF3.h, posRetryTimeUseVel_ms."""
GATE = 5.0
"""Gate of the position innovation, sigmas: EK3_POS_I_GATE 500, AP_NavEKF3.cpp."""
ATTITUDE, VELOCITY_HORIZ, POS_HORIZ_ABS, CONST_POS_MODE = 1, 2, 16, 128
"""Bits of EKF_STATUS_REPORT.flags."""


class ArduPilot(Autopilot):
    """Emulated Plane (or glider) with airspeed, or a Rover without.

    Its source set is switched to external navigation when GPS is lost, as a user or a script does.
    """

    STACK = MAV_AUTOPILOT.ARDUPILOTMEGA
    STATUS = "EKF_STATUS_REPORT"
    WALK = 5e-4
    """Random walk of the wind, (m/s)²/s: AP_NavEKF3_core.cpp, sq(dt * EK3_WIND_P_NSE), 0.2, every 12 ms."""

    def __init__(self, *args: Any, **settings: Any) -> None:
        super().__init__(*args, **settings)
        self._fused_us = -(10**12)
        self._reset_counter: int | None = None
        self._takes[spec("ODOMETRY").id] = self._odometry

    @property
    def aiding(self) -> bool:
        """True if speed or position aids the EKF, else AID_NONE: AP_NavEKF3_Control.cpp, setAidingMode."""
        fused = (self._now_us - self._fused_us) * 1e-6
        return self._airspeed or min(self.since_gps(), fused) < AIDED

    def _advance(self, time_us: int) -> None:
        if not self.aiding:  # AID_NONE holds the last known position
            self._motion = 0.0, 0.0
        super()._advance(time_us)

    def _gps_wins(self) -> bool:
        # AP_NavEKF3_PosVelFusion.cpp: the filter resets to a position source that has timed out; also to the
        # source to which the source set was just switched
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
        age = min(max(message["param2"], 0.0), 5.0)  # extrapolated by the velocity, at most 5 s
        north, east = self.local((message["x"] * 1e-7, message["y"] * 1e-7))
        vn, ve = self.filter.velocity
        self.filter.reset((north + vn * age, east + ve * age), sigma**2)
        self._resets += 1
        return MAV_RESULT.ACCEPTED

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
            # AP_Math.cpp, constrain_value: NaN becomes the middle of the range
            sigma = 50.0 if isnan(sigma) else sigma
        # AP_VisualOdom_MAV.cpp, handle_pose_estimate
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
        if reset:  # ResetPositionNE: keep the claimed variance; the position is fused as usual
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
