"""Simulate vehicles, their calibrations and deployments, and effects of a requested size hidden in a log."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta
from functools import lru_cache
from typing import NamedTuple

import msgspec
import numpy as np
import xarray as xr
from effects import EFFECTS, FOREIGN

from magbridge import Calibration, fit, observations, reference_field
from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.correct import regressors
from magbridge.diagnose.problem import floor
from magbridge.estimation.residual import ResidualSamples, jacobian, residuals
from magbridge.field.grid import AnomalyGrid
from sitl import Twin, load, simulate
from sitl.inject import HiddenEffect, disturb
from sitl.mission import CrissCross, Spirals
from sitl.signals import correlated, first_order
from sitl.trajectory import Track
from sitl.world import Water

Rows = IndexArray
MEMORY = 0.8
"""Correlation of consecutive samples in autoregressive noise."""
SLOWER = 0.95
"""Correlation of consecutive samples in the autoregressive third (by power) of mixed noise."""
NOISES = ("white", "ar", "mixed", "heavy", "uneven", "half", "map")
"""Kinds of noise: white; autoregressive; white plus slower autoregressive; heavy-tailed; of varying level;
1.5 times the calibration's; white over a stronger crustal field."""
FLICKER, CORNER = "flicker", 0.1
"""Noise of 1 nT RMS with a 1/f spectrum below a corner; the corner over the sampling frequency."""
GLIDER = "glider"
"""Noise of the paper's glider: eight times as large, and autocorrelated."""
LOSSES = ("single", "bursts", "hole", "surfacing")
"""Kinds of lost samples: one in twenty; about two minutes, twelve times; a sixth of the log at once; 44 s of
every dive."""
HOURS = 6.0
"""Length of a deployment, h; the tests use a shorter one."""
VEHICLES = 23
"""Number of vehicles of one seed. The number is prime, so that each part's cycles of causes and sizes meet
every vehicle."""
SEEDS = 1_000_000
"""Maximum number of case numbers of one seed."""
INERTIA = 3.0
"""Time constant of each of two lags by which the attitude follows the track of :mod:`sitl.trajectory`, s."""
TURN_ON = 20.0
"""Change of the paper's offset at every power-on, nT (1-sigma) per axis."""
DAY = timedelta(days=1)
CHARTS = ("map at its depth", "map")
"""Maps that serve as reference: aeromagnetic, continued down to the glider, or at flight level."""


class Deployment(NamedTuple):
    """Deployment of a vehicle: its calibration, track and times of the rows.

    `prior` (K, K) is the prior covariance of the calibration's coefficients in a diagnosis: the calibration's
    covariance and the instrument's drift. `learned` is the calibration's log if the diagnosis gets this
    log, and `chart` is the map that is the reference of both logs.
    """

    twin: Twin
    track: Track
    when: FloatArray
    calibration: Calibration
    prior: FloatArray
    learned: tuple[xr.Dataset, ...] = ()
    chart: AnomalyGrid | None = None

    def measure(self, hidden: tuple[HiddenEffect, ...], number: int) -> xr.Dataset:
        """Return the log with hidden effects, without noise and lost samples."""
        ds = disturb(self.twin, hidden, self.track, self.when, number, EFFECTS | FOREIGN)
        return ds if self.chart is None else charted(ds, self.chart)


@lru_cache(maxsize=VEHICLES)
def vehicle(seed: int, rms: float = 60.0, reference: str = "true") -> Deployment:
    """Draw a vehicle, calibrate it on its own log and simulate its survey; `rms` (nT) is the crustal field.

    If the reference is a map, one of :data:`CHARTS`, the vehicle is a glider like the paper's: its noise is
    larger, and its offset has changed between calibration and survey.
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
    # the duration is not a multiple of the 4 s between samples, so masses start to move between samples
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
    """Return the anomaly map of a simulated world: one of :data:`CHARTS`."""
    chart = twin.anomaly_map()
    if reference == "map at its depth":
        return chart
    # without an altitude, the map is not continued downward
    return AnomalyGrid(chart.longitude, chart.latitude, chart.anomaly, name=chart.name)


def charted(ds: xr.Dataset, chart: AnomalyGrid) -> xr.Dataset:
    """Return a log with a map as reference; the error of its former reference is added."""
    known = reference_field(ds.drop_vars("reference_field"), chart)
    return ds.assign(reference_field=ds["reference_field"] - ds["truth_total_field"] + known)


def calibrated(spirals: xr.Dataset) -> Calibration:
    return fit(observations(spirals, ["battpos", "ballast"]), "auto").calibration


def rebuilt(deployment: Deployment, later: timedelta = timedelta()) -> Deployment:
    """Return another deployment of the same vehicle in the same waters, with the true field as reference."""
    scenario = msgspec.structs.replace(deployment.twin.scenario, start=deployment.twin.scenario.start + later)
    twin = replace(deployment.twin, scenario=scenario, seed=deployment.twin.seed + 1000)
    return _flown(twin, deployment.calibration)


def _flown(twin: Twin, calibration: Calibration) -> Deployment:
    track = twin.fly()
    # the hull's inertia: without it the attitude would change in steps, and a delay of a millisecond would
    # look like noise
    roll, pitch, heading = (
        first_order(first_order(angle, track.step, INERTIA), track.step, INERTIA)
        for angle in (track.roll, track.pitch, track.heading)
    )
    track = replace(track, roll=roll, pitch=pitch, heading=heading)
    when = np.arange(0.0, track.elapsed[-1] - 30.0, 1 / twin.scenario.instrument.rate)
    return Deployment(twin, track, when, calibration, calibration.covariance + floor(calibration))


def deployment_of(number: int, noise: str, reference: str = "true") -> Deployment:
    """Return the deployment of a case by its number, noise and reference."""
    seed, place = divmod(number, SEEDS)
    rms = {"map": 300.0, GLIDER: 120.0}.get(noise, 60.0)
    return vehicle(VEHICLES * seed + place % VEHICLES, rms, reference)


def compare(ds: xr.Dataset, calibration: Calibration) -> tuple[FloatArray, FloatArray]:
    """Return the residual (n,), nT, and its derivatives by the calibration's coefficients (n, K)."""
    H = np.column_stack([ds[f"mag_{axis}"] for axis in "xyz"])
    p = np.column_stack([ds[name] for name in calibration.channels])
    phi = regressors(calibration, H, p, ds["time"].to_numpy()).T
    W = calibration.kernel.weights.copy()
    W[0, :3] -= 1.0
    W[:, :6] *= calibration.reference.field
    reference, field = ds["reference_field"].to_numpy(), calibration.reference.field
    samples = ResidualSamples(H, reference, phi, np.ones(len(H)), field)
    e, g = residuals(samples, W.ravel())
    return e, jacobian(phi, g)


def project(X: FloatArray, A: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return columns X (n, m) with the calibration (columns A, prior `covariance`) projected out.

    The inner product of the result with X is the Fisher information with the calibration free. By Woodbury's
    identity the prior covariance need not be inverted.
    """
    inner = np.eye(len(covariance)) + (A.T @ A) @ covariance
    return np.asarray(X - A @ (covariance @ np.linalg.solve(inner, A.T @ X)))


def size_of(name: str, d: FloatArray, A: FloatArray, covariance: FloatArray) -> float:
    """Return the S/N of a signature d (n,) with the calibration projected out; of outliers, the largest."""
    left = project(d[:, None], A, covariance)[:, 0]
    if name == "outliers":
        return float(np.abs(left).max())
    return float(np.sqrt(max(float(d @ left), 0.0)))


class Injected(NamedTuple):
    """Hidden effect, its whitened signature in the residual, and the log with the effect."""

    hidden: HiddenEffect
    signature: FloatArray
    ds: xr.Dataset


class Background(NamedTuple):
    """Data of a case without a hidden effect: rows of the log, its residual, and the calibration's columns.

    The columns (of `rows` only) are whitened; the residual (of all rows) is not.
    """

    deployment: Deployment
    number: int
    noise: str
    rows: Rows
    residual: FloatArray
    columns: FloatArray

    @classmethod
    def of(cls, deployment: Deployment, number: int, noise: str, losses: str = "") -> Background:
        """Return the background of a case; `number` seeds the irrelevant telemetry and the lost samples."""
        clean = deployment.measure((), number)
        rows = kept_rows(losses, len(deployment.when), number)
        e, J = compare(clean, deployment.calibration)
        return cls(deployment, number, noise, rows, e, whiten(J[rows], noise, rows))

    def show(self, hidden: HiddenEffect) -> Injected:
        """Return an effect with its signature and the log in which it is hidden."""
        ds = self.deployment.measure((hidden,), self.number)
        d = compare(ds, self.deployment.calibration)[0] - self.residual
        return Injected(hidden, whiten(d[self.rows], self.noise, self.rows), ds)

    def log(self, ds: xr.Dataset) -> xr.Dataset:
        """Return the log to be diagnosed: with noise, and without the lost samples."""
        return add_noise(ds, self.noise, self.number).isel(time=self.rows)

    def hide(self, name: str, wanted: float, seed: int) -> Injected:
        """Return the effect with the size at which its signal-to-noise ratio is `wanted`."""
        size = 1.0
        for _ in range(6):
            made = self.show(HiddenEffect(name, size, seed))
            found = size_of(name, made.signature, self.columns, self.deployment.prior)
            if abs(found / wanted - 1.0) < 0.02:
                return made
            size *= wanted / max(found, 1e-9)
        raise RuntimeError(f"{name}, seed {seed}: no size gives S/N {wanted:g}; the last gave {found:.3g}")


# ---- noise and lost samples --------------------------------------------------------------------------------


def statistics(noise: str) -> tuple[float, float]:
    """Return the correlation of consecutive samples and the 1-sigma (nT) with which noise is whitened."""
    return (MEMORY if noise in ("ar", GLIDER) else 0.0), {"half": 1.5, GLIDER: 8.0}.get(noise, 1.0)


def add_noise(ds: xr.Dataset, kind: str, seed: int) -> xr.Dataset:
    """Return the log with noise of a `kind` on each channel, 1 nT unless the kind has another amplitude."""
    rng = np.random.default_rng([seed, 99])
    n = ds.sizes["time"]
    noise = rng.standard_normal((n, 3))
    if kind == "heavy":
        noise = rng.standard_t(4.0, (n, 3)) / np.sqrt(2.0)
    if kind == FLICKER:
        power = 1.0 + CORNER / np.maximum(np.fft.rfftfreq(n), 1.0 / n)[:, None]
        noise = np.fft.irfft(np.fft.rfft(noise, axis=0) * np.sqrt(power), n, axis=0)
        noise /= noise.std()
    if kind in ("ar", GLIDER):
        noise = correlated(noise, MEMORY)
    if kind == "mixed":
        noise = np.sqrt(2 / 3) * noise + np.sqrt(1 / 3) * correlated(rng.standard_normal((n, 3)), SLOWER)
    if kind == "uneven":
        noise *= np.repeat(np.exp(rng.normal(0, 0.5, n // 300 + 1)), 300)[:n, None]
    out = ds.copy()
    for k, axis in enumerate("xyz"):
        out[f"mag_{axis}"] = out[f"mag_{axis}"] + statistics(kind)[1] * noise[:, k]
    return out


def kept_rows(losses: str, n: int, seed: int) -> Rows:
    """Return the indices of the rows of a log that are not lost; all n rows if `losses` is empty."""
    rng = np.random.default_rng([seed, 98])
    there = np.ones(n, bool)
    if losses == "single":
        there = rng.random(n) > 0.05
    if losses == "bursts":
        for start, length in zip(rng.integers(0, n, 12), rng.geometric(1 / 30, 12), strict=True):
            there[start : start + length] = False
    if losses == "hole":
        start = rng.integers(1, n - n // 6)
        there[start : start + n // 6] = False
    if losses == "surfacing":
        dive = rng.integers(50, 300)
        there[(np.arange(n) + rng.integers(dive)) % dive < 11] = False
    return np.flatnonzero(there)


def whiten(x: FloatArray, noise: str, rows: Rows) -> FloatArray:
    """Return the innovations of a signal x at `rows`, in units of their 1-sigma under the true noise.

    Over a step of k rows, an AR(1) process has the correlation ``rho^k``. The result omits the first row.
    """
    memory, sigma = statistics(noise)
    rho = (memory ** np.diff(rows)).reshape(-1, *[1] * (x.ndim - 1))
    return np.asarray((x[1:] - rho * x[:-1]) / (sigma * np.sqrt(1 - rho**2)))
