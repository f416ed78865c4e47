"""Add a hidden effect to a simulated deployment, with a finer model than the detector's.

The effects share no model with the detector. Heat diffuses through a slab, but the detector has two lags in
series. Steel has a Preisach distribution, but the detector has one play operator. Currents flow in wires of a
given shape, filters and converters belong to the instrument, and the ionosphere has a spectrum. Each effect
is a function of the :class:`Scene`, a size, and a random generator for its direction, place and time. An
effect is proportional to its size as far as physics allows. Properties of the vehicle or its instrument
depend only on the seed of :class:`HiddenEffect`, so they are the same in every deployment.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from dataclasses import field as attribute

import msgspec
import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from sitl.instrument import Instrument, Samples, rotation
from sitl.signals import autoregressive, first_order
from sitl.trajectory import Track
from sitl.twin import Twin
from sitl.world import MU_0_OVER_4_PI, dipole_field

__all__ = ["EFFECTS", "HiddenEffect", "disturb"]

Array = NDArray[np.float64]
Generator = np.random.Generator


@dataclass
class Scene:
    """Quantities that an effect may change: n points of the simulation's fine grid, m logged rows."""

    track: Track
    when: Array
    """Times of the logged rows (m,), s after the start."""
    field: Array
    """Field at the sensor (n, 3), nT, body axes."""
    earth: Array
    """Change of the Earth's field (n, 3), nT, north-east-down, that the reference does not contain."""
    water: Array
    """Water temperature (n,), degC."""
    instrument: Instrument
    reference: Array
    """Amount by which the reference field is too small (m,), nT."""
    late: float = 0.0
    """Delay of the telemetry's values against their timestamps, s."""
    logged: dict[str, tuple[Array, str]] = attribute(default_factory=dict)
    """Further telemetry by name: values (n,) and unit."""
    bend: list[Callable[[Array], Array]] = attribute(default_factory=list)
    """Functions that change the digitised channels (m, 3), nT."""
    truth: dict[str, float] = attribute(default_factory=dict)
    """Parameters that a perfect diagnosis would report, by the names in the report."""

    @property
    def t(self) -> Array:
        """Time of each point (n,), s after the start."""
        return self.track.elapsed

    def add(self, shape: Array, vector: Array) -> None:
        """Add `shape` (n,) times `vector` (3,), nT in body axes, to the field at the sensor."""
        self.field = self.field + shape[:, None] * vector

    def record_truth(self, vector: Array) -> None:
        """Record as true parameters the channels' readings of a `vector` (3,) in body axes."""
        self.truth |= dict(zip("xyz", (self.instrument.matrix() @ vector).tolist(), strict=True))


Effect = Callable[[Scene, float, Generator], None]


class HiddenEffect(msgspec.Struct, frozen=True):
    """Hidden effect: its name in :data:`EFFECTS`, its size in the effect's unit, and its seed."""

    name: str
    size: float
    seed: int


def direction(rng: Generator) -> Array:
    """Draw a random unit vector (3,)."""
    d = rng.normal(size=3)
    return np.asarray(d / np.linalg.norm(d))


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


def furnish(scene: Scene, rng: Generator) -> None:
    """Add telemetry that vehicles usually log: motor currents, a fin's angle, temperatures."""
    n, t, step = len(scene.t), scene.t, scene.track.step
    moving = np.abs(np.gradient(scene.track.parameters["ballast"], step)) > 1.0
    duty = (autoregressive(rng, (n,), 1.0, 400.0 / step) > 0.8) & ~moving
    pump = 2.5 * first_order(moving.astype(float), step, 3.0) + 0.02 * rng.normal(size=n)
    motor = 0.8 * first_order(duty.astype(float), step, 8.0) * (1.0 + 0.1 * np.sin(t / 700.0))
    scene.logged["amps_a"] = (pump, "A")
    scene.logged["amps_b"] = (motor + 0.005 * rng.normal(size=n), "A")
    fin = np.round(first_order(autoregressive(rng, (n,), 12.0, 240.0 / step), step, 5.0), 1)
    scene.logged["p17"] = (fin, "deg")
    day = 0.8 * np.sin(2 * np.pi * t / 86400.0 + rng.uniform(0, 6.28)) + autoregressive(
        rng, (n,), 0.25, 4000.0 / step
    )
    scene.water = scene.water + day
    scene.logged["sensor_temperature"] = (first_order(scene.water, step, 300.0), "degC")
    scene.logged["water_temperature"] = (scene.water, "degC")
    bay = first_order(scene.water, step, 20_000.0) + first_order(0.6 * pump, step, 5000.0)
    scene.logged["bay_temperature"] = (bay, "degC")


# ---- the effects -------------------------------------------------------------------------------------------


CALIBRATED_AT = 4.5
"""Mean temperature of the instrument during the calibration, degC."""
SWING = {"battpos": 0.6, "ballast": 200.0}
"""Amplitude of the masses' motion in a survey, in their units."""
FIN = np.radians(12.0)
"""Usual deflection of the fin, rad."""


# ---- the instrument: heat, shocks, age; its converter, filter, clock and range ----------------------


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


def jump(scene: Scene, size: float, rng: Generator) -> None:
    """Shift the offset by a shock and relax it within a minute; the size is the amplitude in nT."""
    t0 = rng.uniform(0.15, 0.85) * scene.t[-1]
    settled = np.where(scene.t > t0, 1.0 - 0.15 * np.exp(-np.maximum(scene.t - t0, 0.0) / 20.0), 0.0)
    vector = size * direction(rng)
    scene.add(settled, vector)
    scene.record_truth(vector)


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
        out[rows, rng.integers(0, 3, 12)] += (
            size * rng.choice([-1.0, 1.0], 12) * 2.0 ** rng.integers(0, 3, 12)
        )
        return out

    scene.bend.append(bend)


# ---- the surroundings: the Earth's field, the map of it, machines -----------------------------------


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
        scene.reference = scene.reference + size * rng.normal() * np.exp(
            -0.5 * far / (width * rng.uniform(0.5, 1.0)) ** 2
        )


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


# ---- the vehicle: currents, iron that moves, remembers or is strained, conductors -------------------


def wires(scene: Scene, size: float, rng: Generator) -> None:
    """Add the field of a motor's supply loop at 30 cm (Biot-Savart); the size is in nT/A."""
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
    """Add the field of a magnet on a fin's lever; the size is in nT at a deflection of 12 deg."""
    arm, m = np.array([0.08, 0.0, 0.0]), direction(rng)
    place = np.array([-0.5, 0.1, 0.1]) + 0.1 * rng.normal(size=3)

    def own_columns(angle: Array) -> Array:
        turn = rotation(0.0, 0.0, np.degrees(angle))
        return dipole_field(-(place + turn.apply(arm)), turn.apply(m))

    low, middle, high = own_columns(np.array([-FIN, 0.0, FIN]))
    moved = own_columns(np.radians(scene.logged["p17"][0])) - middle
    scene.field = scene.field + size * moved / (0.5 * float(np.linalg.norm(high - low)))


def neighbours(scene: Scene, size: float, rng: Generator) -> None:
    """Add the field of two masses that magnetise each other, which no cubic fits; the size is in nT."""
    x, y = (scene.track.parameters[name] / SWING[name] for name in ("battpos", "ballast"))
    curved = (35 * x**4 - 30 * x**2 + 3) / 8 + rng.normal(0, 0.5) * x**3 * y
    scene.add(np.tanh(0.5 * curved), size * direction(rng))


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


# ---- a deployment with effects -----------------------------------------------------------------------------


FINER = 5
"""Factor by which the simulation's grid is refined if the instrument has a filter or channel delays."""


def _interpolate(scene: Scene) -> tuple[Array, Array, float]:
    """Return field (nT), water temperature (degC) and step (s) on a finer grid.

    A spline interpolates the Earth's part of the field, because linear interpolation would cause errors in
    delayed channels. The interpolation of the rest is linear, because masses start and stop abruptly.
    """
    track, t = scene.track, scene.t
    turn = rotation(track.roll, track.pitch, track.heading)
    earth = turn.apply(turn.apply(scene.field).mean(axis=0), inverse=True)
    fine = np.linspace(0.0, t[-1], FINER * (len(t) - 1) + 1)
    rest = [np.interp(fine, t, values) for values in (scene.field - earth).T]
    field = np.column_stack(rest) + CubicSpline(t, earth)(fine)
    return field, np.interp(fine, t, scene.water), track.step / FINER


def _samples(scene: Scene, rng: np.random.Generator) -> Samples:
    """Return the samples of the scene's instrument, with the effects on the digitised channels."""
    track = scene.track
    if scene.earth.any():
        turn = rotation(track.roll, track.pitch, track.heading)
        scene.field = scene.field + turn.apply(scene.earth, inverse=True)
    field, water, step = scene.field, scene.water, track.step
    if scene.instrument.corner or any(scene.instrument.channel_delay):
        field, water, step = _interpolate(scene)
    samples = scene.instrument.measure(field, water, step, scene.when, rng)
    for bend in scene.bend:
        samples = replace(samples, channels=bend(samples.channels))
    return samples


def disturb(
    twin: Twin,
    hidden: tuple[HiddenEffect, ...],
    track: Track,
    time: Array,
    seed: int = 0,
    effects: Mapping[str, Effect] = EFFECTS,
) -> xr.Dataset:
    """Return the deployment measured along `track` with `hidden` effects, by their names in `effects`.

    `time` (m,) are the times of the samples, s after the track's start, up to a few seconds before its end.
    `seed` determines the telemetry that :func:`furnish` adds to that of :meth:`~sitl.twin.Twin.measure`.
    ``attrs["truth"]`` (JSON) holds the parameters that a perfect diagnosis would report for a single effect.
    """
    ambient = twin.ambient(track)
    scene = Scene(
        track,
        time,
        field=ambient.field,
        earth=np.zeros_like(ambient.field),
        water=ambient.water,
        instrument=twin.scenario.instrument,
        reference=np.zeros(len(time)),
    )
    furnish(scene, np.random.default_rng([seed, 77]))
    for one in hidden:
        effects[one.name](scene, one.size, np.random.default_rng([one.seed, 78]))
    out = twin.log(track, time, ambient.earth, _samples(scene, twin.instrument_rng()))
    if "reference_field" in out:  # scene.reference is the amount by which it is too small
        known = out["reference_field"]
        out["reference_field"] = "time", known.to_numpy() - scene.reference, known.attrs
    seen = np.clip(time - scene.late, 0.0, None)
    logged = dict(scene.logged)
    if scene.late:
        logged |= {name: (values, out[name].attrs["units"]) for name, values in track.parameters.items()}
    for name, (values, unit) in logged.items():
        attrs = {"units": unit, "long_name": name.replace("_", " ")}
        out[name] = ("time", np.interp(seen, track.elapsed, values), attrs)
    out.attrs["truth"] = msgspec.json.encode(scene.truth).decode()
    return out
