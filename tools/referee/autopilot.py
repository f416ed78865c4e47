"""Common part of both emulated autopilots: motion, GPS, telemetry and replies to commands."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping
from math import cos, hypot, isfinite, radians, sin, sqrt
from typing import NamedTuple

from magbridge.field.geodesy import offset, separation
from magbridge.mavlink import Codec, Message, spec
from magbridge.mavlink.enums import MAV_CMD, MAV_FRAME, MAV_RESULT, MAV_TYPE
from magbridge.mavlink.messages import EXTRA, east_e7

Pair = tuple[float, float]


class PositionFilter:
    """Kalman filter of position and wind, whose two axes share one covariance (inputs have equal variances).

    `position` (m) and `wind` (m/s, the unmeasured part of the velocity) are north and east, `velocity` (m/s)
    is over ground; `pp`, `pw`, `ww` (m², m²/s, m²/s²) are the covariance of position and wind. `walk` is the
    spectral density, (m/s)²/s, of the wind's (or the velocity error's) random walk.
    """

    def __init__(self, walk: float) -> None:
        self._walk = walk
        self.position: Pair = 0.0, 0.0
        self.wind: Pair = 0.0, 0.0
        self.velocity: Pair = 0.0, 0.0
        self.pp, self.pw, self.ww = 1e6, 0.0, 1.0

    @property
    def sigma(self) -> float:
        """1-sigma of the position on each axis, m."""
        return sqrt(self.pp)

    def predict(self, motion: Pair, dt: float) -> None:
        """Predict the state after `dt` s of a known `motion`, m/s.

        Notes
        -----
        The position integrates a random walk of density q: ``Q = q [[dt³/3, dt²/2], [dt²/2, dt]]``.
        """
        self.velocity = motion[0] + self.wind[0], motion[1] + self.wind[1]
        self.position = (self.position[0] + self.velocity[0] * dt, self.position[1] + self.velocity[1] * dt)
        q = self._walk
        self.pp += (2.0 * self.pw + self.ww * dt) * dt + q * dt**3 / 3.0
        self.pw += self.ww * dt + q * dt**2 / 2.0
        self.ww += q * dt

    def distance(self, place: Pair, variance: float) -> float:
        """Return the distance of a measured position (m) in sigmas of the innovation."""
        away = place[0] - self.position[0], place[1] - self.position[1]
        return hypot(*away) / sqrt(2.0 * (self.pp + variance))

    def fuse(self, place: Pair, variance: float) -> None:
        """Update the filter with a measured position (m) of a `variance` (m²)."""
        s = self.pp + variance
        self._shift(place, self.pp / s, self.pw / s)
        kept = variance / s
        self.pp, self.pw, self.ww = self.pp * kept, self.pw * kept, self.ww - self.pw * self.pw / s

    def force(self, place: Pair, variance: float) -> None:
        """Update the filter with a measured position: gain 1 for position, Kalman gain for wind.

        Notes
        -----
        ``P = (1 - K H) P (1 - K H)' + K R K'`` with K = (1, k).
        """
        k = self.pw / (self.pp + variance)
        self._shift(place, 1.0, k)
        ww = self.ww - 2.0 * k * self.pw + k * k * (self.pp + variance)
        self.pp, self.pw, self.ww = variance, k * variance, ww

    def reset(self, place: Pair, variance: float) -> None:
        """Set position and variance to a measured position; keep the wind."""
        self.position = place
        self.pp, self.pw = variance, 0.0

    def _shift(self, place: Pair, gain: float, learned: float) -> None:
        away = place[0] - self.position[0], place[1] - self.position[1]
        self.position = self.position[0] + gain * away[0], self.position[1] + gain * away[1]
        self.wind = self.wind[0] + learned * away[0], self.wind[1] + learned * away[1]


# ---- what both autopilots share ----------------------------------------------------------------------------


GPS_SIGMA = 2.5
"""1-sigma of a GPS position on an axis, m."""
FIX_3D, NO_FIX = 3, 1
"""Values of GPS_RAW_INT.fix_type."""
HEARTBEAT_HZ = 1.0
EARLY_US = 1_000
"""Time by which a message may be early, µs, so that rounded time steps skip none."""
ARMED, IN_AIR = 128, 2
"""Flag of HEARTBEAT.base_mode, and value of EXTENDED_SYS_STATE.landed_state."""
DIFFERENTIAL_PRESSURE = 16
"""Bit of SYS_STATUS: there is an airspeed sensor."""
OPTIONAL = frozenset(("VFR_HUD", "LOCAL_POSITION_NED", "ODOMETRY", "RAW_IMU"))
"""Messages that the autopilot sends only if `streams` names them."""
Place = tuple[float, float]


class Truth(NamedTuple):
    """True state of a vehicle: position (deg), speed through the water (m/s), angles (deg), depth (m).

    `gps` (deg) is the receiver's position, None without reception; `accuracy` (m) is the receiver's claim.
    """

    place: Place
    speed: float
    heading: float
    pitch: float
    depth: float
    gps: Place | None
    accuracy: float = GPS_SIGMA


class Autopilot:
    """Emulated autopilot: a position filter and its telemetry, without attitude and height control.

    The local frame has its `origin` (deg, deg, m above the sea); boot is at `start_us`, µs since 1970 UTC.
    `streams` are the messages in addition to HEARTBEAT, ATTITUDE, GPS_RAW_INT and GLOBAL_POSITION_INT.
    Without ``VFR_HUD`` the speed is unknown; ``GLOBAL_POSITION_INT`` in `streams` adds a velocity to this
    message. With `airspeed` the autopilot measures its speed through water or air. Unless it `obeys`, it
    ignores fixes. `rates` are the messages' rates after a start, Hz, which a request changes; with None, each
    step sends every message. `vehicle` is the MAV_TYPE of the heartbeat.

    `taken` counts the outcomes of received fixes: fused, or the reason of a rejection.
    """

    STACK = 0
    """MAV_AUTOPILOT of the heartbeat."""
    STATUS = ""
    """Message in which the autopilot reports the status of its filter."""
    WALK = 1e-3
    """Spectral density of the wind's random walk, (m/s)²/s."""
    GPS_GATE = 5.0
    """Gate of a GPS position, sigmas."""

    def __init__(
        self,
        origin: tuple[float, float, float],
        start_us: int,
        streams: Collection[str] = ("VFR_HUD",),
        *,
        airspeed: bool = True,
        obeys: bool = True,
        rates: Mapping[str, float] | None = None,
        vehicle: int = MAV_TYPE.SUBMARINE,
    ) -> None:
        self.filter = PositionFilter(self.WALK)
        self.taken: Counter[str] = Counter()
        self.origin, self._streams, self._airspeed, self._obeys = origin, streams, airspeed, obeys
        self._codec = Codec(1, 1)
        self._start_us = self._now_us = start_us
        self._motion: Place = 0.0, 0.0
        self._truth: Truth | None = None
        self._gps_us: int | None = None  # time of the last fused GPS position
        self._gps_seen_us: int | None = None  # start of its rejection
        self._resets = 0
        self._takes: dict[int, Callable[[Message], str]] = {}
        self._vehicle, self.rates = vehicle, None if rates is None else dict(rates)
        self._next_us: dict[str, int] = {}
        self._messages = {
            "HEARTBEAT": self._heartbeat, "ATTITUDE": self._attitude, self.STATUS: self._status,
            "GPS_RAW_INT": self._gps_raw, "GLOBAL_POSITION_INT": self._global_position,
            "VFR_HUD": self._vfr_hud, "LOCAL_POSITION_NED": self._local_position,
            "ODOMETRY": self._own_odometry, "EXTENDED_SYS_STATE": self._extended_state,
            "RAW_IMU": self._raw_imu, "SYS_STATUS": self._sys_status,
        }  # fmt: skip

    @property
    def place(self) -> Place:
        """Estimated position, deg."""
        return offset(*self.origin[:2], *self.filter.position)

    def local(self, place: Place) -> Place:
        """Return a position (deg) in the local frame, m north and east."""
        return separation(*self.origin[:2], *place)

    def since_gps(self) -> float:
        """Return the time since GPS was last fused, s."""
        return 1e9 if self._gps_us is None else (self._now_us - self._gps_us) * 1e-6

    def step(self, time_us: int, truth: Truth) -> bytes:
        """Advance the autopilot to a time with a new `truth`; return its telemetry."""
        self._truth = truth
        along = radians(truth.heading)
        self._motion = truth.speed * cos(along), truth.speed * sin(along)
        self._advance(time_us)
        if truth.gps is not None:
            self._gps(self.local(truth.gps))
        return self._telemetry(truth)

    def receive(self, data: bytes, time_us: int) -> bytes:
        """Process received frames; return the replies."""
        self._advance(time_us)
        answers = b""
        for message in self._codec.parse(data):
            if message.id in (spec("COMMAND_INT").id, spec("COMMAND_LONG").id):
                answers += self._command(message)
            elif message.id in self._takes and self._obeys:
                self.taken[self._takes[message.id](message)] += 1
        return answers

    def _advance(self, time_us: int) -> None:
        dt = (time_us - self._now_us) * 1e-6
        if dt > 0.0:
            self._now_us = time_us
            self.filter.predict(self._motion, dt)

    def _gps(self, place: Place) -> None:
        """Fuse a GPS position (m), reset to it, or reject it, by the rule :meth:`_gps_wins`."""
        if self._gps_us is None or self._gps_wins():
            self.filter.reset(place, GPS_SIGMA**2)
            self._resets += 1
        elif self.filter.distance(place, GPS_SIGMA**2) > self.GPS_GATE:
            if self._gps_seen_us is None:
                self._gps_seen_us = self._now_us
            return
        else:
            self.filter.fuse(place, GPS_SIGMA**2)
        self._gps_us, self._gps_seen_us = self._now_us, None

    def _gps_wins(self) -> bool:
        """Return True if the position is to be reset to GPS, which the filter has rejected for long."""
        raise NotImplementedError

    def _refused_for(self) -> float:
        """Return the time for which GPS has been rejected, s."""
        return 0.0 if self._gps_seen_us is None else (self._now_us - self._gps_seen_us) * 1e-6

    # ---- commands ------------------------------------------------------------------------------------

    def _command(self, message: Message) -> bytes:
        number = message["command"]
        if number == MAV_CMD.REQUEST_MESSAGE and message["param1"] == spec("GPS_GLOBAL_ORIGIN").id:
            return self._origin() if self._gps_us is not None else b""
        if number == MAV_CMD.SET_MESSAGE_INTERVAL:
            result = self._set_interval(message)
        elif number != MAV_CMD.EXTERNAL_POSITION_ESTIMATE or not self._obeys:
            return b""
        else:
            known = message.id == spec("COMMAND_INT").id
            result = self._external(message) if known else MAV_RESULT.COMMAND_INT_ONLY
            self.taken[result.name] += 1
        to = {"target_system": message.system, "target_component": message.component}
        return self._codec.pack("COMMAND_ACK", command=number, result=result, **to)

    def _external(self, message: Message) -> MAV_RESULT:
        """Process EXTERNAL_POSITION_ESTIMATE; return the result of the command."""
        raise NotImplementedError

    def _set_interval(self, message: Message) -> MAV_RESULT:
        """Process SET_MESSAGE_INTERVAL; return the result of the command.

        ``GCS_Common.cpp``, set_message_interval: from 1 ms to 60 s, FAILED for an unknown message;
        ``mavlink_receiver.cpp``, set_message_interval: FAILED for an unknown stream.
        """
        number = int(message["param1"])
        name = spec(number).name if number in EXTRA else ""
        if name not in self._messages:
            return MAV_RESULT.FAILED
        if self.rates is not None:
            self.rates[name] = 1e6 / min(max(message["param2"], 1e3), 6e7)
            self._next_us.pop(name, None)
        return MAV_RESULT.ACCEPTED

    def _status(self, truth: Truth) -> bytes:
        """Return the frame with the status of the position filter."""
        raise NotImplementedError

    # ---- telemetry -----------------------------------------------------------------------------------

    def _origin(self) -> bytes:
        where = {"latitude": round(self.origin[0] * 1e7), "longitude": east_e7(self.origin[1])}
        return self._codec.pack("GPS_GLOBAL_ORIGIN", **where, altitude=round(self.origin[2] * 1e3))

    def _telemetry(self, truth: Truth) -> bytes:
        """Return the frames of the messages that are due."""
        return b"".join(make(truth) for name, make in self._messages.items() if self._is_due(name))

    def _is_due(self, name: str) -> bool:
        """Return True if a message is due now; without rates, each message is due at every step."""
        if self.rates is None:
            return name not in OPTIONAL or name in self._streams
        rate = HEARTBEAT_HZ if name == "HEARTBEAT" else self.rates.get(name, 0.0)
        if rate <= 0.0 or self._now_us < self._next_us.get(name, 0):
            return False
        self._next_us[name] = self._now_us + round(1e6 / rate) - EARLY_US
        return True

    def _boot_ms(self) -> int:
        return (self._now_us - self._start_us) // 1000

    def _heartbeat(self, _: Truth) -> bytes:
        return self._codec.pack("HEARTBEAT", type=self._vehicle, autopilot=self.STACK, base_mode=ARMED)

    def _extended_state(self, _: Truth) -> bytes:
        return self._codec.pack("EXTENDED_SYS_STATE", landed_state=IN_AIR)

    def _raw_imu(self, _: Truth) -> bytes:
        return self._codec.pack("RAW_IMU", time_usec=1000 * self._boot_ms())

    def _attitude(self, truth: Truth) -> bytes:
        angles = {"yaw": radians(truth.heading), "pitch": radians(truth.pitch)}
        return self._codec.pack("ATTITUDE", time_boot_ms=self._boot_ms(), **angles)

    def _gps_raw(self, truth: Truth) -> bytes:
        gps = {"fix_type": NO_FIX}
        if truth.gps is not None:
            gps = {"fix_type": FIX_3D, "h_acc": round(truth.accuracy * 1e3)}
            gps |= {"lat": round(truth.gps[0] * 1e7), "lon": east_e7(truth.gps[1])}
        return self._codec.pack("GPS_RAW_INT", time_usec=self._now_us, **gps)

    def _global_position(self, truth: Truth) -> bytes:
        latitude, longitude = self.place
        vn, ve = self.filter.velocity
        speed = {}
        if "GLOBAL_POSITION_INT" in self._streams:
            speed = {"vx": round(vn * 100.0), "vy": round(ve * 100.0)}
        where = {"lat": round(latitude * 1e7), "lon": east_e7(longitude), "alt": round(-1e3 * truth.depth)}
        return self._codec.pack("GLOBAL_POSITION_INT", time_boot_ms=self._boot_ms(), **where, **speed)

    def _vfr_hud(self, truth: Truth) -> bytes:
        # GCS_Common.cpp, vfr_hud_airspeed: without a sensor, the speed over ground by GPS
        ground = hypot(*self.filter.velocity)
        speed = truth.speed if self._airspeed else ground
        return self._codec.pack("VFR_HUD", airspeed=speed, groundspeed=ground)

    def _sys_status(self, truth: Truth) -> bytes:  # noqa: ARG002 - a message like the others
        # GCS.cpp, update_sensor_status_flags
        present = DIFFERENTIAL_PRESSURE if self._airspeed else 0
        return self._codec.pack("SYS_STATUS", onboard_control_sensors_present=present)

    def _local_position(self, truth: Truth) -> bytes:
        (north, east), (vn, ve) = self.filter.position, self.filter.velocity
        local = {"x": north, "y": east, "z": truth.depth + self.origin[2], "vx": vn, "vy": ve}
        return self._codec.pack("LOCAL_POSITION_NED", time_boot_ms=self._boot_ms(), **local)

    def _own_odometry(self, truth: Truth) -> bytes:
        (north, east), (vn, ve), yaw = self.filter.position, self.filter.velocity, radians(truth.heading)
        return self._codec.pack(
            "ODOMETRY", time_usec=self._now_us, reset_counter=self._resets & 0xFF,
            frame_id=MAV_FRAME.LOCAL_NED, child_frame_id=MAV_FRAME.BODY_FRD,
            x=north, y=east, z=truth.depth + self.origin[2], q=(cos(0.5 * yaw), 0.0, 0.0, sin(0.5 * yaw)),
            vx=vn * cos(yaw) + ve * sin(yaw), vy=ve * cos(yaw) - vn * sin(yaw),
        )  # fmt: skip


def finite(*values: float) -> bool:
    """Return True if all values are finite."""
    return all(isfinite(value) for value in values)
