"""What goes wrong in an instrument, in a vehicle and around it; each effect is one function of the scene."""

from __future__ import annotations

import msgspec
import numpy as np

from sitl.inject.scene import Array, Effect, Generator, Scene, direction, relays, soaked
from sitl.instrument import rotation
from sitl.signals import first_order
from sitl.world import MU_0_OVER_4_PI, dipole_field

CALIBRATED_AT = 4.5
"""Instrument's temperature during the calibration, to about half a degree, degC."""
SWING = {"battpos": 0.6, "ballast": 200.0}
"""How far a survey moves the masses either way, in their units."""
FIN = np.radians(12.0)
"""A usual deflection of the fin."""


# ---- the instrument: heat, shocks, age; its converter, filter, clock and range ------------------------


def _warmer(scene: Scene, rng: Generator) -> Array:
    """Return by how much the core is warmer than during the calibration, degC."""
    core = soaked(scene.logged["sensor_temperature"][0], scene.track.step, float(rng.uniform(300, 4000)))
    return core - CALIBRATED_AT - 0.5 * rng.normal()


def heat_offset(scene: Scene, size: float, rng: Generator) -> None:
    """An offset that follows the core's temperature; size in nT/degC."""
    warmer, vector = _warmer(scene, rng), size * direction(rng)
    scene.add(warmer, vector)
    scene.record_truth(vector)


def heat_scale(scene: Scene, size: float, rng: Generator) -> None:
    """Copper in the coils: gains follow the core's temperature; size in 1/degC, times 5e4."""
    gains = 1.0 + size / 5e4 * np.abs(rng.normal(1.0, 0.4, 3)) * _warmer(scene, rng)[:, None]
    scene.field = scene.field * gains


def jump(scene: Scene, size: float, rng: Generator) -> None:
    """A shock: the offset jumps and relaxes within a minute; amplitude in nT."""
    t0 = rng.uniform(0.15, 0.85) * scene.t[-1]
    settled = np.where(scene.t > t0, 1.0 - 0.15 * np.exp(-np.maximum(scene.t - t0, 0.0) / 20.0), 0.0)
    vector = size * direction(rng)
    scene.add(settled, vector)
    scene.record_truth(vector)


def creep(scene: Scene, size: float, rng: Generator) -> None:
    """Stress relaxes logarithmically (magnetic viscosity: Street & Woolley 1949); size in nT over the log."""
    tau = rng.uniform(0.3, 1.5) * scene.t[-1]
    crept = np.log1p(scene.t / tau) / np.log1p(scene.t[-1] / tau)
    scene.add(crept, size * direction(rng))


def multiplexed(scene: Scene, size: float, rng: Generator) -> None:
    """The converter samples the channels in turn, and the log does not say so; size in s between channels."""
    order = rng.choice([-1.0, 1.0])
    delays = (0.0, size, 2 * size) if order > 0 else (2 * size, size, 0.0)
    scene.instrument = msgspec.structs.replace(scene.instrument, channel_delay=delays)
    scene.truth |= dict(zip("xyz", delays, strict=True))


def anti_alias(scene: Scene, size: float, rng: Generator) -> None:  # noqa: ARG001  (a filter has no direction)
    """A slow RC filter before the converter; size is its time constant in s."""
    scene.instrument = msgspec.structs.replace(scene.instrument, corner=1.0 / (2 * np.pi * max(size, 1e-6)))
    scene.truth["delay"] = size


def late_stamps(scene: Scene, size: float, rng: Generator) -> None:
    """The telemetry's clock is behind, or ahead; size in s."""
    scene.late = size * float(rng.choice([-1.0, 1.0]))
    scene.truth["delay"] = scene.late


def core(scene: Scene, size: float, rng: Generator) -> None:
    """The feedback's gain is finite, so the core's nonlinearity shows; size in nT at 50,000 nT."""
    a, b = rng.normal(0, 1, 3), rng.normal(0, 1, 3)
    scene.bend.append(
        lambda H: H - size * (a * (H / 5e4) ** 2 + b * np.tan(np.clip(H / 5e4, -1.2, 1.2)) / 1.5574)
    )


def rail(scene: Scene, size: float, rng: Generator) -> None:  # noqa: ARG001  (the rail is where it is)
    """An amplifier compresses softly towards its rail; size in nT lost at the largest reading."""

    def bend(H: Array) -> Array:
        axis = int(np.argmax(np.abs(H).max(axis=0)))
        h = np.abs(H[:, axis])
        top = float(h.max())
        knee = top - 0.25 * float(np.ptp(h))
        out = H.copy()
        out[:, axis] -= np.sign(H[:, axis]) * size * (np.maximum(h - knee, 0.0) / (top - knee)) ** 1.5
        return out

    scene.bend.append(bend)


def bit_flips(scene: Scene, size: float, rng: Generator) -> None:
    """A bus flips bits now and then: a dozen samples are off by `size` nT, or two or four times that."""

    def bend(H: Array) -> Array:
        rows = rng.choice(len(H) // 4, 12, replace=False) * 4
        out = H.copy()
        out[rows, rng.integers(0, 3, 12)] += (
            size * rng.choice([-1.0, 1.0], 12) * 2.0 ** rng.integers(0, 3, 12)
        )
        return out

    scene.bend.append(bend)


# ---- the surroundings: the Earth's field, the map of it, machines -------------------------------------


def ionosphere(scene: Scene, size: float, rng: Generator) -> None:
    """Sq's four harmonics and the tide of the ocean, mostly along the field; size in nT."""
    hours = scene.t / 3600.0
    total = sum(
        amplitude * np.cos(2 * np.pi * hours / period + rng.uniform(0, 2 * np.pi))
        for period, amplitude in ((24.0, 1.0), (12.0, 0.6), (8.0, 0.35), (6.0, 0.15), (12.42, 0.2))
    )
    scene.earth = scene.earth + size * np.outer(total - np.mean(total), [0.7, 0.2, 0.68])


def bad_map(scene: Scene, size: float, rng: Generator) -> None:
    """The map lacks some bodies: bumps a kilometre or so across; size in nT."""
    seen = scene.track.pose_at(scene.when)
    north, east = scene.track.local(seen["latitude"], seen["longitude"])
    width = 0.35 * max(np.ptp(north), np.ptp(east))
    for _ in range(3):
        k = rng.integers(len(north))
        far = (north - north[k]) ** 2 + (east - east[k]) ** 2
        scene.reference = scene.reference + size * rng.normal() * np.exp(
            -0.5 * far / (width * rng.uniform(0.5, 1.0)) ** 2
        )


def wrong_level(scene: Scene, size: float, rng: Generator) -> None:
    """The main-field model is off at this site, by slightly different amounts along the way; size in nT."""
    along = scene.when / scene.when[-1] - 0.5
    scene.reference = scene.reference + size * (1.0 + 0.02 * rng.normal() * along)
    scene.truth["bias"] = size


def hum(scene: Scene, size: float, rng: Generator) -> None:
    """A machine's field of a steady frequency, turning in an ellipse, seen by the sampling; size in nT."""
    f = rng.uniform(0.1, 0.4) * scene.instrument.rate
    phase = 2 * np.pi * f * scene.t + 0.1 * np.sin(scene.t / 3000.0)
    a, b = direction(rng), direction(rng)
    scene.field = scene.field + size * (np.outer(np.cos(phase), a) + np.outer(np.sin(phase + 0.3), 0.5 * b))


# ---- the vehicle: currents, iron that moves, remembers or is strained, conductors ---------------------


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


EFFECTS: dict[str, Effect] = {
    "temperature_offset": heat_offset,
    "temperature_scale": heat_scale,
    "offset_step": jump,
    "offset_drift": creep,
    "current_field": wires,
    "unmodelled_actuator": magnet_on_fin,
    "actuator_order": neighbours,
    "hysteresis": preisach,
    "eddy_current": ring,
    "channel_skew": multiplexed,
    "filter_lag": anti_alias,
    "clock_offset": late_stamps,
    "nonlinearity": core,
    "saturation": rail,
    "pressure_offset": squeezed,
    "diurnal_variation": ionosphere,
    "map_error": bad_map,
    "reference_bias": wrong_level,
    "interference_tone": hum,
    "outliers": bit_flips,
}
"""Cause, by its public name -> the effect that is hidden."""
