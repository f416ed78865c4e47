"""Add a hidden effect to a simulated deployment, with a finer model than the detector's.

Each effect is a function of the :class:`Scene`, a size, and a random generator for its direction, place and
time. An effect is proportional to its size as far as physics allows. Properties of the vehicle or its
instrument depend only on the seed of :class:`HiddenEffect`, so they are the same in every deployment. This
module has the effects of the built-in scenarios; ``tools/effects.py`` has those of the studies.
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
from sitl.world import MU_0_OVER_4_PI

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


SWING = {"battpos": 0.6, "ballast": 200.0}
"""Amplitude of the masses' motion in a survey, in their units."""


def jump(scene: Scene, size: float, rng: Generator) -> None:
    """Shift the offset by a shock and relax it within a minute; the size is the amplitude in nT."""
    t0 = rng.uniform(0.15, 0.85) * scene.t[-1]
    settled = np.where(scene.t > t0, 1.0 - 0.15 * np.exp(-np.maximum(scene.t - t0, 0.0) / 20.0), 0.0)
    vector = size * direction(rng)
    scene.add(settled, vector)
    scene.record_truth(vector)


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


def neighbours(scene: Scene, size: float, rng: Generator) -> None:
    """Add the field of two masses that magnetise each other, which no cubic fits; the size is in nT."""
    x, y = (scene.track.parameters[name] / SWING[name] for name in ("battpos", "ballast"))
    curved = (35 * x**4 - 30 * x**2 + 3) / 8 + rng.normal(0, 0.5) * x**3 * y
    scene.add(np.tanh(0.5 * curved), size * direction(rng))


EFFECTS: dict[str, Effect] = {
    "offset_step": jump,
    "current_field": wires,
    "actuator_order": neighbours,
}
"""Functions that add the effects of the built-in scenarios, by the cause's public name."""


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
