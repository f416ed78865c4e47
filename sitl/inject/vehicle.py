"""What goes wrong with the vehicle: currents, iron that moves, remembers or is strained, conductors."""

from __future__ import annotations

import numpy as np

from sitl.inject.scene import Array, Generator, Scene, direction, relays
from sitl.instrument import rotation
from sitl.signals import first_order
from sitl.world import MU_0_OVER_4_PI, dipole_field

SWING = {"battpos": 0.6, "ballast": 200.0}
"""How far a survey moves the masses either way, in their units."""
FIN = np.radians(12.0)
"""A usual deflection of the fin."""


def wires(scene: Scene, size: float, rng: Generator) -> None:
    """A motor's supply loop, four wires by Biot and Savart; size times the field of a loop 30 cm away."""
    name = str(rng.choice(["amps_a", "amps_b"]))
    centre, u = 0.3 * direction(rng), direction(rng)
    v = np.cross(u, direction(rng))
    corners = centre + 0.05 * np.array([u + v, u - v, -u - v, -u + v])
    total = np.zeros(3)
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        points = a + (b - a) * (np.arange(200)[:, None] + 0.5) / 200
        dl = np.broadcast_to((b - a) / 200, points.shape)
        r = -points
        total += MU_0_OVER_4_PI * np.sum(np.cross(dl, r) / np.linalg.norm(r, axis=1)[:, None] ** 3, axis=0)
    vector = size * total / np.linalg.norm(total)
    scene.add(scene.logged[name][0], vector)
    scene.record_truth(vector)


def magnet_on_fin(scene: Scene, size: float, rng: Generator) -> None:
    """A magnet on a lever that another actuator turns moves and turns; size in nT at 12 deg."""
    arm, m = np.array([0.08, 0.0, 0.0]), direction(rng)
    place = np.array([-0.5, 0.1, 0.1]) + 0.1 * rng.normal(size=3)

    def own_columns(angle: Array) -> Array:
        turn = rotation(0.0, 0.0, np.degrees(angle))
        return dipole_field(-(place + turn.apply(arm)), turn.apply(m))

    low, middle, high = own_columns(np.array([-FIN, 0.0, FIN]))
    moved = own_columns(np.radians(scene.logged["p17"][0])) - middle
    scene.field = scene.field + size * moved / (0.5 * float(np.linalg.norm(high - low)))


def neighbours(scene: Scene, size: float, rng: Generator) -> None:
    """Two masses that magnetise each other, and a field too curved for a cubic; size in nT."""
    x, y = (scene.track.parameters[name] / SWING[name] for name in ("battpos", "ballast"))
    curved = (35 * x**4 - 30 * x**2 + 3) / 8 + rng.normal(0, 0.5) * x**3 * y
    scene.add(np.tanh(0.5 * curved), size * direction(rng))


def preisach(scene: Scene, size: float, rng: Generator) -> None:
    """Steel in the battery's path, remagnetised as it moves: relays of many widths; size in nT."""
    x = scene.track.parameters["battpos"] / SWING["battpos"]
    # relays() leaves out what depends on the position alone: a calibration has that already
    memory = relays(x, rng.normal(0, 0.35, 80), rng.lognormal(np.log(0.5), 0.4, 80))
    scene.add(memory, size * direction(rng))


def ring(scene: Scene, size: float, rng: Generator) -> None:
    """A conducting ring with inductance; size in s, which multiplies the field's rate of change.

    It lies where its own field at the sensor is perpendicular to its axis n. The field of a dipole along n,
    in the direction p, is ``3 p (p . n) - n``: at the magic angle, ``(p . n)^2 = 1/3``, it has no part
    along n.
    """
    normal = np.eye(3)[rng.integers(3)] + 0.05 * rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    side = np.cross(normal, direction(rng))
    place = normal / np.sqrt(3.0) + side / np.linalg.norm(side) * np.sqrt(2.0 / 3.0)
    flux = first_order(scene.field @ normal, scene.track.step, float(rng.uniform(0.05, 0.3)))
    shape = 3 * place * (place @ normal) - normal
    scene.add(np.gradient(flux, scene.track.step), -size * shape)
    coupling = -size * np.outer(shape, normal)
    scene.truth |= {"xyz"[i] + "xyz"[j]: float(coupling[i, j]) for i in range(3) for j in range(3) if i != j}


def squeezed(scene: Scene, size: float, rng: Generator) -> None:
    """Hull and mount under pressure, with a little creep; size in nT at 100 m."""
    depth = scene.track.depth
    strain = depth / 100.0 * (1.0 + 0.03 * depth / 100.0)
    strain = 0.93 * strain + 0.07 * first_order(strain, scene.track.step, 120.0)
    vector = size * direction(rng)
    slope = float(np.polyfit(depth, strain, 1)[0])
    scene.add(strain / slope, slope * vector)
    scene.record_truth(slope * vector)
