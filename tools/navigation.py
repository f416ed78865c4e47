"""How well the navigator holds a position: simulated gliders on simulated maps, beside the bound and beside peers.

    python tools/navigation.py [--runs 100] [--part accuracy|watch|calibration|speed|peers ...] [--out DIR]

accuracy      error over the posterior Cramér-Rao bound, lost runs, consistency, for narrow and wide starts
watch         how soon a filter that was put in the wrong place says so, and how often one says so in error
calibration   the same maps with the errors that nominal, cubic and auto calibrations leave
speed         one update, 100,000 samples, the start
peers         Stone Soup's particle filter on one of the problems; MagNav.jl's published flight
"""

from __future__ import annotations

import argparse
import time as clock
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from math import exp

import numpy as np
import xarray as xr
from msgspec.structs import replace as with_options
from numpy.typing import NDArray
from scipy.stats import chi2

from magbridge.field.earth import metres_per_degree, offset
from magbridge.field.grid import AnomalyGrid
from magbridge.field.igrf import total_field
from magbridge.navigate.bound import position_bound
from magbridge.navigate.model import Options
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


MAPS = (Map(60, 2000), Map(60, 800), Map(20, 1000), Map(20, 1000, rough=True), Map(5, 1000), Map(1, 2000))


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


# ---- the tables ---------------------------------------------------------------------------------------------

GLIDER = Options(current_sigma=0.05, bias_sigma=1.0, map_sigma=1.0)


def one(kind: Map, options: Options, sigma: float, seed: int) -> Run:
    grid = synthetic(kind, seed % 10)
    return sail(voyage(grid, options, 1000 + seed, sigma=sigma), grid, options)


def many(pool: ProcessPoolExecutor, runs: int, kind: Map, options: Options, sigma: float) -> list[Run]:
    return list(pool.map(partial(one, kind, options, sigma), range(runs), chunksize=4))


def row(label: str, runs: Sequence[Run]) -> list[str]:
    """Return one line of the accuracy table."""
    drms, bound = np.array([r.drms for r in runs]), np.array([r.bound for r in runs])
    consistent = np.mean([np.mean(r.nees[r.hours > 0.5 * r.hours[-1]]) / 2 for r in runs])
    ends = np.array([r.nees[[np.searchsorted(r.hours, h) - 1 for h in (3, 4, 5, 6)]] for r in runs]).mean(
        axis=0
    )
    low, high = chi2.ppf([0.005, 0.995], 2 * len(runs)) / len(runs)
    return [
        label,
        f"{np.median(drms):.0f}",
        f"{np.median(bound):.0f}",
        f"{np.median(drms) / np.median(bound):.2f}",
        f"{np.percentile(drms / bound, 90):.2f}",
        f"{100 * np.mean([r.lost for r in runs]):.0f}",
        f"{consistent:.2f}",
        f"{np.mean((ends > low) & (ends < high)):.2f}",
        f"{100 * np.mean([r.flagged and not r.outside(0.1) for r in runs]):.0f}",
        f"{100 * np.mean([np.mean(r.vouched) for r in runs]):.0f}",
        f"{1e3 * np.mean([r.seconds / r.samples for r in runs]):.2f}",
    ]


HEAD = (
    "map, start", "DRMS m", "bound m", "ratio", "90 %", "lost %", "NEES/2", "in bounds", "false alarm %", "vouched %", "ms/sample",
)  # fmt: skip


def accuracy(pool: ProcessPoolExecutor, runs: int) -> None:
    """Narrow and wide starts on every map; 1 nT white, 1 nT of bias and of map error."""
    print(
        f"\n## Accuracy: {runs} runs of 6 h a row, 0.35 m/s, sigma 1 nT, bias 1 nT, map error 1 nT, current 0.05 m/s\n"
    )
    table = [HEAD]
    for kind in MAPS:
        length = synthetic(kind, 0).correlation_length
        for name, share in (("narrow", 0.2), ("wide", 1.0)):
            options = with_options(GLIDER, start_sigma=share * length)
            table.append(row(f"{kind}; {name} {share * length:.0f} m", many(pool, runs, kind, options, 1.0)))
            show(table)


def calibration(pool: ProcessPoolExecutor, runs: int) -> None:
    """Fly the same maps with what each calibration leaves on a survey (SCIENCE, section 3): white and slow part."""
    print(f"\n## What calibration buys: {runs} runs a row, wide start of one correlation length\n")
    table = [("calibration: white, slow nT", *HEAD)]
    for kind in (Map(60, 2000), Map(20, 1000)):
        for name, white, slow in CALIBRATIONS:
            length = synthetic(kind, 0).correlation_length
            options = with_options(GLIDER, start_sigma=length, bias_sigma=slow, bias_time=1800.0)
            table.append(
                (f"{name}: {white:g}, {slow:g}", *row(str(kind), many(pool, runs, kind, options, white)))
            )
            show(table)


CALIBRATIONS = (("nominal", 1.0, 160.0), ("cubic", 1.0, 7.2), ("auto", 1.0, 0.6))
"""Survey errors after each fit with 1 nT white noise: medians over simulated gliders; replaced by --calibration."""


def carried(kind: Map, seed: int) -> tuple[float, float]:
    """Carry a tracking vehicle off by 1.5 lengths at 2 h; return as :func:`silence`."""
    grid = synthetic(kind, seed % 10)
    rng = np.random.default_rng(seed)
    length, angle = 1.5 * grid.correlation_length, rng.uniform(0.0, 2.0 * np.pi)
    options = with_options(GLIDER, start_sigma=0.2 * grid.correlation_length)
    away = (2.0, float(length * np.cos(angle)), float(length * np.sin(angle)))
    return silence(sail(voyage(grid, options, 5000 + seed, jump=away), grid, options))


def misled(kind: Map, seed: int) -> tuple[float, float]:
    """Start a filter that claims a tenth of a length, and is one length off; return as :func:`silence`."""
    grid = synthetic(kind, seed % 10)
    options = with_options(GLIDER, start_sigma=1.0 * grid.correlation_length)
    ds = voyage(grid, options, 7000 + seed)
    return silence(sail(ds, grid, with_options(options, start_sigma=0.1 * grid.correlation_length)))


def silence(run: Run) -> tuple[float, float]:
    """Return for how many hours on end the filter vouched for a place where it was not; and was not there at all."""
    outside = (run.nees > OUTSIDE) & (run.error > 0.25 * run.length)
    return longest(outside & run.vouched, run.hours), longest(outside, run.hours)


def watch(pool: ProcessPoolExecutor, runs: int) -> None:
    """How soon a lost filter stops vouching for itself."""
    print(
        f"\n## A lost filter says so: {runs} runs of 6 h a row; lost: the truth is outside the 99.99 % ellipse,\na quarter of a correlation length away or more\n"
    )
    table = [("how, map", "lost %", "vouches under 30 min %", "longest, 95 %, min", "found in 2 h %")]
    for how in (carried, misled):
        for kind in MAPS[:4]:
            spans = np.array(list(pool.map(partial(how, kind), range(runs), chunksize=4)))
            lost = spans[spans[:, 1] > 0]
            table.append(
                (
                    f"{how.__name__}; {kind}",
                    f"{100 * len(lost) / len(spans):.0f}",
                    f"{100 * np.mean(lost[:, 0] <= 0.5):.0f}",
                    f"{60 * np.percentile(lost[:, 0], 95):.0f}",
                    f"{100 * np.mean(lost[:, 1] <= 2.0):.0f}",
                )
            )
            show(table)


def speed(_pool: ProcessPoolExecutor, _runs: int) -> None:
    """Time the pieces on one core."""
    from magbridge.navigate.batch import navigate  # noqa: PLC0415
    from magbridge.navigate.model import Block, prior, transition  # noqa: PLC0415
    from magbridge.navigate.tracker import Tracker  # noqa: PLC0415

    kind = Map(30, 1500)
    grid = synthetic(kind, 3, 40_000.0)
    options = with_options(GLIDER, start_sigma=50.0)
    tracker = Tracker(grid, *prior(options), options.gate)
    block = Block(int(START * 1e6), *PLACE, grid.look_up(PLACE[1], PLACE[0]).anomaly, 1.0, 0.0, 0.0)
    moved = transition(options, 4.0, 1.4)
    begun = clock.process_time()
    for _ in range(5000):
        tracker.predict(*moved)
        tracker.update(block)
    each = (clock.process_time() - begun) / 5000
    ds = voyage(grid, options, 5, hours=100_000 / 3600, every=1.0)
    begun = clock.process_time()
    navigate(ds, grid, options, start=PLACE)
    whole = clock.process_time() - begun
    begun = clock.process_time()
    navigate(ds, grid, with_options(options, interval=0.0), start=PLACE)
    every = clock.process_time() - begun
    wide = one(Map(60, 2000), with_options(GLIDER, start_sigma=2000.0), 1.0, 7)
    print(f"\n## Speed\n\none update with its look-up   {1e6 * each:.0f} us (asked: 150)")
    print(f"navigate, 100,000 samples     {whole:.1f} s; each an update of its own {every:.1f} s (asked: 20)")
    print(f"wide start, mean over 6 h     {1e3 * wide.seconds / wide.samples:.2f} ms a sample (asked: 5)")


def show(table: Sequence[Sequence[str]]) -> None:
    """Print the head once, then each new row, in columns of one width."""
    widths = [max(34, len(table[0][0]))] + [max(8, len(head)) for head in table[0][1:]]
    for line in table[:2] if len(table) == 2 else table[-1:]:
        print(
            "  ".join(
                str(cell).ljust(w) if i == 0 else str(cell).rjust(w)
                for i, (cell, w) in enumerate(zip(line, widths, strict=True))
            ),
            flush=True,
        )


PARTS = {"accuracy": accuracy, "watch": watch, "calibration": calibration, "speed": speed}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--part", choices=sorted(PARTS), action="append")
    parser.add_argument("--workers", type=int, default=2)
    asked = parser.parse_args()
    with ProcessPoolExecutor(asked.workers) as pool:
        for name in asked.part or PARTS:
            PARTS[name](pool, asked.runs)


if __name__ == "__main__":
    main()
