"""Hide an effect in a simulated deployment, with finer physics than anyone would fit to it.

It shares nothing with the detector: heat soaks through a slab where the detector has one time constant, steel has a
Preisach distribution where it has one backlash, currents flow in wires with a shape, filters and converters are the
instrument's own, the ionosphere has a spectrum. Each effect is one function of the :class:`Scene`, a size and a stream
of random numbers that draw its direction, place and time; sizes are proportional to what they do, as far as physics lets them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from dataclasses import field as attribute

import msgspec
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sitl.instrument import Instrument, Samples, rotation
from sitl.signals import autoregressive, first_order
from sitl.trajectory import Track
from sitl.twin import Twin
from sitl.world import MU_0_OVER_4_PI, dipole_field, to_local

__all__ = ["EFFECTS", "FOREIGN", "Hidden", "Scene", "disturb", "furnish"]

Array = NDArray[np.float64]
Generator = np.random.Generator


@dataclass
class Scene:
    """What an effect may change, on the simulation's fine grid of n points; m rows are logged.

    Attributes
    ----------
    track : Track
    when : array (m,)
        s after the start, of the rows.
    field : array (n, 3)
        nT at the sensor, body axes.
    earth : array (n, 3)
        nT NED that the reference does not know of.
    water : array (n,)
        degC.
    instrument : Instrument
    late : float
        s by which the telemetry's stamps are behind.
    logged : dict of (array (n,), unit)
        Further telemetry.
    reference : array (m,)
        nT by which the reference is too small.
    bend : list of callable
        What happens to the channels (m, 3) after the analogue chain.
    """

    track: Track
    when: Array
    field: Array
    earth: Array
    water: Array
    instrument: Instrument
    late: float = 0.0
    logged: dict[str, tuple[Array, str]] = attribute(default_factory=dict)
    reference: Array = attribute(default_factory=lambda: np.zeros(1))
    bend: list[Callable[[Array], Array]] = attribute(default_factory=list)

    @property
    def t(self) -> Array:
        """S after the start, (n,)."""
        return self.track.elapsed


Effect = Callable[[Scene, float, Generator], None]


class Hidden(msgspec.Struct, frozen=True):
    """One hidden effect: its name in :data:`EFFECTS` or :data:`FOREIGN`, its size, and the seed of all else."""

    name: str
    size: float
    seed: int


def _direction(rng: Generator) -> Array:
    d = rng.normal(size=3)
    return np.asarray(d / np.linalg.norm(d))


def furnish(scene: Scene, rng: Generator) -> None:
    """Log what any vehicle logs, whether it matters or not: two motors' currents, a fin, three temperatures."""
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


def soaked(surface: Array, step: float, lag: float) -> Array:
    """Temperature in the middle of a slab whose faces follow `surface`: the series of Carslaw & Jaeger 1959, sec. 3.4.

    ``lag`` is the slowest mode's time constant, s.
    """
    modes = range(8)
    weights = np.array([4.0 * (-1) ** k / (np.pi * (2 * k + 1)) for k in modes])
    parts = [first_order(surface, step, lag / (2 * k + 1) ** 2) for k in modes]
    return np.asarray((weights / weights.sum()) @ np.array(parts))


def heat_offset(scene: Scene, size: float, rng: Generator) -> None:
    """An offset that follows the core's temperature; size in nT/degC."""
    core = soaked(scene.logged["sensor_temperature"][0], scene.track.step, float(rng.uniform(300, 4000)))
    scene.field = scene.field + size * _direction(rng) * (core - core[0] + 0.5 * rng.normal())[:, None]


def heat_scale(scene: Scene, size: float, rng: Generator) -> None:
    """Copper in the coils: gains follow the core's temperature; size in 1/degC, times 5e4."""
    core = soaked(scene.logged["sensor_temperature"][0], scene.track.step, float(rng.uniform(300, 4000)))
    gains = (
        1.0 + size / 5e4 * np.abs(rng.normal(1.0, 0.4, 3)) * (core - core[0] + 0.5 * rng.normal())[:, None]
    )
    scene.field = scene.field * gains


def jump(scene: Scene, size: float, rng: Generator) -> None:
    """A shock: the offset jumps and settles within a minute; size in nT."""
    t0 = rng.uniform(0.15, 0.85) * scene.t[-1]
    settled = np.where(scene.t > t0, 1.0 - 0.15 * np.exp(-np.maximum(scene.t - t0, 0.0) / 20.0), 0.0)
    scene.field = scene.field + size * _direction(rng) * settled[:, None]


def creep(scene: Scene, size: float, rng: Generator) -> None:
    """Stress relaxes logarithmically (magnetic viscosity: Street & Woolley 1949); size in nT over the log."""
    tau = rng.uniform(0.3, 1.5) * scene.t[-1]
    scene.field = (
        scene.field
        + size * _direction(rng) * (np.log1p(scene.t / tau) / np.log1p(scene.t[-1] / tau))[:, None]
    )


def wires(scene: Scene, size: float, rng: Generator) -> None:
    """A motor's supply loop: four straight wires by Biot and Savart; size times the field of a loop 30 cm away."""
    name = str(rng.choice(["amps_a", "amps_b"]))
    centre, u = 0.3 * _direction(rng), _direction(rng)
    v = np.cross(u, _direction(rng))
    corners = centre + 0.05 * np.array([u + v, u - v, -u - v, -u + v])
    total = np.zeros(3)
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        points = a + (b - a) * (np.arange(200)[:, None] + 0.5) / 200
        dl = np.broadcast_to((b - a) / 200, points.shape)
        r = -points
        total += MU_0_OVER_4_PI * np.sum(np.cross(dl, r) / np.linalg.norm(r, axis=1)[:, None] ** 3, axis=0)
    scene.field = scene.field + size * total / np.linalg.norm(total) * scene.logged[name][0][:, None]


def magnet_on_fin(scene: Scene, size: float, rng: Generator) -> None:
    """A magnet on a lever that another actuator turns: a dipole that moves and turns; size in nT over the travel."""
    angle = np.radians(scene.logged["p17"][0])
    arm, m = np.array([0.08, 0.0, 0.0]), _direction(rng)
    place = np.array([-0.5, 0.1, 0.1]) + 0.1 * rng.normal(size=3)
    turn = rotation(0.0, 0.0, np.degrees(angle))
    own = dipole_field(-(place + turn.apply(arm)), turn.apply(m))
    own -= own[0]
    scene.field = scene.field + size * own / np.std(np.linalg.norm(own, axis=1))


def neighbours(scene: Scene, size: float, rng: Generator) -> None:
    """Two masses that magnetise each other, and a field too curved for a cubic; size in nT."""
    x, y = (_unit(scene.track.parameters[name]) for name in ("battpos", "ballast"))
    curved = (35 * x**4 - 30 * x**2 + 3) / 8 + rng.normal(0, 0.5) * x**3 * y
    scene.field = scene.field + size * _direction(rng) * np.tanh(0.5 * curved)[:, None]


def _unit(p: Array) -> Array:
    return np.asarray(2.0 * (p - p.min()) / (np.ptp(p) + 1e-12) - 1.0)


def preisach(scene: Scene, size: float, rng: Generator) -> None:
    """Steel in the battery's path, remagnetised as it moves: relays of many widths (Preisach 1935); size in nT."""
    x = _unit(scene.track.parameters["battpos"])
    centres, widths = rng.normal(0, 0.35, 80), rng.lognormal(np.log(0.5), 0.4, 80)
    total = np.zeros(len(x))
    for c, w in zip(centres, widths, strict=True):
        up, down = x >= c + w / 2, x <= c - w / 2
        last = np.maximum.accumulate(np.where(up | down, np.arange(len(x)), 0))
        state = np.where(up[last], 1.0, -1.0)
        # what does not depend on the past belongs to the position, and to any calibration
        total += state - np.where(x >= c, 1.0, -1.0)
    scene.field = scene.field + size * _direction(rng) * (total / 80)[:, None]


def ring(scene: Scene, size: float, rng: Generator) -> None:
    """A conducting ring with inductance, where its own field stands across its axis; size in s times the field's change.

    A dipole n seen from p is ``3 p (p . n) - n``: at the magic angle, ``(p . n)^2 = 1/3``, it has nothing along n.
    """
    normal = np.eye(3)[rng.integers(3)] + 0.05 * rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    side = np.cross(normal, _direction(rng))
    place = normal / np.sqrt(3.0) + side / np.linalg.norm(side) * np.sqrt(2.0 / 3.0)
    flux = first_order(scene.field @ normal, scene.track.step, float(rng.uniform(0.05, 0.3)))
    shape = 3 * place * (place @ normal) - normal
    scene.field = scene.field - size * shape * np.gradient(flux, scene.track.step)[:, None]


def multiplexed(scene: Scene, size: float, rng: Generator) -> None:
    """The converter takes the channels in turn, and nobody says so; size in s between channels."""
    order = rng.choice([-1.0, 1.0])
    delays = (0.0, size, 2 * size) if order > 0 else (2 * size, size, 0.0)
    scene.instrument = msgspec.structs.replace(scene.instrument, channel_delay=delays)


def anti_alias(scene: Scene, size: float, rng: Generator) -> None:  # noqa: ARG001  (a filter has no direction)
    """A slow RC before the converter; size its time constant in s."""
    scene.instrument = msgspec.structs.replace(scene.instrument, corner=1.0 / (2 * np.pi * max(size, 1e-6)))


def late_stamps(scene: Scene, size: float, rng: Generator) -> None:  # noqa: ARG001  (a clock has no direction)
    """The telemetry's clock is behind; size in s."""
    scene.late = size


def core(scene: Scene, size: float, rng: Generator) -> None:
    """The feedback's finite gain lets the core's curve through; size in nT at 50,000 nT."""
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


def squeezed(scene: Scene, size: float, rng: Generator) -> None:
    """Hull and mount under pressure, with a little creep; size in nT at 100 m."""
    strain = scene.track.depth / 100.0 * (1.0 + 0.03 * scene.track.depth / 100.0)
    strain = 0.93 * strain + 0.07 * first_order(strain, scene.track.step, 120.0)
    scene.field = scene.field + size * _direction(rng) * strain[:, None]


def ionosphere(scene: Scene, size: float, rng: Generator) -> None:
    """Sq's four harmonics, the ocean's tide and a substorm's tail, mostly along north; size in nT."""
    hours = scene.t / 3600.0
    total = sum(
        amplitude * np.cos(2 * np.pi * hours / period + rng.uniform(0, 2 * np.pi))
        for period, amplitude in ((24.0, 1.0), (12.0, 0.6), (8.0, 0.35), (6.0, 0.15), (12.42, 0.2))
    )
    scene.earth = scene.earth + size * np.outer(total - np.mean(total), [0.7, 0.2, 0.68])


def bad_map(scene: Scene, size: float, rng: Generator) -> None:
    """The map lacks some bodies: bumps a kilometre or so across; size in nT."""
    seen = scene.track.at(scene.when)
    origin = float(scene.track.latitude[0]), float(scene.track.longitude[0])
    north, east = to_local(seen["latitude"], seen["longitude"], origin)
    width = 0.35 * max(np.ptp(north), np.ptp(east))
    for _ in range(3):
        k = rng.integers(len(north))
        far = (north - north[k]) ** 2 + (east - east[k]) ** 2
        scene.reference = scene.reference + size * rng.normal() * np.exp(
            -0.5 * far / (width * rng.uniform(0.5, 1.0)) ** 2
        )


def wrong_level(scene: Scene, size: float, rng: Generator) -> None:
    """The main-field model is off at this site, and the slope of it a little; size in nT."""
    along = scene.when / scene.when[-1] - 0.5
    scene.reference = scene.reference + size * (1.0 + 0.02 * rng.normal() * along)


def hum(scene: Scene, size: float, rng: Generator) -> None:
    """A machine's field at a steady frequency with a second harmonic, seen through the sampling; size in nT."""
    f = rng.uniform(0.1, 0.4) * scene.instrument.rate
    phase = 2 * np.pi * f * scene.t + 0.1 * np.sin(scene.t / 3000.0)
    a, b = _direction(rng), _direction(rng)
    scene.field = scene.field + size * (np.outer(np.cos(phase), a) + np.outer(np.sin(phase + 0.3), 0.5 * b))


def bit_flips(scene: Scene, size: float, rng: Generator) -> None:
    """A bus drops bits now and then: a dozen samples are off by about `size` nT, on any channel."""

    def bend(H: Array) -> Array:
        rows = rng.choice(len(H) // 4, 12, replace=False) * 4
        out = H.copy()
        out[rows, rng.integers(0, 3, 12)] += (
            size * rng.choice([-1.0, 1.0], 12) * 2.0 ** rng.integers(0, 3, 12)
        )
        return out

    scene.bend.append(bend)


def relay(scene: Scene, size: float, rng: Generator) -> None:
    """A payload that nothing logs switches on and off; size in nT."""
    flips = np.cumsum(rng.exponential(1500.0, 60))
    state = np.searchsorted(flips, scene.t) % 2
    scene.field = scene.field + size * _direction(rng) * state[:, None]


def ship(scene: Scene, size: float, rng: Generator) -> None:
    """A ship passes: a distant dipole on a straight course; size in nT at its nearest."""
    t0 = rng.uniform(0.3, 0.7) * scene.t[-1]
    r = np.column_stack([4.0 * (scene.t - t0), np.full_like(scene.t, 900.0), np.full_like(scene.t, -50.0)])
    own = dipole_field(r, np.broadcast_to(_direction(rng), r.shape))
    scene.earth = scene.earth + size * own / np.linalg.norm(own, axis=1).max()


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
"""Cause, as the contract names it -> what is hidden."""
FOREIGN: dict[str, Effect] = {"relay": relay, "ship": ship}
"""Effects that the contract has no name for."""


class _Tap(Instrument, frozen=True):
    """The instrument, with something between the vehicle and it."""

    through: Callable[[Array, Array], Scene] | None = None

    def measure(self, field: Array, water: Array, step: float, when: Array, rng: Generator) -> Samples:
        assert self.through is not None
        scene = self.through(field, water)
        if scene.earth.any():
            track = scene.track
            turn = rotation(track.roll, track.pitch, track.heading)
            scene.field = scene.field + turn.apply(scene.earth, inverse=True)
        samples = scene.instrument.measure(scene.field, scene.water, step, when, rng)
        channels = samples.channels
        for bend in scene.bend:
            channels = bend(channels)
        return Samples(channels, samples.times, samples.temperature, samples.power_cycle)


def disturb(twin: Twin, hidden: tuple[Hidden, ...], track: Track, when: Array, seed: int = 0) -> xr.Dataset:
    """Measure along `track` with `hidden` effects; without any, the furnished deployment alone.

    Parameters
    ----------
    twin : Twin
    hidden : tuple of Hidden
    track : Track
    when : array (m,)
        s after the track's start; a few seconds short of its end.
    seed : int
        Of what is logged beside and does not matter.

    Returns
    -------
    Dataset (time)
        As :meth:`~sitl.twin.Twin.measure`, with more telemetry.
    """
    plain = twin.scenario.instrument
    scenes: list[Scene] = []

    def through(field: Array, water: Array) -> Scene:
        scene = Scene(track, when, field, np.zeros_like(field), water, plain, reference=np.zeros(len(when)))
        furnish(scene, np.random.default_rng([seed, 77]))
        for one in hidden:
            effect = EFFECTS.get(one.name) or FOREIGN[one.name]
            effect(scene, one.size, np.random.default_rng([one.seed, 78]))
        scenes.append(scene)
        return scene

    tap = _Tap(**{name: getattr(plain, name) for name in plain.__struct_fields__}, through=through)
    out = replace(twin, scenario=msgspec.structs.replace(twin.scenario, instrument=tap)).measure(track, when)
    scene = scenes[0]
    # the truth is larger than the reference by so much
    out["reference_field"] = (
        "time",
        out["reference_field"].to_numpy() - scene.reference,
        out["reference_field"].attrs,
    )
    seen = np.clip(when - scene.late, 0.0, None)
    logged = dict(scene.logged)
    if scene.late:
        logged |= {name: (values, out[name].attrs["units"]) for name, values in track.parameters.items()}
    for name, (values, unit) in logged.items():
        attrs = {"units": unit, "long_name": name.replace("_", " ")}
        out[name] = ("time", np.interp(seen, track.elapsed, values), attrs)
    return out
