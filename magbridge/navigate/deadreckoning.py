"""Dead reckoning of a vehicle's position from heading, speed and depth, or from velocity or position."""

from __future__ import annotations

from math import cos, hypot, isfinite, log, nan, radians, sin, tan
from typing import NamedTuple

from magbridge.field.geodesy import offset, separation

__all__ = ["GLIDE", "DeadReckoning", "MotionNoise", "Step"]

GLIDE = 8.0
"""Smallest pitch of a gliding vehicle, deg; below it the glider turns between dive and climb."""
DEPTH_BASE = 10.0
"""Time over which the rate of depth is computed, s."""
MAX_WATER_SPEED_M_S = 3.0
"""Largest speed through the water, m/s; a higher one comes from a jump in the depth."""
MAX_TELEMETRY_GAP_S = 3600.0
"""Longest time without telemetry for which the last velocity holds, s."""
MAX_REPORT_INTERVAL_S = 60.0
"""Longest time between two reports of the velocity over which their change is averaged, s."""
MIN_GAP_S, BURST_TIME_S = 1.0, 0.5
"""Shortest time without a report that counts as a gap, s; and the time after it in which reports that have
waited arrive, s."""
MIN_TURN_FRACTION = 0.25
"""Smallest change of velocity that counts as a turn, as a fraction of the speed; noise is smaller."""
SURFACE_LAYER_M, MIN_LAYERS = 10.0, 0.1
"""Height above the ground, m, below which the logarithmic profile of the wind is not resolved; the smallest
change of height that counts, as a change of its logarithm: noise is smaller."""


class MotionNoise(NamedTuple):
    """Uncertainty of the dead-reckoned motion since the start, which only grows.

    The difference of two values is the uncertainty of the motion between their times.
    """

    nn: float = 0.0
    ne: float = 0.0
    ee: float = 0.0
    """`nn`, `ne`, `ee`: covariance (m², north and east) of the motion between two reports of the velocity."""
    turns: float = 0.0
    """Sum of the squared changes of velocity in turns, (m/s)²."""
    layers: float = 0.0
    """Sum of the changes of an aircraft's height, as changes of its logarithm."""

    def growth_since(self, earlier: MotionNoise) -> MotionNoise:
        """Return the uncertainty of the motion since an earlier moment."""
        return MotionNoise(*(a - b for a, b in zip(self, earlier, strict=True)))


class Step(NamedTuple):
    """Motion between two measurements; steps add up."""

    seconds: float = 0.0
    metres: float = 0.0
    """`seconds`, `metres`: time (s), and distance through the water (m)."""
    noise: MotionNoise = MotionNoise()

    def joined(self, later: Step) -> Step:
        """Return this step and a later one as one step."""
        noise = MotionNoise(*(a + b for a, b in zip(self.noise, later.noise, strict=True)))
        return Step(self.seconds + later.seconds, self.metres + later.metres, noise)


class DeadReckoning:
    """Dead-reckoned position from any kind of telemetry that the vehicle has.

    `latitude` and `longitude` (deg) are NaN before :meth:`place`. `depth` is in m. `time` (s) is the time of
    the position, NaN before the first telemetry. `travelled` is the distance through the water since the
    start, m, and `noise` the uncertainty of the motion since the start.
    """

    def __init__(self) -> None:
        self.latitude = self.longitude = nan
        self.depth, self.travelled = 0.0, 0.0
        self.noise = MotionNoise()
        self.time = self._reported = nan
        self._velocity = self._steady = (0.0, 0.0)
        self._ground = self._height = nan  # lowest height, and that of the last counted change, m
        self._gap = nan, 0.0, 0.0  # end of the last gap and its length, s; velocity changed since then, m/s
        self._heading = self._pitch = self._speed = nan
        self._dive = (nan, nan)  # time and depth since when the rate of depth is taken
        self._rate = nan
        self._local: tuple[float, float] | None = None
        self._carrier: tuple[float, float] | None = None

    def place(self, latitude: float, longitude: float) -> None:
        """Set the position, deg, from which dead reckoning continues."""
        self.latitude, self.longitude = latitude, longitude

    def forget(self) -> None:
        """Discard the telemetry except the velocity, because another source of motion follows."""
        self._heading = self._pitch = self._speed = self._reported = nan
        self._local = self._carrier = None

    @property
    def speed(self) -> float:
        """Last known speed, m/s."""
        return hypot(*self._velocity)

    def advance(self, time: float) -> None:
        """Advance the position along the last known velocity to `time` (s)."""
        elapsed = time - self.time
        # Event time never goes back.
        if elapsed <= 0.0:
            return
        if isfinite(elapsed) and elapsed < MAX_TELEMETRY_GAP_S:
            self._move(self._velocity[0] * elapsed, self._velocity[1] * elapsed)
        self.time = time

    def extrapolate(self, time: float) -> tuple[float, float]:
        """Return latitude and longitude (deg) at `time` (s) by the last velocity, without moving there."""
        elapsed = time - self.time
        if not 0.0 < elapsed < MAX_TELEMETRY_GAP_S:
            return self.latitude, self.longitude
        return offset(self.latitude, self.longitude, self._velocity[0] * elapsed, self._velocity[1] * elapsed)

    def telemetry(self, time: float, values: dict[str, float]) -> None:
        """Update position and velocity with the telemetry of `time`, s on any clock.

        `values` holds any of ``depth`` m; ``heading`` deg true, ``pitch`` deg, ``speed`` m/s through the
        water or air; ``height`` m, of an aircraft; ``velocity_north velocity_east`` m/s; ``north east`` m, a
        local position; ``dr_latitude dr_longitude`` deg, a dead-reckoned position. Only the changes of height
        and position count. NaN counts as missing. Without ``speed``, the speed is a
        glider's, from pitch and rate of depth.
        """
        self.advance(time)
        values = {name: value for name, value in values.items() if isfinite(value)}
        if "depth" in values:
            self.depth = values["depth"]
            self._sink(time)
        if "height" in values:
            self._climb(values["height"])
        self._heading = values.get("heading", self._heading)
        self._pitch = values.get("pitch", self._pitch)
        self._speed = values.get("speed", self._speed)
        # Sources of motion, the best first: local position, dead-reckoned position, velocity, speed.
        if "north" in values and "east" in values:
            here = values["north"], values["east"]
            if self._local is not None:
                self._move(here[0] - self._local[0], here[1] - self._local[1])
            self._local, self._velocity = here, (0.0, 0.0)
        elif "dr_latitude" in values and "dr_longitude" in values:
            there = values["dr_latitude"], values["dr_longitude"]
            if self._carrier is not None:
                self._move(*separation(*self._carrier, *there))
            self._carrier, self._velocity = there, (0.0, 0.0)
        elif "velocity_north" in values and "velocity_east" in values:
            self._change_velocity(time, (values["velocity_north"], values["velocity_east"]), reported=True)
        elif self._local is None and self._carrier is None and isfinite(self._heading):
            speed = self._speed if isfinite(self._speed) else self._glide()
            if isfinite(speed):
                along = radians(self._heading)
                velocity = speed * cos(along), speed * sin(along)
                self._change_velocity(time, velocity, reported="heading" in values)

    def _change_velocity(self, time: float, velocity: tuple[float, float], *, reported: bool) -> None:
        """Set a new velocity, m/s north and east; `reported` is True if its direction was reported.

        Notes
        -----
        The velocity v₀ of the previous report, Δt ago, became v₁ at an unknown moment, uniformly distributed
        over Δt. The motion in Δt then has the mean (v₀ + v₁) Δt/2 and the covariance
        (v₁ - v₀)(v₁ - v₀)ᵀ Δt²/12. After a gap, several reports that have waited arrive at once; the changes
        of all of them then took place during the gap. An error of heading or speed turns with the vehicle, so
        that a turn changes the error of the velocity in proportion to v₁ - v₀.
        """
        # Change of the velocity since the previous report.
        north, east = velocity[0] - self._velocity[0], velocity[1] - self._velocity[1]
        elapsed = min(time - self._reported, MAX_REPORT_INTERVAL_S)
        nn, ne, ee, turns, layers = self.noise
        if reported and elapsed > 0.0:
            # the motion so far was v₀ Δt: add half of the change
            self._shift(0.5 * north * elapsed, 0.5 * east * elapsed)
            scale = elapsed * elapsed / 12.0
            nn, ne, ee = nn + north * north * scale, ne + north * east * scale, ee + east * east * scale
            waited = self._gap_noise(time, elapsed, hypot(north, east))
            nn, ee = nn + waited, ee + waited
        change = hypot(velocity[0] - self._steady[0], velocity[1] - self._steady[1])
        if change > MIN_TURN_FRACTION * hypot(*self._steady):
            turns += change * change if self._steady != (0.0, 0.0) else 0.0
            self._steady = velocity
        self.noise = MotionNoise(nn, ne, ee, turns, layers)
        self._velocity = velocity
        if reported:
            self._reported = time

    def _gap_noise(self, time: float, elapsed: float, change: float) -> float:
        """Return the variance (m²) of the motion in a gap that the reports after it add, on each axis.

        `elapsed` (s) is the time since the previous report, and `change` (m/s) that of the velocity.
        """
        end, length, before = self._gap
        if elapsed > MIN_GAP_S:
            self._gap = time, elapsed, change
            return 0.0  # this report's change is included already
        if not time - end < BURST_TIME_S:
            return 0.0
        self._gap = end, length, before + change
        return ((before + change) ** 2 - before**2) * length * length / 12.0

    def _climb(self, height: float) -> None:
        """Count the layers of air between the last height and this one, m.

        Notes
        -----
        The wind's mean profile is logarithmic in the height above the ground z (Stull 1988, section 9.7), so
        that the wind changes by the same amount from 10 to 20 m as from 100 to 200 m. The lowest height so
        far stands for the ground.
        """
        self._ground = min(height, self._ground) if isfinite(self._ground) else height
        if not isfinite(self._height):
            self._height = height
        before, now = (z - self._ground + SURFACE_LAYER_M for z in (self._height, height))
        layers = abs(log(now / before))
        if layers > MIN_LAYERS:
            self._height = height
            self.noise = self.noise._replace(layers=self.noise.layers + layers)

    def _sink(self, time: float) -> None:
        since, depth = self._dive
        if not isfinite(since):
            self._dive = time, self.depth
        elif time - since >= DEPTH_BASE:
            self._rate = (self.depth - depth) / (time - since)
            self._dive = time, self.depth

    def _glide(self) -> float:
        """Return a glider's horizontal speed from sink rate and pitch; NaN between dive and climb."""
        if not isfinite(self._pitch) or abs(self._pitch) < GLIDE:
            return nan
        speed = abs(self._rate / tan(radians(self._pitch)))
        return min(speed, MAX_WATER_SPEED_M_S)

    def _move(self, north: float, east: float) -> None:
        self.travelled += hypot(north, east)
        self._shift(north, east)

    def _shift(self, north: float, east: float) -> None:
        if isfinite(self.latitude):
            self.latitude, self.longitude = offset(self.latitude, self.longitude, north, east)
