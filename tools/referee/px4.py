"""PX4's EKF2, as of August 2026; each rule with its file under ``src/modules/``."""

from __future__ import annotations

from math import isnan
from typing import Any

from magbridge.mavlink import Message, spec
from magbridge.mavlink.enums import MAV_AUTOPILOT, MAV_FRAME, MAV_RESULT
from referee.autopilot import Autopilot, finite

__all__ = ["Px4"]

STOPPED = 5.0
"""s without data, after which an auxiliary position stops: aux_global_position_control.cpp in ekf2/EKF."""
RETRY = 7.0
"""s without a position fused, after which one resets: ekf2/EKF/common.h, reset_timeout_max."""
GATE = 3.0
"""Sigmas: EKF2_AGPn_GATE."""
EXTERNAL_GATE = 5.0
"""Sigmas: ekf2/EKF/ekf.cpp, resetGlobalPosToExternalObservation."""
DEFAULT_ACCURACY = 50.0
"""m: ekf2/EKF2.cpp, kDefaultExternalPosAccuracy."""


class Px4(Autopilot):
    """A plane in the air, with EKF2_AGP0_CTRL 1 and its id.

    Parameters
    ----------
    agp_id : int
        EKF2_AGP0_ID; 0 is off.
    """

    STACK = MAV_AUTOPILOT.PX4
    WALK = 2.5e-3
    """EKF2_WIND_NSD, 0.05 m/s²/√Hz."""

    def __init__(self, *args: Any, agp_id: int = 1, **settings: Any) -> None:
        super().__init__(*args, **settings)
        self._id = agp_id
        self._pushed_us = self._fused_us = -(10**12)
        self._takes[spec("GLOBAL_POSITION_SENSOR").id] = self._sensor
        self._takes[spec("ODOMETRY").id] = self._odometry

    def _active(self) -> bool:
        """Return whether an auxiliary position aids."""
        return min(self._now_us - self._fused_us, self._now_us - self._pushed_us) * 1e-6 < STOPPED

    def _gps_wins(self) -> bool:
        # ekf2/EKF/aid_sources/gnss/gps_control.cpp: reset only while no other position aids
        return self._refused_for() > RETRY and not self._active()

    def _external(self, message: Message) -> MAV_RESULT:
        # ekf2/EKF2.cpp: while it dead-reckons (in the air), and all are numbers
        if self.since_gps() < 1.0 or self._active() or not finite(message["param2"]):
            return MAV_RESULT.TEMPORARILY_REJECTED
        accuracy = message["param3"]
        if not finite(accuracy) or accuracy <= 1e-7:
            accuracy = DEFAULT_ACCURACY
        place = self.local((message["x"] * 1e-7, message["y"] * 1e-7))
        variance = max(accuracy, 0.01) ** 2
        # ekf2/EKF/ekf.cpp: below 1 m, or far off, a hard reset; else all the way there, wind learning from it
        if accuracy < 1.0 or self.filter.distance(place, variance) > EXTERNAL_GATE:
            self.filter.reset(place, variance)
        else:
            self.filter.force(place, variance)
        self._resets += 1
        return MAV_RESULT.ACCEPTED

    def _sensor(self, message: Message) -> str:
        # mavlink/mavlink_receiver.cpp: one slot an id, the arrival is the time
        if self._id == 0 or message["id"] != self._id:
            return "dropped: id"
        self._pushed_us = self._now_us
        # ekf2/EKF/aid_sources/aux_global_position_control.cpp: max(eph, EKF2_AGPn_NOISE) drops a NaN
        eph = message["eph"]
        variance = max(1.0 if isnan(eph) else eph, 1.0) ** 2
        place = self.local((message["lat"] * 1e-7, message["lon"] * 1e-7))
        unfused = (self._now_us - self._fused_us) * 1e-6
        if self.filter.distance(place, variance) <= GATE:
            self.filter.fuse(place, variance)
        elif unfused > RETRY and self.since_gps() > RETRY:  # isResetAllowed: no other position aids
            self.filter.reset(place, variance)
            self._resets += 1
        else:
            return "refused: gate"
        self._fused_us = self._now_us
        return "fused"

    def _odometry(self, message: Message) -> str:
        # mavlink/mavlink_receiver.cpp, handle_message_odometry: the whole position, or none of it
        if not finite(message["x"], message["y"], message["z"]):
            return "dropped: position"
        if message["frame_id"] not in (MAV_FRAME.LOCAL_NED, MAV_FRAME.LOCAL_FRD):
            return "dropped: frame"
        return "a bias is made of it"
