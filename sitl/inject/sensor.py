"""What goes wrong inside the instrument: heat, shocks, age; its converter, filter, clock and range."""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from sitl.inject.scene import Generator, Scene, direction, relays
from sitl.signals import first_order

Array = NDArray[np.float64]

CALIBRATED_AT = 4.5
"""degC, the instrument's temperature during the calibration, to about half a degree."""


def soaked(surface: Array, step: float, lag: float) -> Array:
    """Temperature in the middle of a slab whose faces follow `surface` (Carslaw & Jaeger 1959, sec. 3.4).

    ``lag`` is the slowest mode's time constant, s.
    """
    modes = range(40)
    weights = np.array([4.0 * (-1) ** k / (np.pi * (2 * k + 1)) for k in modes])
    parts = [first_order(surface, step, lag / (2 * k + 1) ** 2) for k in modes]
    return np.asarray((weights / weights.sum()) @ np.array(parts))


def _warmer(scene: Scene, rng: Generator) -> Array:
    """Return by how much the core is warmer than during the calibration, degC."""
    core = soaked(scene.logged["sensor_temperature"][0], scene.track.step, float(rng.uniform(300, 4000)))
    return core - CALIBRATED_AT - 0.5 * rng.normal()


def heat_offset(scene: Scene, size: float, rng: Generator) -> None:
    """An offset that follows the core's temperature; size in nT/degC."""
    scene.add(_warmer(scene, rng), size * direction(rng))


def heat_scale(scene: Scene, size: float, rng: Generator) -> None:
    """Copper in the coils: gains follow the core's temperature; size in 1/degC, times 5e4."""
    gains = 1.0 + size / 5e4 * np.abs(rng.normal(1.0, 0.4, 3)) * _warmer(scene, rng)[:, None]
    scene.field = scene.field * gains


def jump(scene: Scene, size: float, rng: Generator) -> None:
    """A shock: the offset jumps and settles within a minute; size in nT."""
    t0 = rng.uniform(0.15, 0.85) * scene.t[-1]
    settled = np.where(scene.t > t0, 1.0 - 0.15 * np.exp(-np.maximum(scene.t - t0, 0.0) / 20.0), 0.0)
    scene.add(settled, size * direction(rng))


def creep(scene: Scene, size: float, rng: Generator) -> None:
    """Stress relaxes logarithmically (magnetic viscosity: Street & Woolley 1949); size in nT over the log."""
    tau = rng.uniform(0.3, 1.5) * scene.t[-1]
    crept = np.log1p(scene.t / tau) / np.log1p(scene.t[-1] / tau)
    scene.field = scene.field + size * direction(rng) * crept[:, None]


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


def perming(scene: Scene, size: float, rng: Generator) -> None:
    """Cores that are never quite saturated remember past fields, each by relays of its own; size in nT."""
    memory = [
        rng.normal() * relays(h / 2e4, rng.normal(0.0, 0.8, 80), rng.lognormal(np.log(0.6), 0.5, 80))
        for h in scene.field.T
    ]
    scene.field = scene.field + size * np.stack(memory, axis=1)


def staircase(scene: Scene, size: float, rng: Generator) -> None:
    """Uneven steps cancel most of the field, and the rest is measured with another gain; size in nT."""
    step, gain, steps = 4000.0, rng.choice([-1.0, 1.0]), 0.5 * rng.normal(size=(64, 3))

    def bend(H: Array) -> Array:
        code = np.round(H / step).astype(int)
        own = gain * (H / step - code) + np.take_along_axis(steps, code % 64, axis=0)
        return np.asarray(H + size * own)

    scene.bend.append(bend)


def brownout(scene: Scene, size: float, rng: Generator) -> None:
    """The converter's reference sags with load and charge of the supply; size in 1e-5 of the field at 1 A."""
    step, load = (
        scene.track.step,
        scene.logged["amps_a"][0] + scene.logged["amps_b"][0] + rng.uniform(0.1, 0.3),
    )
    drawn = np.cumsum(load) / np.sum(load)
    slow = first_order(load, step, float(rng.uniform(100.0, 400.0)))  # ions take time to diffuse
    sag = 0.6 * load + 0.4 * slow + rng.uniform(0.3, 1.0) * drawn**3
    scene.field = scene.field * (1.0 + 1e-5 * size * sag[:, None])


def ranges(scene: Scene, size: float, rng: Generator) -> None:
    """Large readings have a range of another gain, switched with hysteresis; size in nT at full scale."""
    changes, gains = rng.uniform(0.3, 0.6, 3), rng.choice([-1.0, 1.0], 3)

    def bend(H: Array) -> Array:
        x = np.abs(H) / np.abs(H).max(axis=0)
        up, down = x > changes + 0.05, x < changes - 0.05
        last = np.maximum.accumulate(np.where(up | down, np.arange(len(H))[:, None], 0), axis=0)
        upper = np.take_along_axis(up, last, axis=0)
        return np.asarray(H + size * gains * upper * x * np.sign(H))

    scene.bend.append(bend)


def sag(scene: Scene, size: float, rng: Generator) -> None:
    """A core's bracket bends under its weight towards another channel's axis; size in 2e-5 rad at 1 g."""
    leaning = int(rng.integers(0, 3))
    neighbour = (leaning + int(rng.integers(1, 3))) % 3
    roll, pitch = np.radians(scene.track.roll), np.radians(scene.track.pitch)
    weight = np.column_stack([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)])
    swing = first_order(weight[:, neighbour] - weight[0, neighbour], scene.track.step, 1.0)
    out = scene.field.copy()
    out[:, leaning] += 2e-5 * size * swing * scene.field[:, neighbour]
    scene.field = out


def crossover(scene: Scene, size: float, rng: Generator) -> None:
    """Two transistors share the feedback current by its sign, with a dead zone about zero; size in nT."""
    widths, gaps = rng.uniform(600.0, 2500.0, 3), rng.lognormal(0.0, 0.5, 3) * rng.choice([-1.0, 1.0], 3)

    def bend(H: Array) -> Array:
        x = H / widths
        return np.asarray(H - size * gaps * 2.0 * x / (1.0 + x**4))

    scene.bend.append(bend)


def popcorn(scene: Scene, size: float, rng: Generator) -> None:
    """A defect in the voltage reference switches at random between two gains; size in 1e-5 of the field."""
    dwell = rng.exponential(1.0, len(scene.t)) * np.resize(rng.uniform(200.0, 1800.0, 2), len(scene.t))
    trapped = np.searchsorted(np.cumsum(dwell), scene.t) % 2
    scene.field = scene.field * (1.0 + 1e-5 * size * trapped[:, None])


def restart(scene: Scene, size: float, rng: Generator) -> None:
    """The sensor rests at the surface, and its offset settles anew on each dive; size in nT."""
    depth = scene.track.depth
    up = depth < depth.min() + 0.1 * np.ptp(depth)
    dive = np.cumsum(np.diff(up, prepend=up[0]) & ~up)
    scene.field = scene.field + size * rng.normal(size=(dive[-1] + 1, 3))[dive]


def whistle(scene: Scene, size: float, rng: Generator) -> None:
    """The excitation beats with another oscillator, faster as the electronics warm; size in nT."""
    warm = scene.logged["sensor_temperature"][0]
    beat = rng.uniform(0.02, 0.1) * (1.0 + rng.uniform(0.03, 0.1) * (warm - warm[0]))
    phase = 2.0 * np.pi * np.cumsum(beat) * scene.track.step + rng.uniform(0.0, 2.0 * np.pi)
    scene.field = scene.field + size * direction(rng) * np.cos(phase)[:, None]


def mast(scene: Scene, size: float, rng: Generator) -> None:
    """The flow bends the sensor's mast, as the square of the speed; size in 1e-5 rad at 0.3 m/s down."""
    sinking = np.gradient(scene.track.depth, scene.track.step) / 0.3
    bent = first_order(sinking * np.abs(sinking), scene.track.step, float(rng.uniform(1.0, 10.0)))
    scene.field = scene.field + 1e-5 * size * bent[:, None] * np.cross(direction(rng), scene.field)


def annealed(scene: Scene, size: float, rng: Generator) -> None:
    """Stress in the cores depends on whether they were warmed or cooled, and by how much; size in nT."""
    warm = soaked(scene.water, scene.track.step, 300.0)
    x = (warm - warm.mean()) / np.ptp(warm)
    memory = relays(x, rng.uniform(-0.5, 0.5, 60), rng.uniform(0.1, 0.5, 60))
    scene.field = scene.field + size * direction(rng) * memory[:, None]
