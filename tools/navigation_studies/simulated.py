"""Simulated gliders on simulated maps, and how they navigated: what tools/navigation.py tabulates."""

from __future__ import annotations

import time as clock
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from math import inf
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy.stats import chi2

from magbridge.arrays import BoolArray, FloatArray, IntArray
from magbridge.estimation.residual import rms
from magbridge.field.geodesy import metres_per_degree, offset
from magbridge.field.grid import AnomalyGrid
from magbridge.field.igrf import total_field
from magbridge.navigate.bound import position_bound
from magbridge.navigate.collect import Collector
from magbridge.navigate.deadreckoning import DeadReckoning
from magbridge.navigate.model import Block, block_length
from magbridge.navigate.navigator import Navigator
from magbridge.navigate.options import Options
from magbridge.navigate.record import State
from sitl.signals import autoregressive

START = 1_386_201_600.0
"""s, 2013-12-05."""
PLACE = (49.5, -57.9)
"""deg, Bonne Bay."""
HOUR = 3600.0
SPEEDS = (0.35, 0.25, 0.5)
"""m/s, from run to run."""
LEFT = {"auto": 0.5, "nominal": 125.0}
"""nT, slow, beside 1 nT of white noise: what tools/accuracy.py finds on a survey, auto rounded up."""
GLIDER = Options(current_sigma=0.05, bias_sigma=LEFT["auto"], bias_time=1800.0, map_sigma=1.0, interval=40.0)
"""A glider moves 14 m in 40 s: less than 2 % of any correlation length here."""
AT_HOURS = (3.0, 4.0, 5.0, 6.0)
OUTSIDE = float(chi2.ppf(0.9999, 2))
"""Squared distance beyond which the filter is wrong."""


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


def track_over(
    grid: AnomalyGrid,
    options: Options,
    seed: int,
    *,
    hours: float = 6.0,
    speed: float = 0.35,
    every: float = 4.0,
    jump: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> xr.Dataset:
    """Return a deployment drawn from the options' own model: legs of 45 minutes at random headings.

    A sample has 1 nT of white noise.

    Parameters
    ----------
    grid : AnomalyGrid
        The true anomaly, of which the filter's map differs by the options' map error.
    options : Options
        The filter's.
    seed : int
        Of everything that is drawn.
    hours : float
        How long it lasts.
    speed : float
        m/s through the water.
    every : float
        s between samples.
    jump : (hour, north, east)
        Metres by which the vehicle is displaced at once, unnoticed by its dead reckoning.
    """
    rng = np.random.default_rng(seed)
    n = int(hours * HOUR / every)
    legs = np.cumsum(rng.uniform(-100.0, 100.0, n // int(2700 / every) + 1)) + rng.uniform(0.0, 360.0)
    heading = np.radians(legs[np.arange(n) // int(2700 / every)])
    bias = autoregressive(rng, (n,), options.bias_sigma, options.bias_time / every)
    errors = bias + rng.normal(size=n)
    velocity = speed * np.column_stack([np.cos(heading), np.sin(heading)])
    return adrift(grid, options, rng, velocity, errors, np.ones(n), every=every, jump=jump)


def adrift(
    grid: AnomalyGrid,
    options: Options,
    rng: np.random.Generator,
    velocity: FloatArray,
    errors: FloatArray,
    sigma: FloatArray,
    *,
    every: float = 4.0,
    jump: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> xr.Dataset:
    """Return the measurements of a vehicle that moves through water with a current, over a map with errors.

    Parameters
    ----------
    grid, options
        As for :func:`track_over`.
    rng : Generator
        Of current, drift, start and the map's error.
    velocity : FloatArray, (n, 2)
        m/s north and east through the water, each `every` s up to its sample.
    errors, sigma : FloatArray, (n,)
        nT: errors of the corrected total field, and the 1-sigma that the calibration claims.
    every, jump
        As for :func:`track_over`.
    """
    o, n = options, len(velocity)
    time = START + every * np.arange(1, n + 1)
    current = autoregressive(rng, (n, 2), o.current_sigma, o.current_time / every)
    drift = rng.normal(size=(n, 2)) * o.drift * every**0.5
    away = rng.normal(size=2) * o.start_sigma + np.cumsum(current * every + drift, axis=0)
    away[time > START + jump[0] * HOUR] += jump[1:]
    metres = every * float(np.hypot(*velocity.T).mean())
    errors = errors + autoregressive(rng, (n,), o.map_sigma, o.map_length / metres)
    reckoned, true = np.empty((n, 2)), np.empty((n, 2))
    where = PLACE
    for i, (north, east) in enumerate((every * velocity).tolist()):
        where = offset(*where, north, east)
        reckoned[i], true[i] = where, offset(*where, *away[i].tolist())
    anomaly = np.nan_to_num(grid.evaluate(true[:, 1], true[:, 0]).anomaly)
    columns = {
        "total_field": total_field(true[:, 1], true[:, 0], 30.0, time) + anomaly + errors,
        "total_field_sigma": sigma,
        "velocity_north": velocity[:, 0],
        "velocity_east": velocity[:, 1],
        "depth": np.full(n, 30.0),
        "truth_latitude": true[:, 0],
        "truth_longitude": true[:, 1],
        "away_north": away[:, 0],
        "away_east": away[:, 1],
    }
    return xr.Dataset({k: ("time", v) for k, v in columns.items()}, {"time": time}, {"source": "voyage"})


@dataclass(frozen=True)
class Run:
    """The result of one track; arrays over the records."""

    hours: FloatArray
    error: FloatArray  # m
    nees: FloatArray  # squared distance of the truth, two degrees of freedom
    state: IntArray
    valid: BoolArray
    bound: float  # m, RMS of the second half
    unaided: float  # m, the same of dead reckoning alone
    length: float  # m, correlation length of the map
    seconds: float  # of a processor, a sample

    @property
    def second_half(self) -> BoolArray:
        """Records of the second half."""
        return np.asarray(self.hours > 0.5 * self.hours[-1])

    def score(self) -> Score:
        """Return what the tables need."""
        half = self.second_half
        away = longest(self.nees > OUTSIDE, self.hours)
        return Score(
            drms=rms(self.error[half]),
            bound=self.bound,
            unaided=self.unaided,
            lost=longest(self.nees[half] > OUTSIDE, self.hours[half]) > 0.5,
            nees=float(np.mean(self.nees[half])) / 2,
            at_hours=tuple(self.nees[np.searchsorted(self.hours, AT_HOURS) - 1].tolist()),
            false_alarm=bool((self.state == State.LOST).any()) and away <= 0.1,
            valid=float(np.mean(self.valid)),
            waited=float(self.hours[self.valid][0]) if self.valid.any() else inf,
            seconds=self.seconds,
        )


class Score(NamedTuple):
    """One run in numbers: errors in m over the second half; NEES over its two degrees of freedom."""

    drms: float
    bound: float
    unaided: float
    lost: bool  # the truth lay outside for half an hour on end, in the second half
    nees: float
    at_hours: tuple[float, ...]  # NEES at AT_HOURS
    false_alarm: bool  # said to be lost, and the truth was never outside for more than 6 minutes
    valid: float  # share of the time
    waited: float  # hours, until its position was first valid
    seconds: float  # of a processor, a sample


def longest(flags: BoolArray, hours: FloatArray) -> float:
    """Return the longest time, in hours, that the flags were set without a break."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    spans = [hours[min(b, hours.size) - 1] - hours[a] for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return float(max(spans, default=0.0))


def sail(ds: xr.Dataset, grid: AnomalyGrid, options: Options) -> Run:
    """Run the navigator over a track."""
    navigator = Navigator(grid, options)
    every = float(ds["time"][1] - ds["time"][0])
    navigator.fix(round(1e6 * (float(ds["time"][0]) - every)), *PLACE)
    begun = clock.process_time()
    found = []
    for t, motion, field, sigma in telemetry(ds):
        navigator.telemetry(round(1e6 * (t - every)), **motion)
        record = navigator.measure(round(1e6 * t), field, sigma)
        if record is not None:
            place, spread = navigator.estimate.x[:2], navigator.estimate.P[:2, :2].ravel()
            found.append((record.time_us * 1e-6, *place, *spread, record.state, record.valid))
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
        options,
        float(ds["total_field_sigma"].median()),
        30.0,
        every,
    )
    half = best.time > 0.5 * (best.time[0] + best.time[-1])
    return Run(
        (table[:, 0] - START) / HOUR,
        np.hypot(*error.T),
        nees,
        table[:, 7].astype(int),
        table[:, 8] > 0,
        rms(best.sigma[half]),
        rms(best.unaided[half]),
        grid.correlation_length,
        seconds / ds.sizes["time"],
    )


def blocks(ds: xr.Dataset, grid: AnomalyGrid, options: Options) -> Iterator[tuple[Block, float]]:
    """Yield the measurements that the navigator makes of a track, and the metres travelled until each."""
    where = DeadReckoning()
    where.place(*PLACE)
    collector = Collector(options, block_length(grid))
    every = float(ds["time"][1] - ds["time"][0])
    for t, motion, field, sigma in telemetry(ds):
        where.telemetry(t - every, motion)
        where.advance(t)
        block = collector.add(round(t * 1e6), where, field, sigma)
        if block is not None:
            yield block, where.travelled


def telemetry(ds: xr.Dataset) -> Iterator[tuple[float, dict[str, float], float, float]]:
    """Yield the time of each sample, the motion up to it, the total field and its sigma."""
    motion = {name: ds[name].to_numpy().tolist() for name in ("velocity_north", "velocity_east", "depth")}
    columns = [ds[name].to_numpy().tolist() for name in ("time", "total_field", "total_field_sigma")]
    for t, field, sigma, *moved in zip(*columns, *motion.values(), strict=True):
        yield t, dict(zip(motion, moved, strict=True)), field, sigma
