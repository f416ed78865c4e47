"""What goes wrong inside the instrument and is in no table: its cores, ranges, supply and mechanics."""

from __future__ import annotations

import numpy as np

from sitl.inject.scene import Array, Generator, Scene, direction, relays, soaked
from sitl.signals import autoregressive, first_order


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
    load = scene.logged["amps_a"][0] + scene.logged["amps_b"][0] + rng.uniform(0.1, 0.3)
    drawn = np.cumsum(load) / np.sum(load)
    # ions take time to diffuse
    slow = first_order(load, scene.track.step, float(rng.uniform(100.0, 400.0)))
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
    scene.add(np.cos(phase), size * direction(rng))


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
    scene.add(memory, size * direction(rng))


def dew(scene: Scene, size: float, rng: Generator) -> None:
    """Water condenses on the electronics below the dew point, leaks current, and dries late; size in nT."""
    warm = soaked(scene.water, scene.track.step, 300.0)
    cold = np.maximum(np.quantile(warm, rng.uniform(0.3, 0.7)) - warm, 0.0)
    wets, dries = scene.track.step / rng.uniform(100.0, 300.0), scene.track.step / rng.uniform(1500.0, 5000.0)
    film, wet = 0.0, np.empty(len(cold))
    for k, below in enumerate(cold / max(cold.max(), 1e-9)):
        film = min(film + wets * below, 1.0) - dries * film
        wet[k] = film
    scene.add(wet, size * direction(rng))


def stuck(scene: Scene, size: float, rng: Generator) -> None:
    """A bit of one channel's converter sticks half way: every other step reads too high; size in nT."""
    channel, step = int(rng.integers(0, 3)), rng.uniform(500.0, 4000.0)

    def bend(H: Array) -> Array:
        out = H.copy()
        out[:, channel] += size * (np.floor(H[:, channel] / step) % 2.0)
        return out

    scene.bend.append(bend)


def gradient(scene: Scene, size: float, rng: Generator) -> None:
    """Cores are strained while the housing around them is warmer or colder; size in nT at 1 degC."""
    middle = soaked(scene.water, scene.track.step, float(rng.uniform(200.0, 1200.0)))
    housing = first_order(scene.water, scene.track.step, float(rng.uniform(20.0, 60.0)))
    scene.add(housing - middle, size * direction(rng))


def squeezed(scene: Scene, size: float, rng: Generator) -> None:
    """Pressure narrows the feedback coils, each by its own; size in 1e-5 of the field at 100 m."""
    strain = scene.track.depth / 100.0 * (1.0 + 0.05 * scene.track.depth / 100.0)
    scene.field = scene.field * (1.0 + 1e-5 * size * np.outer(strain, rng.uniform(0.5, 1.5, 3)))


def ageing(scene: Scene, size: float, rng: Generator) -> None:
    """The feedback resistors age, each by its own, fast at first; size in 1e-5 of the field in a decade."""
    burnt_in = rng.uniform(600.0, 3600.0)
    grown = np.log10(1.0 + scene.t / burnt_in)
    scene.field = scene.field * (1.0 + 1e-5 * size * np.outer(grown, rng.uniform(0.3, 1.7, 3)))


def crossfield(scene: Scene, size: float, rng: Generator) -> None:
    """A core reads less where the field across it is strong (Ripka 2001); size in 1e-4 at 50,000 nT."""
    across = np.roll(scene.field, 1, axis=1) ** 2 + np.roll(scene.field, 2, axis=1) ** 2
    loss = 1e-4 * size * rng.uniform(0.3, 1.7, 3) * across / (across + 5e4**2) * 2.0
    scene.field = scene.field * (1.0 - loss)


def clamp(scene: Scene, size: float, rng: Generator) -> None:
    """A clamp holds the cores until the housing's strain exceeds its grip; size in nT at 1 degC."""
    housing = soaked(scene.water, scene.track.step, float(rng.uniform(100.0, 600.0)))
    grip = rng.uniform(0.15, 0.4) * np.ptp(housing)
    held, slipped = housing[0], np.empty(len(housing))
    for k, strain in enumerate(housing):
        if abs(strain - held) > grip:  # creaks, and comes to rest beyond the middle
            held = strain + 0.2 * np.sign(strain - held) * grip
        slipped[k] = strain - held
    scene.add(slipped, size * direction(rng))


def rezero(scene: Scene, size: float, rng: Generator) -> None:
    """The sensor zeroes itself by the clock, and its offset warms away in between; size in nT at 1 degC."""
    warm = soaked(scene.water, scene.track.step, float(rng.uniform(200.0, 1200.0)))
    every = round(rng.uniform(1800.0, 7200.0) / scene.track.step)
    zeroed = np.arange(len(warm)) // every * every
    scene.add(warm - warm[zeroed], size * direction(rng))


def microphonic(scene: Scene, size: float, rng: Generator) -> None:
    """Stressed cores rectify the pump's vibration, which is louder against pressure; size in nT at most."""
    step, depth = scene.track.step, scene.track.depth / scene.track.depth.max()
    pumps = (np.abs(np.gradient(scene.track.parameters["ballast"], step)) > 1.0).astype(float)
    loud = pumps * (rng.uniform(0.05, 0.3) + depth) ** 2
    rung = first_order(loud, step, float(rng.uniform(1.0, 10.0)))
    scene.add(rung / max(rung.max(), 1e-9), size * direction(rng))


def seep(scene: Scene, size: float, rng: Generator) -> None:
    """Salt water in a connector leads one channel's signal into another; size in 1e-5 of it when soaked.

    It is pressed in below a depth, within minutes, and dries over hours.
    """
    depth = scene.track.depth / scene.track.depth.max()
    wets, dries = (scene.track.step / lag for lag in (rng.uniform(100.0, 400.0), rng.uniform(1500.0, 9000.0)))
    opens, wet, film = rng.uniform(0.4, 0.8), 0.0, np.empty(len(scene.t))
    for k, pressed in enumerate(depth > opens):
        wet += wets * (1.0 - wet) if pressed else -dries * wet
        film[k] = wet
    heard, hears = rng.permutation(3)[:2]
    leads = film / max(float(film.max()), 1e-9)
    crossed = np.zeros_like(scene.field)
    crossed[:, hears] = leads * scene.field[:, heard]
    scene.field = scene.field + 1e-5 * size * crossed


def lookup(scene: Scene, size: float, rng: Generator) -> None:
    """Firmware takes the offset of a temperature from a table of coarse steps; size in nT at 1 degC.

    It reads its own thermometer, which is late, and keeps an entry until it is well past the next.
    """
    warm = soaked(scene.water, scene.track.step, float(rng.uniform(200.0, 900.0)))
    read = first_order(warm, scene.track.step, float(rng.uniform(20.0, 120.0)))
    apart, keeps = rng.uniform(0.1, 0.35) * np.ptp(warm), rng.uniform(0.55, 0.8)
    start, entry = rng.uniform(0.0, 1.0), 0
    used = np.empty(len(warm))
    for k, at in enumerate((read - read[0]) / max(float(apart), 1e-9) + start):
        if abs(at - entry) > keeps:
            entry = round(at)
        used[k] = entry
    scene.add(warm - warm[0] - apart * (used - used[0]), size * direction(rng))


def duet(scene: Scene, size: float, rng: Generator) -> None:
    """Two converters of nearly one frequency fold into the band, and beat slowly; size in nT of the louder.

    Each wanders with its own load.
    """
    step, total = scene.track.step, np.zeros_like(scene.t)
    folded = rng.uniform(0.01, 0.1)
    for share, apart in ((1.0, 0.0), (rng.uniform(0.4, 1.0), rng.uniform(3e-4, 1.5e-3))):
        wanders = 1e-4 * autoregressive(rng, (len(scene.t),), 1.0, 1200.0 / step)
        phase = 2.0 * np.pi * np.cumsum(folded + apart + wanders) * step
        total += share * np.cos(phase + rng.uniform(0.0, 2.0 * np.pi))
    scene.add(total, size * direction(rng))
