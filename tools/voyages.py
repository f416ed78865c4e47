"""Simulated gliders on simulated maps, and what the navigator made of them: what tools/navigation.py tabulates."""

from __future__ import annotations

import time as clock
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from math import exp

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.stats import chi2

from magbridge.field.earth import metres_per_degree, offset
from magbridge.field.grid import AnomalyGrid
from magbridge.field.igrf import total_field
from magbridge.navigate.bound import position_bound
from magbridge.navigate.collect import Collector
from magbridge.navigate.deadreckoning import DeadReckoning
from magbridge.navigate.model import Block, Options, block_length
from magbridge.navigate.navigator import Navigator
from magbridge.navigate.record import State

Array = NDArray[np.float64]

START = 1_386_201_600.0  # s, 2013-12-05
PLACE = (49.5, -57.9)  # deg, Bonne Bay
HOUR = 3600.0
OUTSIDE = float(chi2.ppf(0.9999, 2))  # squared distance: the truth is not where the filter says


@dataclass(frozen=True)
class Map:
    """A synthetic anomaly: its scatter nT, correlation length m, and spectrum."""

    rms: float
    length: float
    rough: bool = False  # waves down to a quarter of the length, as k^-3, instead of a Gaussian

    def __str__(self) -> str:
        return f"{self.rms:g} nT, {self.length:g} m{', rough' if self.rough else ''}"


@cache
def synthetic(kind: Map, seed: int, extent: float = 16_000.0) -> AnomalyGrid:
    """Return a random map: the sum of 600 plane waves."""
    rng = np.random.default_rng(seed)
    size = 600
    k = rng.normal(size=(size, 2))
    if kind.rough:  # wavenumbers between 1/2 and 4 over the length, fewer the finer
        k *= (0.5 * 8.0 ** (rng.uniform(size=size) ** 2) / np.linalg.norm(k, axis=1))[:, None]
    k, phase = k / kind.length, rng.uniform(0.0, 2.0 * np.pi, size)
    y = np.arange(-extent, extent + 1.0, kind.length / (16 if kind.rough else 8))
    east, north = np.exp(1j * np.outer(y, k[:, 0])), np.exp(1j * (np.outer(y, k[:, 1]) + phase))
    values = np.real(north @ east.T)
    per_latitude, per_longitude = metres_per_degree(PLACE[0])
    return AnomalyGrid(
        PLACE[1] + y / per_longitude, PLACE[0] + y / per_latitude, kind.rms * values / values.std()
    )


def voyage(
    grid: AnomalyGrid,
    options: Options,
    seed: int,
    *,
    sigma: float = 1.0,
    hours: float = 6.0,
    speed: float = 0.35,
    every: float = 4.0,
    jump: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> xr.Dataset:
    """Return a deployment drawn from the very model that the options state: legs of 45 minutes at random headings.

    Parameters
    ----------
    jump : (hour, north, east)
        Metres by which the vehicle is carried off at once, unknown to itself.
    """
    rng = np.random.default_rng(seed)
    n = int(hours * HOUR / every)
    time = START + every * np.arange(1, n + 1)
    legs = np.cumsum(rng.uniform(-100.0, 100.0, n // int(2700 / every) + 1)) + rng.uniform(0.0, 360.0)
    heading = legs[np.arange(n) // int(2700 / every)]
    o = options
    current = _markov(rng, n, o.current_sigma, every / o.current_time, 2)
    drift = rng.normal(size=(n, 2)) * o.drift * every**0.5
    away = rng.normal(size=2) * o.start_sigma + np.cumsum(current * every + drift, axis=0)
    away[time > START + jump[0] * HOUR] += jump[1:]
    errors = (
        _markov(rng, n, o.bias_sigma, every / o.bias_time)[:, 0]
        + _markov(rng, n, o.map_sigma, every * speed / o.map_length)[:, 0]
        + rng.normal(size=n) * sigma
    )
    reckoned, true = np.empty((n, 2)), np.empty((n, 2))
    where = PLACE
    for i, along in enumerate(np.radians(heading)):
        where = offset(*where, speed * every * float(np.cos(along)), speed * every * float(np.sin(along)))
        reckoned[i], true[i] = where, offset(*where, *away[i].tolist())
    anomaly = np.nan_to_num(grid.evaluate(true[:, 1], true[:, 0]).anomaly)
    columns = {
        "total_field": total_field(true[:, 1], true[:, 0], 30.0, time) + anomaly + errors,
        "total_field_sigma": np.full(n, sigma),
        "heading": heading % 360.0,
        "water_speed": np.full(n, speed),
        "depth": np.full(n, 30.0),
        "truth_latitude": true[:, 0],
        "truth_longitude": true[:, 1],
        "away_north": away[:, 0],
        "away_east": away[:, 1],
    }
    return xr.Dataset(
        {k: ("time", v) for k, v in columns.items()}, {"time": time}, {"source": f"voyage {seed}"}
    )


def _markov(rng: np.random.Generator, n: int, sigma: float, decay: float, size: int = 1) -> Array:
    """Return n steps of `size` Gauss-Markov processes, each step `decay` correlation times long."""
    kept = exp(-decay)
    noise = rng.normal(size=(n, size)) * sigma
    noise[1:] *= (1.0 - kept * kept) ** 0.5
    for i in range(1, n):
        noise[i] += kept * noise[i - 1]
    return noise


@dataclass(frozen=True)
class Run:
    """What one voyage came to; arrays over the records."""

    hours: Array
    error: Array  # m
    nees: Array  # squared distance of the truth, two degrees of freedom
    state: NDArray[np.int64]
    vouched: NDArray[np.bool_]
    bound: float  # m, second half
    length: float  # m, correlation length of the map
    seconds: float
    samples: int

    @property
    def drms(self) -> float:
        """Error of the second half, m."""
        return float(np.sqrt(np.mean(self.error[self._second] ** 2)))

    @property
    def _second(self) -> NDArray[np.bool_]:
        return self.hours > 0.5 * self.hours[-1]

    @property
    def lost(self) -> bool:
        """Whether the truth lay outside for half an hour on end, in the second half."""
        return (
            self.outside(0.5) and longest(self.nees[self._second] > OUTSIDE, self.hours[self._second]) > 0.5
        )

    def outside(self, hours: float) -> bool:
        """Whether the truth ever lay outside for so long."""
        return longest(self.nees > OUTSIDE, self.hours) > hours

    @property
    def flagged(self) -> bool:
        """Whether the filter ever said it was lost."""
        return bool((self.state == State.LOST).any())


def longest(flags: NDArray[np.bool_], hours: Array) -> float:
    """Return how long, in hours, the flags stood at most."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    spans = [hours[min(b, hours.size) - 1] - hours[a] for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return float(max(spans, default=0.0))


def sail(ds: xr.Dataset, grid: AnomalyGrid, options: Options, truth: Options | None = None) -> Run:
    """Run the navigator over a voyage; `truth` is what the bound is told, if not the same."""
    navigator = Navigator(grid, options)
    time_us = np.round(ds["time"].to_numpy() * 1e6).astype(int).tolist()
    columns = [
        ds[name].to_numpy().tolist()
        for name in ("heading", "water_speed", "depth", "total_field", "total_field_sigma")
    ]
    navigator.fix(time_us[0] - int(1e6 * float(ds["time"][1] - ds["time"][0])), *PLACE)
    begun = clock.process_time()
    found = []
    first = True
    for t, heading, speed, depth, field, sigma in zip(time_us, *columns, strict=True):
        if first:
            navigator.telemetry(time_us[0] - 4_000_000, heading=heading, speed=speed, depth=depth)
            first = False
        record = navigator.measure(t, field, sigma)
        navigator.telemetry(t, heading=heading, speed=speed, depth=depth)
        if record is not None:
            found.append(
                (
                    record.time_us * 1e-6,
                    *navigator.x[:2],
                    *navigator.P[:2, :2].ravel(),
                    record.state,
                    record.vouched,
                )
            )
    seconds = clock.process_time() - begun
    table = np.array(found, float)
    away = np.stack(
        [np.interp(table[:, 0], ds["time"], ds[f"away_{axis}"]) for axis in ("north", "east")], axis=1
    )
    error = table[:, 1:3] - away
    nees = np.einsum("ki,kij,kj->k", error, np.linalg.inv(table[:, 3:7].reshape(-1, 2, 2)), error)
    corners = slice(None, None, 5)
    best = position_bound(
        grid,
        ds["time"].to_numpy()[corners],
        ds["truth_latitude"].to_numpy()[corners],
        ds["truth_longitude"].to_numpy()[corners],
        truth or options,
        float(ds["total_field_sigma"][0]),
        30.0,
        float(ds["time"][1] - ds["time"][0]),
    )
    half = best.time > 0.5 * (best.time[0] + best.time[-1])
    return Run(
        (table[:, 0] - START) / HOUR,
        np.hypot(*error.T),
        nees,
        table[:, 7].astype(int),
        table[:, 8] > 0,
        float(np.sqrt(np.mean(best.sigma[half] ** 2))),
        grid.correlation_length,
        seconds,
        len(time_us),
    )


def blocks(ds: xr.Dataset, grid: AnomalyGrid, options: Options) -> Iterator[tuple[Block, float]]:
    """Yield the measurements that the navigator makes of a voyage, and the metres travelled until each."""
    where = DeadReckoning()
    where.place(*PLACE)
    collector = Collector(options.interval, block_length(grid), options.noise)
    every = float(ds["time"][1] - ds["time"][0])
    columns = [
        ds[name].to_numpy().tolist()
        for name in ("heading", "water_speed", "depth", "total_field", "total_field_sigma")
    ]
    for t, heading, speed, depth, field, sigma in zip(ds["time"].to_numpy().tolist(), *columns, strict=True):
        where.telemetry(t - every, {"heading": heading, "speed": speed, "depth": depth})
        where.advance(t)
        block = collector.add(round(t * 1e6), where, field, sigma)
        if block is not None:
            yield block, where.travelled
