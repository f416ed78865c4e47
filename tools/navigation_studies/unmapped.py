"""Vehicles that nobody gave a map: surveys over random rock, and what localisation makes of them."""

from __future__ import annotations

import time as clock
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.estimation.residual import rms
from magbridge.navigate.options import Options
from magbridge.navigate.own_survey import localise
from magbridge.navigate.reference_track import errors
from navigation_studies.simulated import HOUR, PLACE, Map, adrift, synthetic
from sitl.signals import autoregressive

__all__ = ["AIRCRAFT", "GLIDER", "Located", "Vehicle", "located", "survey"]


@dataclass(frozen=True)
class Vehicle:
    """What flies a survey that crosses itself.

    Attributes
    ----------
    options : Options
        Those its errors are drawn from, and that localisation is given.
    hours, speed, every : float
        h, m/s, and s between samples.
    leg : (float, float)
        s, shortest and longest leg of a survey.
    star : bool
        Whether every leg turns by 125 to 150 degrees; else they zigzag out along an axis, and back.
    extent : float
        m, half the side of the rock.
    """

    options: Options
    hours: float
    speed: float
    every: float
    leg: tuple[float, float]
    star: bool
    extent: float


GLIDER = Vehicle(
    Options(start_sigma=20.0, current_sigma=0.02, drift=0.2, bias_sigma=0.5, bias_time=1800.0, map_sigma=0.0),
    hours=6.0,
    speed=0.35,
    every=4.0,
    leg=(1500.0, 3600.0),
    star=False,
    extent=10_000.0,
)
"""A current of 2 cm/s is what is left when its mean is known from the last surfacings."""
AIRCRAFT = Vehicle(
    Options(
        start_sigma=10.0, current_sigma=0.5, current_time=3600.0, drift=0.1,
        bias_sigma=0.5, bias_time=1800.0, map_sigma=0.0,
    ),
    hours=100 / 60,
    speed=70.0,
    every=1.0,
    leg=(150.0, 250.0),
    star=True,
    extent=30_000.0,
)  # fmt: skip
"""100 minutes with an inertial platform that drifts by a nautical mile an hour."""


class Located(NamedTuple):
    """One survey: RMS in m over the whole track, NEES over its two degrees of freedom, processor seconds."""

    error: float
    reckoned: float  # of dead reckoning alone
    sigma: float
    bound: float
    nees: float
    valid: float  # share of the time
    seconds: float


def located(vehicle: Vehicle, kind: Map, seed: int) -> Located:
    """Fly a survey and localise it."""
    flown = survey(vehicle, kind, seed)
    begun = clock.process_time()
    track = localise(flown, vehicle.options, start=PLACE)
    seconds = clock.process_time() - begun
    off, reckoned = (one.to_numpy() for one in errors(track))
    nn, ne, ee = (track[f"covariance_{axes}"].to_numpy() for axes in ("nn", "ne", "ee"))
    north, east = track["error_north"].to_numpy(), track["error_east"].to_numpy()
    nees = (ee * north**2 - 2.0 * ne * north * east + nn * east**2) / (nn * ee - ne**2)
    return Located(
        rms(off),
        rms(reckoned),
        rms(np.sqrt(nn + ee)),
        rms(track["bound_sigma"].to_numpy()),
        float(nees.mean()) / 2,
        float(track["valid"].mean()),
        seconds,
    )


def survey(vehicle: Vehicle, kind: Map, seed: int) -> xr.Dataset:
    """Return a survey's measurements by a vehicle whose drift nobody knows, with its true track."""
    rng, o = np.random.default_rng([seed, 44]), vehicle.options
    velocity = _velocity(vehicle, rng)
    n = len(velocity)
    errors = autoregressive(rng, (n,), o.bias_sigma, o.bias_time / vehicle.every) + rng.normal(size=n)
    grid = synthetic(kind, seed, vehicle.extent)
    return adrift(grid, o, rng, velocity, errors, np.ones(n), every=vehicle.every)


def _velocity(vehicle: Vehicle, rng: np.random.Generator) -> FloatArray:
    """Return velocities (n, 2), m/s north and east, of legs of a random shape."""
    n = int(vehicle.hours * HOUR / vehicle.every)
    leg = np.arange(n) // int(rng.uniform(*vehicle.leg) / vehicle.every)
    first = rng.uniform(0.0, 360.0)
    if vehicle.star:
        turns = rng.uniform(125.0, 150.0, leg[-1] + 1)
        heading = np.radians(first + np.cumsum(turns)[leg])
    else:
        back = 180.0 * (leg >= (leg[-1] + 1) // 2)
        heading = np.radians(first + back + rng.uniform(35.0, 65.0) * np.where(leg % 2, 1.0, -1.0))
    return vehicle.speed * np.column_stack([np.cos(heading), np.sin(heading)])
