"""Compare in-flight calibration with the fixed calibration, in a simulation that does not use ``sitl``.

    python3 tools/never_worse.py                          every change, vehicles 1 to 4
    python3 tools/never_worse.py none --vehicles 11 12    vehicles that were not used for tuning

Each vehicle has two dipole masses and 1 nT of white noise. It is calibrated with ten
runs whose true field is known. It then surveys a crustal field of 7 nT (standard deviation) for 12 hours at
0.25 Hz with one hidden change. The reference is the IGRF alone. Errors are RMS, nT: from one hour after a
step on, else from the start.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from live import learn
from studies import Column, Row, Study

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.model import Calibration
from magbridge.estimation.residual import rms
from magbridge.field.igrf import igrf
from magbridge.learning import Learner

START_S = 1_780_000_000.0
"""Time of the first sample, s since 1970 UTC."""
METRES_PER_DEGREE = 111_200.0
MU0_OVER_4PI_NT = 100.0
"""mu_0 / 4 pi in nT m^3 / (A m^2)."""


@dataclass(frozen=True)
class Track:
    """Trajectory and telemetry: `time` (n,) s, attitude (n, 3) rad, position (deg, m) and masses."""

    time: FloatArray
    attitude: FloatArray
    latitude: FloatArray
    longitude: FloatArray
    depth: FloatArray
    masses: dict[str, FloatArray]
    temperature: FloatArray

    def metres(self) -> FloatArray:
        """Return the positions (n, 2), m north and east of the first position."""
        north = (self.latitude - self.latitude[0]) * METRES_PER_DEGREE
        east = (self.longitude - self.longitude[0]) * METRES_PER_DEGREE * np.cos(np.radians(self.latitude[0]))
        return np.stack([north, east], axis=1)


class Crust:
    """Random crustal anomaly with a given standard deviation (nT) and shortest wavelength (m)."""

    def __init__(self, seed: int, sigma_nt: float, wavelength_m: float, waves: int = 60) -> None:
        rng = np.random.default_rng([seed, 11])
        length = wavelength_m * np.exp(rng.uniform(0.0, 2.0, waves))
        angle = rng.uniform(0.0, 2.0 * np.pi, waves)
        self._k = 2.0 * np.pi / length[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        self._phase = rng.uniform(0.0, 2.0 * np.pi, waves)
        self._amplitude = sigma_nt * np.sqrt(2.0 / waves)

    def at_position(self, metres: FloatArray) -> FloatArray:
        """Return the anomaly (n,), nT, at positions (n, 2), m north and east."""
        return np.asarray(self._amplitude * np.cos(metres @ self._k.T + self._phase).sum(axis=1))


class Vehicle:
    """Magnetic model of a vehicle: hard iron, soft iron and dipole masses, drawn from `seed`."""

    def __init__(self, seed: int, masses: tuple[str, ...] = ("battpos", "ballast")) -> None:
        rng = np.random.default_rng([seed, 3])
        self.masses = masses
        self._hard = rng.normal(0.0, 800.0, 3)
        soft = rng.normal(0.0, 0.012, (3, 3))
        self._soft = np.eye(3) + soft
        self._moment = {name: rng.normal(0.0, 1.6, 3) for name in masses}
        self._induced = {name: abs(rng.normal(0.0, 1.0e-5)) for name in masses}  # A m^2 per nT
        self._home = {}
        for name in masses:
            away = rng.normal(size=3)
            self._home[name] = away / np.linalg.norm(away) * rng.uniform(0.55, 0.75)

    def field(
        self, track: Track, anomaly: FloatArray, masses: dict[str, FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """Return the noiseless reading (n, 3) and the true total field (n,), nT."""
        ned = igrf(track.longitude, track.latitude, track.depth, track.time)
        total = np.linalg.norm(ned, axis=1)
        ned = ned * ((total + anomaly) / total)[:, None]
        body = to_body(track.attitude, ned)
        out = body @ self._soft.T + self._hard
        for name in self.masses:
            r = self._home[name] + masses[name][:, None] * np.array([0.0254, 0.0, 0.0])
            distance = np.linalg.norm(r, axis=1)[:, None]
            n = r / distance
            moment = self._moment[name] + self._induced[name] * body
            along = np.sum(n * moment, axis=1)[:, None]
            out = out + MU0_OVER_4PI_NT * (3.0 * n * along - moment) / distance**3
        return np.asarray(out), np.asarray(total + anomaly)


def to_body(attitude: FloatArray, ned: FloatArray) -> FloatArray:
    """Rotate (n, 3) from north-east-down to body axes by roll, pitch and heading (n, 3), rad."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(attitude).T, np.sin(attitude).T
    n, e, d = ned.T
    x = cp * cy * n + cp * sy * e - sp * d
    y = (sr * sp * cy - cr * sy) * n + (sr * sp * sy + cr * cy) * e + sr * cp * d
    z = (cr * sp * cy + sr * sy) * n + (cr * sp * sy - sr * cy) * e + cr * cp * d
    return np.stack([x, y, z], axis=1)


def smooth(values: FloatArray, samples: float) -> FloatArray:
    """Return the moving mean of values (n,) over a number of samples, which turns steps into ramps."""
    width = max(round(samples), 1)
    padded = np.concatenate([np.full(width, values[0]), values, np.full(width, values[-1])])
    kernel = np.ones(width) / width
    return np.asarray(np.convolve(padded, kernel, "same")[width:-width])


def wander(rng: np.random.Generator, n: int, step: float, tau: float, sigma: float) -> FloatArray:
    """Return a smoothed Ornstein-Uhlenbeck process (n,) with time constant `tau` (s) and 1-sigma `sigma`."""
    keep = np.exp(-step / tau)
    out = np.empty(n)
    state = rng.normal()
    for k, shock in enumerate(rng.normal(size=n) * np.sqrt(1.0 - keep**2)):
        state = keep * state + shock
        out[k] = state
    return smooth(sigma * out, 3.0 / step)


def glider_track(
    seed: int, hours: float, rate_hz: float, *, spirals: bool = False, start_s: float = START_S
) -> Track:
    """Return a glider's dives over a criss-cross, or ten banked spirals for a calibration."""
    rng = np.random.default_rng([seed, 5, int(spirals)])
    step = 1.0 / rate_hz
    n = int(3600.0 * hours * rate_hz)
    seconds = step * np.arange(n)
    half = 180.0 if spirals else 840.0
    leg = np.floor(seconds / half)
    climbing = leg % 2 == 1
    jitter = rng.normal(size=int(leg[-1]) + 1)
    steep = np.radians(24.0) + np.radians(3.0) * jitter[leg.astype(int)]
    pitch = smooth(np.where(climbing, steep, -steep), 25.0 / step)
    battpos = smooth(np.where(climbing, -0.8, 0.8) + 0.12 * jitter[leg.astype(int)], 20.0 / step)
    trims = rng.normal(0.0, 0.05, int(seconds[-1] / 240.0) + 1)[(seconds / 240.0).astype(int)]
    battpos = battpos + smooth(trims, 4.0 / step)
    ballast = smooth(np.where(climbing, 1.0, -1.0), 30.0 / step)
    if spirals:
        run = (seconds / (3600.0 * hours / 10.0)).astype(int)
        bank = np.radians(rng.uniform(-35.0, 35.0, 10))
        heading = np.cumsum(np.full(n, np.radians(2.2) * step))
        roll = smooth(bank[np.minimum(run, 9)], 10.0 / step)
        battpos = battpos * (0.4 + 0.12 * np.minimum(run, 9))
        ballast = ballast * (1.0 - 0.09 * (np.minimum(run, 9) % 5))
    else:
        course = np.radians(rng.choice([20.0, 110.0, 200.0, 290.0], int(seconds[-1] / 2400.0) + 2))
        course += rng.normal(0.0, 0.15, len(course))
        heading = np.unwrap(course)[(seconds / 2400.0).astype(int)]
        heading = smooth(heading, 40.0 / step)
        roll = np.radians(rng.uniform(-3.0, 3.0)) + np.zeros(n)
    for angle, sigma in ((pitch, 0.6), (roll, 0.8), (heading, 2.0)):
        angle[:] = angle + np.radians(wander(rng, n, step, 20.0, sigma))
    vertical = 0.16 * np.sin(pitch) / np.sin(np.radians(24.0))
    depth = np.maximum(1.0 - np.cumsum(vertical) * step, 0.0)
    speed = 0.35
    north, east = (np.cumsum(speed * f(heading)) * step for f in (np.cos, np.sin))
    latitude = 47.5 + north / METRES_PER_DEGREE
    longitude = -59.0 + east / (METRES_PER_DEGREE * np.cos(np.radians(47.5)))
    temperature = 4.0 + 9.0 / (1.0 + np.exp((depth - 40.0) / 6.0))
    return Track(
        np.asarray(start_s + seconds, float),
        np.stack([roll, pitch, heading], axis=1),
        latitude,
        longitude,
        depth,
        {"battpos": battpos, "ballast": ballast},
        temperature,
    )


def as_log(track: Track, field: FloatArray) -> xr.Dataset:
    """Return the log of a track, with the readings `field` (n, 3), nT, and all telemetry."""
    columns: dict[str, Any] = {
        f"mag_{axis}": ("time", field[:, k], {"units": "nT"}) for k, axis in enumerate("xyz")
    }
    columns |= {name: ("time", values, {"units": "in"}) for name, values in track.masses.items()}
    columns |= {name: ("time", getattr(track, name)) for name in ("latitude", "longitude", "depth")}
    columns["sensor_temperature"] = "time", track.temperature
    return xr.Dataset(columns, coords={"time": track.time})


def calibrate(vehicle: Vehicle, track: Track, noise: FloatArray) -> Calibration:
    """Fit a calibration to ten runs whose true total field is known."""
    field, total = vehicle.field(track, np.zeros(len(track.time)), track.masses)
    log = as_log(track, field + noise).drop_vars(["latitude", "longitude", "depth", "sensor_temperature"])
    run = np.floor(10.0 * np.arange(len(total)) / len(total)).astype(int).astype(str)
    log = log.assign(reference_field=("time", total, {"units": "nT"}), segment=("time", run))
    return fit(observations(log, vehicle.masses)).calibration


# ---- the study ---------------------------------------------------------------------------------------------


def seconds(track: Track) -> FloatArray:
    """Return the time since the middle of the survey (n,), s."""
    return np.asarray(track.time - track.time[len(track.time) // 2])


CHANGES: dict[str, Callable[[Track], np.ndarray]] = {
    "none": lambda track: np.zeros(len(track.time)),
    "offset step of 60 nT": lambda track: 60.0 * (seconds(track) >= 0.0),
    "offset drift": lambda track: 60.0 * np.linspace(0.0, 1.0, len(track.time)),
    "temperature": lambda track: track.temperature - 10.0,
    "current without telemetry": lambda track: 20.0 * (track.time % 600.0 < 120.0),
}
"""Functions that return a hidden field (n,), nT, along a random direction: a step in the middle of the
survey, a drift over all of it, 1 nT/degC, and a pump that is on in two of every ten minutes."""


def run(name: str, seed: int, hours: float) -> list[Row]:
    """Return the row of one vehicle: RMS errors of the fixed and of the in-flight calibration."""
    vehicle, rng = Vehicle(seed), np.random.default_rng([seed, 21])
    runs = glider_track(seed, 5.0, 0.25, spirals=True)
    calibration = calibrate(vehicle, runs, rng.normal(0.0, 1.0, (len(runs.time), 3)))
    track = glider_track(seed, hours, 0.25, start_s=START_S + 3.0 * 86_400.0)
    anomaly = Crust(seed, 7.0, 900.0).at_position(track.metres())
    field, truth = vehicle.field(track, anomaly, track.masses)
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    field = field + np.outer(CHANGES[name](track), direction) + rng.normal(0.0, 1.0, field.shape)
    log = as_log(track, field)
    fixed, learned = (learn(one, calibration, log, age_s=0.0) for one in (None, Learner(calibration)))
    moving = fixed.quality & 0b101 != 0
    late = ~moving & (seconds(track) > 3600.0 if name.startswith("offset step") else True)
    errors = [(one.total - truth)[late] for one in (fixed, learned)]
    row: Row = {"change": name, "vehicle": seed, "fixed": rms(errors[0]), "learned": rms(errors[1])}
    row |= {"ratio": row["learned"] / row["fixed"], "about": float(errors[1].std())}
    return [row | {"standardised": rms(errors[1] / learned.sigma[late]), "alarms": len(learned.alarms)}]


STUDY = Study(
    run,
    ("change", "vehicle"),
    {
        "fixed, nT": Column("fixed"),
        "learned, nT": Column("learned"),
        "about the mean": Column("about"),
        "learned / fixed": Column("ratio", form=".3f"),
        "standardised": Column("standardised"),
        "alarms": Column("alarms", form=".0f"),
    },
)


def cases_of(options: argparse.Namespace) -> list[tuple[str, int, float]]:
    """Return the cases: every change of every vehicle."""
    return [(name, seed, options.hours) for name in options.names for seed in options.vehicles]


if __name__ == "__main__":
    STUDY.main(__doc__, cases_of, CHANGES, vehicles=[1, 2, 3, 4], hours=12.0)
