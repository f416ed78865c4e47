"""The worlds of tools/survey.py: gliders over rock that is a random Gaussian field."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.field.geodesy import metres_per_degree
from magbridge.field.igrf import igrf
from sitl import Twin, load, segments
from sitl.dataset import at_rest
from sitl.mission import CrissCross, Spirals

__all__ = ["MASSES", "NOISES", "GaussianRock", "drifted", "fly"]

MASSES = ("battpos", "ballast")
NOISES = {"1 nT white": (1.0, 0.0), "5 nT AR(1)": (5.0, 10.0)}
"""nT of a channel, and samples over which its correlation falls by e."""
WAVES = 1500
"""Plane waves of a field."""


class GaussianRock:
    """Rock whose field is a Gaussian random field in the plane, along the main field, at every depth."""

    def __init__(self, size: float, length: float, direction: FloatArray, rng: np.random.Generator) -> None:
        self.k, self.phase = rng.normal(0, 1 / length, (WAVES, 2)), rng.uniform(0, 2 * np.pi, WAVES)
        self.size, self.direction = size * np.sqrt(2 / WAVES), direction

    def anomaly(self, place: FloatArray) -> FloatArray:
        """Return nT (n,) at places (n, 2), m north and east of the world's origin."""
        out = np.empty(len(place))
        for start in range(0, len(place), 4096):
            part = slice(start, start + 4096)
            out[part] = self.size * np.cos(place[part] @ self.k.T + self.phase).sum(axis=1)
        return out

    def field(self, ned: FloatArray) -> FloatArray:
        """Return nT (n, 3), north-east-down, as the simulated world's rock does."""
        return self.anomaly(ned[:, :2])[:, None] * self.direction


def fly(
    hours: float, rock: float, length: float, noise: str, seed: int
) -> tuple[Twin, dict[str, xr.Dataset]]:
    """Return a glider in its world, its calibration runs, and its surveys on two days."""
    sigma, memory = NOISES[noise]
    same = {"hours": hours, "pitch": (25.0, 2.5), "roll": (1.0, 2.0), "battery_spread": 0.1}
    parts = [Spirals(), CrissCross(**same), CrissCross(**same, segment="another day")]  # type: ignore[arg-type]
    scenario = load("random_glider").replace(
        mission=tuple(parts), instrument={"noise_sigma": sigma, "noise_memory": memory}
    )
    twin = Twin.draw(scenario, seed)
    latitude, longitude = twin.world.origin
    when = np.array([scenario.start.timestamp()])
    main = igrf(np.array([longitude]), np.array([latitude]), np.zeros(1), when)[0]
    drawn = GaussianRock(rock, length, main / np.linalg.norm(main), np.random.default_rng([seed, 7]))
    twin = replace(twin, world=replace(twin.world, rock=drawn))  # type: ignore[arg-type]
    flown = twin.fly()
    log = twin.measure(flown, np.arange(0.0, flown.elapsed[-1] - 1.0, 1 / scenario.instrument.rate))
    return twin, {name: at_rest(part, MASSES) for name, part in segments(log).items()}


def drifted(log: xr.Dataset, by: float) -> xr.Dataset:
    """Return a log whose positions are slowly off by `by` m north and east, as dead-reckoned ones."""
    t = (log["time"] - log["time"][0]) / float(log["time"][-1] - log["time"][0])
    per_latitude, per_longitude = metres_per_degree(float(log["latitude"].mean()))
    north, east = by * np.sin(2.2 * np.pi * t + 0.3), by * (np.cos(1.7 * np.pi * t) - 1.0)
    return log.assign(
        latitude=log["latitude"] + north / per_latitude, longitude=log["longitude"] + east / per_longitude
    )
