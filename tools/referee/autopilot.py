"""What both autopilots share: their motion, GPS, telemetry, and the commands that they answer."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection
from math import cos, hypot, isfinite, radians, sin
from typing import NamedTuple

from magbridge.field.geodesy import offset, separation
from magbridge.mavlink import Codec, Message, spec
from magbridge.mavlink.enums import MAV_CMD, MAV_FRAME, MAV_RESULT, MAV_TYPE
from magbridge.mavlink.messages import east_e7
from referee.filter import PositionFilter

__all__ = ["GPS_SIGMA", "Autopilot", "Truth", "finite"]

GPS_SIGMA = 2.5
"""m."""
FIX_3D, NO_FIX = 3, 1
"""GPS_RAW_INT.fix_type"""
Place = tuple[float, float]


class Truth(NamedTuple):
    """The vehicle at one moment.

    Attributes
    ----------
    place : tuple of float
        deg, latitude and longitude.
    speed, heading, pitch : float
        m/s through the water or air, deg, deg.
    depth : float
        m below the sea.
    gps : tuple of float or None
        deg, what the receiver measures; None without reception.
    accuracy : float
        m, what the receiver claims.
    """

    place: Place
    speed: float
    heading: float
    pitch: float
    depth: float
    gps: Place | None
    accuracy: float = GPS_SIGMA


class Autopilot:
    """An autopilot without its attitude and height control: a position filter, and its telemetry.

    Parameters
    ----------
    origin : tuple of float
        deg, deg, m above the sea: of the local frame.
    start_us : int
        µs since 1970 UTC, when it boots.
    streams : collection of str
        The messages that it sends besides HEARTBEAT, ATTITUDE, GPS_RAW_INT and GLOBAL_POSITION_INT. Without
        ``VFR_HUD`` nobody learns its speed; with ``GLOBAL_POSITION_INT`` that message has a velocity, too.
    airspeed : bool
        It measures its speed through the water or air.
    obeys : bool
        It takes fixes; else it does as if none had come.

    Attributes
    ----------
    filter : PositionFilter
    taken : Counter
        How often which message was taken, and why others were not.
    """

    STACK = 0
    """MAV_AUTOPILOT"""
    WALK = 1e-3
    """(m/s)²/s, of the wind."""
    GPS_GATE = 5.0
    """Sigmas."""

    def __init__(
        self,
        origin: tuple[float, float, float],
        start_us: int,
        streams: Collection[str] = ("VFR_HUD",),
        *,
        airspeed: bool = True,
        obeys: bool = True,
    ) -> None:
        self.filter = PositionFilter(self.WALK)
        self.taken: Counter[str] = Counter()
        self.origin, self._streams, self._airspeed, self._obeys = origin, streams, airspeed, obeys
        self._codec = Codec(1, 1)
        self._start_us = self._now_us = start_us
        self._motion: Place = 0.0, 0.0
        self._truth: Truth | None = None
        self._gps_us: int | None = None  # when GPS was last fused
        self._gps_seen_us: int | None = None  # since when it was refused
        self._resets = 0
        self._takes: dict[int, Callable[[Message], str]] = {}

    @property
    def place(self) -> Place:
        """deg, where it believes to be."""
        return offset(*self.origin[:2], *self.filter.position)

    def local(self, place: Place) -> Place:
        """Return a position (deg) in the local frame, m."""
        return separation(*self.origin[:2], *place)

    def since_gps(self) -> float:
        """Return the seconds since GPS was last fused."""
        return 1e9 if self._gps_us is None else (self._now_us - self._gps_us) * 1e-6

    def step(self, time_us: int, truth: Truth) -> bytes:
        """Let time pass until a new `truth`; return the telemetry."""
        self._truth = truth
        along = radians(truth.heading)
        self._motion = truth.speed * cos(along), truth.speed * sin(along)
        self._advance(time_us)
        if truth.gps is not None:
            self._gps(self.local(truth.gps))
        return self._telemetry(truth)

    def receive(self, data: bytes, time_us: int) -> bytes:
        """Take in frames; return the answers."""
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
        """Fuse GPS, or come back to it: the rules differ, see :meth:`_gps_wins`."""
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
        """Return whether the position is put to that of GPS, which has been refused for long."""
        raise NotImplementedError

    def _refused_for(self) -> float:
        """Return the seconds since GPS is there and refused."""
        return 0.0 if self._gps_seen_us is None else (self._now_us - self._gps_seen_us) * 1e-6

    # ---- commands ------------------------------------------------------------------------------------

    def _command(self, message: Message) -> bytes:
        number = message["command"]
        if number == MAV_CMD.REQUEST_MESSAGE and message["param1"] == spec("GPS_GLOBAL_ORIGIN").id:
            return self._origin() if self._gps_us is not None else b""
        if number != MAV_CMD.EXTERNAL_POSITION_ESTIMATE or not self._obeys:
            return b""
        known = message.id == spec("COMMAND_INT").id
        result = self._external(message) if known else MAV_RESULT.COMMAND_INT_ONLY
        self.taken[result.name] += 1
        return self._codec.pack(
            "COMMAND_ACK",
            command=number,
            result=result,
            target_system=message.system,
            target_component=message.component,
        )

    def _external(self, message: Message) -> MAV_RESULT:
        """Answer EXTERNAL_POSITION_ESTIMATE."""
        raise NotImplementedError

    def _status(self) -> bytes:
        """Return what it reports of its filter."""
        return b""

    # ---- telemetry -----------------------------------------------------------------------------------

    def _origin(self) -> bytes:
        where = {"latitude": round(self.origin[0] * 1e7), "longitude": east_e7(self.origin[1])}
        return self._codec.pack("GPS_GLOBAL_ORIGIN", **where, altitude=round(self.origin[2] * 1e3))

    def _telemetry(self, truth: Truth) -> bytes:
        pack, boot_ms = self._codec.pack, (self._now_us - self._start_us) // 1000
        north, east = self.filter.position
        vn, ve = self.filter.velocity
        data = pack("HEARTBEAT", type=MAV_TYPE.SUBMARINE, autopilot=self.STACK)
        yaw, pitch = radians(truth.heading), radians(truth.pitch)
        data += pack("ATTITUDE", time_boot_ms=boot_ms, yaw=yaw, pitch=pitch) + self._status()
        gps = {"fix_type": NO_FIX}
        if truth.gps is not None:
            gps = {"fix_type": FIX_3D, "h_acc": round(truth.accuracy * 1e3)}
            gps |= {"lat": round(truth.gps[0] * 1e7), "lon": east_e7(truth.gps[1])}
        data += pack("GPS_RAW_INT", time_usec=self._now_us, **gps)
        latitude, longitude = self.place
        speed = {}
        if "GLOBAL_POSITION_INT" in self._streams:
            speed = {"vx": round(vn * 100.0), "vy": round(ve * 100.0)}
        where = {"lat": round(latitude * 1e7), "lon": east_e7(longitude), "alt": round(-1e3 * truth.depth)}
        data += pack("GLOBAL_POSITION_INT", time_boot_ms=boot_ms, **where, **speed)
        if "VFR_HUD" in self._streams:
            # GCS_Common.cpp, vfr_hud_airspeed: without a sensor, the speed over ground by GPS
            ground = hypot(vn, ve)
            data += pack("VFR_HUD", airspeed=truth.speed if self._airspeed else ground, groundspeed=ground)
        down = truth.depth + self.origin[2]
        if "LOCAL_POSITION_NED" in self._streams:
            local = {"x": north, "y": east, "z": down, "vx": vn, "vy": ve}
            data += pack("LOCAL_POSITION_NED", time_boot_ms=boot_ms, **local)
        if "ODOMETRY" in self._streams:
            data += pack(
                "ODOMETRY",
                time_usec=self._now_us,
                frame_id=MAV_FRAME.LOCAL_NED,
                child_frame_id=MAV_FRAME.BODY_FRD,
                x=north,
                y=east,
                z=down,
                q=(cos(0.5 * yaw), 0.0, 0.0, sin(0.5 * yaw)),
                vx=vn * cos(yaw) + ve * sin(yaw),
                vy=ve * cos(yaw) - vn * sin(yaw),
                reset_counter=self._resets & 0xFF,
            )
        return data


def finite(*values: float) -> bool:
    """Return whether all values are numbers."""
    return all(isfinite(value) for value in values)
