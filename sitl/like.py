"""The forward model driven by a real log's attitude, position and masses; the rest is simulated."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.errors import FormatError
from magbridge.field.geodesy import wrap
from magbridge.field.reference import with_true_heading
from sitl.scenario import Scenario
from sitl.trajectory import Track
from sitl.twin import FINE_STEP, TEMPERATURE, Twin

__all__ = ["placed_at", "simulate_like"]

POINTS = 8
"""Points of the simulation between two rows of a slow log."""


def simulate_like(log: xr.Dataset, scenario: Scenario, seed: int = 0) -> xr.Dataset:
    """Simulate what the scenario's vehicle and instrument would have measured in a logged deployment.

    The `log` has attitude, position, depth and the position of every moving mass of the scenario. A lacking
    value is interpolated in time; before the first and after the last one it is held. The scenario's mission,
    place and start are not used. `seed` is that of what the scenario leaves open, and of the noise.

    The result has the log's rows and columns, with ``mag_*``, ``sensor_temperature``, ``power_cycle``,
    ``truth_*`` and, as the scenario asks, ``reference_field`` simulated; the log's attitude and position are
    the truth.

    Raises
    ------
    FormatError
        The log lacks a column that the forward model needs, or one holds nothing.
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
    """Return a log's track with these `channels` on a uniform grid, and the times in s from its start."""
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
    """Return a column (n,), NaN where it lacks a value; angles without their jumps by 360 deg."""
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
