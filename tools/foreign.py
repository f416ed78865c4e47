"""Simulate effects for which ``diagnose`` has no cause, so that any name for such an effect is wrong.

Like the causes in :mod:`sitl.inject`, each is a function of the scene, a size in nT and a random generator.
"""

from __future__ import annotations

import numpy as np

from sitl.inject import Array, Effect, Generator, Scene, direction, relays
from sitl.instrument import rotation
from sitl.signals import autoregressive, first_order
from sitl.world import MU_0_OVER_4_PI, dipole_field


def relay(scene: Scene, size: float, rng: Generator) -> None:
    """Add the field of an unlogged payload that switches on and off about a dozen times."""
    flips = np.cumsum(rng.exponential(0.08 * scene.t[-1], 60))
    on = (np.searchsorted(flips, scene.t) % 2).astype(float)
    scene.add(on, size * direction(rng))


def ship(scene: Scene, size: float, rng: Generator) -> None:
    """Add the dipole of a ship on a straight course; `size` is the field at the closest point, nT."""
    t0 = rng.uniform(0.3, 0.7) * scene.t[-1]
    r = np.column_stack([4.0 * (scene.t - t0), np.full_like(scene.t, 900.0), np.full_like(scene.t, -50.0)])
    own = dipole_field(r, np.broadcast_to(direction(rng), r.shape))
    scene.earth = scene.earth + size * own / np.linalg.norm(own, axis=1).max()


def pan(scene: Scene, size: float, rng: Generator) -> None:
    """Add a magnet in an unlogged scanning head that sweeps a sector at random rates."""
    turns = np.cumsum(rng.uniform(0.02, 0.06, 80)) * scene.t[-1]
    angle = np.radians(150.0) * np.interp(scene.t, turns, (-1.0) ** np.arange(80))
    a, b = direction(rng), direction(rng)
    scene.field = scene.field + size * (np.outer(np.cos(angle), a) + np.outer(np.sin(angle), b))


def loose(scene: Scene, size: float, rng: Generator) -> None:
    """Add a loose magnet that slides to the lower end when the hull tilts the other way."""
    tip = scene.track.pitch - rng.uniform(-5.0, 5.0)
    stick = rng.uniform(5.0, 12.0)
    last = np.maximum.accumulate(np.where(np.abs(tip) > stick, np.arange(len(tip)), 0))
    slid = first_order(np.sign(tip[last]), scene.track.step, 3.0)
    scene.add(slid, size * direction(rng))


def corrosion(scene: Scene, size: float, rng: Generator) -> None:
    """Add a galvanic current in the hull that varies slowly and grows with the speed."""
    wander = autoregressive(rng, (len(scene.t),), 1.0, 2500.0 / scene.track.step)
    fed = np.sqrt(1.0 + np.abs(np.gradient(scene.track.depth, scene.track.step)))
    scene.add(fed * wander, size * direction(rng))


def pulsation(scene: Scene, size: float, rng: Generator) -> None:
    """Add packets of Pc5 pulsations of 150 to 600 s (Jacobs et al. 1964) to the Earth's field."""
    total = np.zeros_like(scene.t)
    for _ in range(4):
        t0, length = rng.uniform(0.0, 1.0) * scene.t[-1], rng.uniform(600.0, 2400.0)
        since = scene.t - t0
        phase = 2 * np.pi * since / rng.uniform(150.0, 600.0) * (1.0 + 0.1 * since / length)
        total += rng.uniform(0.5, 1.0) * np.exp(-0.5 * (since / length) ** 2) * np.cos(phase)
    scene.earth = scene.earth + size * np.outer(total, [0.7, 0.5, 0.3])


def needle(scene: Scene, size: float, rng: Generator) -> None:
    """Add a payload's compass card that points north, floats level and lags in turns."""
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
    """Add an unlogged heater with a thermostat, whose duty cycle follows the water temperature."""
    lag, band = rng.uniform(400.0, 1200.0), rng.uniform(1.0, 3.0)
    warm, heats, on = 15.0, False, np.empty(len(scene.t))
    for k, water in enumerate(scene.water):
        heats = warm < 15.0 + (0.5 if heats else -0.5) * band
        warm += scene.track.step / lag * (water - warm + 30.0 * heats)
        on[k] = heats
    scene.add(on, size * direction(rng))


def perming(scene: Scene, size: float, rng: Generator) -> None:
    """Add the hysteresis of unsaturated cores by the Preisach model, a different core on each axis."""
    memory = [
        rng.normal() * relays(h / 2e4, rng.normal(0.0, 0.8, 80), rng.lognormal(np.log(0.6), 0.5, 80))
        for h in scene.field.T
    ]
    scene.field = scene.field + size * np.stack(memory, axis=1)


def staircase(scene: Scene, size: float, rng: Generator) -> None:
    """Add the error of a sensor that cancels the field in uneven steps, with another gain for the rest."""
    step, gain, steps = 4000.0, rng.choice([-1.0, 1.0]), 0.5 * rng.normal(size=(64, 3))

    def bend(H: Array) -> Array:
        code = np.round(H / step).astype(int)
        own = gain * (H / step - code) + np.take_along_axis(steps, code % 64, axis=0)
        return np.asarray(H + size * own)

    scene.bend.append(bend)


def jettison(scene: Scene, size: float, rng: Generator) -> None:
    """Remove iron shot with an induced moment, which leaks out of its box; `size` is the total loss, nT."""
    began, lasts = scene.t[-1] * rng.uniform(0.2, 0.7), scene.t[-1] * rng.uniform(0.02, 0.2)
    lost = np.clip((scene.t - began) / lasts, 0.0, 1.0)
    unit = scene.field / np.linalg.norm(scene.field[0])
    own = dipole_field(np.broadcast_to(direction(rng), unit.shape), unit)
    scene.field = scene.field - size * lost[:, None] * own / MU_0_OVER_4_PI


def duet(scene: Scene, size: float, rng: Generator) -> None:
    """Add the beat of two converters whose aliased frequencies are close and vary with the load."""
    step, total = scene.track.step, np.zeros_like(scene.t)
    folded = rng.uniform(0.01, 0.1)
    for share, difference in ((1.0, 0.0), (rng.uniform(0.4, 1.0), rng.uniform(3e-4, 1.5e-3))):
        wanders = 1e-4 * autoregressive(rng, (len(scene.t),), 1.0, 1200.0 / step)
        phase = 2.0 * np.pi * np.cumsum(folded + difference + wanders) * step
        total += share * np.cos(phase + rng.uniform(0.0, 2.0 * np.pi))
    scene.add(total, size * direction(rng))


def winch(scene: Scene, size: float, rng: Generator) -> None:
    """Add a winch that pays out a random length of steel wire at the bottom of each dive."""
    track = scene.track
    deep = track.depth > rng.uniform(0.5, 0.8) * track.depth.max()
    dive = np.cumsum(np.diff(deep, prepend=deep[0]) & deep)
    wanted = deep * rng.uniform(0.2, 1.0, dive[-1] + 1)[dive]
    speed, out, wire = 1.0 / rng.uniform(60.0, 300.0), 0.0, np.empty(len(deep))
    for k, goal in enumerate(wanted):
        out += float(np.clip(goal - out, -speed * track.step, speed * track.step))
        wire[k] = out
    scene.add(wire, size * direction(rng))


def mooring(scene: Scene, size: float, rng: Generator) -> None:
    """Add a steel buoy that swings about its anchor near the track; `size` is the largest field, nT."""
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


FOREIGN: dict[str, Effect] = {
    effect.__name__: effect
    for effect in (
        relay, ship, pan, loose, corrosion, pulsation, needle, thermostat, perming, staircase, jettison,
        duet, winch, mooring,
    )
}  # fmt: skip
"""Foreign effects by name."""
