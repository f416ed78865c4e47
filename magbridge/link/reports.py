"""What the bridge says of itself: heartbeat, status, version."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

from magbridge.link.outbox import Outbox
from magbridge.link.vehicle import Vehicle
from magbridge.mavlink import spec
from magbridge.mavlink.dialect import (
    MAV_AUTOPILOT,
    MAV_PROTOCOL_CAPABILITY,
    MAV_STATE,
    MAV_TYPE,
)

__all__ = ["Reports"]

MASK = 0xFFFFFFFF
COUNTERS = [field.name for field in spec("MAG_STATUS").fields.values() if field.code == "I"]
UNKNOWN = float("nan")
NOTHING = {**dict.fromkeys(COUNTERS, 0), "sample_rate": UNKNOWN, "sensor_clock_drift": UNKNOWN}
"""What MAG_STATUS says where nobody above knows."""
OFFICIAL = 255
"""FIRMWARE_VERSION_TYPE_OFFICIAL"""
CAPABILITIES = (
    MAV_PROTOCOL_CAPABILITY.PARAM_FLOAT
    | MAV_PROTOCOL_CAPABILITY.COMMAND_INT
    | MAV_PROTOCOL_CAPABILITY.MAVLINK2
)


class Reports:
    """Sends HEARTBEAT, MAG_STATUS and AUTOPILOT_VERSION.

    Parameters
    ----------
    outbox : Outbox
    vehicle : Vehicle
    start_us : int
        us, when the bridge started.
    version : str
        Of the program, ``"0.1.0"``.
    calibration_id : int
    status : callable
        Returns fields of MAG_STATUS: what the rooms above know.
    speaking : callable
        Says whether the sensor speaks.
    """

    def __init__(
        self,
        outbox: Outbox,
        vehicle: Vehicle,
        start_us: int,
        version: str,
        calibration_id: int,
        status: Callable[[], Mapping[str, Any]],
        speaking: Callable[[], bool],
    ) -> None:
        self._outbox, self._vehicle, self._status = outbox, vehicle, status
        self._speaking = speaking
        self._start_us, self._version, self._calibration_id = start_us, version, calibration_id

    def heartbeat(self) -> None:
        """Send HEARTBEAT: active while the sensor speaks, else critical."""
        self._outbox.send(
            "HEARTBEAT",
            type=MAV_TYPE.ONBOARD_CONTROLLER,
            autopilot=MAV_AUTOPILOT.INVALID,
            system_status=MAV_STATE.ACTIVE if self._speaking() else MAV_STATE.CRITICAL,
            mavlink_version=3,
        )

    def status(self) -> None:
        """Send MAG_STATUS."""
        codec, vehicle, clock = self._outbox.codec, self._vehicle, self._vehicle.clock
        fields: dict[str, Any] = {
            **NOTHING,
            "calibration_id": self._calibration_id,
            **self._status(),
            "uptime": (codec.now_us - self._start_us) // 1_000_000,
            "link_frames": codec.frames,
            "link_frames_lost": vehicle.frames_lost,
            "link_bytes_skipped": codec.bytes_skipped,
            "link_refused": codec.signing.refused if codec.signing else 0,
            "vehicle_reboots": vehicle.reboots & 0xFFFF,
            "autopilot_state": vehicle.state,
            "vehicle_clock_drift": clock.drift_ppm,
            "vehicle_clock_sigma": clock.sigma,
        }
        for name in COUNTERS:
            fields[name] &= MASK
        self._outbox.send(
            "MAG_STATUS",
            time_usec=codec.now_us,
            vehicle_clock_offset=round(clock.offset_us(codec.now_us)),
            **fields,
        )

    def version(self) -> None:
        """Send AUTOPILOT_VERSION."""
        numbers = [int(number) & 0xFF for number in re.findall(r"\d+", self._version)[:3]]
        self._outbox.send(
            "AUTOPILOT_VERSION",
            capabilities=CAPABILITIES,
            flight_sw_version=int.from_bytes(bytes([*numbers, 0, 0, 0][:3]) + bytes((OFFICIAL,)), "big"),
        )

    def sample_interval_us(self) -> int:
        """Return the us between samples of late; 0 while not known."""
        rate = self._status().get("sample_rate", 0.0)
        return round(1e6 / rate) if rate > 0 else 0
