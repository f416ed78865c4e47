"""What payloads do that no log tells: they switch, turn, heat, pump, ping and talk by rules of their own."""

from __future__ import annotations

import numpy as np

from sitl.inject.scene import Generator, Scene, direction
from sitl.instrument import rotation
from sitl.signals import autoregressive, first_order
from sitl.world import dipole_field


def relay(scene: Scene, size: float, rng: Generator) -> None:
    """An unlogged payload switches on and off, a dozen times or so; size in nT."""
    flips = np.cumsum(rng.exponential(0.08 * scene.t[-1], 60))
    on = (np.searchsorted(flips, scene.t) % 2).astype(float)
    scene.add(on, size * direction(rng))


def pan(scene: Scene, size: float, rng: Generator) -> None:
    """An unlogged scanning head: its magnet sweeps a sector, no two sweeps of one length; size in nT."""
    turns = np.cumsum(rng.uniform(0.02, 0.06, 80)) * scene.t[-1]
    angle = np.radians(150.0) * np.interp(scene.t, turns, (-1.0) ** np.arange(80))
    a, b = direction(rng), direction(rng)
    scene.field = scene.field + size * (np.outer(np.cos(angle), a) + np.outer(np.sin(angle), b))


def needle(scene: Scene, size: float, rng: Generator) -> None:
    """A payload's compass: a card that points north, floats level, and is dragged in turns; size in nT."""
    track = scene.track
    turned = np.radians(track.heading)
    dragged = rng.uniform(0.1, 0.4) * (
        turned - first_order(turned, track.step, float(rng.uniform(10.0, 40.0)))
    )
    level = np.column_stack([np.cos(dragged), np.sin(dragged), np.zeros_like(dragged)])
    card = rotation(track.roll, track.pitch, track.heading).apply(level, inverse=True)
    own = dipole_field(np.broadcast_to(direction(rng), card.shape), card)
    scene.field = scene.field + size * own / np.linalg.norm(own, axis=1).max()


def thermostat(scene: Scene, size: float, rng: Generator) -> None:
    """An unlogged payload heats itself, the longer the colder the water, then cools; size in nT."""
    lag, band = rng.uniform(400.0, 1200.0), rng.uniform(1.0, 3.0)
    warm, heats, on = 15.0, False, np.empty(len(scene.t))
    for k, water in enumerate(scene.water):
        heats = warm < 15.0 + (0.5 if heats else -0.5) * band
        warm += scene.track.step / lag * (water - warm + 30.0 * heats)
        on[k] = heats
    scene.add(on, size * direction(rng))


def strobe(scene: Scene, size: float, rng: Generator) -> None:
    """An unlogged payload is on for a part of each cycle; its clock slows with its cells; size in nT."""
    along = scene.t / scene.t[-1]
    slower = rng.uniform(0.15, 0.4) * along**2 + 0.01 * autoregressive(
        rng, (len(along),), 1.0, 900.0 / scene.track.step
    )
    turns = np.cumsum(1.0 - slower) * scene.track.step / rng.uniform(60.0, 240.0)
    on = (turns % 1.0 < rng.uniform(0.1, 0.4)).astype(float)
    drawn = first_order(on, scene.track.step, 2.0) * (1.0 - 0.15 * along)
    scene.add(drawn, size * direction(rng))


def towed(scene: Scene, size: float, rng: Generator) -> None:
    """A magnet on a line astern swings out in turns, and back when they end; size in nT at 1 deg/s."""
    rate = np.gradient(scene.track.heading, scene.track.step)
    swung = first_order(
        first_order(rate, scene.track.step, 8.0), scene.track.step, float(rng.uniform(5.0, 30.0))
    )
    aside, astern = direction(rng), direction(rng)
    scene.field = scene.field + size * (swung[:, None] * aside - 0.5 * (swung**2)[:, None] * astern)


def sampler(scene: Scene, size: float, rng: Generator) -> None:
    """A water sampler's unlogged pump runs on every climb, and draws more as its filter clogs; size in nT."""
    sinking = np.gradient(first_order(scene.track.depth, scene.track.step, 20.0), scene.track.step)
    runs = (sinking < -rng.uniform(0.02, 0.1)).astype(float)
    hours = np.cumsum(runs) * scene.track.step / 3600.0
    draws = runs * (1.0 + rng.uniform(0.05, 0.2) * hours)
    scene.add(first_order(draws, scene.track.step, 5.0), size * direction(rng))


def sounder(scene: Scene, size: float, rng: Generator) -> None:
    """An unlogged echo sounder hears the bottom below a depth and pings faster the nearer; size in nT."""
    depth = scene.track.depth
    heard = (depth > rng.uniform(0.3, 0.7) * depth.max()).astype(float)
    near = rng.uniform(5.0, 20.0)
    pings = heard * np.minimum(2.0 * near / (depth.max() + near - depth), 1.0)
    scene.add(first_order(pings, scene.track.step, 5.0), size * direction(rng))


def modem(scene: Scene, size: float, rng: Generator) -> None:
    """An unlogged acoustic modem talks to a mooring, while that is within range; size in nT."""
    track = scene.track
    north, east = track.local(track.latitude, track.longitude)
    k = rng.integers(len(north))
    away = np.hypot(north - north[k], east - east[k])
    heard = away < np.quantile(away, rng.uniform(0.3, 0.6))
    talks = (scene.t / rng.uniform(60.0, 240.0)) % 1.0 < rng.uniform(0.2, 0.6)
    scene.add((heard & talks).astype(float), size * direction(rng))


def wiper(scene: Scene, size: float, rng: Generator) -> None:
    """An optical window's wiper, with a magnet, is parked at either stop or stalls between; size in nT.

    It wipes by the clock, and rarely it sticks where algae have grown.
    """
    every = rng.uniform(0.02, 0.06) * scene.t[-1]
    sweep = (scene.t / every).astype(int)
    stalls = rng.random(sweep[-1] + 1) < rng.uniform(0.1, 0.4)
    stops = np.where(stalls, rng.uniform(0.2, 0.8, len(stalls)), np.arange(len(stalls)) % 2)
    angle = np.radians(120.0) * first_order(stops[sweep], scene.track.step, 3.0)
    a, b = direction(rng), direction(rng)
    scene.field = scene.field + size * (np.outer(np.cos(angle), a) + np.outer(np.sin(angle), b))


def gimbal(scene: Scene, size: float, rng: Generator) -> None:
    """A camera's gimbal keeps level between its stops, its motors' magnets with it; size in nT."""
    track, lag = scene.track, float(rng.uniform(0.5, 3.0))
    stop = rng.uniform(8.0, 25.0)
    roll, pitch = (first_order(np.clip(-a, -stop, stop), track.step, lag) for a in (track.roll, track.pitch))
    held = rotation(roll, pitch, np.zeros_like(roll))
    magnet, place = direction(rng), direction(rng)
    turned = held.apply(magnet)
    own = dipole_field(np.broadcast_to(place, turned.shape), turned - magnet)
    scene.field = scene.field + size * own / max(float(np.linalg.norm(own, axis=1).max()), 1e-30)


def winch(scene: Scene, size: float, rng: Generator) -> None:
    """A winch of steel wire lowers an instrument while the vehicle is deep; size in nT, all wire out.

    How much wire it pays out it chooses on each dive; it winds it in again before the next.
    """
    track = scene.track
    deep = track.depth > rng.uniform(0.5, 0.8) * track.depth.max()
    dive = np.cumsum(np.diff(deep, prepend=deep[0]) & deep)
    wanted = deep * rng.uniform(0.2, 1.0, dive[-1] + 1)[dive]
    speed, out, wire = 1.0 / rng.uniform(60.0, 300.0), 0.0, np.empty(len(deep))
    for k, goal in enumerate(wanted):
        out += float(np.clip(goal - out, -speed * track.step, speed * track.step))
        wire[k] = out
    scene.add(wire, size * direction(rng))
