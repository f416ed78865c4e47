"""Simulate tracks over magnetic maps and navigate them; ``tools/navigation.py`` prints the tables."""

from __future__ import annotations

import time as clock
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from math import inf
from pathlib import Path

import numpy as np
import xarray as xr
from msgspec.structs import replace as with_options
from scipy.stats import chi2
from studies import Row
from study_worlds import MASSES, METHODS, true_field

from magbridge import Correction, correct_rows, fit, observations, read_grid
from magbridge.arrays import BoolArray, FloatArray, IntArray
from magbridge.estimation.residual import rms
from magbridge.field.geodesy import metres_per_degree, offset, separation
from magbridge.field.grid import AnomalyGrid
from magbridge.field.igrf import total_field
from magbridge.navigate.batch import navigate
from magbridge.navigate.bound import position_bound
from magbridge.navigate.deadreckoning import DeadReckoning
from magbridge.navigate.findings import errors as track_errors
from magbridge.navigate.model import Block, Collector, block_length
from magbridge.navigate.navigator import Navigator
from magbridge.navigate.options import NavigationOptions, at_depth, informed
from magbridge.navigate.own_survey import localise
from sitl import Twin, load, segments, simulate
from sitl.dataset import at_rest
from sitl.signals import autoregressive

START = 1_386_201_600.0
"""Start of a track (2013-12-05), s since 1970 UTC."""
PLACE = (49.5, -57.9)
"""Latitude and longitude of Bonne Bay, deg."""
HOUR = 3600.0
SPEEDS = (0.35, 0.25, 0.5)
"""Speeds of successive runs, m/s."""
GLIDER = NavigationOptions(current_sigma=0.05, bias_sigma=0.5, bias_time=1800.0, map_sigma=1.0, interval=40.0)
"""Options for a glider, which moves 14 m in 40 s: less than 2 % of any correlation length here."""
OUTSIDE = float(chi2.ppf(0.9999, 2))
"""Squared Mahalanobis distance of the 99.99 % ellipse, beyond which the filter is wrong."""


@dataclass(frozen=True)
class Map:
    """Synthetic anomaly map: RMS (nT), correlation length (m) and spectrum."""

    rms: float
    length: float
    rough: bool = False  # k^-3 spectrum down to a quarter of the length, instead of a Gaussian

    def __str__(self) -> str:
        return f"{self.rms:g} nT, {self.length:g} m{', rough' if self.rough else ''}"


@cache
def synthetic(kind: Map, seed: int, extent: float = 16_000.0) -> AnomalyGrid:
    """Return a random map: the sum of 600 plane waves, `extent` m to each side."""
    rng = np.random.default_rng(seed)
    size = 600
    k = rng.normal(size=(size, 2))
    if kind.rough:  # wavenumbers of 1/2 to 4 over the length, with fewer short waves
        k *= (0.5 * 8.0 ** (rng.uniform(size=size) ** 2) / np.linalg.norm(k, axis=1))[:, None]
    k, phase = k / kind.length, rng.uniform(0.0, 2.0 * np.pi, size)
    y = np.arange(-extent, extent + 1.0, kind.length / (16 if kind.rough else 8))
    east, north = np.exp(1j * np.outer(y, k[:, 0])), np.exp(1j * (np.outer(y, k[:, 1]) + phase))
    values = np.real(north @ east.T)
    per_latitude, per_longitude = metres_per_degree(PLACE[0])
    anomaly = kind.rms * values / values.std()
    return AnomalyGrid(PLACE[1] + y / per_longitude, PLACE[0] + y / per_latitude, anomaly)


def track_over(
    grid: AnomalyGrid,
    options: NavigationOptions,
    seed: int,
    *,
    hours: float = 6.0,
    speed: float = 0.35,
    every: float = 4.0,
    jump: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> xr.Dataset:
    """Return the measurements of a vehicle that changes to a random heading every 45 minutes.

    All errors are drawn from the error model of the options; a sample also has 1 nT of white noise.
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
    options: NavigationOptions,
    rng: np.random.Generator,
    velocity: FloatArray,
    errors: FloatArray,
    sigma: FloatArray,
    *,
    every: float = 4.0,
    jump: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> xr.Dataset:
    """Return the measurements of a vehicle in water with a current, over a map with errors.

    `velocity` (n, 2), m/s, is the motion through the water up to each sample, every `every` s. `errors` (n,),
    nT, are the errors of the corrected total field, `sigma` (n,), nT, their claimed sigma. A `jump` (hour,
    metres north and east) displaces the vehicle at once, without a change of its dead reckoning.
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
    """Result of the navigation of one track; the arrays have one value for each record."""

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
        """Mask (n,) of the records in the second half."""
        return np.asarray(self.hours > 0.5 * self.hours[-1])

    def score(self) -> dict[str, float]:
        """Return the scores of a run: errors over the second half, m; NEES over its degrees of freedom.

        A run is *lost* if the truth was outside the ellipse for half an hour without a break. *waited* is the
        time until the position is valid, h.
        """
        half = self.second_half
        return {
            "drms": rms(self.error[half]), "bound": self.bound, "unaided": self.unaided,
            "lost": float(longest(self.nees[half] > OUTSIDE, self.hours[half]) > 0.5),
            "nees": float(np.mean(self.nees[half])) / 2,
            "valid": float(np.mean(self.valid)),
            "waited": float(self.hours[self.valid][0]) if self.valid.any() else inf,
        }  # fmt: skip

    @property
    def outside(self) -> BoolArray:
        """Mask (n,) of the records with the truth outside the ellipse and a quarter length away."""
        return (self.nees > OUTSIDE) & (self.error > 0.25 * self.length)

    def silence(self) -> tuple[float, float]:
        """Return the longest times (h) in which a wrong position counted as valid, and existed."""
        return longest(self.outside & self.valid, self.hours), longest(self.outside, self.hours)

    def standing(self) -> tuple[float, float]:
        """Return the fractions of the time in which a right and a wrong position counted as valid."""
        return float(np.mean(self.valid & ~self.outside)), float(np.mean(self.valid & self.outside))


def longest(flags: BoolArray, hours: FloatArray) -> float:
    """Return the longest time (h) in which the flags (n,) were set without a break."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    spans = [hours[min(b, hours.size) - 1] - hours[a] for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return float(max(spans, default=0.0))


def sail(ds: xr.Dataset, grid: AnomalyGrid, options: NavigationOptions) -> Run:
    """Run the navigator over a track and return its errors."""
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
    series = [ds[f"away_{axis}"] for axis in ("north", "east")]
    away = np.stack([np.interp(table[:, 0], ds["time"], one) for one in series], axis=1)
    error = table[:, 1:3] - away
    nees = np.einsum("ki,kij,kj->k", error, np.linalg.inv(table[:, 3:7].reshape(-1, 2, 2)), error)
    corners = ds.isel(time=slice(None, None, 5))
    names = "time", "truth_latitude", "truth_longitude"
    when, latitude, longitude = (corners[name].to_numpy() for name in names)
    sigma = float(ds["total_field_sigma"].median())
    best = position_bound(grid, when, latitude, longitude, options, sigma, 30.0, every)
    half = best.time > 0.5 * (best.time[0] + best.time[-1])
    return Run(
        (table[:, 0] - START) / HOUR, np.hypot(*error.T), nees, table[:, 7].astype(int), table[:, 8] > 0,
        rms(best.sigma[half]), rms(best.unaided[half]), grid.correlation_length, seconds / ds.sizes["time"],
    )  # fmt: skip


def blocks(ds: xr.Dataset, grid: AnomalyGrid, options: NavigationOptions) -> Iterator[tuple[Block, float]]:
    """Yield the measurements that the navigator forms from a track, and the distance travelled so far, m."""
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
    """Yield time, motion up to the sample, total field and its sigma of each sample of a track."""
    motion = {name: ds[name].to_numpy().tolist() for name in ("velocity_north", "velocity_east", "depth")}
    columns = [ds[name].to_numpy().tolist() for name in ("time", "total_field", "total_field_sigma")]
    for t, field, sigma, *moved in zip(*columns, *motion.values(), strict=True):
        yield t, dict(zip(motion, moved, strict=True)), field, sigma


# ---- the runs of the studies -------------------------------------------------------------------------------


def drawn_track(
    kind: Map,
    seed: int,
    start: float,
    *,
    first: int = 1000,
    over: AnomalyGrid | None = None,
    jump: tuple[float, float, float] = (0.0, 0.0, 0.0),
    **changes: float,
) -> tuple[xr.Dataset, AnomalyGrid, NavigationOptions]:
    """Return a glider's track, its map and its options, as :func:`sail` takes them.

    `start` is the 1-sigma of the first position in correlation lengths of the map. The true field is `over`
    if given, else the map.
    """
    grid = synthetic(kind, seed % 10)
    options = with_options(GLIDER, start_sigma=start * grid.correlation_length, **changes)
    speed = SPEEDS[seed % 3]
    return track_over(over or grid, options, first + seed, speed=speed, jump=jump), grid, options


def carried(kind: Map, seed: int) -> tuple[float, float]:
    """Displace a vehicle by 1.5 correlation lengths at 2 h and navigate; return :meth:`Run.silence`."""
    length = 1.5 * synthetic(kind, seed % 10).correlation_length
    angle = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi)
    away = (2.0, float(length * np.cos(angle)), float(length * np.sin(angle)))
    return sail(*drawn_track(kind, seed, 0.2, first=5000, jump=away)).silence()


def misled(kind: Map, seed: int) -> tuple[float, float]:
    """Navigate with a tenth of the true 1-sigma of the start (one length); return :meth:`Run.silence`."""
    ds, grid, options = drawn_track(kind, seed, 1.0, first=7000)
    return sail(ds, grid, with_options(options, start_sigma=0.1 * grid.correlation_length)).silence()


def dived(seed: int) -> Iterator[Row]:
    """Yield the scores of the demo's deployment with the map as it is, and continued to the depth."""
    scenario = load("demo")
    grid, log = Twin.draw(scenario, seed).anomaly_map(), simulate(scenario, seed)
    log = log.assign(total_field=log["truth_total_field"])
    options = NavigationOptions()
    yield {"map": "as it was flown"} | track_score(navigate(log, grid, options))
    below, used = at_depth(grid, options, log["depth"].to_numpy())
    yield {"map": "at the glider's depth"} | track_score(navigate(log, below, used))


def track_score(track: xr.Dataset) -> dict[str, float]:
    """Return RMS error (m), NEES over its two degrees of freedom, and the valid fraction of the time."""
    north, east = track["error_north"].to_numpy(), track["error_east"].to_numpy()
    nn, ne, ee = (track[f"covariance_{axes}"].to_numpy() for axes in ("nn", "ne", "ee"))
    nees = (ee * north**2 - 2.0 * ne * north * east + nn * east**2) / (nn * ee - ne**2)
    valid = float(track["valid"].mean())
    return {"error": rms(np.hypot(north, east)), "nees": float(nees.mean()) / 2, "valid": valid}


def calibrated(kinds: tuple[Map, ...], seed: int) -> Iterator[Row]:
    """Yield the scores of a glider's navigation on each map with each calibration, otherwise equal.

    *error* is the RMS error (nT) of the corrected field on the survey, *claimed* the median claimed sigma.
    """
    parts = segments(simulate(load("random_glider"), seed))
    runs, survey = at_rest(parts["calibration"], MASSES), parts["survey"]
    places = separation(*PLACE, *(survey[f"truth_{name}"].to_numpy() for name in ("latitude", "longitude")))
    every = float(survey["time"][1] - survey["time"][0])
    velocity = np.gradient(np.column_stack(places), every, axis=0)
    for method, options in METHODS.items():
        fitted = fit(observations(runs, () if method == "nominal" else MASSES), method, **options).calibration
        corrected = correct_rows(Correction(fitted), survey)
        error = corrected["total_field"].to_numpy() - true_field(survey)
        sigma = corrected["total_field_sigma"].to_numpy()
        claimed = float(np.median(sigma))
        for kind in kinds:
            grid = synthetic(kind, seed % 10)
            known = with_options(GLIDER, start_sigma=grid.correlation_length)
            known = informed(known, fitted, claimed)
            ds = adrift(grid, known, np.random.default_rng(seed), velocity, error, sigma, every=every)
            row = {"map": str(kind), "calibration": method, "error": rms(error), "claimed": claimed}
            yield row | sail(ds, grid, known).score()


# ---- without a map -----------------------------------------------------------------------------------------


SURVEYOR = NavigationOptions(
    start_sigma=20.0, current_sigma=0.02, drift=0.2, bias_sigma=0.5, bias_time=1800.0, map_sigma=0.0
)
"""Options for a survey; a current of 2 cm/s remains if its mean is known from the latest surfacings."""
VEHICLES = {"6 h": 6.0, "12 h": 12.0}
"""Durations of the gliders' surveys, h."""


def located(vehicle: str, kind: Map, seed: int) -> list[Row]:
    """Simulate a survey and localise it without a map; return RMS errors (m) and processor time (s)."""
    flown = survey(VEHICLES[vehicle], kind, seed)
    begun = clock.process_time()
    track = localise(flown, SURVEYOR, start=PLACE)
    seconds = clock.process_time() - begun
    error, reckoned = (rms(one.to_numpy()) for one in track_errors(track))
    sigma = rms(np.sqrt(track["covariance_nn"].to_numpy() + track["covariance_ee"].to_numpy()))
    row: Row = {
        "error": error, "reckoned": reckoned, "sigma": sigma, "bound": rms(track["bound_sigma"].to_numpy()),
        "worse": float(error > reckoned), "beyond": float(error > max(reckoned, 2.0 * sigma)),
        "seconds": seconds,
    }  # fmt: skip
    return [track_score(track) | row]


def survey(hours: float, kind: Map, seed: int) -> xr.Dataset:
    """Return the measurements of a glider on a zigzag along an axis and back, with its true track."""
    rng, o, every = np.random.default_rng([seed, 44]), SURVEYOR, 4.0
    n = int(hours * HOUR / every)
    leg = np.arange(n) // int(rng.uniform(1500.0, 3600.0) / every)
    course = rng.uniform(0.0, 360.0) + 180.0 * (leg >= (leg[-1] + 1) // 2)
    heading = np.radians(course + rng.uniform(35.0, 65.0) * np.where(leg % 2, 1.0, -1.0))
    velocity = 0.35 * np.column_stack([np.cos(heading), np.sin(heading)])
    errors = autoregressive(rng, (n,), o.bias_sigma, o.bias_time / every) + rng.normal(size=n)
    return adrift(synthetic(kind, seed, 10_000.0), o, rng, velocity, errors, np.ones(n), every=every)


# ---- a published flight ------------------------------------------------------------------------------------


def magnav_flight(folder: Path) -> tuple[AnomalyGrid, xr.Dataset]:
    """Return map and flight of MagNav.jl's simple example: field, inertial track and true track."""
    log = np.genfromtxt(folder / "xyz.csv", delimiter=",", names=True)
    time = 1.5e9 + log["tt"]
    columns = {
        "total_field": total_field(log["lon"], log["lat"], -log["alt"], time) + log["mag_1_c"],
        "total_field_sigma": np.full(time.size, 3.0),
        "dr_latitude": log["ins_lat"],
        "dr_longitude": log["ins_lon"],
        "gps_latitude": log["lat"],
        "gps_longitude": log["lon"],
        "depth": -log["alt"],
    }
    ds = xr.Dataset({name: ("time", values) for name, values in columns.items()}, {"time": time})
    return read_grid(folder / "map"), ds
