"""Hide an effect in a simulated deployment, with finer physics than anyone would fit to it.

It shares nothing with the detector: heat soaks through a slab where the detector has two lags in series,
steel has a Preisach distribution where it has one play operator, currents flow in wires with a shape, filters
and converters are the instrument's own, the ionosphere has a spectrum. Each effect is one function of the
:class:`~.scene.Scene`, a size, and a random generator that draws its direction, place and time. An effect is
proportional to its size as far as physics allows. Properties of the vehicle or its instrument are drawn from
the seed of :class:`~.scene.HiddenEffect` alone, so they are the same on every deployment.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import msgspec
import numpy as np
import xarray as xr
from scipy.interpolate import CubicSpline

from sitl.inject.effects import EFFECTS
from sitl.inject.scene import Array, Effect, HiddenEffect, Scene, furnish
from sitl.instrument import Samples, rotation
from sitl.trajectory import Track
from sitl.twin import Twin

__all__ = ["EFFECTS", "HiddenEffect", "disturb"]

FINER = 5
"""Factor by which the simulation's grid is refined if the instrument has a filter or channel delays."""


def _interpolate(scene: Scene) -> tuple[Array, Array, float]:
    """Return field, water temperature and step on a finer grid.

    The Earth's part of the field turns with the vehicle and is interpolated by a spline, because a delayed
    channel would see the error of a straight line. The rest is interpolated linearly: masses start and stop
    abruptly.
    """
    track, t = scene.track, scene.t
    turn = rotation(track.roll, track.pitch, track.heading)
    earth = turn.apply(turn.apply(scene.field).mean(axis=0), inverse=True)
    fine = np.linspace(0.0, t[-1], FINER * (len(t) - 1) + 1)
    rest = [np.interp(fine, t, values) for values in (scene.field - earth).T]
    field = np.column_stack(rest) + CubicSpline(t, earth)(fine)
    return field, np.interp(fine, t, scene.water), track.step / FINER


def _samples(scene: Scene, rng: np.random.Generator) -> Samples:
    """Return what the scene's instrument gives, the effects on the channels after it included."""
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
    """Measure along `track` with `hidden` effects, by their names in `effects`.

    Without any, the furnished deployment alone is returned. The triples are taken at `time` (m,), s after the
    track's start, up to a few seconds before its end. `seed` is that of the telemetry that has nothing to do
    with the effects. The deployment has more telemetry than that of :meth:`~sitl.twin.Twin.measure`;
    ``attrs["truth"]`` (JSON) holds what a perfect diagnosis would print of a single effect, where physics has
    such numbers.
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
    if "reference_field" in out:  # `reference` is by how much the true field exceeds it
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
