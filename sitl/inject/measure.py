"""Measure along a track with hidden effects."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import msgspec
import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from sitl.inject.scene import Effect, Hidden, Scene, furnish
from sitl.instrument import Instrument, Samples, rotation
from sitl.trajectory import Track
from sitl.twin import Twin

__all__ = ["measure"]

Array = NDArray[np.float64]
FINER = 5
"""Factor by which the simulation's grid is refined if the instrument has a filter or channel delays."""


class _Tap(Instrument, frozen=True):
    """The instrument, with effects on the field before it and on the channels after it."""

    through: Callable[[Array, Array], Scene] | None = None

    def measure(
        self, field: Array, water: Array, step: float, when: Array, rng: np.random.Generator
    ) -> Samples:
        assert self.through is not None
        scene = self.through(field, water)
        if scene.earth.any():
            track = scene.track
            turn = rotation(track.roll, track.pitch, track.heading)
            scene.field = scene.field + turn.apply(scene.earth, inverse=True)
        field, water = scene.field, scene.water
        if scene.instrument.corner or any(scene.instrument.channel_delay):
            field, water, step = _between(scene)
        samples = scene.instrument.measure(field, water, step, when, rng)
        channels = samples.channels
        for bend in scene.bend:
            channels = bend(channels)
        return Samples(channels, samples.times, samples.temperature, samples.power_cycle)


def _between(scene: Scene) -> tuple[Array, Array, float]:
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


def measure(
    effects: Mapping[str, Effect],
    twin: Twin,
    hidden: tuple[Hidden, ...],
    track: Track,
    when: Array,
    seed: int,
) -> xr.Dataset:
    """Measure with the `hidden` effects, looked up in `effects`; arguments as :func:`sitl.inject.disturb`."""
    plain = twin.scenario.instrument
    scenes: list[Scene] = []

    def through(field: Array, water: Array) -> Scene:
        scene = Scene(track, when, field, np.zeros_like(field), water, plain, reference=np.zeros(len(when)))
        furnish(scene, np.random.default_rng([seed, 77]))
        for one in hidden:
            effects[one.name](scene, one.size, np.random.default_rng([one.seed, 78]))
        scenes.append(scene)
        return scene

    tap = _Tap(**{name: getattr(plain, name) for name in plain.__struct_fields__}, through=through)
    out = replace(twin, scenario=msgspec.structs.replace(twin.scenario, instrument=tap)).measure(track, when)
    scene = scenes[0]
    # `reference` is by how much the true field exceeds the logged reference
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
    out.attrs["truth"] = msgspec.json.encode(scene.truth).decode()
    return out
