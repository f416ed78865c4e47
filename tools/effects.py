"""Simulate the effects of the causes that ``diagnose`` knows, and foreign effects, for which it has no cause.

The effects share no model with the detector. Heat diffuses through a slab, but the detector has two lags in
series. Steel has a Preisach distribution, but the detector has one play operator. Filters and converters
belong to the instrument, and the ionosphere has a spectrum. Each effect is a function of the scene, a size in
its unit and a random generator, like those in :mod:`sitl.inject`. Any name for a foreign effect is wrong.
"""

from __future__ import annotations

import msgspec
import numpy as np

from sitl.inject import SWING, Array, Effect, Generator, Scene, direction, jump, neighbours, wires
from sitl.instrument import rotation
from sitl.signals import autoregressive, first_order
from sitl.world import MU_0_OVER_4_PI, dipole_field

CALIBRATED_AT = 4.5
"""Mean temperature of the instrument during the calibration, degC."""
FIN = np.radians(12.0)
"""Usual deflection of the fin, rad."""


def relays(x: Array, centres: Array, widths: Array) -> Array:
    """Return the mean state (n,) of Preisach relays along x (n,), minus the state without hysteresis.

    `centres` and `widths` are the relays' thresholds, in the unit of x.
    """
    total = np.zeros(len(x))
    for c, w in zip(centres, widths, strict=True):
        up, down = x >= c + w / 2, x <= c - w / 2
        last = np.maximum.accumulate(np.where(up | down, np.arange(len(x)), 0))
        total += np.where(up[last], 1.0, -1.0) - np.where(x >= c, 1.0, -1.0)
    return total / len(centres)


def soaked(surface: Array, step: float, lag: float) -> Array:
    """Return the temperature (n,) in the middle of a slab whose faces have `surface` (n,), every `step` s.

    `lag` is the slowest mode's time constant, s (Carslaw & Jaeger 1959, sec. 3.4).
    """
    modes = range(40)
    weights = np.array([4.0 * (-1) ** k / (np.pi * (2 * k + 1)) for k in modes])
    parts = [first_order(surface, step, lag / (2 * k + 1) ** 2) for k in modes]
    return np.asarray((weights / weights.sum()) @ np.array(parts))


# ---- the instrument: heat, shocks, age; its converter, filter, clock and range -----------------------------


def _warmer(scene: Scene, rng: Generator) -> Array:
    """Return the core's temperature (n,) minus that during the calibration, degC."""
    core = soaked(scene.logged["sensor_temperature"][0], scene.track.step, float(rng.uniform(300, 4000)))
    return core - CALIBRATED_AT - 0.5 * rng.normal()


def heat_offset(scene: Scene, size: float, rng: Generator) -> None:
    """Add an offset that follows the temperature of the core; the size is in nT/degC."""
    warmer, vector = _warmer(scene, rng), size * direction(rng)
    scene.add(warmer, vector)
    scene.record_truth(vector)


def heat_scale(scene: Scene, size: float, rng: Generator) -> None:
    """Change the gains with the temperature of the coils; the size is in nT/degC at 50,000 nT."""
    gains = 1.0 + size / 5e4 * np.abs(rng.normal(1.0, 0.4, 3)) * _warmer(scene, rng)[:, None]
    scene.field = scene.field * gains


def creep(scene: Scene, size: float, rng: Generator) -> None:
    """Relax the offset logarithmically (Street & Woolley 1949); the size is the total change in nT."""
    tau = rng.uniform(0.3, 1.5) * scene.t[-1]
    crept = np.log1p(scene.t / tau) / np.log1p(scene.t[-1] / tau)
    scene.add(crept, size * direction(rng))


def multiplexed(scene: Scene, size: float, rng: Generator) -> None:
    """Sample one channel after the other, without logged times; the size is the interval in s."""
    order = rng.choice([-1.0, 1.0])
    delays = (0.0, size, 2 * size) if order > 0 else (2 * size, size, 0.0)
    scene.instrument = msgspec.structs.replace(scene.instrument, channel_delay=delays)
    scene.truth |= dict(zip("xyz", delays, strict=True))


def anti_alias(scene: Scene, size: float, rng: Generator) -> None:  # noqa: ARG001  (a filter has no direction)
    """Put a slow RC filter before the converter; the size is its time constant in s."""
    scene.instrument = msgspec.structs.replace(scene.instrument, corner=1.0 / (2 * np.pi * max(size, 1e-6)))
    scene.truth["delay"] = size


def late_stamps(scene: Scene, size: float, rng: Generator) -> None:
    """Delay or advance the telemetry against its timestamps; the size is the delay in s."""
    scene.late = size * float(rng.choice([-1.0, 1.0]))
    scene.truth["delay"] = scene.late


def core(scene: Scene, size: float, rng: Generator) -> None:
    """Add the nonlinearity of a core whose feedback has a finite gain; the size is in nT at 50,000 nT."""
    a, b = rng.normal(0, 1, 3), rng.normal(0, 1, 3)
    scene.bend.append(
        lambda H: H - size * (a * (H / 5e4) ** 2 + b * np.tan(np.clip(H / 5e4, -1.2, 1.2)) / 1.5574)
    )


def rail(scene: Scene, size: float, rng: Generator) -> None:  # noqa: ARG001  (the rail is where it is)
    """Compress the readings softly towards a rail; the size is the loss at the largest reading in nT."""

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
    """Add outliers of 1, 2 or 4 times the size to a dozen readings, like flipped bits; the size is in nT."""

    def bend(H: Array) -> Array:
        rows = rng.choice(len(H) // 4, 12, replace=False) * 4
        out = H.copy()
        axes, signs = rng.integers(0, 3, 12), rng.choice([-1.0, 1.0], 12)
        out[rows, axes] += size * signs * 2.0 ** rng.integers(0, 3, 12)
        return out

    scene.bend.append(bend)


# ---- the surroundings: the Earth's field, the map of it, machines ------------------------------------------


def ionosphere(scene: Scene, size: float, rng: Generator) -> None:
    """Add four harmonics of the Sq variation and the ocean's tide; the size is in nT."""
    hours = scene.t / 3600.0
    total = sum(
        amplitude * np.cos(2 * np.pi * hours / period + rng.uniform(0, 2 * np.pi))
        for period, amplitude in ((24.0, 1.0), (12.0, 0.6), (8.0, 0.35), (6.0, 0.15), (12.42, 0.2))
    )
    scene.earth = scene.earth + size * np.outer(total - np.mean(total), [0.7, 0.2, 0.68])


def bad_map(scene: Scene, size: float, rng: Generator) -> None:
    """Omit three wide anomalies from the map; the size is the 1-sigma of their amplitudes in nT."""
    seen = scene.track.pose_at(scene.when)
    north, east = scene.track.local(seen["latitude"], seen["longitude"])
    width = 0.35 * max(np.ptp(north), np.ptp(east))
    for _ in range(3):
        k = rng.integers(len(north))
        far = (north - north[k]) ** 2 + (east - east[k]) ** 2
        height, radius = size * rng.normal(), width * rng.uniform(0.5, 1.0)
        scene.reference = scene.reference + height * np.exp(-0.5 * far / radius**2)


def wrong_level(scene: Scene, size: float, rng: Generator) -> None:
    """Add an error of the main-field model that varies slightly along the track; the size is in nT."""
    along = scene.when / scene.when[-1] - 0.5
    scene.reference = scene.reference + size * (1.0 + 0.02 * rng.normal() * along)
    scene.truth["bias"] = size


def hum(scene: Scene, size: float, rng: Generator) -> None:
    """Add the field of a machine with a steady frequency, aliased by the sampling; the size is in nT."""
    f = rng.uniform(0.1, 0.4) * scene.instrument.rate
    phase = 2 * np.pi * f * scene.t + 0.1 * np.sin(scene.t / 3000.0)
    a, b = direction(rng), direction(rng)
    scene.field = scene.field + size * (np.outer(np.cos(phase), a) + np.outer(np.sin(phase + 0.3), 0.5 * b))


# ---- the vehicle: iron that moves, remembers or is strained, conductors ------------------------------------


def magnet_on_fin(scene: Scene, size: float, rng: Generator) -> None:
    """Add the field of a magnet on a fin's lever; the size is in nT at a deflection of 12 deg."""
    arm, m = np.array([0.08, 0.0, 0.0]), direction(rng)
    place = np.array([-0.5, 0.1, 0.1]) + 0.1 * rng.normal(size=3)

    def own_columns(angle: Array) -> Array:
        turn = rotation(0.0, 0.0, np.degrees(angle))
        return dipole_field(-(place + turn.apply(arm)), turn.apply(m))

    low, middle, high = own_columns(np.array([-FIN, 0.0, FIN]))
    moved = own_columns(np.radians(scene.logged["p17"][0])) - middle
    scene.field = scene.field + size * moved / (0.5 * float(np.linalg.norm(high - low)))


def preisach(scene: Scene, size: float, rng: Generator) -> None:
    """Add the hysteresis of steel along the battery's path, by relays of many widths; the size is in nT."""
    x = scene.track.parameters["battpos"] / SWING["battpos"]
    # relays() subtracts the part that depends only on the position: a calibration has this part already
    memory = relays(x, rng.normal(0, 0.35, 80), rng.lognormal(np.log(0.5), 0.4, 80))
    scene.add(memory, size * direction(rng))


def ring(scene: Scene, size: float, rng: Generator) -> None:
    """Add the field of a conducting ring with inductance; the size (s) multiplies the field's rate.

    The ring is where its field at the sensor is perpendicular to its axis n. The field of a dipole along n,
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
    """Add an offset that the water pressure causes, with a little creep; the size is in nT at 100 m."""
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
"""Function that adds the effect of each cause, by the cause's public name."""


# ---- foreign effects ---------------------------------------------------------------------------------------


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
    share, lag = rng.uniform(0.1, 0.4), float(rng.uniform(10.0, 40.0))
    dragged = share * (turned - first_order(turned, track.step, lag))
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
    start, rate = rng.uniform(0.0, 2.0 * np.pi), autoregressive(rng, scene.t.shape, 4e-4, 3600.0 / track.step)
    turned = start + np.cumsum(rate) * track.step
    x, y = north - north[k] - circle * np.cos(turned), east - east[k] - circle * np.sin(turned)
    away = np.column_stack([x, y, track.depth + rng.uniform(5.0, 15.0)])
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
