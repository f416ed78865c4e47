"""Vehicles with their calibrations, their deployments, and effects of a wanted size hidden in them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from dataclasses import field as attribute
from datetime import timedelta
from functools import lru_cache
from typing import NamedTuple

import msgspec
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magbridge.calibration.correct import regressors
from magbridge.calibration.fitting.columns import observations
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.model import Calibration
from magbridge.calibration.residual import Samples, residuals
from magbridge.diagnose.compare.prior import floor
from magbridge.field.grid import AnomalyGrid
from magbridge.field.reference import reference_field
from sitl import Twin, load, simulate
from sitl.inject import Hidden, disturb
from sitl.mission import CrissCross, Spirals
from sitl.signals import first_order
from sitl.trajectory import Track
from sitl.world import Water, World
from study.noise import GLIDER, Rows, add_noise, left, statistics, whiten

Array = NDArray[np.float64]
HOURS = 6.0
"""Length of a deployment; the tests' are shorter."""
VEHICLES = 23
"""Of a seed. A prime: parts step through their causes and sizes in cycles, and each of these meets
every vehicle."""
SEEDS = 1_000_000
"""Numbers that a study of one seed may have."""
INERTIA = 3.0
"""s, twice, with which the attitude follows what :mod:`sitl.trajectory` draws."""
TURN_ON = 20.0
"""nT an axis, by which the paper's offset settles anew at every power-on."""
DAY = timedelta(days=1)
CHARTS = ("map at its depth", "map")
"""An aeromagnetic map, continued down to the glider or taken as it was flown, for a reference."""


@dataclass(frozen=True)
class Remembered(World):
    """A world that remembers the field along a track: all cases of a vehicle fly through the same."""

    known: dict[bytes, Array] = attribute(default_factory=dict)

    def field(self, time: Array, latitude: Array, longitude: Array, depth: Array) -> Array:
        """See :meth:`~sitl.world.World.field`."""
        way = np.stack([time, latitude, longitude, depth]).tobytes()
        if way not in self.known:
            self.known[way] = super().field(time, latitude, longitude, depth)
        return self.known[way]


class Stage(NamedTuple):
    """A vehicle with its calibration, and a deployment's track with the times of its rows.

    `prior` (K, K) is what the calibration's coefficients are allowed: its covariance, and what no instrument
    holds; `learned` the calibration's own log, where a diagnosis is given it; `chart` the map that both have
    for a reference.
    """

    twin: Twin
    track: Track
    when: Array
    calibration: Calibration
    prior: Array
    learned: tuple[xr.Dataset, ...] = ()
    chart: AnomalyGrid | None = None

    def measure(self, hidden: tuple[Hidden, ...], number: int) -> xr.Dataset:
        """The log with effects, before its noise and its losses."""
        ds = disturb(self.twin, hidden, self.track, self.when, number)
        return ds if self.chart is None else charted(ds, self.chart)


@lru_cache(maxsize=VEHICLES)
def vehicle(seed: int, rms: float = 60.0, reference: str = "true") -> Stage:
    """Draw a vehicle, calibrate it on a log of its own, fly its survey; `rms` (nT) is the rock's field.

    Against a map, one of :data:`CHARTS`, it is a glider like the paper's: its log is louder, and its offset
    has settled anew when it surveys.
    """
    swap = msgspec.structs.replace
    base = load("demo")
    memory, sigma = statistics("white" if reference == "true" else GLIDER)
    instrument = swap(
        base.instrument, corner=0.0, channel_delay=(0.0, 0.0, 0.0),
        noise_sigma=sigma, noise_memory=-1.0 / np.log(memory) if memory else 0.0,
    )  # fmt: skip
    water = Water(surface=6.0, deep=2.5, thermocline=50.0, thickness=30.0)
    world = swap(base.world, water=water, geology=swap(base.world.geology, rms=rms))
    base = swap(base, instrument=instrument, world=world, motion=swap(base.motion, settle=40.0))
    trial = swap(base, mission=(Spirals(),))
    # no multiple of the sampling's 4 s: else every mass would start to move just when a sample is taken
    survey = CrissCross(hours=HOURS, roll=(0.0, 4.0), pitch=(24.0, 3.0), battery_spread=0.12, duration=701.5)
    twin = Twin.draw(swap(base, instrument=swap(instrument, noise_sigma=0.0), mission=(survey,)), seed)
    if reference == "true":
        return _flown(twin, calibrated(simulate(trial, seed)))
    chart = drawn(twin, reference)
    spirals = charted(simulate(swap(trial, start=trial.start - DAY), seed), chart)
    settled = instrument.offset + np.random.default_rng([seed, 97]).normal(0.0, TURN_ON, 3)
    started = swap(twin.scenario.instrument, offset=tuple(settled.tolist()))
    twin = replace(twin, scenario=swap(twin.scenario, instrument=started))
    return _flown(twin, calibrated(spirals))._replace(learned=(spirals,), chart=chart)


def drawn(twin: Twin, reference: str) -> AnomalyGrid:
    """The map of a twin's waters: one of :data:`CHARTS`."""
    chart = twin.anomaly_map()
    if reference == "map at its depth":
        return chart
    # that knows no altitude
    return AnomalyGrid(chart.longitude, chart.latitude, chart.anomaly, name=chart.name)


def charted(ds: xr.Dataset, chart: AnomalyGrid) -> xr.Dataset:
    """A log whose reference is a map, off by what it was off before besides."""
    known = reference_field(ds.drop_vars("reference_field"), chart)
    return ds.assign(reference_field=ds["reference_field"] - ds["truth_total_field"] + known)


def calibrated(spirals: xr.Dataset) -> Calibration:
    return fit(observations(spirals, ["battpos", "ballast"]), "auto").calibration


def again(stage: Stage, later: timedelta = timedelta()) -> Stage:
    """Another deployment of the same vehicle in the same waters, whose reference is true."""
    scenario = msgspec.structs.replace(stage.twin.scenario, start=stage.twin.scenario.start + later)
    twin = replace(stage.twin, scenario=scenario, seed=stage.twin.seed + 1000)
    return _flown(twin, stage.calibration)


def _flown(twin: Twin, calibration: Calibration) -> Stage:
    twin = replace(twin, world=Remembered(twin.world.origin, twin.world.rock, twin.world.water))
    track = twin.fly()
    # a hull has inertia: without it the attitude has no rate, and a delay of a millisecond is a
    # noise of its own
    smooth = {
        name: first_order(first_order(getattr(track, name), track.step, INERTIA), track.step, INERTIA)
        for name in ("roll", "pitch", "heading")
    }
    track = replace(track, **smooth)
    when = np.arange(0.0, track.elapsed[-1] - 30.0, 1 / twin.scenario.instrument.rate)
    return Stage(twin, track, when, calibration, calibration.covariance + floor(calibration))


def stage_of(number: int, noise: str, reference: str = "true") -> Stage:
    """The stage of a case."""
    seed, place = divmod(number, SEEDS)
    rms = {"map": 300.0, GLIDER: 120.0}.get(noise, 60.0)
    return vehicle(VEHICLES * seed + place % VEHICLES, rms, reference)


def compare(ds: xr.Dataset, calibration: Calibration) -> tuple[Array, Array]:
    """Residual (n,) and its derivative by the calibration's coefficients (n, K)."""
    H = np.column_stack([ds[f"mag_{axis}"] for axis in "xyz"])
    p = np.column_stack([ds[name] for name in calibration.channels])
    phi = regressors(calibration, H, p, ds["time"].to_numpy()).T
    W = calibration.kernel.weights.copy()
    W[0, :3] -= 1.0
    W[:, :6] *= calibration.reference.field
    samples = Samples(H, ds["reference_field"].to_numpy(), phi, np.ones(len(H)), calibration.reference.field)
    e, g = residuals(samples, W.ravel())
    return e, (phi[:, :, None] * g[:, None, :]).reshape(len(e), -1)


def project(X: Array, A: Array, covariance: Array) -> Array:
    """Take out of columns X what a calibration (columns A, prior `covariance`) fitted with them absorbs.

    The inner product of the result with X is Fisher's information with the calibration free; Woodbury's
    identity needs no inverse of the prior.
    """
    inner = np.eye(len(covariance)) + (A.T @ A) @ covariance
    return np.asarray(X - A @ (covariance @ np.linalg.solve(inner, A.T @ X)))


def size_of(name: str, d: Array, A: Array, covariance: Array) -> float:
    """Signal-to-noise of a signature: the norm of what the free calibration leaves of it.

    Outliers come one by one, each at a moment that nobody knows: theirs is that of the largest.
    """
    left = project(d[:, None], A, covariance)[:, 0]
    if name == "outliers":
        return float(np.abs(left).max())
    return float(np.sqrt(max(d @ left, 0.0)))


class Found(NamedTuple):
    """An effect of the wanted size: what it is, what it leaves (whitened), and the log with it."""

    hidden: Hidden
    signature: Array
    ds: xr.Dataset


class Stall(NamedTuple):
    """What all sizes share: the log's rows, its residual without an effect, the calibration's columns.

    Residual and columns are whitened.
    """

    stage: Stage
    number: int
    noise: str
    rows: Rows
    residual: Array
    columns: Array

    @classmethod
    def of(cls, stage: Stage, number: int, noise: str, losses: str = "") -> Stall:
        """Set up; `number` draws what the vehicle logs beside, and which samples are lost."""
        clean = stage.measure((), number)
        rows = left(losses, len(stage.when), number)
        e, J = compare(clean, stage.calibration)
        return cls(stage, number, noise, rows, e, whiten(J[rows], noise, rows))

    def measure(self, *hidden: Hidden) -> xr.Dataset:
        """The log with effects, before its noise and its losses."""
        return self.stage.measure(hidden, self.number)

    def show(self, hidden: Hidden) -> Found:
        """What an effect does here."""
        ds = self.measure(hidden)
        d = compare(ds, self.stage.calibration)[0] - self.residual
        return Found(hidden, whiten(d[self.rows], self.noise, self.rows), ds)

    def log(self, ds: xr.Dataset) -> xr.Dataset:
        """What is there to be diagnosed: with noise, without what was lost."""
        return add_noise(ds, self.noise, self.number).isel(time=self.rows)

    def hide(self, name: str, wanted: float, seed: int) -> Found:
        """Find the size at which the effect has the signal-to-noise that is wanted."""
        size = 1.0
        for _ in range(6):
            made = self.show(Hidden(name, size, seed))
            found = size_of(name, made.signature, self.columns, self.stage.prior)
            if abs(found / wanted - 1.0) < 0.02:
                return made
            size *= wanted / max(found, 1e-9)
        raise RuntimeError(f"{name}, seed {seed}: no size gives S/N {wanted:g}; the last gave {found:.3g}")
