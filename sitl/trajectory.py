"""Compute the vehicle's track: it follows legs of constant commands with lag and wander."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from magbridge.arrays import FloatArray, IndexArray
from magbridge.config import NotNegative, Positive
from magbridge.errors import OutOfRange
from magbridge.field.geodesy import offset, separation
from magbridge.toml import Table
from sitl.mission import LIMITS, Leg, Limit
from sitl.signals import autoregressive, first_order

__all__ = ["Motion", "Track", "fly"]


class Motion(Table, frozen=True):
    """Table ``[motion]``: how the vehicle follows its commands."""

    speed: Positive = 0.35
    """Speed through the water, m/s."""
    angle_of_attack: float = 3.0
    """Angle by which the path is steeper than the pitch, deg."""
    settle: NotNegative = 15.0
    """Time constant of the first-order approach to a commanded attitude, s."""
    wander: tuple[float, float, float] = (0.3, 0.6, 5.0)
    """Standard deviations of roll, pitch and heading about the command, deg, as in a Slocum glider's log."""
    wander_memory: Positive = 20.0
    """Correlation time of the wander, s."""
    current: tuple[float, float] = (0.0, 0.0)
    """Velocity of the water, north and east, m/s."""
    max_depth: Positive = 200.0
    """Depth at which the vehicle stays until it climbs, m."""


STEADY = Motion()
"""Motion of a small glider."""


@dataclass(frozen=True)
class Track:
    """True track of the vehicle, on a uniform grid of n times."""

    start: float
    step: float
    """`start`, `step`: Time of the first point (s since 1970), and interval between points (s)."""
    latitude: FloatArray
    longitude: FloatArray
    depth: FloatArray
    """`latitude`, `longitude`, `depth`: True position (n,), deg, deg, m."""
    roll: FloatArray
    pitch: FloatArray
    heading: FloatArray
    """`roll`, `pitch`, `heading`: True attitude (n,), deg; the heading is unwrapped beyond 360."""
    parameters: dict[str, FloatArray]
    """Positions of the moving masses (n,), and other channels on which the vehicle's magnetism depends, by
    name."""
    run: FloatArray | None = None
    """Number of the leg at each point (n,), from 1."""
    segments: tuple[tuple[str, float, float], ...] = ()
    """Name, first time and last time of each segment, s after the start."""
    water: FloatArray | None = None
    """Measured water temperature (n,), degC; None if the world's model is to give it."""

    @property
    def elapsed(self) -> FloatArray:
        """Time since the start, s, (n,)."""
        return np.asarray(self.step * np.arange(len(self.depth)))

    def pose_at(self, time: FloatArray) -> dict[str, FloatArray]:
        """Return pose and parameters by name at `time` (m,), s after the start, interpolated linearly."""
        names = ("latitude", "longitude", "depth", "roll", "pitch", "heading")
        columns = {name: getattr(self, name) for name in names} | self.parameters
        elapsed = self.elapsed
        return {name: np.interp(time, elapsed, column) for name, column in columns.items()}

    def local(self, latitude: FloatArray, longitude: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Convert positions (m,), deg, to metres north and east of the track's first point."""
        return separation(float(self.latitude[0]), float(self.longitude[0]), latitude, longitude)


def fly(
    legs: Sequence[Leg],
    start: tuple[float, float, float],
    step: float,
    rng: np.random.Generator,
    motion: Motion = STEADY,
    limits: Mapping[str, Limit] = LIMITS,
) -> Track:
    """Return the track of consecutive `legs`, from a `start` (s since 1970, latitude and longitude in deg).

    The track has a point every `step` s; `rng` generates the wander. `limits` has every moving mass; a mass
    that no leg moves stays in the middle of its travel.

    Raises
    ------
    OutOfRange
        A leg commands a mass beyond its limits, or a mass without limits.
    """
    ends = np.cumsum([leg.duration for leg in legs])
    t = np.arange(0.0, ends[-1], step)
    leg_of = np.searchsorted(ends, t, side="right")
    memory = motion.wander_memory / step
    # a vehicle has inertia, so smooth the wander. A lag of time constant T reduces the variance of noise with
    # correlation time tau by 1 / (1 + T / tau), 3/4 for T = tau / 3; the factor 4 / 3 restores the variance
    wander = first_order(autoregressive(rng, (len(t), 3), 1.0, memory), step, motion.wander_memory / 3)
    wander *= np.sqrt(4 / 3) * np.asarray(motion.wander)

    def settled(command: FloatArray) -> FloatArray:
        return first_order(command, step, motion.settle)

    roll = settled(np.array([leg.roll for leg in legs])[leg_of]) + wander[:, 0]
    pitch = settled(np.array([leg.pitch for leg in legs])[leg_of]) + wander[:, 1]
    heading = settled(_headings(legs, ends, t, leg_of)) + wander[:, 2]

    # the angle of attack changes its sign between dive and climb
    path = np.radians(pitch + motion.angle_of_attack * np.tanh(pitch / 5))
    sink = -motion.speed * np.sin(path) * step
    ahead = motion.speed * np.cos(path)
    north = np.cumsum(ahead * np.cos(np.radians(heading)) + motion.current[0]) * step
    east = np.cumsum(ahead * np.sin(np.radians(heading)) + motion.current[1]) * step
    latitude, longitude = offset(*start[1:], north, east)
    names = dict.fromkeys((*limits, *(name for leg in legs for name in leg.parameters)))
    return Track(
        start=start[0],
        step=step,
        latitude=latitude,
        longitude=longitude,
        depth=_depth(sink, motion.max_depth),
        roll=roll,
        pitch=pitch,
        heading=heading,
        parameters={name: _mass_motion(name, legs, ends, t, leg_of, limits) for name in names},
        run=1 + leg_of.astype(np.float64),
        segments=_segments(legs, ends),
    )


def _depth(sink: FloatArray, deepest: float) -> FloatArray:
    """Return the depth (n,), m, from the `sink` (m) of each step, between the surface and `deepest`."""
    return np.array(
        [*accumulate(sink.tolist(), lambda depth, by: min(max(depth + by, 0.0), deepest), initial=0.0)][1:]
    )


def _headings(legs: Sequence[Leg], ends: FloatArray, t: FloatArray, leg_of: IndexArray) -> FloatArray:
    """Return the commanded heading (n,), deg, unwrapped; between legs it turns the shorter way."""
    first, last = [], legs[0].heading or 0.0
    for leg in legs:
        start = last if leg.heading is None else last + (leg.heading - last + 180) % 360 - 180
        first.append(start)
        last = start + leg.turn * leg.duration
    begins = ends - [leg.duration for leg in legs]
    turn = np.array([leg.turn for leg in legs])
    return np.asarray(np.array(first)[leg_of] + turn[leg_of] * (t - begins[leg_of]))


def _mass_motion(
    name: str,
    legs: Sequence[Leg],
    ends: FloatArray,
    t: FloatArray,
    leg_of: IndexArray,
    limits: Mapping[str, Limit],
) -> FloatArray:
    """Return a mass's position (n,); from each leg's start it moves at full speed to its target."""
    if name not in limits:
        raise OutOfRange("moving mass", name, f"the vehicle has {', '.join(limits)}")
    limit = limits[name]
    wanted = [leg.parameters[name] for leg in legs if name in leg.parameters]
    for value in wanted:
        if not limit.low <= value <= limit.high:
            raise OutOfRange(
                name, value, f"the vehicle allows {limit.low:g} to {limit.high:g} {limit.unit}".rstrip()
            )
    position = wanted[0] if wanted else (limit.low + limit.high) / 2
    begin: list[float] = []
    origin: list[float] = []
    target: list[float] = []
    for leg, end in zip(legs, ends, strict=True):
        begin.append(end - leg.duration)
        origin.append(position)
        target.append(leg.parameters.get(name, position))
        reach = limit.rate * leg.duration
        position += min(max(target[-1] - position, -reach), reach)
    way = np.array(target) - np.array(origin)
    gone = limit.rate * (t - np.array(begin)[leg_of])
    return np.asarray(np.array(origin)[leg_of] + np.clip(way[leg_of], -gone, gone))


def _segments(legs: Sequence[Leg], ends: FloatArray) -> tuple[tuple[str, float, float], ...]:
    segments: list[tuple[str, float, float]] = []
    for leg, end in zip(legs, ends, strict=True):
        if segments and segments[-1][0] == leg.segment:
            segments[-1] = (leg.segment, segments[-1][1], float(end))
        else:
            segments.append((leg.segment, float(end - leg.duration), float(end)))
    return tuple(segments)
