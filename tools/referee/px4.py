"""Emulation of PX4's EKF2 of August 2026; each rule names its file under ``src/modules/``."""

from __future__ import annotations

from math import isnan
from typing import Any

from magbridge.mavlink import Message, spec
from magbridge.mavlink.enums import MAV_AUTOPILOT, MAV_FRAME, MAV_RESULT
from referee.autopilot import Autopilot, Truth, finite

PX4_RATES_HZ = {
    "ATTITUDE": 15.0, "VFR_HUD": 4.0, "GPS_RAW_INT": 5.0, "GLOBAL_POSITION_INT": 5.0,
    "LOCAL_POSITION_NED": 1.0, "ESTIMATOR_STATUS": 0.5, "SYS_STATUS": 1.0,
}  # fmt: skip
"""Rates after a start, Hz: mavlink_main.cpp, configure_streams_to_default, MAVLINK_MODE_NORMAL."""

AGP0_ID = 1
"""Id of the only auxiliary position source: EKF2_AGP0_ID."""
STOPPED = 5.0
"""Time without data until an auxiliary position stops, s: aux_global_position_control.cpp in ekf2/EKF."""
RETRY = 7.0
"""Time without a fused position until the filter resets to one, s: ekf2/EKF/common.h, reset_timeout_max."""
GATE = 3.0
"""Gate of an auxiliary position, sigmas: EKF2_AGPn_GATE."""
EXTERNAL_GATE = 10.0
"""Gate of an external position, sigmas: ekf2/EKF/ekf.cpp, resetGlobalPosToExternalObservation."""
ATTITUDE, VELOCITY_HORIZ, POS_HORIZ_REL, POS_HORIZ_ABS, CONST_POS_MODE = 1, 2, 8, 16, 128
"""Bits of ESTIMATOR_STATUS.flags."""
DEFAULT_ACCURACY = 50.0
"""1-sigma of an external position without a claim, m: ekf2/EKF2.cpp, kDefaultExternalPosAccuracy."""


class Px4(Autopilot):
    """Emulated PX4 plane in the air, with EKF2_AGP0_CTRL 1 and EKF2_AGP0_ID `AGP0_ID`."""

    STACK = MAV_AUTOPILOT.PX4
    STATUS = "ESTIMATOR_STATUS"
    WALK = 2.5e-3
    """Spectral density of the wind's random walk, (m/s)²/s: EKF2_WIND_NSD is 0.05 m/s²/√Hz."""

    def __init__(self, *args: Any, **settings: Any) -> None:
        super().__init__(*args, **settings)
        self._pushed_us = self._fused_us = -(10**12)
        self._takes[spec("GLOBAL_POSITION_SENSOR").id] = self._sensor
        self._takes[spec("ODOMETRY").id] = self._odometry

    def _active(self) -> bool:
        """Return True if an auxiliary position aids the filter."""
        return self._now_us - min(self._fused_us, self._pushed_us) < STOPPED * 1e6

    def _gps_wins(self) -> bool:
        # ekf2/EKF/aid_sources/gnss/gps_control.cpp: reset only while no other position aids
        return self._refused_for() > RETRY and not self._active()

    def _external(self, message: Message) -> MAV_RESULT:
        # ekf2/EKF2.cpp, MAV_CMD_EXTERNAL_POSITION_ESTIMATE (582b8f0a2b): rejected only if not finite
        place_e7 = message["x"], message["y"]
        if not finite(message["param2"], *place_e7):
            return MAV_RESULT.TEMPORARILY_REJECTED
        accuracy = message["param3"]
        if not finite(accuracy) or accuracy <= 1e-7:
            accuracy = DEFAULT_ACCURACY
        place = self.local((place_e7[0] * 1e-7, place_e7[1] * 1e-7))
        variance = max(accuracy, 0.01) ** 2
        aided = self.since_gps() < 1.0 or self._active()
        # ekf2/EKF/ekf.cpp: a hard reset that clears the wind while GPS or an auxiliary position aids, for an
        # accuracy below 1 m, or outside the gate; else a full move to the position, which updates the wind
        if aided or accuracy < 1.0 or self.filter.distance(place, variance) > EXTERNAL_GATE:
            self.filter.reset(place, variance)
            self.filter.wind = 0.0, 0.0
        else:  # bbf32a537e, December 2025: full move of the position, but the variance of a fused one
            before = self.filter.pp
            self.filter.force(place, variance)
            self.filter.pp = before * variance / (before + variance)
        self._resets += 1
        return MAV_RESULT.ACCEPTED

    def _status(self, truth: Truth) -> bytes:  # noqa: ARG002 - as the other messages
        # ekf2/EKF/ekf_helper.cpp, get_ekf_soln_status: velocity is valid while dead reckoning is possible
        aided = self._airspeed or self.since_gps() < STOPPED or self._active()
        flags = ATTITUDE | (VELOCITY_HORIZ | POS_HORIZ_REL if aided else CONST_POS_MODE)
        if self.since_gps() < STOPPED or self._active():
            flags |= POS_HORIZ_ABS
        return self._codec.pack("ESTIMATOR_STATUS", time_usec=self._now_us, flags=flags)

    def _sensor(self, message: Message) -> str:
        # mavlink/mavlink_receiver.cpp: one slot for each id, stamped with the time of arrival
        if message["id"] != AGP0_ID:
            return "dropped: id"
        self._pushed_us = self._now_us
        # ekf2/EKF/aid_sources/aux_global_position_control.cpp: max(eph, EKF2_AGPn_NOISE) drops a NaN
        eph = message["eph"]
        variance = max(1.0 if isnan(eph) else eph, 1.0) ** 2
        place = self.local((message["lat"] * 1e-7, message["lon"] * 1e-7))
        unfused = (self._now_us - self._fused_us) * 1e-6
        # aux_global_position_control.cpp, isResetAllowed with EKF2_AGP0_MODE 0: no other position aids
        allowed = self.since_gps() > RETRY
        if self.filter.distance(place, variance) <= GATE:
            self.filter.fuse(place, variance)
        elif unfused > RETRY and allowed:
            self.filter.reset(place, variance)
            self._resets += 1
        else:
            return "refused: gate"
        self._fused_us = self._now_us
        return "fused"

    def _odometry(self, message: Message) -> str:
        # mavlink/mavlink_receiver.cpp, handle_message_odometry: all three coordinates or none
        if not finite(message["x"], message["y"], message["z"]):
            return "dropped: position"
        if message["frame_id"] not in (MAV_FRAME.LOCAL_NED, MAV_FRAME.LOCAL_FRD):
            return "dropped: frame"
        return "a bias is made of it"
