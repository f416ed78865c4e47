"""What goes wrong around the vehicle and is in no table: ships, seas, storms and cables."""

from __future__ import annotations

import numpy as np

from sitl.inject.scene import Array, Generator, Scene, direction
from sitl.signals import autoregressive, first_order
from sitl.world import dipole_field


def ship(scene: Scene, size: float, rng: Generator) -> None:
    """A ship passes: a distant dipole on a straight course; size in nT at its nearest."""
    t0 = rng.uniform(0.3, 0.7) * scene.t[-1]
    r = np.column_stack([4.0 * (scene.t - t0), np.full_like(scene.t, 900.0), np.full_like(scene.t, -50.0)])
    own = dipole_field(r, np.broadcast_to(direction(rng), r.shape))
    scene.earth = scene.earth + size * own / np.linalg.norm(own, axis=1).max()


def pulsation(scene: Scene, size: float, rng: Generator) -> None:
    """Field lines ring after a gust of solar wind: packets of Pc5 (Jacobs et al. 1964); size in nT.

    Their periods are 150 to 600 s.
    """
    total = np.zeros_like(scene.t)
    for _ in range(4):
        t0, length = rng.uniform(0.0, 1.0) * scene.t[-1], rng.uniform(600.0, 2400.0)
        since = scene.t - t0
        phase = 2 * np.pi * since / rng.uniform(150.0, 600.0) * (1.0 + 0.1 * since / length)
        total += rng.uniform(0.5, 1.0) * np.exp(-0.5 * (since / length) ** 2) * np.cos(phase)
    scene.earth = scene.earth + size * np.outer(total, [0.7, 0.5, 0.3])


def swell(scene: Scene, size: float, rng: Generator) -> None:
    """Sea water moved by a swell through the Earth's field (Weaver 1965); size in nT at the surface."""
    track, omega = scene.track, 2 * np.pi / rng.uniform(11.0, 17.0)
    wave = omega**2 / 9.81
    course = rng.uniform(0.0, 2 * np.pi)
    north, east = track.local(track.latitude, track.longitude)
    groups = autoregressive(rng, (len(scene.t), 2), 1.0, rng.uniform(100.0, 300.0) / track.step)
    phase = omega * scene.t - wave * (north * np.cos(course) + east * np.sin(course))
    moved = groups[:, 0] * np.cos(phase) + groups[:, 1] * np.sin(phase)
    scene.earth = scene.earth + size * np.outer(np.exp(-wave * track.depth) * moved, [0.6, 0.2, 0.77])


def storm(scene: Scene, size: float, rng: Generator) -> None:
    """A magnetic storm: the wind's shock, then a ring current (Burton et al. 1975); size in nT."""
    t0 = rng.uniform(0.1, 0.4) * scene.t[-1]
    since = scene.t - t0
    after = since > rng.uniform(900.0, 3600.0)
    # a new wind every few minutes
    south = np.repeat(rng.normal(0.6, 0.8, 60), len(since) // 60 + 1)[: len(since)]
    decay = 7.7 * 3600.0
    ring = decay * first_order(np.where(after, np.maximum(south, 0.0), 0.0), scene.track.step, decay)
    shock = np.where(since > 0.0, 1.0 - np.exp(-np.maximum(since, 0.0) / 120.0), 0.0)
    total = ring / max(float(ring.max()), 1e-9) - rng.uniform(0.15, 0.35) * shock
    scene.earth = scene.earth + size * np.outer(total, [-0.5, 0.05, 0.45])


def mains(scene: Scene, size: float, rng: Generator) -> None:
    """A three-phase cable on the bottom, its 50 Hz aliased by the sampling; size in nT at 100 m."""
    aside, above, across = _cable(scene, rng)
    drift = np.cumsum(autoregressive(rng, (len(scene.t),), 0.02, 300.0 / scene.track.step)) * scene.track.step
    phase = 2 * np.pi * (50.0 * scene.t + drift)
    bearing = np.arctan2(aside, above)
    turning = np.outer(np.cos(phase + 2 * bearing), across) + np.outer(
        np.sin(phase + 2 * bearing), [0.0, 0.0, 1.0]
    )
    scene.earth = scene.earth + size * 1e4 / (aside**2 + above**2)[:, None] * turning


def astray(scene: Scene, size: float, rng: Generator) -> None:
    """The current under water is unknown, so the map is read off track; size in nT after half an hour."""
    top = scene.track.depth < scene.track.depth.min() + 0.1 * np.ptp(scene.track.depth)
    fixed = scene.t[np.maximum.accumulate(np.where(top, np.arange(len(top)), 0))]
    current = autoregressive(rng, (len(top),), 1.0, 7200.0 / scene.track.step) + rng.choice([-1.0, 1.0])
    off = current * (scene.t - fixed) / 1800.0
    scene.reference = scene.reference + size * np.interp(scene.when, scene.t, off)


def dynamo(scene: Scene, size: float, rng: Generator) -> None:
    """A tidal stream carries the Earth's field along, the more water lies above (Longuet-Higgins 1949).

    Size in nT at the greatest depth.
    """
    stream = np.cos(2 * np.pi * scene.t / 44714.0 + rng.uniform(0.0, 2 * np.pi))
    course = rng.uniform(0.0, 2 * np.pi)
    above = scene.track.depth / scene.track.depth.max()
    scene.earth = scene.earth + size * np.outer(stream * above, [np.cos(course), np.sin(course), 0.0])


def hvdc(scene: Scene, size: float, rng: Generator) -> None:
    """A direct-current cable on the bottom; its load changes by the half-hour. Size in nT at 100 m."""
    aside, above, across = _cable(scene, rng)
    traded = rng.uniform(-0.3, 1.0, int(scene.t[-1] // 1800.0) + 1)
    load = first_order(traded[(scene.t // 1800.0).astype(int)], scene.track.step, 60.0)
    scene.earth = scene.earth + size * load[:, None] * _around(aside, above, across)


def substorm(scene: Scene, size: float, rng: Generator) -> None:
    """Substorms bend the field for an hour or two: each sets in fast and recovers slowly; size in nT."""
    total = np.zeros_like(scene.t)
    for _ in range(int(rng.integers(2, 6))):
        since = (scene.t - rng.uniform(-0.05, 1.0) * scene.t[-1]) / rng.uniform(900.0, 2700.0)
        total -= rng.uniform(0.4, 1.0) * np.maximum(since, 0.0) * np.exp(1.0 - np.maximum(since, 0.0))
    scene.earth = scene.earth + size * np.outer(total, [0.8, 0.2, 0.5])


def litter(scene: Scene, size: float, rng: Generator) -> None:
    """Iron litter on the sea bed, another piece below each dive; size in nT at the greatest depth."""
    depth = scene.track.depth
    down = depth > 0.5 * depth.max()
    dive = np.cumsum(np.diff(down, prepend=False) & down)
    nearest = rng.uniform(10.0, 30.0)
    nearer = (nearest / (depth.max() + nearest - depth)) ** 3
    pieces = rng.normal(size=(dive[-1] + 1, 3))
    scene.earth = scene.earth + size * nearer[:, None] * pieces[dive]


def flare(scene: Scene, size: float, rng: Generator) -> None:
    """A flare on the Sun drives more current in the ionosphere for half an hour (a crochet); size in nT."""
    since = np.maximum(scene.t - rng.uniform(0.1, 0.9) * scene.t[-1], 0.0)
    rises, falls = rng.uniform(60.0, 300.0), rng.uniform(600.0, 2400.0)
    shape = np.exp(-since / falls) - np.exp(-since / rises)
    scene.earth = scene.earth + size * np.outer(shape / shape.max(), [0.8, 0.3, 0.4])


def railway(scene: Scene, size: float, rng: Generator) -> None:
    """A railway's direct current returns through the ground, and trains start, roll and brake; size in nT."""
    n, step = len(scene.t), scene.track.step
    starts = np.cumsum(rng.exponential(rng.uniform(600.0, 1500.0), 200))
    drawn = np.zeros(n)
    for start, rolls, way in zip(starts, rng.uniform(60.0, 300.0, 200), rng.normal(size=200), strict=True):
        since = scene.t - start
        drawn += way * ((since > 0.0) & (since < rolls)) * np.exp(-np.maximum(since, 0.0) / 90.0)
        drawn -= 0.4 * way * ((since > rolls + 40.0) & (since < rolls + 65.0))
    spread = first_order(drawn, step, float(rng.uniform(3.0, 15.0)))
    scene.earth = scene.earth + size * np.outer(spread, direction(rng))


def seiche(scene: Scene, size: float, rng: Generator) -> None:
    """After a wind the basin's water sloshes to and fro, and induces currents as it does; size in nT."""
    since = scene.t - rng.uniform(0.0, 0.4) * scene.t[-1]
    period, calms = rng.uniform(1200.0, 3600.0), rng.uniform(0.3, 1.0) * scene.t[-1]
    sloshes = (since > 0.0) * np.exp(-np.maximum(since, 0.0) / calms) * np.sin(2.0 * np.pi * since / period)
    deeper = 1.0 - 0.3 * scene.track.depth / scene.track.depth.max()
    scene.earth = scene.earth + size * np.outer(sloshes * deeper, direction(rng))


def pipeline(scene: Scene, size: float, rng: Generator) -> None:
    """A pipeline's protection current is interrupted for a survey of its own; size in nT at 100 m."""
    aside, above, across = _cable(scene, rng)
    flows = (scene.t + rng.uniform(0.0, 15.0)) % 15.0 < 12.0
    scene.earth = scene.earth + size * flows[:, None] * _around(aside, above, across)


def soliton(scene: Scene, size: float, rng: Generator) -> None:
    """Trains of internal waves run along the thermocline and carry the Earth's field; size in nT.

    In a train the first wave is the highest (Apel 2003); each moves the water above the thermocline one way
    and that below the other.
    """
    depth = scene.track.depth
    middle, thick = rng.uniform(0.2, 0.5) * depth.max(), rng.uniform(5.0, 20.0)
    moved = np.zeros_like(scene.t)
    for _ in range(int(rng.integers(2, 5))):
        t0, apart, width = (
            rng.uniform(0.0, 1.0) * scene.t[-1],
            rng.uniform(400.0, 1200.0),
            rng.uniform(60.0, 200.0),
        )
        for n in range(int(rng.integers(3, 7))):
            moved += 0.75**n / np.cosh(np.clip((scene.t - t0 - n * apart) / width, -30.0, 30.0)) ** 2
    shear = np.tanh((middle - depth) / thick)
    scene.earth = scene.earth + size * np.outer(moved * shear, direction(rng))


def escort(scene: Scene, size: float, rng: Generator) -> None:
    """A boat of steel stands by where the vehicle surfaces, never in the same place; size in nT."""
    depth = scene.track.depth
    down = depth > 0.5 * depth.max()
    dive = np.cumsum(np.diff(down, prepend=False) & down)
    north, east = 15.0 * rng.normal(size=(2, dive[-1] + 1))[:, dive]
    away = np.column_stack([north, east, depth + rng.uniform(5.0, 15.0)])
    own = dipole_field(away, np.broadcast_to(direction(rng), away.shape))
    scene.earth = scene.earth + size * own / np.linalg.norm(own, axis=1).max()


def ferry(scene: Scene, size: float, rng: Generator) -> None:
    """A ferry lies at a berth near the track between its crossings; size in nT where it is strongest."""
    track, at = scene.track, rng.uniform(0.1, 0.9)
    k = int(at * (len(scene.t) - 1))
    north, east = track.local(track.latitude, track.longitude)
    aside, bearing = rng.uniform(150.0, 400.0), rng.uniform(0.0, 2.0 * np.pi)
    berth = np.array([north[k] + aside * np.cos(bearing), east[k] + aside * np.sin(bearing)])
    away = np.column_stack([north - berth[0], east - berth[1], track.depth + 3.0])
    # the same crossing all day, but for delays in port
    hour = rng.uniform(0.06, 0.15) * scene.t[-1]
    late = 0.15 * hour * rng.normal(size=int(scene.t[-1] / hour) + 2)
    turn = (scene.t / hour).astype(int)
    since = scene.t - hour * turn - np.abs(late[turn])
    lies = (since > 0.0) & (since < rng.uniform(0.3, 0.7) * hour)
    come = first_order(lies.astype(float), track.step, 30.0)
    own = dipole_field(away, np.broadcast_to(direction(rng), away.shape)) * come[:, None]
    scene.earth = scene.earth + size * own / max(float(np.linalg.norm(own, axis=1).max()), 1e-30)


def consort(scene: Scene, size: float, rng: Generator) -> None:
    """Another vehicle of the fleet dives beside the track, out of step with this one; size in nT at most."""
    track = scene.track
    depth, aside = track.depth, rng.uniform(15.0, 50.0)
    period = rng.uniform(0.7, 1.4) * scene.t[-1] / max(_dives(depth), 1)
    other = depth.max() * np.abs(2.0 * ((scene.t / period + rng.uniform()) % 1.0) - 1.0)
    drifts = aside * autoregressive(rng, (len(scene.t), 2), 0.7, 3600.0 / track.step)
    away = np.column_stack([drifts[:, 0] + aside, drifts[:, 1], depth - other])
    own = dipole_field(away, np.broadcast_to(direction(rng), away.shape))
    scene.earth = scene.earth + size * own / np.linalg.norm(own, axis=1).max()


def mooring(scene: Scene, size: float, rng: Generator) -> None:
    """A steel buoy swings about its anchor, while the vehicle works near it; size in nT at most.

    It is found at another place each time that the vehicle comes by.
    """
    track = scene.track
    north, east = track.local(track.latitude, track.longitude)
    k, circle = rng.integers(len(north)), rng.uniform(40.0, 150.0)
    turned = (
        rng.uniform(0.0, 2.0 * np.pi)
        + np.cumsum(autoregressive(rng, (len(scene.t),), 4e-4, 3600.0 / track.step)) * track.step
    )
    away = np.column_stack(
        [
            north - north[k] - circle * np.cos(turned),
            east - east[k] - circle * np.sin(turned),
            track.depth + rng.uniform(5.0, 15.0),
        ]
    )
    own = dipole_field(away, np.broadcast_to(direction(rng), away.shape))
    scene.earth = scene.earth + size * own / np.linalg.norm(own, axis=1).max()


def _dives(depth: Array) -> int:
    down = depth > 0.5 * depth.max()
    return int(np.sum(np.diff(down, prepend=False) & down))


def _cable(scene: Scene, rng: Generator) -> tuple[Array, Array, Array]:
    """Lay a straight cable below the track: m aside and above (n,), and north-east-down across it."""
    track = scene.track
    north, east = track.local(track.latitude, track.longitude)
    k, course = rng.integers(len(north)), rng.uniform(0.0, np.pi)
    aside = (east - east[k]) * np.cos(course) - (north - north[k]) * np.sin(course)
    above = track.depth.max() + rng.uniform(20.0, 60.0) - track.depth
    return aside, above, np.array([-np.sin(course), np.cos(course), 0.0])


def _around(aside: Array, above: Array, across: Array) -> Array:
    """Field (n, 3) of a cable's current, 1 at 100 m."""
    rings = np.outer(above, across) - np.outer(aside, [0.0, 0.0, 1.0])
    return np.asarray(100.0 / (aside**2 + above**2)[:, None] * rings)
