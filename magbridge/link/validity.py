"""Check that the values of a motion message are possible for a vehicle."""

from __future__ import annotations

from math import isnan, pi
from typing import Final

from magbridge.mavlink import Message, by_id, spec

__all__ = ["is_possible"]

MAX_ANGLE_RAD: Final = 2.0 * pi + 0.1
MAX_DISTANCE_M: Final = 4e7
"""m: the Earth's circumference."""
MAX_VALID_SPEED_M_S: Final = 1e4
LATITUDE_E7, LONGITUDE_E7 = 900_000_000, 1_800_000_000
"""1e-7 deg."""

REQUIRED: dict[int, dict[str, float]] = by_id(
    ATTITUDE={"roll": MAX_ANGLE_RAD, "pitch": MAX_ANGLE_RAD, "yaw": MAX_ANGLE_RAD},
    GLOBAL_POSITION_INT={"lat": LATITUDE_E7, "lon": LONGITUDE_E7},
    GPS_RAW_INT={"lat": LATITUDE_E7, "lon": LONGITUDE_E7},
    GPS_GLOBAL_ORIGIN={"latitude": LATITUDE_E7, "longitude": LONGITUDE_E7},
)
"""Fields that must be numbers, and their largest magnitudes."""
LIMITED: dict[int, dict[str, float]] = by_id(
    LOCAL_POSITION_NED={
        **dict.fromkeys(("x", "y", "z"), MAX_DISTANCE_M),
        **dict.fromkeys(("vx", "vy", "vz"), MAX_VALID_SPEED_M_S),
    },
    ODOMETRY={
        **dict.fromkeys(("x", "y", "z"), MAX_DISTANCE_M),
        **dict.fromkeys(("vx", "vy", "vz"), MAX_VALID_SPEED_M_S),
    },
    VFR_HUD={"airspeed": MAX_VALID_SPEED_M_S, "groundspeed": MAX_VALID_SPEED_M_S},
)
"""Fields that may be NaN, which means unknown, and their largest magnitudes."""
MAX_QUATERNION: Final = 1.1
ODOMETRY: Final = spec("ODOMETRY").id


def is_possible(message: Message) -> bool:
    """Return False if a message has an infinite, a missing or an impossible value in a field that is used."""
    for name, largest in REQUIRED.get(message.id, {}).items():
        if not abs(message[name]) <= largest:  # also NaN
            return False
    limits = LIMITED.get(message.id)
    if limits is None:
        return True
    for name, largest in limits.items():
        value = message[name]
        if not (isnan(value) or abs(value) <= largest):
            return False
    if message.id == ODOMETRY:
        return all(isnan(part) or abs(part) <= MAX_QUATERNION for part in message["q"])
    return True
