"""Simulate deployments from a scenario and a seed.

>>> from sitl.scenario import load
>>> deployment = simulate(load("demo"), seed=1)
>>> sorted(deployment.sizes)
['time']
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.calibration.file import load as load_calibration
from magbridge.errors import FormatError, WrongUse
from magbridge.field.geodesy import offset, separation, wrap
from magbridge.field.grid import AnomalyGrid
from magbridge.field.igrf import total_field
from magbridge.field.reference import with_true_heading
from sitl.dataset import dataset
from sitl.instrument import Samples, rotation
from sitl.platform import Calibrated, Vehicle, draw_vehicle
from sitl.scenario import Scenario
from sitl.trajectory import Track, fly
from sitl.world import World

__all__ = ["FINE_STEP", "TEMPERATURE", "Ambient", "Twin", "placed_at", "simulate", "simulate_like"]

FINE_STEP = 0.5
"""Interval between the simulation's points, s: in a spiral, linear interpolation is exact to 0.1 nT."""
TEMPERATURE = "sensor_temperature"
"""Column of the fluxgate's temperature, which is always simulated, even if a log drives the twin."""
FIELD_STEP = 4.0
"""Interval of the Earth's field evaluations, s: linear interpolation is exact to 0.01 nT."""


class Ambient(NamedTuple):
    """Field and temperature at an instrument, on a track's grid of n points."""

    earth: FloatArray
    """Earth's field (n, 3), nT, north-east-down."""
    field: FloatArray
    """Field at the sensor (n, 3), nT, body axes, including the vehicle's."""
    water: FloatArray
    """Water temperature (n,), degC."""


@dataclass(frozen=True)
class Twin:
    """World and vehicle of a scenario, with all that the scenario leaves open drawn from a seed."""

    scenario: Scenario
    seed: int
    world: World
    vehicle: Vehicle | Calibrated

    @classmethod
    def draw(cls, scenario: Scenario, seed: int) -> Twin:
        """Return a twin of the scenario; draw from the seed what the scenario leaves open.

        World, vehicle, mission, instrument and telemetry have separate random streams, so that a change of
        one does not change the others.
        """
        place = scenario.world
        world = World.draw(
            (place.latitude, place.longitude),
            scenario.start.timestamp(),
            place.geology,
            place.water,
            _stream(seed, 0),
        )
        vehicle: Vehicle | Calibrated
        if scenario.calibration is not None:
            vehicle = Calibrated(load_calibration(scenario.calibration))
        else:
            vehicle = scenario.vehicle or draw_vehicle(_stream(seed, 1), scenario.masses)
        return cls(scenario, seed, world, vehicle)

    def fly(self) -> Track:
        """Return the track of the scenario's mission.

        Raises
        ------
        WrongUse
            The scenario has no mission.
        """
        rng = _stream(self.seed, 2)
        limits = self.scenario.all_limits
        legs = [leg for part in self.scenario.mission for leg in part.legs(rng, limits)]
        if not legs:
            raise WrongUse(
                f"scenario {self.scenario.name!r} has no mission: drive it with a log (--trajectory-from)"
            )
        start = (self.scenario.start.timestamp(), *self.world.origin)
        step = min(FINE_STEP, 1 / self.scenario.instrument.rate)
        return fly(legs, start, step, rng, self.scenario.motion, limits)

    def measure(self, track: Track, time: FloatArray) -> xr.Dataset:
        """Return the deployment measured along a track at `time` (n,), s after the track's start.

        The deployment has the standard columns and ``truth_*``. With the channel delays, `time` must lie
        within the track.
        """
        ambient = self.ambient(track)
        samples = self.scenario.instrument.measure(
            ambient.field, ambient.water, track.step, time, self.instrument_rng()
        )
        return self.log(track, time, ambient.earth, samples)

    def ambient(self, track: Track) -> Ambient:
        """Return field and temperature at the instrument along a track."""
        earth = self._earth_field(track)
        attitude = rotation(track.roll, track.pitch, track.heading)
        water = self.world.water.temperature(track.depth) if track.water is None else track.water
        field = self.vehicle.field(
            attitude.apply(earth, inverse=True), self._channels(track, water), track.start + track.elapsed
        )
        return Ambient(earth, field, water)

    def instrument_rng(self) -> np.random.Generator:
        """Return the generator of the instrument's offsets at power-on and of its noise."""
        return _stream(self.seed, 3)

    def log(self, track: Track, time: FloatArray, earth: FloatArray, samples: Samples) -> xr.Dataset:
        """Return the deployment of an instrument's samples at `time` (m,), s after the track's start.

        `earth` (n, 3) is :attr:`Ambient.earth`.
        """
        true = track.pose_at(time)
        field_ned = np.column_stack([np.interp(time, track.elapsed, b) for b in earth.T])
        field_body = rotation(true["roll"], true["pitch"], true["heading"]).apply(field_ned, inverse=True)
        columns = self._telemetry(true, time) | {
            TEMPERATURE: samples.temperature,
            "power_cycle": samples.power_cycle,
            "truth_total_field": np.linalg.norm(field_ned, axis=1),
            "truth_latitude": true["latitude"],
            "truth_longitude": true["longitude"],
        }
        for k, axis in enumerate("xyz"):
            columns[f"mag_{axis}"] = samples.channels[:, k]
            columns[f"truth_field_{axis}"] = field_body[:, k]
            if any(self.scenario.instrument.channel_delay):
                columns[f"mag_time_{axis}"] = track.start + samples.times[:, k]
        if track.run is not None:
            columns["run"] = track.run[np.rint(time / track.step).astype(np.intp)]
        reference = self.scenario.telemetry.reference
        if reference == "true":
            columns["reference_field"] = columns["truth_total_field"]
        elif reference == "map":
            columns["reference_field"] = self._map_reference(columns, track.start + time)
        return dataset(track, time, columns, self.scenario.name)

    def anomaly_map(self) -> AnomalyGrid:
        """Return the aeromagnetic map of the scenario's world: see :meth:`World.anomaly_map`."""
        geology, altitude = self.scenario.world.geology, self.scenario.telemetry.map_altitude
        return self.world.anomaly_map(
            self.scenario.start.timestamp(),
            altitude,
            extent=0.75 * geology.extent,
            spacing=(geology.top + altitude) / 3,  # the width of an anomaly is about the depth of its source
        )

    def _earth_field(self, track: Track) -> FloatArray:
        """Return the Earth's field (n, 3), nT NED, on the track's grid, interpolated from fewer points."""
        stride = max(1, int(FIELD_STEP / track.step))
        points = np.unique(np.append(np.arange(0, len(track.depth), stride), len(track.depth) - 1))
        when = track.start + track.step * points
        field = self.world.field(when, track.latitude[points], track.longitude[points], track.depth[points])
        grid = np.arange(len(track.depth))
        return np.column_stack([np.interp(grid, points, component) for component in field.T])

    def _channels(self, track: Track, water: FloatArray) -> dict[str, FloatArray]:
        """Return the channels (n,) on which the vehicle's field depends, by name."""
        known = track.pose_at(track.elapsed)
        known[TEMPERATURE] = self.scenario.instrument.temperature(water, track.step)
        for name in self.vehicle.channels:
            if name not in known:
                raise WrongUse(
                    f"scenario {self.scenario.name!r}: nothing drives {name!r}; there are {', '.join(known)}"
                )
        return {name: known[name] for name in self.vehicle.channels}

    def _telemetry(self, true: dict[str, FloatArray], time: FloatArray) -> dict[str, FloatArray]:
        """Return the telemetry: attitude and position with simulated errors, other quantities unchanged."""
        settings, rng = self.scenario.telemetry, _stream(self.seed, 4)
        seen = dict(true)
        for name in ("roll", "pitch"):
            seen[name] = true[name] + rng.normal(0, settings.roll_pitch_sigma, len(time))
        seen["heading"] = (true["heading"] + rng.normal(0, settings.heading_sigma, len(time))) % 360
        north, east = separation(*self.world.origin, true["latitude"], true["longitude"])
        current = rng.normal(0, settings.drift, 2)
        seen["latitude"], seen["longitude"] = offset(
            *self.world.origin, north - current[0] * time, east - current[1] * time
        )
        return seen

    def _map_reference(self, columns: dict[str, FloatArray], time: FloatArray) -> FloatArray:
        """Return the IGRF plus the map's anomaly, nT, at the vehicle's logged position (paper, eq. 4)."""
        latitude, longitude = columns["latitude"], columns["longitude"]
        main = total_field(longitude, latitude, columns["depth"], time)
        return main + self.anomaly_map().evaluate(longitude, latitude).anomaly


def simulate(scenario: Scenario, seed: int = 0) -> xr.Dataset:
    """Simulate a deployment, with ``truth_*`` in addition to the columns of any deployment.

    ``attrs["segments"]`` lists the parts of the mission (JSON: name, first and last time in s since 1970);
    :func:`sitl.segments` splits them.
    """
    twin = Twin.draw(scenario, seed)
    track = twin.fly()
    last = track.elapsed[-1] - max(scenario.instrument.channel_delay)
    when = np.arange(0.0, last, 1 / scenario.instrument.rate)
    if scenario.hidden:
        return _with_hidden(twin, track, when)
    return twin.measure(track, when)


def _with_hidden(twin: Twin, track: Track, moment: FloatArray) -> xr.Dataset:
    """Return the deployment of a track at the times `moment` (m,), s, with each effect in its segment only.

    Simulations with and without an effect have the same noise, so their segments fit together.
    """
    from sitl.inject import HiddenEffect, disturb  # noqa: PLC0415 - the effects simulate with twins

    out = disturb(twin, (), track, moment, twin.seed)
    spans = {name: (begin, end) for name, begin, end in json.loads(out.attrs["segments"])}
    time = out["time"].to_numpy()
    for number, one in enumerate(twin.scenario.hidden):
        if one.segment not in spans:
            raise WrongUse(f"scenario {twin.scenario.name!r}: no segment {one.segment!r}")
        effect = HiddenEffect(one.effect, one.size, twin.seed + number)
        other = disturb(twin, (effect,), track, moment, twin.seed)
        begin, end = spans[one.segment]
        there = (time >= begin) & (time <= end)
        for name in other.data_vars:
            out[name] = out[name].where(~there, other[name])
    return out


def _stream(seed: int, hidden: int) -> np.random.Generator:
    return np.random.default_rng([seed, hidden])


# ---- the forward model driven by a log's attitude, position and masses -------------------------------------


POINTS = 8
"""Number of the simulation's points between two rows of a slow log."""


def simulate_like(log: xr.Dataset, scenario: Scenario, seed: int = 0) -> xr.Dataset:
    """Simulate what the scenario's vehicle and instrument would have measured in a logged deployment.

    The `log` has attitude, position, depth and the position of every moving mass of the scenario. A missing
    value is interpolated in time; before the first and after the last value, that value is held. The
    scenario's mission, place and start are not used. The `seed` determines what the scenario leaves open, and
    the noise.

    The result has the log's rows and columns. ``mag_*``, ``sensor_temperature``, ``power_cycle``, ``truth_*``
    and, if the scenario has one, ``reference_field`` are simulated, with the log's attitude and position as
    the truth.

    Raises
    ------
    FormatError
        The log lacks a column that the forward model needs, or such a column has no value.
    """
    twin = Twin.draw(placed_at(log, scenario), seed)
    measured = twin.measure(*read_track(log, scenario, twin.vehicle.channels))
    replaced = [name for name in log.data_vars if str(name).startswith(("mag_", "reference_field"))]
    own = [
        name
        for name in measured.data_vars
        if str(name).startswith(("mag_", "truth_", "reference_field", "sensor_temp", "power_cycle"))
    ]
    out = log.drop_vars(replaced).assign(
        {name: ("time", measured[name].data, measured[name].attrs) for name in own}
    )
    out.attrs["source"] = f"simulated: {scenario.name}, driven by {log.attrs.get('source', 'a log')}"
    return out


def placed_at(log: xr.Dataset, scenario: Scenario) -> Scenario:
    """Return the scenario at the log's median position, starting at the log's first time."""
    latitude, longitude = (float(np.nanmedian(_column(log, name))) for name in ("latitude", "longitude"))
    start = datetime.fromtimestamp(float(log["time"][0]), UTC)
    return scenario.replace(world={"latitude": latitude, "longitude": wrap(longitude)}, start=start)


def read_track(log: xr.Dataset, scenario: Scenario, channels: Sequence[str]) -> tuple[Track, FloatArray]:
    """Return a log's track with these `channels` on a uniform grid, and its times, s after the start."""
    log = with_true_heading(log)
    time = log["time"].to_numpy().astype(np.float64)
    if len(time) < 2:
        raise FormatError(_source(log), "at least two rows")
    when = time - time[0]
    step = max(FINE_STEP, float(np.median(np.diff(when))) / POINTS)
    last = when[-1] + max(scenario.instrument.channel_delay)
    grid = np.arange(0.0, last + 2 * step, step)

    def column(name: str) -> FloatArray:
        value = _column(log, name)
        known = np.isfinite(value)
        return np.interp(grid, when[known], value[known])

    track = Track(
        start=float(time[0]),
        step=step,
        latitude=column("latitude"),
        longitude=wrap(column("longitude")),
        depth=column("depth"),
        roll=column("roll"),
        pitch=column("pitch"),
        heading=column("heading"),
        parameters={name: column(name) for name in channels if name != TEMPERATURE},
        water=column("water_temperature") if "water_temperature" in log else None,
    )
    return track, when


def _column(log: xr.Dataset, name: str) -> FloatArray:
    """Return a column (n,), with NaN for missing values; heading and longitude are unwrapped (deg)."""
    if name not in log:
        there = ", ".join(map(str, log))
        raise FormatError(_source(log), f"the forward model needs it; there are {there}", column=name)
    value = log[name].to_numpy().astype(np.float64)
    known = np.isfinite(value)
    if not known.any():
        raise FormatError(_source(log), "a value in at least one row", column=name)
    if name in ("heading", "longitude"):
        value[known] = np.unwrap(value[known], period=360)
    return value


def _source(log: xr.Dataset) -> str:
    return str(log.attrs.get("source", "the log"))
