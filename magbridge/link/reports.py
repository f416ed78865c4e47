"""Reports of the bridge on itself: heartbeat, status and version."""

from __future__ import annotations

import re
from collections.abc import Callable
from math import nan
from typing import NamedTuple

from magbridge.link.metadata import GENERAL, crc32, uri
from magbridge.link.output import Outbox
from magbridge.link.vehicle import VehicleState
from magbridge.mavlink import spec
from magbridge.mavlink.enums import (
    FIRMWARE_VERSION_TYPE,
    MAV_AUTOPILOT,
    MAV_PROTOCOL_CAPABILITY,
    MAV_STATE,
    MAV_TYPE,
)

__all__ = ["Condition", "Reports"]

HEARTBEAT, STATUS = spec("HEARTBEAT"), spec("MAG_STATUS")
MASK = 0xFFFFFFFF
ALIVE, CRITICAL = (
    HEARTBEAT.payload(
        type=MAV_TYPE.ONBOARD_CONTROLLER,
        autopilot=MAV_AUTOPILOT.INVALID,
        system_status=state,
        mavlink_version=3,
    )
    for state in (MAV_STATE.ACTIVE, MAV_STATE.CRITICAL)
)
CAPABILITIES = (
    MAV_PROTOCOL_CAPABILITY.PARAM_FLOAT
    | MAV_PROTOCOL_CAPABILITY.COMMAND_INT
    | MAV_PROTOCOL_CAPABILITY.MAVLINK2
    | MAV_PROTOCOL_CAPABILITY.FTP
    | MAV_PROTOCOL_CAPABILITY.PARAM_ENCODE_C_CAST
)


class Condition(NamedTuple):
    """The part of MAG_STATUS that the link cannot know itself; fields, units and states as in the message."""

    samples: int = 0
    samples_lost: int = 0
    sensor_bytes_skipped: int = 0
    sensor_frames_bad: int = 0
    sensor_state: int = 0
    sensor_clock_drift: float = nan
    sample_rate: float = nan
    telemetry_stale: int = 0
    log_records: int = 0
    log_lost: int = 0
    log_state: int = 0


class Reports:
    """Send HEARTBEAT, MAG_STATUS, AUTOPILOT_VERSION and the description of the component.

    Parameters
    ----------
    outbox : Outbox
    vehicle : VehicleState
    start_us : int
        µs, when the bridge started.
    version : str
        Of the program, ``"0.1.0"``.
    calibration_id : int
    status : callable
        Returns the Condition.
    speaking : callable
        Says whether readings come from the sensor.
    general : bytes
        The general metadata file.
    """

    def __init__(
        self,
        outbox: Outbox,
        vehicle: VehicleState,
        start_us: int,
        version: str,
        calibration_id: int,
        status: Callable[[], Condition],
        speaking: Callable[[], bool],
        general: bytes,
    ) -> None:
        self._outbox, self._vehicle, self._status = outbox, vehicle, status
        self._speaking, self._general = speaking, general
        self._start_us, self._version, self.calibration_id = start_us, version, calibration_id

    def heartbeat(self) -> None:
        """Send HEARTBEAT: active while readings come from the sensor, else critical."""
        self._outbox.put(HEARTBEAT, ALIVE if self._speaking() else CRITICAL)

    def status(self) -> None:
        """Send MAG_STATUS."""
        codec, vehicle, clock = self._outbox.codec, self._vehicle, self._vehicle.clock
        condition = self._status()
        payload = STATUS.struct.pack(
            codec.utc_us, round(clock.offset_us(codec.now_us)) - codec.utc_offset_us if clock.known else 0,
            (codec.now_us - self._start_us) // 1_000_000 & MASK, self.calibration_id,
            condition.samples & MASK, condition.samples_lost & MASK, condition.sensor_bytes_skipped & MASK,
            condition.sensor_frames_bad & MASK, codec.frames & MASK, vehicle.frames_lost & MASK,
            codec.bytes_skipped & MASK, codec.signing.refused & MASK if codec.signing else 0,
            condition.log_records & MASK, condition.log_lost & MASK, condition.telemetry_stale,
            condition.sample_rate, condition.sensor_clock_drift, clock.sigma, clock.drift_ppm,
            vehicle.reboots & 0xFFFF, condition.sensor_state, vehicle.state, condition.log_state,
        )  # fmt: skip
        self._outbox.put(STATUS, payload)

    def version(self) -> None:
        """Send AUTOPILOT_VERSION."""
        numbers = [int(number) & 0xFF for number in re.findall(r"\d+", self._version)[:3]]
        self._outbox.send(
            "AUTOPILOT_VERSION",
            capabilities=CAPABILITIES,
            flight_sw_version=int.from_bytes(
                bytes([*numbers, 0, 0, 0][:3]) + bytes((FIRMWARE_VERSION_TYPE.OFFICIAL,)), "big"
            ),
        )

    def component(self) -> None:
        """Send COMPONENT_INFORMATION_BASIC."""
        codec = self._outbox.codec
        self._outbox.send(
            "COMPONENT_INFORMATION_BASIC",
            time_boot_ms=(codec.now_us - self._start_us) // 1000 & MASK,
            capabilities=CAPABILITIES,
            vendor_name="magbridge",
            model_name="magnetometer bridge",
            software_version=self._version,
        )

    def metadata(self) -> None:
        """Send COMPONENT_METADATA with the URI of the files that describe the parameters."""
        codec = self._outbox.codec
        self._outbox.send(
            "COMPONENT_METADATA",
            time_boot_ms=(codec.now_us - self._start_us) // 1000 & MASK,
            file_crc=crc32(self._general),
            uri=uri(codec.component, GENERAL),
        )

    def sample_interval_us(self) -> int:
        """Return the recent mean interval between samples in µs; 0 while unknown."""
        rate = self._status().sample_rate
        return round(1e6 / rate) if rate > 0 else 0
