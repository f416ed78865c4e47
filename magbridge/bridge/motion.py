"""Selection of the telemetry for dead reckoning, without telemetry that contains the bridge's own fixes.

An autopilot that uses our fixes sends them back in LOCAL_POSITION_NED, GLOBAL_POSITION_INT and ODOMETRY. If
the bridge used these positions as the vehicle's motion, each fix would shift the track of the next fix, and
an error of 60 m would grow to a kilometre. So the autopilot's position counts as motion only until the first
fix is sent, and again after GPS has corrected it.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from math import degrees, hypot, isfinite, isnan, nan, sqrt
from typing import Any

import numpy as np

from magbridge.field.geodesy import separation
from magbridge.field.igrf import igrf
from magbridge.link.component import Component
from magbridge.link.estimates import Pose, quaternion
from magbridge.link.telemetry import AIRCRAFT, EKF_STATUS, PX4_STATUS, is_contradicted, is_null_position
from magbridge.mavlink import Message, by_id, spec
from magbridge.mavlink.enums import MAV_AUTOPILOT, MAV_FRAME, MAV_SEVERITY, MAV_TYPE
from magbridge.navigate import Navigator
from magbridge.navigate.attitude import AttitudeFilter
from magbridge.navigate.deadreckoning import GLIDE
from magbridge.records import Corrected, Quality

__all__ = ["FIX_3D", "GPS_RAW", "LONGEST_US", "Autopilot", "Motion", "MotionSource"]

MAX_MAIN_FIELD_AGE_US = 60_000_000
"""Longest time for which the main field at one position is used, µs."""
MAX_STATE_AGE_US = 10_000_000
"""Longest time for which a received height or attitude is used, µs."""
UNSET = (0, 0)
"""Latitude and longitude in GPS_GLOBAL_ORIGIN of an autopilot without an origin."""
LONGEST_US = 60_000_000
"""Time after which a report of the autopilot no longer counts, µs."""
ATTITUDE, HEARTBEAT, ODOMETRY = (spec(name).id for name in ("ATTITUDE", "HEARTBEAT", "ODOMETRY"))
GLOBAL_POSITION, LOCAL_POSITION = spec("GLOBAL_POSITION_INT").id, spec("LOCAL_POSITION_NED").id
GPS_RAW, ORIGIN = spec("GPS_RAW_INT").id, spec("GPS_GLOBAL_ORIGIN").id
SYS_STATUS, SYSTEM_STATE = spec("SYS_STATUS").id, spec("EXTENDED_SYS_STATE").id
VERSION = spec("AUTOPILOT_VERSION").id
FIX_3D = 3
"""Smallest GPS_RAW_INT.fix_type whose position is used."""
ARMED = 128
"""Flag of HEARTBEAT.base_mode: the vehicle is armed."""
STATE_UNKNOWN, ON_GROUND = 0, 1
"""Values of EXTENDED_SYS_STATE.landed_state (MAV_LANDED_STATE)."""
DIFFERENTIAL_PRESSURE = 16
"""Flag of SYS_STATUS.onboard_control_sensors_present: the vehicle has an airspeed sensor."""
VELOCITY_HORIZ, CONST_POS_MODE = 2, 128
"""Flags of EKF_STATUS_REPORT and ESTIMATOR_STATUS: horizontal velocity is valid; position is held
constant."""


class Autopilot:
    """State of the autopilot, from its latest messages, as far as navigation needs it.

    `stack`: MAV_AUTOPILOT of the autopilot; GENERIC before it is known.
    `origin`: origin of its local frame: latitude (deg), longitude (deg) and altitude (m above the sea); None
        if unknown.
    `position_us`: time when its GPS receiver last sent a position, used or not, µs.
    `unvouched_us`, `contradicted_us`: times when it last reported that its velocity does not hold, and that
        its filter contradicts a sensor, µs.
    """

    def __init__(self) -> None:
        self.stack = int(MAV_AUTOPILOT.GENERIC)
        self.origin: tuple[float, float, float] | None = None
        self.position_us = self.unvouched_us = self.contradicted_us = -LONGEST_US
        self._latest: dict[int, tuple[Message, int]] = {}
        self._altitude = self._down = self._gps_altitude = nan
        self._altitude_us = self._down_us = -MAX_STATE_AGE_US

    def receive(self, message: Message, time_us: int) -> None:
        """Process a message of the autopilot, received at `time_us` (µs)."""
        number = message.id
        self._latest[number] = message, time_us
        if number == HEARTBEAT:
            self.stack = message["autopilot"]
        elif number in (LOCAL_POSITION, ODOMETRY):
            self._down, self._down_us = message["z"], time_us
        elif number == GLOBAL_POSITION:
            altitude = 1e-3 * message["alt"]
            if is_null_position(message):  # without an origin, its altitude is relative to the start
                self._down, self._down_us = -altitude, time_us
            else:
                self._altitude, self._altitude_us = altitude, time_us
        elif number == GPS_RAW and message["fix_type"] >= FIX_3D:
            self._gps_altitude, self.position_us = 1e-3 * message["alt"], time_us
        elif number == ORIGIN and (message["latitude"], message["longitude"]) != UNSET:
            self.origin = message["latitude"] * 1e-7, message["longitude"] * 1e-7, 1e-3 * message["altitude"]
        elif number in (EKF_STATUS, PX4_STATUS):
            holds = message["flags"] & VELOCITY_HORIZ and not message["flags"] & CONST_POS_MODE
            self.unvouched_us = -LONGEST_US if holds else time_us
            if is_contradicted(message):
                self.contradicted_us = time_us

    def value(self, number: int, field: str, unknown: Any) -> Any:
        """Return a field of the latest message with the id `number`; `unknown` before the first one."""
        return self._latest[number][0][field] if number in self._latest else unknown

    @property
    def is_aircraft(self) -> bool:
        """True if the vehicle is an aircraft."""
        return self.value(HEARTBEAT, "type", 0) in AIRCRAFT

    @property
    def is_grounded(self) -> bool:
        """True if the vehicle is an aircraft on the ground."""
        landed_state = self.value(SYSTEM_STATE, "landed_state", STATE_UNKNOWN)
        is_armed = self.value(HEARTBEAT, "base_mode", 0) & ARMED
        return self.is_aircraft and (landed_state == ON_GROUND if landed_state else not is_armed)

    @property
    def measures_airspeed(self) -> bool:
        """False if the airspeed is not the speed through the medium.

        A rover and an ArduPilot boat measure the wind. An ArduPilot without an airspeed sensor sends a speed
        that depends on GPS.
        """
        kind = self.value(HEARTBEAT, "type", 0)
        if self.stack != MAV_AUTOPILOT.ARDUPILOTMEGA or kind == MAV_TYPE.GROUND_ROVER:
            return bool(kind != MAV_TYPE.GROUND_ROVER)
        sensors = self.value(SYS_STATUS, "onboard_control_sensors_present", DIFFERENTIAL_PRESSURE)
        return bool(kind != MAV_TYPE.SURFACE_BOAT and sensors & DIFFERENTIAL_PRESSURE)

    @property
    def version(self) -> tuple[int, int] | None:
        """Major and minor version of the firmware; None if unknown."""
        version = self.value(VERSION, "flight_sw_version", 0)
        return (version >> 24, version >> 16 & 0xFF) if version else None

    def altitude(self, time_us: int) -> float:
        """Return the altitude (m above the sea) at `time_us` (µs); NaN if unknown."""
        if time_us - self._altitude_us < MAX_STATE_AGE_US:
            return self._altitude
        if self.origin is not None and time_us - self._down_us < MAX_STATE_AGE_US:
            return self.origin[2] - self._down
        return nan

    def depth(self, time_us: int) -> float:
        """Return the depth (m below the sea) at `time_us` (µs); NaN if unknown.

        Without the autopilot's altitude, it is the GPS receiver's, else relative to the origin of the local
        frame.
        """
        altitude = self.altitude(time_us)
        if isnan(altitude) and time_us - self.position_us < MAX_STATE_AGE_US:
            return -self._gps_altitude
        return self._down if isnan(altitude) and time_us - self._down_us < MAX_STATE_AGE_US else -altitude

    def pose(self, time_us: int, latitude: float, longitude: float) -> Pose | str:
        """Return the vehicle's pose at a position (deg) and a time, or the reason why it is unknown."""
        if self.origin is None:
            return "no origin of the autopilot's frame"
        attitude, received_us = self._latest.get(ATTITUDE, (None, 0))
        if attitude is None or time_us - received_us >= MAX_STATE_AGE_US:
            return "no attitude from the autopilot"
        is_recent = time_us - self._down_us < MAX_STATE_AGE_US
        down = self._down if is_recent else self.origin[2] - self.altitude(time_us)
        if isnan(down):
            return "no height from the autopilot"
        turn = quaternion(attitude["roll"], attitude["pitch"], attitude["yaw"])
        return Pose(*separation(*self.origin[:2], latitude, longitude), down, turn)


MAX_SOURCE_AGE_US = 30_000_000
"""Time without data from a source of motion after which the next best source is used, µs."""
GLIDING_US, MIN_DIVE_M = 600_000_000, 3.0
"""Time after the last dive or climb for which the vehicle counts as a glider, µs; smallest change of depth
of one, m, while the pitch is steep."""
SPEED_WEIGHT = 0.1
"""Weight of each new speed in the running mean, which is used if no source of motion is left."""
EQUAL_M_S = 0.011
"""Largest difference from the ground speed at which an airspeed counts as ground speed, m/s. ArduPilot
without an airspeed sensor sends ground speed (``GCS_Common.cpp``, vfr_hud_airspeed), GPS_RAW_INT in 0.01
m/s steps."""
MIN_EQUAL = 5
"""Number of airspeeds in a row equal to the ground speed after which the bridge reports them."""
CONTRADICTED_US = 10_000_000
"""Time for which the autopilot's attitude stays doubtful after its filter contradicted a sensor, µs."""
MIN_HEADING_SIGMA_RAD, HEADING_INTERVAL_US = 0.07, 5_000_000
"""Smallest 1-sigma of a heading while the autopilot's is wrong, rad; the time from one widening of the
current by it to the next, µs."""
UNCHECKED_HEADING_SIGMA_RAD = 0.5
"""1-sigma of the autopilot's heading while it is wrong and no rates check it, rad: 20 to 40 deg were seen."""
UNKNOWN_SPEED_RAD = 1.0
"""1-sigma of the heading, rad, that stands for an unknown speed: the velocity is uncertain by its length."""
MAX_RATE_RAD_S, MAX_FIELD_NT = 50.0, 1e6
"""Limits of a rate, rad/s, and of a field, nT, that no vehicle reaches."""
NO_DIRECTION_FLAGS = int(Quality.SATURATED | Quality.UNCALIBRATED | Quality.NO_BORESIGHT | Quality.LATE_JOIN)
"""Flags of samples whose direction is not used."""
JUMP = 10.0
"""Step of a position, in excess of the motion by its velocity, that counts as a reset, m."""


class MotionSource(IntEnum):
    """Source of the motion for dead reckoning; a smaller value is preferred."""

    OTHER = 0
    """Position from another component of the vehicle, such as a Doppler log."""
    SPEED = 1
    """Heading and speed through the water or air."""
    TRACK = 2
    """The autopilot's position or velocity, while it does not contain the bridge's fixes."""
    GLIDE = 3
    """Heading, and the speed computed from pitch and depth."""
    LAST = 4
    """Heading, and the last known speed."""
    NONE = 5


class Motion:
    """Selector that passes the vehicle's motion from the best available source to the navigator.

    `autopilot`: state of the autopilot; the caller has passed each message to it before.
    `velocity_stays`: returns True if a fix does not change the autopilot's velocity, so that the velocity
        remains an independent measurement.
    `source`: present source of the motion.
    `fed_back`: True if the autopilot's position contains the bridge's fixes.
    `gps_trusted`: False if the autopilot's position may contain GPS positions that the bridge rejected.
    """

    def __init__(
        self,
        navigator: Navigator,
        component: Component,
        autopilot: Autopilot,
        velocity_stays: Callable[[], bool],
    ) -> None:
        self.source, self.fed_back, self.gps_trusted = MotionSource.NONE, False, True
        self._navigator, self._output, self._autopilot = navigator, component.output, autopilot
        self._autopilot_id = component.peer[1]
        self._velocity_stays = velocity_stays
        self._received_us = 0
        self._heading = self._pitch = self._last = nan
        self._steep_us = -GLIDING_US
        self._dive_from = nan  # depth at which the pitch became steep, m
        self._equal = 0  # airspeeds in a row that were equal to the speed over ground
        self._widened_us = -MAX_SOURCE_AGE_US
        self._filter = AttitudeFilter()
        self._main_field = np.zeros(3)  # north, east, down, nT, at the time _main_us
        self._main_us = -MAX_MAIN_FIELD_AGE_US
        self._grounded = False
        self._stream: tuple[int, int] | None = None  # component and message that the track comes from
        self._step: tuple[int, float, float, int] | None = None  # µs, m, m, resets of that message
        self._jumps = 0.0, 0.0
        self._measured: set[tuple[int, int]] = set()  # streams with a velocity that is not always zero
        self._handlers = by_id(
            ATTITUDE=self._attitude, GLOBAL_POSITION_INT=self._global, LOCAL_POSITION_NED=self._local,
            ODOMETRY=self._odometry, RAW_IMU=self._gyro, VFR_HUD=self._speed,
        )  # fmt: skip

    def receive(self, message: Message, time_us: int) -> None:
        """Process a message of the vehicle, received at `time_us` (µs).

        On the ground, dead reckoning by airspeed does not estimate the wind, because the wind does not move
        the aircraft. The estimate is restarted at take-off.
        """
        grounded = self._autopilot.is_grounded
        if self._grounded and not grounded:
            self._navigator.new_motion(time_us)
        self._grounded = grounded
        if self.source is MotionSource.SPEED and not self._autopilot.measures_airspeed:
            self.source = MotionSource.NONE  # the next best source is used at once
        if handler := self._handlers.get(message.id):
            handler(message, time_us)

    def fixes_sent(self) -> None:
        """Record that the autopilot's position contains the bridge's fixes from now on."""
        if not self.fed_back and self.source is MotionSource.TRACK and not self._velocity_stays():
            self.source = MotionSource.NONE  # the next best source is used at once
        self.fed_back = True

    def gps_held(self) -> None:
        """Record that GPS has corrected the autopilot's position."""
        self.fed_back = False

    def direct(self, time_us: int, corrected: Corrected, utc_us: int) -> None:
        """Use the direction of a corrected sample, at `time_us` and at UNIX time `utc_us` (µs)."""
        field = np.array(corrected.field)
        known = 0.0 < corrected.total_field < MAX_FIELD_NT and bool(np.isfinite(field).all())
        if corrected.quality & NO_DIRECTION_FLAGS or not known:
            return
        if time_us - self._main_us >= MAX_MAIN_FIELD_AGE_US:
            latitude, longitude = self._navigator.reckoned(time_us)
            if not isfinite(latitude):
                return
            self._main_field = igrf(longitude, latitude, 0.0, utc_us * 1e-6).ravel()
            self._main_us = time_us
        self._filter.direct(time_us * 1e-6, field, self._main_field)

    def _gyro(self, message: Message, time_us: int) -> None:  # noqa: ARG002 - a handler like the others
        if message.component == self._autopilot_id:
            rates = 1e-3 * np.array([message["xgyro"], message["ygyro"], message["zgyro"]])
            self._filter.gyro(message["time_usec"] * 1e-6, rates)

    def _turn(self, message: Message, time_us: int) -> float:
        """Return the heading of an ATTITUDE, rad; while it is wrong, return that of rates and field."""
        # While GPS is used, GPS is the more likely fault, and dead reckoning has to test GPS.
        uses_gps = self.gps_trusted and time_us - self._autopilot.position_us < CONTRADICTED_US
        vouched = uses_gps or time_us - self._autopilot.contradicted_us >= CONTRADICTED_US
        angles = message["roll"], message["pitch"], message["yaw"]
        rates = np.array([message["rollspeed"], message["pitchspeed"], message["yawspeed"]])
        received, heading, sigma = time_us * 1e-6, float(message["yaw"]), UNCHECKED_HEADING_SIGMA_RAD
        if np.all(np.abs(rates) < MAX_RATE_RAD_S) and rates.any():  # all 0: the autopilot sends none
            time = message["time_boot_ms"] * 1e-3 or received
            self._filter.rotate(received, time, angles, rates, vouched=vouched)
            vouched = self._filter.agrees
            if not vouched:
                heading, sigma = self._filter.heading, self._filter.heading_sigma
        if not vouched and time_us - self._widened_us >= HEADING_INTERVAL_US:
            self._widened_us = time_us
            self._navigator.widen_heading(time_us, max(sigma, MIN_HEADING_SIGMA_RAD))
        return heading

    def _attitude(self, message: Message, time_us: int) -> None:
        own = message.component == self._autopilot_id
        heading = self._turn(message, time_us) if own else message["yaw"]
        self._heading, self._pitch = degrees(heading) % 360.0, degrees(message["pitch"])
        # the vehicle glides if its depth changes while it is steep; with thrusters it may only accelerate
        depth = self._autopilot.depth(time_us)
        if abs(self._pitch) < GLIDE or isnan(depth):
            self._dive_from = nan
        elif isnan(self._dive_from):
            self._dive_from = depth
        elif abs(depth - self._dive_from) >= MIN_DIVE_M:
            self._steep_us = time_us
        if self.source is MotionSource.SPEED and time_us - self._received_us < MAX_SOURCE_AGE_US:
            self._navigator.telemetry(time_us, heading=self._heading, pitch=self._pitch)
        elif time_us - self._steep_us < GLIDING_US and isfinite(depth):
            if self._use(MotionSource.GLIDE, time_us, "heading, pitch and depth"):
                self._navigator.telemetry(time_us, heading=self._heading, pitch=self._pitch)
        elif isfinite(self._last):
            was_known = self.source is not MotionSource.LAST
            if self._use(MotionSource.LAST, time_us, "heading and the last known speed: no other is sent"):
                self._navigator.telemetry(time_us, heading=self._heading, speed=self._last)
                if was_known:
                    self._navigator.widen_heading(time_us, UNKNOWN_SPEED_RAD)

    def _speed(self, message: Message, time_us: int) -> None:
        if not self._autopilot.measures_airspeed:
            return
        speed = message["airspeed"]  # 0 of a vehicle that does not measure it
        ground_speeds = message["groundspeed"], self._autopilot.value(GPS_RAW, "vel", nan) * 1e-2
        is_ground = any(abs(speed - one) < EQUAL_M_S for one in ground_speeds)
        if is_ground and speed > 0.0:
            text = "VFR_HUD.airspeed is the speed over ground: not used"
            self._equal += 1
            if self._equal >= MIN_EQUAL:
                self._output.announce("airspeed", text, MAV_SEVERITY.WARNING)
        elif speed > 0.0 and isfinite(self._heading):
            self._equal = 0
            self._last = speed
            # if speed is the source already, the navigator has the heading since its own message
            heading = nan if self.source is MotionSource.SPEED else self._heading
            if self._use(MotionSource.SPEED, time_us, "heading and speed through the water or air"):
                # the horizontal part of the airspeed in a climb or dive
                level = sqrt(max(speed * speed - message["climb"] ** 2, 0.0))
                speed = message["groundspeed"] if self._grounded else level
                self._navigator.telemetry(time_us, heading=heading, pitch=self._pitch, speed=speed)

    def rise(self, time_us: int) -> None:
        """Pass the depth, and an aircraft's height, to the navigator."""
        depth = self._autopilot.depth(time_us)
        self._navigator.telemetry(time_us, depth=depth, height=-depth if self._autopilot.is_aircraft else nan)

    def _global(self, message: Message, time_us: int) -> None:
        self.rise(time_us)
        self._track(message, time_us, None, (message["vx"] * 1e-2, message["vy"] * 1e-2))

    def _local(self, message: Message, time_us: int) -> None:
        self.rise(time_us)
        self._track(message, time_us, (message["x"], message["y"]), (message["vx"], message["vy"]))

    def _odometry(self, message: Message, time_us: int) -> None:
        self.rise(time_us)
        velocity = message["vx"], message["vy"], message["vz"]
        if message["child_frame_id"] == MAV_FRAME.BODY_FRD:
            velocity = rotate(message["q"], velocity)
        self._track(message, time_us, (message["x"], message["y"]), velocity[:2], message["reset_counter"])

    def _track(
        self,
        message: Message,
        time_us: int,
        place: tuple[float, float] | None,
        velocity: tuple[float, float],
        resets: int = 0,
    ) -> None:
        """Process an estimate of position (north, east, m; None without one) and velocity (north, east, m/s).

        `resets`: reset counter of the message, which changes when the position jumps.
        """
        stream, own = (message.component, message.id), message.component == self._autopilot_id
        if own and (not self.gps_trusted or time_us - self._autopilot.unvouched_us < MAX_SOURCE_AGE_US):
            return
        if isfinite(hypot(*velocity)) and velocity != (0.0, 0.0):
            self._measured.add(stream)
            if own and not self.fed_back:
                last, speed = self._last, hypot(*velocity)
                self._last = last + SPEED_WEIGHT * (speed - last) if isfinite(last) else speed
        measured = stream in self._measured
        source = MotionSource.TRACK if own else MotionSource.OTHER
        clean = not (own and self.fed_back)
        if own and measured and (self._velocity_stays() or (clean and place is None)):
            if self._use(source, time_us, "the autopilot's velocity", stream):
                self._navigator.telemetry(time_us, velocity_north=velocity[0], velocity_east=velocity[1])
        elif place is not None and clean:
            words = "the autopilot's position" if own else f"the position from component {stream[0]}"
            if self._use(source, time_us, words, stream):
                self._move(time_us, place, velocity if measured else None, resets)

    def _move(
        self, time_us: int, place: tuple[float, float], velocity: tuple[float, float] | None, resets: int
    ) -> None:
        """Pass a position (m) to the navigator without the jumps that no `velocity` (m/s) explains."""
        if self._step is not None:
            then_us, *before, count = self._step
            seconds = (time_us - then_us) * 1e-6
            moved = place[0] - before[0], place[1] - before[1]
            carried = (velocity[0] * seconds, velocity[1] * seconds) if velocity else (0.0, 0.0)
            odd = moved[0] - carried[0], moved[1] - carried[1]
            unexplained = velocity is not None and hypot(*odd) > JUMP + 0.5 * hypot(*carried)
            if resets != count or unexplained:
                self._jumps = self._jumps[0] + odd[0], self._jumps[1] + odd[1]
        self._step = time_us, *place, resets
        self._navigator.telemetry(time_us, north=place[0] - self._jumps[0], east=place[1] - self._jumps[1])

    def _use(
        self, source: MotionSource, time_us: int, words: str, stream: tuple[int, int] | None = None
    ) -> bool:
        """Return True if `source` is now the source of motion, because no better source is recent.

        `words`: description of the source for a STATUSTEXT. `stream`: its component and message id.
        """
        same = (source, stream) == (self.source, self._stream)
        if not same and source >= self.source and time_us - self._received_us < MAX_SOURCE_AGE_US:
            return False
        if not same:
            self._navigator.new_motion(time_us)
            self.source, self._stream, self._step = source, stream, None
        self._received_us = time_us
        severity = MAV_SEVERITY.WARNING if source is MotionSource.LAST else MAV_SEVERITY.INFO
        self._output.announce("motion", f"dead reckoning by {words}", severity)
        return True


def rotate(q: tuple[float, float, float, float], v: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the vector `v` rotated by the quaternion w, x, y, z: v + 2 u × (u × v + w v), u = (x, y, z)."""
    w, x, y, z = q
    a, b, c = (y * v[2] - z * v[1] + w * v[0], z * v[0] - x * v[2] + w * v[1], x * v[1] - y * v[0] + w * v[2])
    return (v[0] + 2.0 * (y * c - z * b), v[1] + 2.0 * (z * a - x * c), v[2] + 2.0 * (x * b - y * a))
