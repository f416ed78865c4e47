"""Tracks over a field with anomalies, for tests of bridge and autopilot in closed loop."""

from functools import cache

import numpy as np
import xarray as xr
from referee.loop import Receiver, honest, outage
from voyages import Map, synthetic

from magbridge.field.geodesy import metres_per_degree, offset
from magbridge.field.grid import AnomalyGrid
from magbridge.field.igrf import total_field
from magbridge.navigate import NavigationOptions

PLACE = (49.5, -57.9)
START = 1_780_000_000.0
LOST, BACK, LAST = 60.0, 840.0, 900.0
"""Times at which GPS is lost, GPS returns and the track ends, s after the start."""
AIRCRAFT = NavigationOptions(
    start_sigma=50.0, current_sigma=4.0, current_time=3600.0, bias_sigma=2.0, map_sigma=2.0, interval=5.0,
    sigma_limit=65.0,
)  # fmt: skip
"""Navigation options for a plane in a wind of 4 m/s (1-sigma)."""
OPTIONS = NavigationOptions(start_sigma=200.0, current_sigma=0.1, bias_sigma=1.0, map_sigma=0.5, interval=4.0)


@cache
def hills(seed: int = 4) -> AnomalyGrid:
    """Return a map of 6 km by 6 km with 12 random waves of 15 nT and 80 to 300 m per radian."""
    rng = np.random.default_rng(seed)
    per_latitude, per_longitude = metres_per_degree(PLACE[0])
    along = np.arange(-3000.0, 3001.0, 20.0)
    x, y = np.meshgrid(along, along)
    anomaly = np.zeros_like(x)
    for direction, length, phase in zip(
        rng.uniform(0, 3.1, 12), rng.uniform(80, 300, 12), rng.uniform(0, 6.3, 12), strict=True
    ):
        anomaly += 15.0 * np.sin((x * np.cos(direction) + y * np.sin(direction)) / length + phase)
    return AnomalyGrid(PLACE[1] + along / per_longitude, PLACE[0] + along / per_latitude, anomaly)


def _track(
    time: np.ndarray, away: np.ndarray, velocity: np.ndarray, grid: AnomalyGrid, rng: np.random.Generator,
    depth: float,
) -> xr.Dataset:  # fmt: skip
    """Return a track at `away` (n, 2), m from :data:`PLACE`, with readings of 1 nT of noise."""
    latitude, longitude = np.array([offset(*PLACE, *row) for row in away.tolist()]).T
    anomaly = grid.evaluate(longitude, latitude).anomaly
    assert np.isfinite(anomaly).all()
    columns = {
        "truth_latitude": latitude, "truth_longitude": longitude,
        "velocity_north": velocity[:, 0], "velocity_east": velocity[:, 1],
        "total_field": total_field(longitude, latitude, depth, time) + anomaly + rng.normal(size=time.size),
        "total_field_sigma": np.ones(time.size), "depth": np.full(time.size, depth),
    }  # fmt: skip
    return xr.Dataset({name: ("time", values) for name, values in columns.items()}, {"time": time})


@cache
def passage(seed: int = 1, current: float = 0.1) -> tuple[xr.Dataset, Receiver]:
    """Return a track of two legs at 1.5 m/s through an unmeasured current (m/s, north)."""
    rng = np.random.default_rng(seed)
    time = START + np.arange(0.0, LAST + 1.0)
    heading = np.where(time - START < 0.5 * LAST, np.radians(50.0), np.radians(-40.0))
    velocity = 1.5 * np.column_stack([np.cos(heading), np.sin(heading)])
    away = np.vstack([[0.0, 0.0], np.cumsum(velocity + np.array([current, 0.0]), axis=0)[:-1]])
    return _track(time, away, velocity, hills(), rng, 2.0), outage(LOST, BACK + 1.0)


@cache
def steep_map(seed: int = 1) -> AnomalyGrid:
    """Return a map of 120 nT RMS and 1 km correlation length that extends 16 km to each side."""
    return synthetic(Map(120.0, 1000.0), seed)


def _changing_wind(rng: np.random.Generator, seconds: int) -> np.ndarray:
    """Return one wind vector a second, (n, 2) in m/s, with the statistics of :data:`AIRCRAFT`."""
    sigma, kept = AIRCRAFT.current_sigma, np.exp(-1.0 / AIRCRAFT.current_time)
    steps = sigma * np.sqrt(1.0 - kept**2) * rng.normal(size=(seconds, 2))
    wind = np.empty((seconds, 2))
    wind[0] = sigma * rng.normal(size=2)
    for k in range(1, seconds):
        wind[k] = kept * wind[k - 1] + steps[k]
    return wind


def flight(
    minutes: float,
    lost: float,
    back: float,
    receiver: Receiver = honest,
    seed: int = 1,
    turn_every: float = 300.0,
    *,
    changing_wind: bool = False,
) -> tuple[xr.Dataset, Receiver]:
    """Return a plane's flight at 22 m/s in a wind of 4 m/s, with a turn of 90 degrees every 5 minutes.

    A turn takes 6 s. There is no GPS between `lost` and `back`, s. A changing wind is a Gauss-Markov process
    with the statistics of :data:`AIRCRAFT`.
    """
    rng = np.random.default_rng(seed)
    time = START + np.arange(0.0, 60.0 * minutes + 1.0)
    seconds = time - START
    turns = (seconds % turn_every) - turn_every + 6.0 > 0.0
    radians = np.radians(30.0 + 90.0 * np.cumsum(turns) / 12.0)
    velocity = 22.0 * np.column_stack([np.cos(radians), np.sin(radians)])
    wind = _changing_wind(rng, time.size) if changing_wind else np.array([3.0, -2.6])
    away = np.vstack([[0.0, 0.0], np.cumsum(velocity + wind, axis=0)[:-1]])
    away -= 0.5 * (away.min(axis=0) + away.max(axis=0))  # centre the track on the map
    return _track(time, away, velocity, steep_map(), rng, 0.0), outage(lost, back, receiver)
